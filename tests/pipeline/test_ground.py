import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import se3
from pipeline.ground import BAND_M, fit_ground
from pipeline.records import PointCloud

UP = np.array([0.0, 0.0, 1.0])


def street(rng, *, tilt_deg=2.0, height=1.7, noise=0.02):
    """Ground with ring-like density, two facades, cars and a canopy; returns xyz, normal, ground mask."""
    tilt = se3.exp_so3(np.array([math.radians(tilt_deg), math.radians(-0.5 * tilt_deg), 0.0]))
    angle = rng.uniform(0, 2 * np.pi, 20_000)
    # Rings at equal angles below the horizon lie dense near the sensor: 1 / tan of the angle.
    radius = height / np.tan(np.radians(rng.uniform(2.0, 24.0, 20_000)))
    road = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(20_000, -height)])
    facade = np.column_stack(
        [
            rng.uniform(-40, 40, 8000),
            rng.choice([-12.0, 14.0], 8000) + rng.normal(0, 0.05, 8000),
            rng.uniform(-height, 8, 8000),
        ]
    )
    cars = np.column_stack(
        [rng.uniform(5, 20, 3000), rng.uniform(3, 5, 3000), rng.uniform(-height + 0.3, -0.2, 3000)]
    )
    crowns = np.column_stack(
        [rng.uniform(-30, 30, 6000), rng.uniform(-10, 10, 6000), rng.uniform(3, 5, 6000)]
    )
    xyz = np.concatenate([road, facade, cars, crowns])
    xyz[:, 2] += rng.normal(0, noise, len(xyz))
    return xyz @ tilt.T, tilt @ UP, np.arange(len(xyz)) < 20_000


def test_plane_of_a_street_is_found_to_millimetres():
    rng = np.random.default_rng(3)
    xyz, normal, is_road = street(rng)
    ground = fit_ground(PointCloud(xyz.astype(np.float32)), UP, rng)
    assert ground is not None
    assert math.degrees(math.acos(min(1.0, ground.normal @ normal))) < 0.05
    assert ground.offset == pytest.approx(1.7, abs=0.01)
    assert ground.inliers[is_road].mean() > 0.99
    np.testing.assert_allclose(ground.heights(xyz[:5]), xyz[:5] @ ground.normal + ground.offset)
    assert np.array_equal(ground.inliers, np.abs(ground.heights(xyz.astype(np.float32))) <= BAND_M / 2)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_turning_the_lidar_turns_the_plane(seed):
    rng = np.random.default_rng(seed)
    turn = se3.exp_so3(rng.normal(size=3) * 2)
    xyz, normal, _ = street(rng)
    xyz = xyz @ turn.T + turn @ np.array([0.0, 0.0, 0.4])
    ground = fit_ground(PointCloud(xyz.astype(np.float32)), turn @ UP, rng)
    assert ground is not None
    assert ground.normal @ (turn @ normal) > math.cos(math.radians(0.1))
    # The origin was moved by 0.4 m along LiDAR up: the offset follows along the plane's normal.
    assert ground.offset == pytest.approx(1.7 - 0.4 * normal[2], abs=0.02)


def rolling(rng, shape, *, height=1.7, noise=0.02, rings=40):
    """Rings of a sensor over a road of ``shape(x, y)`` m between hedges, walls and parked cars.

    Returns xyz and whether each point is ground.
    """
    angle = np.tile(np.arange(0.0, 2 * np.pi, 0.01), rings)
    down = np.tan(np.radians(np.linspace(1.8, 24.0, rings)).repeat(len(angle) // rings))
    # Where each beam first passes below the road.
    steps = np.arange(2.0, 60.0, 0.2)
    reach = np.full(len(angle), 60.0)
    for step in steps[::-1]:
        below = height - step * down < shape(step * np.cos(angle), step * np.sin(angle))
        reach[below] = step
    reach -= rng.uniform(0.0, 0.2, len(angle))
    x, y = reach * np.cos(angle), reach * np.sin(angle)
    on_road = (np.abs(y) < 7.0) & (reach < 58)
    road = np.column_stack([x, y, shape(x, y)])[on_road]
    count = 6000
    along = rng.uniform(-40, 40, count)
    side = rng.choice([-7.5, 7.5], count)
    hedge = np.column_stack([along, side + rng.normal(0, 0.3, count), rng.uniform(0.0, 1.3, count)])
    cars = np.column_stack(
        [rng.uniform(-35, 35, count), rng.choice([-5.5, 5.5], count), rng.uniform(0.25, 1.5, count)]
    )
    wall = np.column_stack([along, 1.2 * side, rng.uniform(0.0, 6.0, count)])
    for thing in (hedge, cars, wall):
        thing[:, 2] += shape(thing[:, 0], thing[:, 1])
    xyz = np.concatenate([road, hedge, cars[np.abs(cars[:, 0] % 6) < 4], wall]) - [0, 0, height]
    xyz[:, 2] += rng.normal(0, noise, len(xyz))
    return xyz, np.arange(len(xyz)) < len(road)


SHAPES = {
    "flat": lambda x, y: 0.0 * (x + y),
    "ramp of 2 %": lambda x, y: 0.02 * np.maximum(x - 8.0, 0.0) + 0.0 * y,
    "ramp of 5 %": lambda x, y: 0.05 * np.maximum(x - 12.0, 0.0) + 0.0 * y,
    "crest": lambda x, y: -(x**2) / (2 * 600.0) + 0.0 * y,
    "dip": lambda x, y: x**2 / (2 * 800.0) + 0.0 * y,
    "camber of 4 %": lambda x, y: -0.04 * np.abs(y) + 0.0 * x,
}


@pytest.mark.parametrize("name", SHAPES)
def test_slopes_crests_and_cambers_are_ground(name):
    rng = np.random.default_rng(4)
    xyz, is_road = rolling(rng, SHAPES[name])
    ground = fit_ground(PointCloud(xyz.astype(np.float32)), UP, rng)
    assert ground is not None
    near = np.hypot(xyz[:, 0], xyz[:, 1]) < 40
    plane_alone = (np.abs(ground.heights(xyz))[is_road & near] <= BAND_M / 2).mean()
    share = ground.inliers[is_road & near].mean()
    assert share > (0.97 if name == "flat" or "ramp" in name else 0.8)
    assert share - plane_alone >= (0.0 if name == "flat" else 0.015)
    # A lump of hedge or car within the band is no ground to speak of; the rest of them is none.
    height = xyz[:, 2] + 1.7 - SHAPES[name](xyz[:, 0], xyz[:, 1])
    assert ground.inliers[~is_road & near & (height > 0.3)].mean() < 0.07
    error = ground.local_heights(xyz) - height
    assert np.sqrt((error[is_road & near] ** 2).mean()) < 0.08
    assert np.abs(error[~is_road & near]).max() < 0.35
    assert (ground.relief is None) == (name == "flat")


def test_a_ramp_is_ground_in_any_frame():
    rng = np.random.default_rng(6)
    turn = se3.exp_so3(np.array([0.5, -2.0, 0.7]))
    xyz, is_road = rolling(rng, SHAPES["ramp of 5 %"])
    near = np.hypot(xyz[:, 0], xyz[:, 1]) < 40
    ground = fit_ground(PointCloud((xyz @ turn.T).astype(np.float32)), turn @ UP, rng)
    assert ground.inliers[is_road & near].mean() > 0.97


@pytest.mark.parametrize("kerb", [0.08, 0.15])
def test_a_pavement_beside_the_road_is_ground(kerb):
    rng = np.random.default_rng(7)
    xyz, is_ground = rolling(rng, lambda x, y: kerb * (np.abs(y) > 4.0) + 0.0 * x)
    ground = fit_ground(PointCloud(xyz.astype(np.float32)), UP, rng)
    near = np.hypot(xyz[:, 0], xyz[:, 1]) < 30
    assert ground.inliers[is_ground & near].mean() > 0.97


@pytest.mark.parametrize("top", [0.6, 1.0, 1.5])
def test_a_level_top_beside_the_road_is_no_ground(top):
    """A row of flat boxes, a wide hedge, a loading ramp: the road does not go over into them."""
    rng = np.random.default_rng(8)
    xyz, is_road = rolling(rng, SHAPES["flat"])
    box = np.column_stack(
        [rng.uniform(-30, 30, 20_000), rng.uniform(7.0, 13.0, 20_000), np.full(20_000, top - 1.7)]
    )
    whole = np.concatenate([xyz, box])
    ground = fit_ground(PointCloud(whole.astype(np.float32)), UP, rng)
    assert not ground.inliers[len(xyz) :].any()
    assert ground.inliers[: len(xyz)][is_road].mean() > 0.97


@pytest.mark.parametrize("tilt_deg", [10.0, 25.0])
def test_planes_steeper_than_the_tolerance_are_refused(tilt_deg):
    rng = np.random.default_rng(5)
    xyz, _, is_road = street(rng, tilt_deg=tilt_deg)
    ground = fit_ground(PointCloud(xyz[is_road].astype(np.float32)), UP, rng)
    assert (ground is not None) == (tilt_deg < 15)


def test_same_seed_gives_the_same_plane():
    xyz, _, _ = street(np.random.default_rng(1))
    cloud = PointCloud(xyz.astype(np.float32))
    first, second = (fit_ground(cloud, UP, np.random.default_rng(9)) for _ in range(2))
    assert first is not None
    assert second is not None
    assert np.array_equal(first.normal, second.normal)


@pytest.mark.parametrize(
    "xyz",
    [
        np.zeros((0, 3)),
        np.zeros((5000, 3)),
        np.column_stack([np.linspace(-30, 30, 5000), np.zeros(5000), np.zeros(5000)]),
        np.random.default_rng(0).uniform(-30, 30, (4000, 3)),
        # A wall alone: level planes have no support.
        np.random.default_rng(0).uniform([-1, 5, -2], [1, 5.1, 2], (4000, 3)),
    ],
    ids=["empty", "one point", "one line", "clutter", "wall"],
)
def test_no_plane_is_a_value(xyz):
    assert fit_ground(PointCloud(xyz.astype(np.float32)), UP, np.random.default_rng(0)) is None
