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
