import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import se3
from pipeline.cloud_lanes import find_lanes
from pipeline.cloud_poles import find_poles
from pipeline.ground import fit_ground
from pipeline.records import PointCloud

_spec = importlib.util.spec_from_file_location(
    "line_scenes", Path(__file__).parents[1] / "oracles" / "line_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)


def found(cloud, rng, up=scenes.UP):
    ground = fit_ground(cloud, up, rng)
    seen = np.ones(len(cloud), dtype=bool)
    return find_lanes(cloud, ground, seen, rng), find_poles(cloud, ground, seen)


def off_axis(line, start, end):
    """Largest distance of the line's ends from the true line, m."""
    along = (end - start) / np.linalg.norm(end - start)
    offsets = np.stack([line.start, line.end]) - start
    return np.linalg.norm(offsets - (offsets @ along)[:, None] * along, axis=1).max()


def partner(line, truth):
    return min(truth, key=lambda ends: off_axis(line, *ends))


@pytest.mark.parametrize("dash", [None, (3.0, 6.0)])
def test_painted_lines_and_poles_are_found_where_they_are(dash):
    rng = np.random.default_rng(0)
    lanes, poles = found(scenes.sampled_cloud(rng, dash=dash), rng)
    assert len(lanes) == 4
    assert len({partner(line, scenes.lane_ends())[0][1] for line in lanes}) == 4
    for line in lanes:
        assert off_axis(line, *partner(line, scenes.lane_ends())) < 0.06
        assert line.sigma_m < 0.08
    assert len(poles) == 4
    for line in poles:
        start, end = partner(line, scenes.pole_ends())
        assert off_axis(line, start, end) < 0.09
        assert (line.end - line.start) @ scenes.UP > 1.0


def test_poles_are_moved_from_their_front_to_their_axis():
    rng = np.random.default_rng(1)
    radius = 0.15
    cloud = scenes.sampled_cloud(rng, poles=[(10.0, 5.0), (12.0, -6.0)], radius=radius, noise=0.005)
    _, poles = found(cloud, rng)
    assert len(poles) == 2
    for line in poles:
        (x, y) = min([(10.0, 5.0), (12.0, -6.0)], key=lambda p: abs(p[1] - line.start[1]))
        sight = np.array([x, y]) / np.hypot(x, y)
        # Uncorrected the axis would stand pi/4 of the radius, 0.12 m, too near.
        assert abs((line.start[:2] - [x, y]) @ sight) < 0.03


def test_stated_noise_is_that_of_the_points():
    rng = np.random.default_rng(2)
    cloud = scenes.sampled_cloud(rng)
    for line in [line for lines in found(cloud, rng) for line in lines]:
        xyz = cloud.xyz[line.points].astype(float)
        along = (line.end - line.start) / np.linalg.norm(line.end - line.start)
        offset = xyz - xyz.mean(axis=0)
        across = offset - (offset @ along)[:, None] * along
        assert line.sigma_m == pytest.approx(math.sqrt((across**2).sum() / (2 * len(xyz) - 4)), rel=0.2)
        assert line.spread == pytest.approx(((offset @ along) ** 2).sum(), rel=1e-3)
        assert line.mean_m == pytest.approx((xyz.mean(axis=0) - line.start) @ along, abs=0.02)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000))
def test_turning_the_lidar_turns_the_lines(seed):
    rng = np.random.default_rng(seed)
    turn = se3.exp_so3(rng.normal(size=3) * 2)
    cloud = scenes.sampled_cloud(np.random.default_rng(3), turn=turn)
    lanes, poles = found(cloud, rng, turn @ scenes.UP)
    assert len(lanes) == 4
    assert len(poles) == 4
    for line in lanes:
        ends = [(turn @ a, turn @ b) for a, b in scenes.lane_ends()]
        assert off_axis(line, *partner(line, ends)) < 0.06


def test_points_out_of_view_take_no_part():
    rng = np.random.default_rng(4)
    cloud = scenes.sampled_cloud(rng)
    ground = fit_ground(cloud, scenes.UP, rng)
    left = cloud.xyz[:, 1] > 0
    for line in find_lanes(cloud, ground, left, rng) + find_poles(cloud, ground, left):
        assert left[line.points].all()


def test_no_intensity_no_lanes():
    rng = np.random.default_rng(5)
    lanes, poles = found(PointCloud(scenes.sampled_cloud(rng).xyz), rng)
    assert lanes == []
    assert len(poles) == 4


def test_bare_road_has_no_lines():
    rng = np.random.default_rng(6)
    assert found(scenes.sampled_cloud(rng, lanes=[], poles=[]), rng) == ([], [])


def test_a_bright_patch_is_no_lane_line():
    rng = np.random.default_rng(7)
    cloud = scenes.sampled_cloud(rng, lanes=[], poles=[])
    x, y = cloud.xyz[:, 0], cloud.xyz[:, 1]
    intensity = np.where((y > 2.0) & (y < 6.0) & (x > 5), 0.6, cloud.intensity).astype(np.float32)
    lanes, _ = found(PointCloud(cloud.xyz, intensity), rng)
    assert lanes == []


@pytest.mark.parametrize("thing", ["wall", "car", "leaning", "hedge row"])
def test_upright_things_that_are_no_poles(thing):
    rng = np.random.default_rng(8)
    cloud = scenes.sampled_cloud(rng, poles=[])
    n = 3000
    z = rng.uniform(-1.7, 1.5, n)
    shapes = {
        "wall": np.column_stack([rng.uniform(8, 20, n), np.full(n, 6.0), z]),
        "car": np.column_stack([rng.uniform(10, 14, n), rng.uniform(4, 5.8, n), z]),
        "leaning": np.column_stack([12.0 + 0.3 * z, np.full(n, 4.0), z]),
        "hedge row": np.column_stack([rng.uniform(9, 10.5, n), rng.uniform(4, 4.4, n), z]),
    }
    xyz = np.concatenate([cloud.xyz, shapes[thing].astype(np.float32)])
    _, poles = found(PointCloud(xyz), rng)
    assert poles == []
