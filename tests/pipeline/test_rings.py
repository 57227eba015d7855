import dataclasses
import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline import rings, se3
from pipeline.records import PointCloud
from pipeline.rings import scan_pattern
from pipeline.simulation.lidar import spinning, sweep

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[3] / "shared" / "data"))
TURN = 2.0 * math.pi


def azimuth_of(cloud):
    return np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0]).astype(np.float64)


def taken(cloud, index, *, ring=False):
    """Points of a cloud in a given order, without times, and without rings unless asked for."""
    return PointCloud(cloud.xyz[index], cloud.intensity[index], cloud.ring[index] if ring else None)


def ring_after_ring(cloud, seam, *, sense=1, downwards=True):
    """Order of the points in which files hold whole rings, each begun at azimuth ``seam``."""
    ring = cloud.ring.astype(int)
    return np.lexsort((np.mod(sense * (azimuth_of(cloud) - seam), TURN), -ring if downwards else ring))


def pattern(cloud, keep=None):
    return scan_pattern(cloud, np.ones(len(cloud), dtype=bool) if keep is None else keep)


def same_rings(found, true):
    """Share of the ordered points whose found ring means one true ring and the other way round."""
    pairs, counts = np.unique(np.column_stack([found, true]), axis=0, return_counts=True)
    best = {}
    for (ring, name), count in zip(pairs.tolist(), counts.tolist(), strict=True):
        if count > best.get(ring, (0, None))[0]:
            best[ring] = (count, name)
    names = [name for _, name in best.values()]
    assert len(set(names)) == len(names), "one ring was split"
    return sum(count for count, _ in best.values()) / len(found)


@pytest.fixture(scope="module")
def cloud(street):
    return street.cloud


def test_with_a_ring_field_the_order_is_by_definition(cloud):
    found = pattern(cloud)
    assert sorted(found.index.tolist()) == list(range(len(cloud)))
    np.testing.assert_array_equal(found.ring, cloud.ring[found.index])  # the simulator counts from below
    xyz = cloud.xyz[found.index].astype(float)
    np.testing.assert_allclose(found.distance, np.linalg.norm(xyz, axis=1), rtol=1e-6)
    np.testing.assert_allclose(np.sin(found.elevation), xyz[:, 2] / found.distance, atol=1e-6)
    true = np.arctan2(xyz[:, 1], xyz[:, 0])
    shift = np.mod(found.azimuth - true, TURN)
    np.testing.assert_allclose(np.exp(1j * shift), np.exp(1j * shift[0]), atol=1e-6)
    assert (np.diff(found.ring) >= 0).all()
    assert (np.diff(found.azimuth)[np.diff(found.ring) == 0] >= 0).all()
    assert found.azimuth_step == pytest.approx(TURN / 1800, rel=1e-3)
    elevations = np.radians(np.concatenate([np.linspace(-24.9, -8.87, 32), np.linspace(-8.33, 2.0, 32)]))
    assert found.ring_spacing == pytest.approx(np.median(np.diff(elevations)), rel=1e-3)


@pytest.mark.parametrize("names", ["reversed", "interleaved"])
def test_rank_is_by_elevation_whatever_the_sensor_calls_its_rings(cloud, names):
    table = {"reversed": np.arange(64)[::-1], "interleaved": np.argsort(np.arange(64) * 29 % 64) + 100}[names]
    renamed = dataclasses.replace(cloud, ring=table[cloud.ring].astype(np.uint16))
    a, b = pattern(cloud), pattern(renamed)
    np.testing.assert_array_equal(a.index, b.index)
    np.testing.assert_array_equal(a.ring, b.ring)


def test_a_ring_field_makes_the_order_of_points_irrelevant(cloud):
    order = np.random.default_rng(1).permutation(len(cloud))
    a, b = pattern(cloud), pattern(taken(cloud, order, ring=True))
    np.testing.assert_array_equal(a.index, order[b.index])
    np.testing.assert_array_equal(a.ring, b.ring)


@pytest.mark.parametrize("degrees", [90, -90, 173])
def test_a_sensor_turned_about_its_axis_has_the_same_pattern(cloud, degrees):
    T = se3.transform(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), np.zeros(3))
    keep = np.abs(azimuth_of(cloud)) < 0.8
    turned = dataclasses.replace(cloud, xyz=se3.apply(T, cloud.xyz).astype(np.float32))
    a, b = pattern(cloud, keep), pattern(turned, keep)
    np.testing.assert_array_equal(a.index, b.index)
    np.testing.assert_allclose(a.azimuth, b.azimuth, atol=1e-5)
    assert a.azimuth_step == pytest.approx(b.azimuth_step, rel=1e-3)


@settings(max_examples=8, deadline=None)
@given(st.floats(-math.pi, math.pi), st.sampled_from([1, -1]), st.booleans())
def test_rings_from_the_order_of_a_file(street, seam, sense, downwards):
    cloud = street.cloud
    order = ring_after_ring(cloud, seam, sense=sense, downwards=downwards)
    bare = taken(cloud, order)
    found = pattern(bare)
    assert same_rings(found.ring, cloud.ring[order][found.index]) > 0.999
    assert int(found.ring.max()) == 63
    # What is left out lies at the seam, two steps to each side of it.
    out = np.setdiff1d(np.arange(len(bare)), found.index)
    assert len(out) < 0.005 * len(bare)
    # Lowest ring first, whichever way the file goes.
    np.testing.assert_array_equal(np.unique(found.ring), np.arange(64))
    low, high = found.elevation[found.ring == 0], found.elevation[found.ring == 63]
    assert np.median(low) < np.median(high)


@pytest.mark.parametrize("seam_deg", [0, 20, 90, 180])
@pytest.mark.parametrize("half_deg", [35, 60, 120])
def test_a_sweep_cut_to_what_the_camera_sees_keeps_its_rings(cloud, seam_deg, half_deg):
    order = ring_after_ring(cloud, math.radians(seam_deg))
    order = order[np.abs(azimuth_of(cloud)[order]) < math.radians(half_deg)]
    found = pattern(taken(cloud, order))
    assert same_rings(found.ring, cloud.ring[order][found.index]) > 0.999
    assert len(np.unique(found.ring)) == 64


def test_only_what_is_kept_is_ordered(cloud):
    keep = np.abs(azimuth_of(cloud)) < 0.5
    order = ring_after_ring(cloud, 2.0)
    found = pattern(taken(cloud, order), keep[order])
    assert keep[order][found.index].all()
    assert len(found.index) == keep.sum()


@pytest.mark.parametrize("lasers", [16, 32, 64, 128])
@pytest.mark.parametrize("order", ["columns", "shuffled"])
def test_rings_from_elevations_alone(drive, lasers, order):
    rng = np.random.default_rng(lasers)
    cloud = sweep(drive.scene, spinning(lasers, 600), drive.T_world_lidar, 0.3, rng)
    index = np.arange(len(cloud)) if order == "columns" else rng.permutation(len(cloud))
    found = pattern(taken(cloud, index))
    true = cloud.ring[index][found.index].astype(int)
    np.testing.assert_array_equal(found.ring, np.unique(true, return_inverse=True)[1])
    assert found.azimuth_step == pytest.approx(TURN / 600, rel=1e-2)


@pytest.mark.parametrize("lasers", [16, 32])
def test_few_lasers_ring_after_ring(drive, lasers):
    rng = np.random.default_rng(lasers)
    cloud = sweep(drive.scene, spinning(lasers, 900), drive.T_world_lidar, 0.3, rng)
    order = ring_after_ring(cloud, 1.0)
    found = pattern(taken(cloud, order))
    assert same_rings(found.ring, cloud.ring[order][found.index]) > 0.985


@pytest.mark.parametrize("count", [5, 60, 300, 1000, 2000, 5000, 20_000, 60_000])
@pytest.mark.parametrize("kind", ["gauss", "window", "street"])
def test_points_in_no_order_have_no_rings(cloud, count, kind):
    rng = np.random.default_rng(count)
    if kind == "gauss":
        xyz = rng.normal(size=(count, 3)) * [10, 10, 2]
    elif kind == "window":
        xyz = rng.uniform(3, 50, (count, 1)) * np.column_stack(
            [np.ones(count), rng.uniform(-0.6, 0.6, count), rng.uniform(-0.2, 0.2, count)]
        )
    else:
        # A real street seen from somewhere else: merged clouds, whose origin is no sensor.
        xyz = cloud.xyz[rng.choice(len(cloud), count, replace=False)] + [0.7, -0.4, 0.6]
    assert pattern(PointCloud(xyz.astype(np.float32))) is None


@pytest.mark.parametrize("field", [True, False])
def test_one_ring_is_no_pattern(cloud, field):
    index = np.flatnonzero(cloud.ring == 40)
    assert pattern(taken(cloud, index, ring=field)) is None


def test_few_points(cloud):
    for count in range(6):
        for field in (True, False):
            assert pattern(taken(cloud, np.arange(count), ring=field)) is None
    assert pattern(cloud, np.zeros(len(cloud), dtype=bool)) is None


def test_one_point_a_ring_has_no_step(cloud):
    _, index = np.unique(cloud.ring, return_index=True)
    assert pattern(taken(cloud, index, ring=True)) is None


@settings(max_examples=150, deadline=None)
@given(
    st.integers(0, 10_000),
    st.integers(0, 40),
    st.sampled_from([1.0, 0.0, 1e-3, 1e4]),
    st.sampled_from([None, 1, 3, 60]),
    st.booleans(),
)
def test_any_cloud_gives_a_pattern_or_none(seed, count, spread, lasers, repeated):
    rng = np.random.default_rng(seed)
    xyz = (spread * rng.normal(size=(count, 3))).astype(np.float32)
    if repeated and count:
        xyz = xyz[rng.integers(0, count, 10 * count)]
    ring = None if lasers is None else rng.integers(0, lasers, len(xyz)).astype(np.uint16)
    found = pattern(PointCloud(xyz, ring=ring))
    if found is not None:
        assert found.azimuth_step > 0
        assert found.ring_spacing >= 0
        assert np.isfinite(found.azimuth).all()


def test_a_field_of_zeros_is_no_ring_field(cloud):
    order = ring_after_ring(cloud, 1.0)
    zeros = PointCloud(cloud.xyz[order], ring=np.zeros(len(cloud), np.uint16))
    assert int(pattern(zeros).ring.max()) == 63


def kitti():
    return sorted(DATA.glob("kitti*/**/*.bin"))[::9]


@pytest.mark.recordings
@pytest.mark.skipif(not kitti(), reason="no KITTI sweeps in the recordings folder")
def test_kitti_sweeps_have_64_rings_of_their_order():
    for path in kitti():
        xyz = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]
        ring = rings.ring_numbers(PointCloud(np.ascontiguousarray(xyz[xyz.any(axis=1)])))
        assert len(np.unique(ring[ring >= 0])) == 64, path.name


@pytest.mark.recordings
@pytest.mark.parametrize(
    "name", ["opencalib_crlf", "opencalib_st1", "opencalib_st2", "rellis_os1", "nuscenes_mmdet3d"]
)
def test_elevations_tell_the_rings_that_the_file_names_or_nothing(name):
    path = DATA / name / "cloud.npz"
    if not path.exists():
        pytest.skip(f"{path} is absent")
    with np.load(path) as stored:
        cloud = PointCloud(stored["xyz"], ring=stored["ring"].astype(np.uint16))
    found = pattern(PointCloud(cloud.xyz))
    if name == "nuscenes_mmdet3d":  # its motion was taken out, which bends every ring
        assert found is None
        return
    assert same_rings(found.ring, cloud.ring[found.index]) > 0.99
