"""What a drift does, against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline import se3
from pipeline.consequence import RANGES_M, consequences
from pipeline.records import CameraModel

F = 700.0
K = np.array([[F, 0, 620.0], [0, F, 180.0], [0, 0, 1]])
CAMERA = CameraModel("pinhole", K, np.zeros(0), 1242, 375)
FISHEYE = CameraModel("equidistant", K, np.array([0.01, -0.002, 0.0, 0.0]), 1242, 375)
AHEAD = se3.AXES_CAM_IN_VEHICLE
ROLL, PITCH, YAW, FORWARD, LEFT, UP = range(6)


def one(axis, size):
    drift = np.zeros(6)
    drift[axis] = size
    return drift


def told(drift, covariance=None, camera=CAMERA, R_vc=AHEAD):
    return consequences(camera, R_vc, drift, np.zeros((6, 6)) if covariance is None else covariance)


def test_a_turn_moves_pixels_alike_at_every_range_and_things_the_more_the_further():
    angle = math.radians(0.5)
    for at in told(one(YAW, angle)):
        assert at.shift_px == pytest.approx(F * math.tan(angle), abs=1e-9)
        assert at.left_m == pytest.approx(at.range_m * math.sin(angle), abs=1e-9)
        assert at.up_m == pytest.approx(0.0, abs=1e-12)
    for at in told(one(PITCH, angle)):
        assert at.shift_px == pytest.approx(F * math.tan(angle), abs=1e-9)
        assert at.up_m == pytest.approx(-at.range_m * math.sin(angle), abs=1e-9)


def test_a_shift_moves_pixels_the_less_the_further_and_things_alike():
    for axis, name in ((LEFT, "left_m"), (UP, "up_m")):
        for at in told(one(axis, 0.1)):
            assert at.shift_px == pytest.approx(F * 0.1 / at.range_m)
            assert getattr(at, name) == pytest.approx(0.1)
    for at in told(one(FORWARD, 0.2)):
        assert at.shift_px == pytest.approx(0.0, abs=1e-9)
        # Towards the corners a shift ahead shows: r / (range - 0.2) apart.
        assert at.worst_px > 0.0


def test_a_roll_leaves_the_axis_in_place_and_moves_the_corners():
    angle = math.radians(1.0)
    corner = math.hypot(621.0, 194.0)
    for at in told(one(ROLL, angle)):
        assert at.shift_px == pytest.approx(0.0, abs=1e-9)
        assert at.worst_px == pytest.approx(2.0 * corner * math.sin(angle / 2.0), rel=0.02)


def test_the_compensating_pair_is_nothing_at_its_range_and_something_beyond():
    # Yaw right and shift left keep what is 10 m away.
    drift = one(LEFT, 0.1) + one(YAW, -math.asin(0.1 / 10.0))
    near, middle, far = told(drift)
    assert near.left_m == pytest.approx(0.0, abs=1e-3)
    assert middle.left_m == pytest.approx(-0.2, abs=1e-3)
    assert far.left_m == pytest.approx(-0.7, abs=1e-3)


@given(st.integers(0, 2**32 - 1))
def test_sigma_is_that_of_the_linear_sum_at_small_drifts(seed):
    rng = np.random.default_rng(seed)
    L = np.tril(rng.normal(size=(6, 6))) * np.array([1e-3] * 3 + [0.02] * 3)[:, None]
    C = L @ L.T
    for at in told(np.zeros(6), C):
        by = np.zeros((2, 6))
        by[0, YAW], by[0, LEFT] = at.range_m, 1.0
        by[1, PITCH], by[1, UP] = -at.range_m, 1.0
        metres = by @ C @ by.T
        assert at.sigma_left_m == pytest.approx(math.sqrt(metres[0, 0]), rel=1e-4)
        assert at.sigma_up_m == pytest.approx(math.sqrt(metres[1, 1]), rel=1e-4)
        # Right in front the image is the world, scaled by F / range.
        largest = math.sqrt(float(np.linalg.eigvalsh(metres)[-1]))
        assert at.sigma_px == pytest.approx(F / at.range_m * largest, rel=1e-4)


@given(st.lists(st.floats(-0.05, 0.05), min_size=6, max_size=6), st.floats(-math.pi, math.pi))
def test_a_camera_that_looks_elsewhere_and_moves_alike_in_its_own_axes_suffers_alike(drift, heading):
    drift = np.array(drift)
    turn = np.array(
        [
            [math.cos(heading), -math.sin(heading), 0],
            [math.sin(heading), math.cos(heading), 0],
            [0, 0, 1.0],
        ]
    )
    # Small turns, so that Euler angles turn as vectors do.
    drift[:3] *= 1e-4
    turned = np.concatenate([turn @ drift[:3], turn @ drift[3:]])
    for a, b in zip(told(drift), told(turned, R_vc=turn @ AHEAD), strict=True):
        assert a.left_m == pytest.approx(b.left_m, abs=1e-7)
        assert a.up_m == pytest.approx(b.up_m, abs=1e-7)
        assert a.worst_px == pytest.approx(b.worst_px, abs=1e-4)


def test_a_fisheye_tells_its_worst_too_and_a_half_turn_tells_nothing():
    assert all(np.isfinite(at.worst_px) and at.worst_px > 5.0 for at in told(one(ROLL, 0.02), camera=FISHEYE))
    away = told(one(YAW, math.pi), np.eye(6))
    assert [at.range_m for at in away] == list(RANGES_M)
    assert all(math.isnan(at.shift_px) and math.isnan(at.worst_px) and math.isnan(at.sigma_px) for at in away)
