import importlib.util
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import se3
from pipeline.cloud_lanes import find_lanes
from pipeline.ground import fit_ground
from pipeline.records import PointCloud

_spec = importlib.util.spec_from_file_location(
    "line_scenes", Path(__file__).parents[1] / "oracles" / "line_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)


def found(cloud, rng, up=scenes.UP):
    return find_lanes(cloud, fit_ground(cloud, up, rng), np.ones(len(cloud), dtype=bool), rng)


def off_axis(line, start, end):
    """Largest distance of the line's ends from the true line, m."""
    along = (end - start) / np.linalg.norm(end - start)
    offsets = np.stack([line.start, line.end]) - start
    return np.linalg.norm(offsets - (offsets @ along)[:, None] * along, axis=1).max()


def partner(line, truth):
    return min(truth, key=lambda ends: off_axis(line, *ends))


@pytest.mark.parametrize("dash", [None, (3.0, 6.0)])
def test_painted_lines_are_found_where_they_are(dash):
    rng = np.random.default_rng(0)
    lanes = found(scenes.sampled_cloud(rng, dash=dash), rng)
    assert len(lanes) == 4
    assert len({partner(line, scenes.lane_ends())[0][1] for line in lanes}) == 4
    for line in lanes:
        assert off_axis(line, *partner(line, scenes.lane_ends())) < 0.06
        assert line.sigma_m < 0.05


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 10_000))
def test_turning_the_lidar_turns_the_lines(seed):
    rng = np.random.default_rng(seed)
    turn = se3.exp_so3(rng.normal(size=3) * 2)
    lanes = found(scenes.sampled_cloud(np.random.default_rng(3), turn=turn), rng, turn @ scenes.UP)
    assert len(lanes) == 4
    for line in lanes:
        ends = [(turn @ a, turn @ b) for a, b in scenes.lane_ends()]
        assert off_axis(line, *partner(line, ends)) < 0.08


@pytest.mark.parametrize("numbered", [True, False])
def test_a_cloud_told_in_the_vehicles_frame_shows_the_same_lanes(numbered):
    cloud = weak(scenes.sampled_cloud(np.random.default_rng(10), noise=0.005), 10, noise=0.4, gain=0.25)
    shift = np.array([-3.0, 0.7, 1.9])
    ring = cloud.ring if numbered else None
    cloud = PointCloud(cloud.xyz, cloud.intensity, ring)
    moved = PointCloud((cloud.xyz + shift).astype(np.float32), cloud.intensity, ring)
    every = np.ones(len(cloud), dtype=bool)
    here = find_lanes(
        cloud, fit_ground(cloud, scenes.UP, np.random.default_rng(1)), every, np.random.default_rng(2)
    )
    ground = fit_ground(moved, scenes.UP, np.random.default_rng(1))
    there = find_lanes(moved, ground, every, np.random.default_rng(2), origin=shift)
    assert len(here) == len(there) >= 3
    for line in here:
        near = min(there, key=lambda other: np.abs(other.start - line.start - shift).max())
        assert np.abs(near.start - line.start - shift).max() < 0.1
        assert np.abs(near.end - line.end - shift).max() < 0.1
    # About the frame's own origin tracks are no longer those of beams, unless rings are numbered.
    assert numbered or len(find_lanes(moved, ground, every, np.random.default_rng(2))) < len(here)


def test_points_out_of_view_take_no_part():
    rng = np.random.default_rng(4)
    cloud = scenes.sampled_cloud(rng)
    left = cloud.xyz[:, 1] > 0
    lanes = find_lanes(cloud, fit_ground(cloud, scenes.UP, rng), left, rng)
    assert len(lanes) == 2
    assert all(left[line.points].all() for line in lanes)


def test_no_intensity_no_lanes():
    rng = np.random.default_rng(5)
    assert found(PointCloud(scenes.sampled_cloud(rng).xyz), rng) == []


@pytest.mark.parametrize("seed", range(4))
def test_bare_road_has_no_lanes(seed):
    rng = np.random.default_rng(seed)
    assert found(scenes.sampled_cloud(rng, lanes=[]), rng) == []


def test_scale_and_offset_of_intensity_do_not_matter():
    cloud = scenes.sampled_cloud(np.random.default_rng(6))
    dimmer = PointCloud(cloud.xyz, (0.2 * cloud.intensity + 0.1).astype(np.float32))
    first, second = (found(one, np.random.default_rng(7)) for one in (cloud, dimmer))
    assert [line.points.tolist() for line in first] == [line.points.tolist() for line in second]


@pytest.mark.parametrize("middle", [22.0, 23.0, 24.0])
def test_one_laser_that_reads_bright_paints_no_line(middle):
    """A ring is straight within a stroke's width over five metres of a far arc."""
    rng = np.random.default_rng(8)
    cloud = scenes.sampled_cloud(rng, lanes=[], poles=[], rings_deg=0.1)
    reach = np.hypot(cloud.xyz[:, 0], cloud.xyz[:, 1])
    intensity = np.where(np.abs(reach - middle) < 0.2, 0.6, cloud.intensity).astype(np.float32)
    assert found(PointCloud(cloud.xyz, intensity), rng) == []


@pytest.mark.xfail(strict=True, reason="a beam's track runs along such a line and has no flanks across it")
def test_a_stop_line_across_the_road_is_found():
    rng = np.random.default_rng(9)
    cloud = scenes.sampled_cloud(rng, lanes=[], poles=[], rings_deg=0.2)
    x, y = cloud.xyz[:, 0], cloud.xyz[:, 1]
    on = (np.abs(x - 11.0) < 0.15) & (np.abs(y) < 6.0)
    (line,) = found(PointCloud(cloud.xyz, np.where(on, 0.6, cloud.intensity).astype(np.float32)), rng)
    assert off_axis(line, np.array([11.0, -6, -1.73]), np.array([11.0, 6, -1.73])) < 0.15


@pytest.mark.parametrize("slant_deg", [0.0, 30.0, 45.0])
def test_lines_aslant_to_the_view_are_found(slant_deg):
    rng = np.random.default_rng(9)
    cloud = scenes.sampled_cloud(rng, lanes=[], poles=[], rings_deg=0.2)
    way = np.array([np.cos(np.radians(slant_deg)), np.sin(np.radians(slant_deg))])
    offset = cloud.xyz[:, :2].astype(np.float64) - [11.0, 0.0]
    on = (np.abs(offset @ [-way[1], way[0]]) < 0.1) & (np.abs(offset @ way) < 5.0)
    (line,) = found(PointCloud(cloud.xyz, np.where(on, 0.6, cloud.intensity).astype(np.float32)), rng)
    ends = np.array([11.0, 0.0, -1.73]) + np.array([[-5.0], [5.0]]) * [*way, 0.0]
    assert off_axis(line, *ends) < 0.1


def weak(cloud, seed, *, noise, gain):
    """Paint hardly brighter than the road, lasers of unlike gain, echoes that fade with range."""
    rng = np.random.default_rng(seed)
    reach = np.linalg.norm(cloud.xyz, axis=1)
    ring = np.unique(np.round(np.arcsin(cloud.xyz[:, 2] / reach), 3), return_inverse=True)[1]
    gains = np.exp(rng.normal(0.0, gain, ring.max() + 1))[ring]
    shade = cloud.intensity * gains * np.exp(-reach / 30.0) * np.exp(rng.normal(0.0, noise, len(ring)))
    return PointCloud(cloud.xyz, np.round(shade, 2).astype(np.float32), ring.astype(np.uint16))


@pytest.mark.parametrize("numbered", [True, False])
def test_weak_paint_under_unlike_lasers_is_found(numbered):
    rng = np.random.default_rng(10)
    cloud = weak(scenes.sampled_cloud(rng, noise=0.005), 10, noise=0.4, gain=0.25)
    lanes = found(cloud if numbered else PointCloud(cloud.xyz, cloud.intensity), rng)
    assert len({partner(line, scenes.lane_ends())[0][1] for line in lanes}) >= (4 if numbered else 3)
    for line in lanes:
        assert off_axis(line, *partner(line, scenes.lane_ends())) < 0.15


@pytest.mark.parametrize("seed", range(4))
def test_unlike_lasers_paint_no_line_on_a_bare_road(seed):
    rng = np.random.default_rng(seed)
    cloud = weak(scenes.sampled_cloud(rng, lanes=[], noise=0.005), seed, noise=0.4, gain=0.4)
    assert found(cloud, rng) == []
    assert found(PointCloud(cloud.xyz, cloud.intensity), rng) == []


@pytest.mark.parametrize("thing", ["patch", "verge", "cover"])
def test_bright_ground_that_is_no_line(thing):
    rng = np.random.default_rng(7)
    cloud = scenes.sampled_cloud(rng, lanes=[], poles=[])
    x, y = cloud.xyz[:, 0], cloud.xyz[:, 1]
    bright = {
        "patch": (y > 2.0) & (y < 6.0) & (x > 5),
        "verge": y > 3.0,
        "cover": (np.abs(x - 9) < 0.4) & (np.abs(y - 1) < 0.4),
    }[thing]
    intensity = np.where(bright, 0.6, cloud.intensity).astype(np.float32)
    assert found(PointCloud(cloud.xyz, intensity), rng) == []
