import dataclasses
import math

import numpy as np
import pytest

from pipeline.ego import Ego
from pipeline.records import FramePair, PointCloud
from pipeline.simulation.drive import START_NS

UP, AHEAD = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
S = 1_000_000_000


@pytest.fixture(scope="module")
def frames(drive, street):
    """Three sweeps in a row."""
    return (street, drive.frame(5), drive.frame(6))


def pair_of(frame, *, times=True, sweep_s=0.1):
    cloud = frame.cloud if times else dataclasses.replace(frame.cloud, time=None)
    return FramePair("front", cloud, frame.image, frame.cloud_stamp_ns, frame.image_stamp_ns, sweep_s)


def ego(spin=None):
    return Ego(UP, AHEAD, spin)


@pytest.fixture(scope="module")
def tracked(frames):
    """An ego that has seen two sweeps with times, and what it made of the second."""
    known = ego()
    known.straighten(pair_of(frames[0]))
    return known, known.straighten(pair_of(frames[1]))


def truth(drive, frame):
    """Velocity of the LiDAR in its own frame at the exposure, and its points brought there by the truth."""
    middle = (frame.image_stamp_ns - START_NS) / S
    before, now, after = drive.T_world_lidar(middle + np.array([-0.01, 0.0, 0.01]))
    velocity = now[:3, :3].T @ (after[:3, 3] - before[:3, 3]) / 0.02
    start = (frame.cloud_stamp_ns - START_NS) / S
    moments, which = np.unique(frame.cloud.time, return_inverse=True)
    T = np.linalg.inv(now) @ drive.T_world_lidar(start + moments.astype(np.float64))
    points = np.einsum("nij,nj->ni", T[which, :3, :3], frame.cloud.xyz) + T[which, :3, 3]
    return velocity, points


def rms(a, b):
    return float(np.sqrt(np.mean(np.sum((a - b) ** 2, axis=1))))


def test_the_first_sweep_is_left_as_it_is(frames):
    known = ego()
    first = known.straighten(pair_of(frames[0]))
    assert not first.straight
    assert first.cloud is frames[0].cloud
    assert first.distance_m == 0
    assert known.twist is None


def test_the_second_is_brought_to_the_exposure(drive, frames, tracked):
    known, made = tracked
    velocity, points = truth(drive, frames[1])
    assert made.straight
    np.testing.assert_allclose(known.twist.velocity, velocity, atol=0.3)
    raw = rms(frames[1].cloud.xyz, points)
    assert raw > 0.2
    assert rms(made.cloud.xyz, points) < 0.1 * raw
    assert made.distance_m == pytest.approx(0.1 * np.linalg.norm(velocity), rel=0.03)
    np.testing.assert_array_equal(made.cloud.ring, frames[1].cloud.ring)


@pytest.mark.parametrize("spin", ["cw", "ccw"])
def test_without_times_the_sense_of_rotation_tells_them(drive, frames, spin):
    known = ego(spin)
    known.straighten(pair_of(frames[0], times=False))
    made = known.straighten(pair_of(frames[1], times=False))
    _, points = truth(drive, frames[1])
    raw = rms(frames[1].cloud.xyz, points)
    # The simulated sensor turns clockwise from behind; the wrong sense bends the sweep twice as much.
    assert made.straight
    if spin == "cw":
        assert rms(made.cloud.xyz, points) < 0.15 * raw
    else:
        assert rms(made.cloud.xyz, points) > 1.5 * raw


def test_without_times_and_sense_nothing_is_bent(frames):
    known = ego()
    known.straighten(pair_of(frames[0], times=False, sweep_s=None))
    made = known.straighten(pair_of(frames[1], times=False, sweep_s=None))
    assert not made.straight
    np.testing.assert_array_equal(made.cloud.xyz, frames[1].cloud.xyz)
    assert made.distance_m > 0.5


def test_a_registration_holds_for_a_while(frames, tracked):
    known, _ = tracked
    twist = known.twist
    made = known.straighten(pair_of(frames[2]))
    assert known.twist is twist
    assert made.straight
    assert made.distance_m == pytest.approx(0.2 * np.linalg.norm(twist.velocity), rel=0.01)


def test_what_was_interrupted_or_runs_back_begins_anew(frames):
    for interrupted in (True, False):
        known = ego()
        known.straighten(pair_of(frames[1]))
        known.straighten(pair_of(frames[2]))
        assert known.twist is not None
        if interrupted:
            known.forget()
            made = known.straighten(pair_of(frames[2]))
        else:
            made = known.straighten(pair_of(frames[0]))
        assert known.twist is None
        assert not made.straight


def test_far_exposures_are_not_reached(frames):
    known = ego()
    known.straighten(pair_of(frames[0]))
    late = dataclasses.replace(pair_of(frames[1]), image_stamp_ns=frames[1].cloud_stamp_ns + S)
    assert not known.straighten(late).straight


def test_an_unknown_time_of_exposure_is_less_sure(frames, tracked):
    with_times = tracked[1].sync_s
    bare = ego().straighten(pair_of(frames[0], times=False, sweep_s=None)).sync_s
    sensed = ego("cw").straighten(pair_of(frames[0], times=False)).sync_s
    assert 0 < with_times == sensed < bare


@pytest.mark.parametrize("count", [0, 1, 50])
def test_few_points_tell_no_motion(frames, count):
    known = ego()
    for frame in frames[:2]:
        cloud = frame.cloud
        few = PointCloud(cloud.xyz[:count], time=cloud.time[:count])
        made = known.straighten(dataclasses.replace(pair_of(frame), cloud=few))
    assert known.twist is None
    assert not made.straight
    assert math.isfinite(made.distance_m)
