import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pipeline import se3
from pipeline.cloud_poles import find_poles
from pipeline.ground import fit_ground
from pipeline.records import PointCloud

_spec = importlib.util.spec_from_file_location(
    "line_scenes", Path(__file__).parents[1] / "oracles" / "line_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)


def found(cloud, rng, up=scenes.UP):
    return find_poles(cloud, fit_ground(cloud, up, rng), np.ones(len(cloud), dtype=bool))


def off_axis(line, start, end):
    """Largest distance of the line's ends from the true line, m."""
    along = (end - start) / np.linalg.norm(end - start)
    offsets = np.stack([line.start, line.end]) - start
    return np.linalg.norm(offsets - (offsets @ along)[:, None] * along, axis=1).max()


def partner(line, truth):
    return min(truth, key=lambda ends: off_axis(line, *ends))


def test_poles_are_found_where_they_stand():
    rng = np.random.default_rng(0)
    poles = found(scenes.sampled_cloud(rng), rng)
    assert len(poles) == 4
    for line in poles:
        assert off_axis(line, *partner(line, scenes.pole_ends())) < 0.09
        assert (line.end - line.start) @ scenes.UP > 1.0


def test_poles_are_moved_from_their_front_to_their_axis():
    rng = np.random.default_rng(1)
    radius = 0.15
    cloud = scenes.sampled_cloud(rng, poles=[(10.0, 5.0), (12.0, -6.0)], radius=radius, noise=0.005)
    poles = found(cloud, rng)
    assert len(poles) == 2
    for line in poles:
        (x, y) = min([(10.0, 5.0), (12.0, -6.0)], key=lambda p: abs(p[1] - line.start[1]))
        sight = np.array([x, y]) / np.hypot(x, y)
        # Uncorrected the axis would stand pi/4 of the radius, 0.12 m, too near.
        assert abs((line.start[:2] - [x, y]) @ sight) < 0.03


def test_a_cloud_told_in_the_vehicles_frame_shows_the_same_poles():
    cloud = scenes.sampled_cloud(np.random.default_rng(0))
    shift = np.array([-3.0, 0.7, 1.9])
    moved = PointCloud((cloud.xyz + shift).astype(np.float32), cloud.intensity)
    every = np.ones(len(cloud), dtype=bool)
    here = find_poles(cloud, fit_ground(cloud, scenes.UP, np.random.default_rng(1)), every)
    ground = fit_ground(moved, scenes.UP, np.random.default_rng(1))
    there = find_poles(moved, ground, every, origin=shift)
    assert len(here) == len(there) == 4
    for line in here:
        near = min(there, key=lambda other: np.abs(other.start - line.start - shift).max())
        assert np.abs(near.start - line.start - shift).max() < 1e-3
        assert np.abs(near.end - line.end - shift).max() < 1e-3
    # From the frame's own origin the sensor would seem to see higher than it does.
    assert len(find_poles(moved, ground, every)) < 4


def test_turning_the_lidar_turns_the_poles():
    rng = np.random.default_rng(2)
    turn = se3.exp_so3(np.array([0.4, -1.9, 0.8]))
    poles = found(scenes.sampled_cloud(rng, turn=turn), rng, turn @ scenes.UP)
    assert len(poles) == 4
    for line in poles:
        ends = [(turn @ a, turn @ b) for a, b in scenes.pole_ends()]
        assert off_axis(line, *partner(line, ends)) < 0.09


def test_points_out_of_view_take_no_part():
    rng = np.random.default_rng(4)
    cloud = scenes.sampled_cloud(rng)
    left = cloud.xyz[:, 1] > 0
    poles = find_poles(cloud, fit_ground(cloud, scenes.UP, rng), left)
    assert len(poles) == 2
    assert all(left[line.points].all() for line in poles)


def test_a_pole_on_the_border_of_a_cell_is_one_pole():
    for step in np.linspace(0, 0.5, 6):
        rng = np.random.default_rng(3)
        cloud = scenes.sampled_cloud(rng, lanes=[], poles=[(12.0 + step, 5.0 + step)])
        assert len(found(cloud, rng)) == 1


@pytest.mark.parametrize("thing", ["wall", "car", "leaning", "hedge row", "pole in a bush", "drum"])
def test_upright_things_that_are_no_poles(thing):
    rng = np.random.default_rng(8)
    cloud = scenes.sampled_cloud(rng, poles=[])
    n = 3000
    z = rng.uniform(-1.7, 1.5, n)
    shapes = {
        "wall": np.column_stack([rng.uniform(8, 20, n), np.full(n, 6.0), z]),
        "car": np.column_stack([rng.uniform(10, 14, n), rng.uniform(4, 5.8, n), z]),
        "leaning": np.column_stack([12.0 + 0.3 * z, np.full(n, 4.0), z]),
        # Twigs around the stem, too low to be tall themselves.
        "pole in a bush": np.column_stack(
            [
                12.0 + np.where(z > 0, 0.02, 0.9) * rng.uniform(-1, 1, n),
                5.0 + np.where(z > 0, 0.02, 0.9) * rng.uniform(-1, 1, n),
                np.where(z > 0, rng.uniform(-1.0, 1.5, n), rng.uniform(-0.9, -0.1, n)),
            ]
        ),
        "drum": np.column_stack([12.0 + rng.uniform(-0.34, 0.34, n), 5.0 + rng.uniform(-0.34, 0.34, n), z]),
        "hedge row": np.column_stack([rng.uniform(9, 10.5, n), rng.uniform(4, 4.4, n), z]),
    }
    xyz = np.concatenate([cloud.xyz, shapes[thing].astype(np.float32)])
    assert found(PointCloud(xyz), rng) == []


@pytest.mark.parametrize("aside", [0.0, 0.12])
def test_a_plate_does_not_bend_the_axis_of_its_pole(aside):
    rng = np.random.default_rng(11)
    x, y = 9.0, 4.0
    cloud = scenes.sampled_cloud(rng, poles=[(x, y)], lanes=[], radius=0.04, noise=0.01)
    grid = np.meshgrid(np.arange(y - 0.3, y + 0.3, 0.03) + aside, np.arange(0.32, 1.0, 0.06))
    across, up = (axis.ravel() for axis in grid)
    plate = np.column_stack([np.full(across.size, x - 0.06), across, up]).astype(np.float32)
    # The pole ends at the plate, 2.5 m above ground.
    below = cloud.xyz[:, 2] < 1.0
    (pole,) = found(PointCloud(np.concatenate([cloud.xyz[below], plate])), rng)
    assert off_axis(pole, *scenes.pole_ends([(x, y)])[0]) < 0.06
    way = (pole.end - pole.start) / np.linalg.norm(pole.end - pole.start)
    assert np.degrees(np.arccos(way[2])) < 1.5


@pytest.mark.parametrize("slope", [0.04, -0.04])
def test_poles_beyond_the_break_of_a_slope_are_found_at_their_height(slope):
    rng = np.random.default_rng(12)
    cloud = scenes.sampled_cloud(rng, lanes=[], poles=[(24.0, 5.0)], noise=0.01)
    rise = (slope * np.maximum(cloud.xyz[:, 0] - 10.0, 0.0)).astype(np.float32)
    xyz = cloud.xyz + rise[:, None] * np.array([0, 0, 1], np.float32)
    (pole,) = found(PointCloud(xyz), rng)
    foot = -scenes.HEIGHT + slope * 14.0
    # H0 above the ground of its place, less than one beam's gap higher.
    assert 0.7 < pole.start[2] - foot < 1.0
