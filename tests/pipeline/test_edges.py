import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline import cameras, edges, se3
from pipeline.edge_parameters import BETWEEN_RINGS, KIND_NAMES, PAINT, RING_JUMP, EdgeParameters
from pipeline.edges import CELL_COLUMNS, CELL_ROWS, CELLS, find_edges
from pipeline.field_of_view import in_view
from pipeline.ground import Ground, fit_ground
from pipeline.records import CameraModel, PointCloud
from pipeline.ring_edges import rings_are_mixed
from pipeline.rings import scan_pattern
from pipeline.simulation.drive import START_NS
from pipeline.simulation.lidar import sweep

P = EdgeParameters()
STEP, GAP = math.radians(0.2), math.radians(0.5)
ELEVATIONS = np.arange(math.radians(-24), math.radians(6), GAP)
AZIMUTHS = np.arange(-math.pi / 3, math.pi / 3, STEP)
HEIGHT, WALL_M = 1.7, 30.0
K = np.array([[600.0, 0, 479.5], [0, 600, 199.5], [0, 0, 1]])
CAMERA = CameraModel("pinhole", K, np.zeros(0), 960, 400)
T_CAM = se3.transform(se3.AXES_CAM_IN_VEHICLE.T, np.zeros(3))
"""A camera at the LiDAR that looks along its x axis."""


def flat(count, up=1.0):
    return Ground(np.array([0.0, 0.0, up]), HEIGHT, np.ones(count, dtype=bool))


def beams():
    e, a = np.meshgrid(ELEVATIONS, AZIMUTHS, indexing="ij")
    unit = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    return unit.reshape(-1, 3), np.repeat(np.arange(len(ELEVATIONS)), len(AZIMUTHS)).astype(np.uint16)


def cast(boards=(), paint=None):
    """A road, a wall across it, boards (x, y from, y to, z from, z to) before it; ``paint(xyz)`` on all."""
    unit, ring = beams()
    with np.errstate(divide="ignore"):
        road = np.where(unit[:, 2] < 0, -HEIGHT / unit[:, 2], np.inf)
    reach = np.minimum(road, WALL_M / unit[:, 0])
    for x, left, right, low, high in boards:
        at = unit * (x / unit[:, :1])
        hit = (at[:, 1] > left) & (at[:, 1] < right) & (at[:, 2] > low) & (at[:, 2] < high)
        reach = np.where(hit, np.minimum(reach, x / unit[:, 0]), reach)
    xyz = unit * reach[:, None]
    intensity = np.full(len(xyz), 0.2) if paint is None else paint(xyz)
    return PointCloud(xyz.astype(np.float32), intensity.astype(np.float32), ring)


def found_in(cloud, ground=None, T=T_CAM, camera=CAMERA, parameters=P):
    return find_edges(cloud, ground, camera, T, parameters)


def angles(position):
    return (
        np.arctan2(position[:, 1], position[:, 0]),
        np.arctan2(position[:, 2], np.hypot(position[:, 0], position[:, 1])),
    )


BOARD = (10.0, -1.0, 1.0, -1.7, 0.3)


def test_both_sides_of_a_board_to_a_fraction_of_the_step():
    found = found_in(cast([BOARD]))
    assert (found.kind == RING_JUMP).all()
    azimuth, elevation = angles(found.position)
    side = math.atan2(1.0, 10.0)
    # The near point lies up to one step inside the border, the edge 0.45 steps outside the point.
    assert np.abs(np.abs(azimuth) - side).max() < 0.56 * STEP
    assert abs(np.mean(np.abs(azimuth)) - side) < 0.45 * STEP
    assert np.hypot(found.position[:, 0], found.position[:, 1]) == pytest.approx(math.hypot(10, 1), rel=3e-3)
    # Two edges for each ring that meets the board well before the wall, none elsewhere.
    crossing = [e for e in ELEVATIONS if -1.7 < 10 * math.tan(e) * 1.005 < 0.3]
    rings = np.unique(np.round((elevation - ELEVATIONS[0]) / GAP).astype(int))
    assert len(found) == 2 * len(rings)
    assert len(crossing) - 3 <= len(rings) <= len(crossing)
    np.testing.assert_array_equal(found.weight, 1.0)


def test_the_direction_leads_across_the_border():
    found = found_in(cast([BOARD]))
    np.testing.assert_allclose(np.linalg.norm(found.direction, axis=1), 1)
    np.testing.assert_allclose(found.direction[:, 2], 0, atol=1e-12)
    across = found.position.copy()
    across[:, 2] = 0
    off = np.einsum("ni,ni->n", across, found.direction) / np.linalg.norm(across, axis=1)
    assert np.abs(off).max() < 0.5 * STEP


def test_the_top_of_a_board_lies_half_a_gap_above_its_last_ring():
    cloud = cast([BOARD])
    found = found_in(cloud, flat(len(cloud)))
    top = found.position[found.kind == BETWEEN_RINGS]
    azimuth, elevation = angles(top)
    inside = np.abs(azimuth) < math.atan2(1.0, 10.0)
    assert inside.all()
    columns = np.sum(np.abs(AZIMUTHS) < math.atan2(1.0, 10.0))
    assert len(top) == pytest.approx(columns, abs=2)
    border = np.arctan2(0.3, np.hypot(10, 10 * np.tan(azimuth)))
    assert np.abs(elevation - border).max() < 0.51 * GAP
    # The last ring on the board is the same for all columns; the edge is half a gap above it.
    last = math.atan2(0.3, 10) // GAP * GAP
    assert np.abs(np.mod(elevation - ELEVATIONS[0], GAP) / GAP - 0.5).max() < 0.01
    assert np.median(elevation) == pytest.approx(last + 0.5 * GAP, abs=0.6 * GAP)
    direction = found.direction[found.kind == BETWEEN_RINGS]
    np.testing.assert_allclose(np.einsum("ni,ni->n", top, direction), 0, atol=0.06)
    assert (direction[:, 2] > 0.9).all()
    np.testing.assert_array_equal(found.weight[found.kind == BETWEEN_RINGS], 0.5)


def test_an_empty_road_has_no_edges():
    cloud = cast()
    assert len(found_in(cloud, flat(len(cloud)))) == 0


@pytest.mark.parametrize(("depth", "count"), [(0.4, 0), (0.55, 2)])
def test_a_jump_is_half_a_metre_near_by(depth, count):
    x = 5.0
    cloud = cast([(x + depth, -3, 3, -1.7, 2.0), (x, -0.5, 0.5, -1.7, 2.0)])
    found = found_in(cloud)
    azimuth, elevation = angles(found.position)
    middle = np.abs(azimuth) < 0.15
    rings = np.unique(np.round((elevation[middle] - ELEVATIONS[0]) / GAP))
    assert middle.sum() == count * len(rings)
    assert (len(rings) > 0) == (count > 0)


def test_far_away_a_jump_is_a_share_of_the_range():
    for depth, some in ((1.0, False), (1.5, True)):
        found = found_in(cast([(20.0 + depth, -6, 6, -1.7, 3), (20.0, -1, 1, -1.7, 2)]))
        azimuth, _ = angles(found.position)
        assert bool((np.abs(azimuth) < 0.08).any()) == some


def test_what_lies_beyond_a_gap_was_not_seen():
    cloud = cast([BOARD])
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    keep = np.abs(azimuth - math.atan2(1, 10)) > 3 * STEP
    cut = PointCloud(cloud.xyz[keep], cloud.intensity[keep], cloud.ring[keep])
    assert (angles(found_in(cut).position)[0] < 0).all()


def stripes(borders, *, low=0.2, high=0.6, axis=1):
    """Bright ground where coordinate ``axis`` lies between one of the pairs ``borders``."""

    def paint(xyz):
        inside = np.zeros(len(xyz), dtype=bool)
        for a, b in borders:
            inside |= (xyz[:, axis] > a) & (xyz[:, axis] < b)
        return np.where(inside & (xyz[:, 2] < -HEIGHT + 0.01), high, low)

    return paint


@pytest.mark.parametrize("width", [0.15, 0.3, 0.6])
@pytest.mark.parametrize("middle", [1.6, -2.3])
def test_both_borders_of_a_painted_line(width, middle):
    borders = (middle - width / 2, middle + width / 2)
    cloud = cast(paint=stripes([borders]))
    found = found_in(cloud, flat(len(cloud)))
    paint = found.position[found.kind == PAINT]
    assert len(paint) == len(found) > 8
    reach = np.hypot(paint[:, 0], paint[:, 1])
    off = np.abs(paint[:, 1, None] - np.array(borders)).min(axis=1)
    # The border lies between two neighbouring points, and the edge in their middle.
    assert (off < 0.5 * STEP * reach + 1e-3).all()
    for border in borders:
        assert np.sum(np.abs(paint[:, 1] - border) < 0.06) == len(paint) / 2
    np.testing.assert_allclose(paint[:, 2], -HEIGHT, atol=1e-5)
    assert reach.max() < 35


@pytest.mark.parametrize(
    "paint",
    [
        stripes([(1.0, 2.2)]),  # wider than any line
        stripes([(1.0, 1.15)], high=0.26),  # worn away
        stripes([(1.0, 9.0)]),  # a pavement
    ],
)
def test_what_is_no_line(paint):
    cloud = cast(paint=paint)
    found = found_in(cloud, flat(len(cloud)))
    assert np.sum(found.kind == PAINT) <= 2


def test_a_thread_is_no_line_where_points_lie_close_enough_to_tell():
    cloud = cast(paint=stripes([(1.0, 1.02)]))
    found = found_in(cloud, flat(len(cloud)))
    reach = np.linalg.norm(found.position[found.kind == PAINT], axis=1)
    assert (2 * STEP * reach > P.strip_narrowest_m - 0.02).all()


def test_a_kerb_is_a_step_and_no_strip():
    def kerb(xyz):
        base = np.where(xyz[:, 1] > 1.0, 0.45, 0.2)
        return np.where((xyz[:, 1] > 1.0) & (xyz[:, 1] < 1.15), 0.6, base)

    cloud = cast(paint=kerb)
    assert not (found_in(cloud, flat(len(cloud))).kind == PAINT).any()


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_counts_on_a_dark_road_are_no_paint(share):
    rng = np.random.default_rng(3)
    found = found_in(cast(paint=lambda xyz: rng.poisson(share, len(xyz)) / 255.0), flat(1))
    assert not (found.kind == PAINT).any()


def test_bright_paint_on_a_road_that_reads_nothing_is_paint():
    white, rng = stripes([(-2.0, -1.8), (1.0, 1.2)]), np.random.default_rng(4)

    def read(xyz):
        return rng.poisson(np.where(white(xyz) > 0.5, 60.0, 0.2)) / 255.0

    found = found_in(cast(paint=read), flat(1))
    paint = found.position[found.kind == PAINT]
    assert len(paint) > 20
    assert np.abs(paint[:, 1:2] - [-2.0, -1.8, 1.0, 1.2]).min(axis=1).max() < 0.15


def test_paint_is_on_the_ground():
    cloud = cast([(8.0, -3, 3, -1.2, 1)], paint=lambda xyz: np.where(np.abs(xyz[:, 1] - 1) < 0.1, 0.6, 0.2))
    found = found_in(cloud, flat(len(cloud)))
    heights = found.position[found.kind == PAINT][:, 2] + HEIGHT
    assert len(heights) > 0
    assert np.abs(heights).max() < 0.15


@settings(max_examples=10, deadline=None)
@given(st.floats(0.01, 1.0))
def test_paint_knows_no_unit_of_intensity(gain):
    cloud = cast([BOARD], paint=stripes([(2.0, 2.2)]))
    dimmed = dataclasses.replace(cloud, intensity=(gain * cloud.intensity).astype(np.float32))
    a, b = (found_in(c, flat(len(c))) for c in (cloud, dimmed))
    np.testing.assert_allclose(a.position, b.position, atol=1e-4)


def test_without_intensity_there_is_no_paint_and_without_ground_only_jumps():
    cloud = cast([BOARD], paint=stripes([(2.0, 2.2)]))
    dark = dataclasses.replace(cloud, intensity=None)
    assert set(found_in(cloud, flat(len(cloud))).kind.tolist()) == {RING_JUMP, BETWEEN_RINGS, PAINT}
    assert set(found_in(dark, flat(len(cloud))).kind.tolist()) == {RING_JUMP, BETWEEN_RINGS}
    assert set(found_in(cloud).kind.tolist()) == {RING_JUMP}


def by_place(found):
    order = np.lexsort([*np.round(found.position, 3).T, found.kind])
    return found.position[order], found.direction[order], found.kind[order], found.cell[order]


def same(a, b, T=None):
    pa, da, ka, ca = by_place(a)
    T_back = np.eye(4) if T is None else se3.inverse(T)
    moved = dataclasses.replace(
        b, position=se3.apply(T_back, b.position), direction=b.direction @ T_back[:3, :3].T
    )
    pb, db, kb, cb = by_place(moved)
    np.testing.assert_array_equal(ka, kb)
    np.testing.assert_allclose(pa, pb, atol=2e-4)
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", da, db)), 1, atol=1e-4)
    assert np.mean(ca == cb) > 0.99  # an edge on the border of two cells may fall into either


@pytest.fixture(scope="module")
def scene():
    return cast([BOARD, (15.0, 3.0, 3.4, -1.7, 1.5)], paint=stripes([(-2.0, -1.8), (5.0, 5.3)]))


def test_the_order_of_points_does_not_matter_where_rings_are_named(scene):
    order = np.random.default_rng(2).permutation(len(scene))
    shuffled = PointCloud(scene.xyz[order], scene.intensity[order], scene.ring[order])
    same(found_in(scene, flat(len(scene))), found_in(shuffled, flat(len(scene))))


@pytest.mark.parametrize("degrees", [90, -90, 180, 37])
def test_a_lidar_that_is_turned_about_its_axis_sees_the_same_edges(scene, degrees):
    T = se3.transform(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), np.zeros(3))
    turned = dataclasses.replace(scene, xyz=se3.apply(T, scene.xyz).astype(np.float32))
    other = found_in(turned, flat(len(scene)), T_CAM @ se3.inverse(T))
    same(found_in(scene, flat(len(scene))), other, T)


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("degrees", [90, -90])
@pytest.mark.parametrize("named", [True, False])
def test_axes_of_the_message_are_named_as_it_likes(scene, axis, degrees, named):
    R = np.round(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())
    T = se3.transform(R, np.zeros(3))
    # Without numbers rings are told by their elevations, from points in firing order.
    order = np.lexsort((scene.ring, np.arctan2(scene.xyz[:, 1], scene.xyz[:, 0])))
    plain = PointCloud(scene.xyz[order], scene.intensity[order], scene.ring[order] if named else None)
    turned = dataclasses.replace(plain, xyz=se3.apply(T, plain.xyz).astype(np.float32))
    ground = Ground(R @ [0.0, 0.0, 1.0], HEIGHT, np.ones(len(scene), dtype=bool))
    a, b = found_in(plain, flat(len(scene))), found_in(turned, ground, T_CAM @ se3.inverse(T))
    assert len(a) > 200
    same(a, b, T)


def test_a_lidar_that_hangs_upside_down_sees_the_same_edges(scene):
    T = se3.transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    hanging = dataclasses.replace(scene, xyz=se3.apply(T, scene.xyz).astype(np.float32))
    other = found_in(hanging, flat(len(scene), up=-1.0), T_CAM @ se3.inverse(T))
    a = found_in(scene, flat(len(scene)))
    same(a, other, T)


def test_a_file_without_ring_numbers_gives_nearly_the_same_edges(street):
    p = street.cloud
    azimuth = np.arctan2(p.xyz[:, 1], p.xyz[:, 0])
    order = np.lexsort((np.mod(azimuth - 2.5, 2 * math.pi), -p.ring.astype(int)))
    bare = PointCloud(p.xyz[order], p.intensity[order])
    T = street.T_cam_lidar
    camera = CameraModel("pinhole", K, np.zeros(0), 960, 304)
    a, b = (found_in(c, None, T, camera) for c in (p, bare))
    assert len(a) > 200
    places = {tuple(row) for row in np.round(a.position, 3).tolist()}
    assert np.mean([tuple(row) in places for row in np.round(b.position, 3).tolist()]) > 0.98
    assert len(b) > 0.98 * len(a)


def test_edges_fall_into_the_image_or_just_beside_it(street):
    small = CameraModel("pinhole", np.array([[600.0, 0, 80], [0, 600, 60], [0, 0, 1]]), np.zeros(0), 160, 120)
    found = found_in(street.cloud, None, street.T_cam_lidar, small)
    uv, valid = cameras.project_unbounded(small, se3.apply(street.T_cam_lidar, found.position))
    assert valid.all()
    assert len(found) > 20
    assert uv.min() > -P.margin_px
    assert (uv < np.array([160, 120]) + P.margin_px).all()
    column = np.clip(uv[:, 0] / 160 * CELL_COLUMNS, 0, CELL_COLUMNS - 1).astype(int)
    row = np.clip(uv[:, 1] / 120 * CELL_ROWS, 0, CELL_ROWS - 1).astype(int)
    np.testing.assert_array_equal(found.cell, row * CELL_COLUMNS + column)
    assert found.cell.max() < CELLS
    assert (np.abs(uv[:, 0] - 80) > 80).any(), "some lie in the margin"


@pytest.mark.parametrize(
    ("model", "D"),
    [("plumb_bob", [-0.3, 0.1, 0, 0, 0]), ("equidistant", [0.01, 0, 0, 0]), ("pinhole", [])],
)
def test_nothing_of_the_view_is_lost_to_the_field_of_view(street, model, D):
    camera = CameraModel(
        model, np.array([[400.0, 0, 480], [0, 400, 200], [0, 0, 1]]), np.array(D, float), 960, 400
    )
    mask = in_view(street.cloud, camera, street.T_cam_lidar)
    _, inside = cameras.project(camera, se3.apply(street.T_cam_lidar, street.cloud.xyz))
    assert not (inside & ~mask).any()
    assert mask.sum() < 0.75 * len(street.cloud)


def test_rings_of_two_sensors_under_the_same_numbers_are_not_gone_along(drive, street):
    shift = se3.transform(np.eye(3), np.array([0.0, -1.2, 0.1]))
    start = (street.cloud_stamp_ns - START_NS) / 1e9
    lidar = drive.parameters.lidar
    beside = sweep(
        drive.scene, lidar, lambda t: drive.T_world_lidar(t) @ shift, start, np.random.default_rng(7)
    )
    cloud = street.cloud
    xyz = np.concatenate([cloud.xyz, beside.xyz + shift[:3, 3].astype(np.float32)])
    two = PointCloud(xyz, ring=np.concatenate([cloud.ring, beside.ring]))
    for seen, mixed in ((cloud, False), (beside, False), (two, True)):
        assert rings_are_mixed(scan_pattern(seen, np.ones(len(seen), dtype=bool)), P) == mixed
    plane = fit_ground(cloud, np.array([0.0, 0.0, 1.0]), np.random.default_rng(0))
    T, camera = street.T_cam_lidar, drive.parameters.camera
    named, unnamed = (find_edges(c, plane, camera, T, P) for c in (two, PointCloud(xyz)))
    np.testing.assert_array_equal(named.position, unnamed.position)
    assert len(named) > 300


def test_no_rings_no_answer_and_no_view_no_answer(street):
    rng = np.random.default_rng(1)
    soup = PointCloud(rng.normal(size=(3000, 3)).astype(np.float32) * 20)
    assert found_in(soup, flat(3000)) is None
    behind = dataclasses.replace(street.cloud, xyz=np.abs(street.cloud.xyz) * np.float32([-1, 1, 1]))
    assert found_in(behind) is None
    assert found_in(PointCloud(np.zeros((0, 3), np.float32))) is None


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 300), st.integers(1, 12), st.integers(1, 200))
def test_thinning_is_the_highest_common_cap(seed, count, groups, most):
    rng = np.random.default_rng(seed)
    group = np.minimum(rng.geometric(0.3, count) - 1, groups - 1) * 3
    kept = edges._capped(group, most)  # noqa: SLF001
    if count <= most:
        np.testing.assert_array_equal(kept, np.arange(count))
        return
    sizes = {g: int(np.sum(group == g)) for g in set(group.tolist())}
    fitting = [cap for cap in range(1, count + 1) if sum(min(n, cap) for n in sizes.values()) <= most]
    cap = max(fitting, default=1)
    assert (np.diff(kept) > 0).all()
    for g, size in sizes.items():
        members = np.flatnonzero(group == g)
        rank = np.searchsorted(members, kept[group[kept] == g])
        assert len(rank) == min(size, cap)
        # Evenly spread: no stretch of the group is left out for longer than its share.
        if size > cap:
            assert np.diff([-1, *rank, size]).max() <= math.ceil(size / cap) + 1


def test_a_frame_gives_at_most_so_many(street):
    few = dataclasses.replace(P, most=200)
    camera = CameraModel("pinhole", K, np.zeros(0), 960, 304)
    all_of_them = found_in(street.cloud, None, street.T_cam_lidar, camera)
    found = found_in(street.cloud, None, street.T_cam_lidar, camera, few)
    assert 150 < len(found) <= 200 < len(all_of_them)
    assert set(found.cell.tolist()) == set(all_of_them.cell.tolist())


def test_kinds_have_names_and_edges_are_read_only():
    assert [KIND_NAMES[k] for k in (RING_JUMP, BETWEEN_RINGS, PAINT)] == [
        "ring_jump",
        "between_rings",
        "paint",
    ]
    found = found_in(cast([BOARD]))
    for name in ("position", "direction", "kind", "weight", "cell"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(found, name)[0] = 0
