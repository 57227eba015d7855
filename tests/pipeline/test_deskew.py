import dataclasses
import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from pipeline import se3
from pipeline.deskew import Spin, Twist, deskew, displaced, sweep_times, turned
from pipeline.errors import InputError
from pipeline.records import PointCloud

_spec = importlib.util.spec_from_file_location(
    "box_sweeps", Path(__file__).parents[1] / "oracles" / "box_sweeps.py"
)
sweeps = importlib.util.module_from_spec(_spec)
sys.modules["box_sweeps"] = sweeps
_spec.loader.exec_module(sweeps)

BACK = np.array([-1.0, 0.0, 0.0])
UP = np.array([0.0, 0.0, 1.0])
CLOCKWISE = Spin("cw", UP, BACK)
seeds = st.integers(0, 10_000)


def by_exponential(points, tau, twist):
    """Each point by the matrix exponential of its own instant."""
    generator = sweeps.twist_matrix(twist.omega, twist.velocity)
    return np.array([(expm(t * generator) @ np.append(p, 1.0))[:3] for p, t in zip(points, tau, strict=True)])


@settings(max_examples=40, deadline=None)
@given(seeds, st.sampled_from([0.0, 1e-12, 1e-7, 1e-3, 0.4, 3.0]))
def test_displaced_is_the_matrix_exponential(seed, rate):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    twist = Twist(rate * axis / np.linalg.norm(axis), rng.normal(0, 15, 3))
    points, tau = rng.normal(0, 30, (8, 3)), rng.uniform(-0.5, 0.5, 8)
    exact = by_exponential(points, tau, twist)
    np.testing.assert_allclose(displaced(points, tau, twist), exact, atol=1e-9)
    single = displaced(points.astype(np.float32), tau, twist)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, exact, atol=5e-5)
    np.testing.assert_allclose(
        twist.pose(tau[0]), expm(tau[0] * sweeps.twist_matrix(twist.omega, twist.velocity)), atol=1e-9
    )


def test_figures_of_formulas_g3():
    # 30 m away, 50 ms, 15 m/s, 0.4 rad/s: 0.89 m uncorrected, 9 mm by the first order.
    twist = Twist(np.array([0.0, 0.0, 0.4]), np.array([15.0, 0.0, 0.0]))
    bearing = math.radians(8.5)
    point = 30.0 * np.array([[math.cos(bearing), math.sin(bearing), 0.0]])
    exact = displaced(point, np.array([0.05]), twist)
    first_order = point + 0.05 * (twist.velocity + np.cross(twist.omega, point))
    assert np.linalg.norm(exact - point) == pytest.approx(0.89, abs=0.01)
    assert np.linalg.norm(exact - first_order) == pytest.approx(0.009, abs=0.001)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_turned_and_moved_frame_gives_the_same_motion(seed):
    rng = np.random.default_rng(seed)
    T = se3.transform(se3.exp_so3(rng.normal(size=3) * 2), rng.normal(size=3))
    twist = Twist(rng.normal(0, 0.5, 3), rng.normal(0, 10, 3))
    points, tau = rng.normal(0, 20, (6, 3)), rng.uniform(-0.2, 0.2, 6)
    there = displaced(se3.apply(T, points), tau, twist.in_frame(T))
    np.testing.assert_allclose(there, se3.apply(T, displaced(points, tau, twist)), atol=1e-9)


@pytest.mark.parametrize("clockwise", [True, False])
def test_a_sweep_in_motion_becomes_one_instant(clockwise):
    """Straightened points lie on the boxes where they stand, to a centimetre; others are decimetres off."""
    rng = np.random.default_rng(5)
    twist = Twist(np.array([0.02, -0.03, 0.3]), np.array([14.0, 0.4, 0.1]))
    boxes = sweeps.street(rng)
    motion = {"omega": twist.omega, "velocity": twist.velocity, "start": 0.0}
    cloud = sweeps.sweep(boxes, rng, **motion, clockwise=clockwise, noise=0.0, rings=16, columns=500)
    spin = Spin("cw" if clockwise else "ccw", UP, BACK)
    time = sweep_times(dataclasses.replace(cloud, time=None), 0.1, spin)
    np.testing.assert_allclose(time, cloud.time, atol=1e-5)
    reference = 0.07
    straight = deskew(cloud, time, twist, reference)
    T = expm(reference * sweeps.twist_matrix(twist.omega, twist.velocity))
    assert distance_from(boxes, se3.apply(T, straight.xyz)).max() < 0.01
    assert np.percentile(distance_from(boxes, se3.apply(T, cloud.xyz)), 95) > 0.2
    wrong = Spin("ccw" if clockwise else "cw", UP, BACK)
    bent = deskew(cloud, sweep_times(dataclasses.replace(cloud, time=None), 0.1, wrong), twist, reference)
    assert np.percentile(distance_from(boxes, se3.apply(T, bent.xyz)), 95) > 0.2
    assert (straight.time == np.float32(reference)).all()


def distance_from(boxes, points, height=1.8):
    """Distance (N,) from the nearest box or the ground, of points in the frame of time zero."""
    world = points + np.array([0.0, 0.0, height])
    least = np.abs(world[:, 2])
    for low, high in boxes:
        outside = np.maximum(np.maximum(low - world, world - high), 0.0)
        inside = np.minimum(world - low, high - world).min(axis=1)
        least = np.minimum(least, np.where(inside > 0, inside, np.linalg.norm(outside, axis=1)))
    return least


def test_motion_between_the_exposures_is_undone():
    """A still thing is put where the camera sees it when it exposes."""
    twist = Twist(np.array([0.0, 0.0, 0.1]), np.array([20.0, 0.0, 0.0]))
    thing = np.array([[25.0, 3.0, 0.5]])
    generator = sweeps.twist_matrix(twist.omega, twist.velocity)
    measured = (np.linalg.inv(expm(0.03 * generator)) @ np.append(thing[0], 1.0))[:3]
    at_exposure = (np.linalg.inv(expm(0.045 * generator)) @ np.append(thing[0], 1.0))[:3]
    cloud = PointCloud(measured[None].astype(np.float32))
    moved = deskew(cloud, np.array([0.03], dtype=np.float32), twist, 0.045)
    np.testing.assert_allclose(moved.xyz[0], at_exposure, atol=1e-5)
    assert np.linalg.norm(moved.xyz[0] - cloud.xyz[0]) == pytest.approx(0.3, abs=0.01)


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from(["cw", "ccw"]))
def test_turned_angle_in_any_frame(seed, sense):
    rng = np.random.default_rng(seed)
    R = se3.exp_so3(rng.normal(size=3) * 2)
    angle = rng.uniform(0.01, 2 * math.pi - 0.01, 20)
    azimuth = math.pi + (angle if sense == "ccw" else -angle)
    radius = rng.uniform(1, 50, 20)
    points = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), rng.normal(0, 3, 20)])
    spin = Spin(sense, R @ UP, R @ (BACK + 0.7 * UP))
    np.testing.assert_allclose(turned(points @ R.T, spin), angle, atol=1e-9)


def test_own_times_win_and_without_any_there_are_none():
    xyz = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 1e-3, 0]], dtype=np.float32)
    own = np.array([-0.02, 0.0, 0.03], dtype=np.float32)
    assert np.array_equal(sweep_times(PointCloud(xyz, time=own), 0.1, CLOCKWISE), own)
    assert sweep_times(PointCloud(xyz), 0.1, None) is None
    # Clockwise from straight back: past the left (y) after a quarter, ahead after a half.
    times = sweep_times(PointCloud(xyz), 0.1, CLOCKWISE)
    np.testing.assert_allclose(times[:2], [0.05, 0.025], atol=1e-6)
    empty = PointCloud(np.zeros((0, 3), dtype=np.float32))
    assert sweep_times(empty, 0.1, CLOCKWISE).shape == (0,)
    assert len(deskew(empty, np.zeros(0), Twist(np.zeros(3), np.ones(3)), 0.0)) == 0


def test_bad_input_is_named():
    cloud = PointCloud(np.zeros((2, 3), dtype=np.float32))
    still = Twist(np.zeros(3), np.zeros(3))
    with pytest.raises(InputError, match="times for 2 points"):
        deskew(cloud, np.zeros(3), still, 0.0)
    with pytest.raises(InputError, match="times for 2 points"):
        deskew(cloud, np.array([0.0, np.nan]), still, 0.0)
    with pytest.raises(InputError, match=r"Twist\.velocity"):
        Twist(np.zeros(3), np.array([np.inf, 0, 0]))
    with pytest.raises(InputError, match="along the spin axis"):
        Spin("cw", UP, 2 * UP)
