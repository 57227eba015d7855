"""A configured sense of rotation, held against the bend of the sweeps."""

import dataclasses

import numpy as np
import pytest

from pipeline.ego import Ego
from pipeline.records import FramePair
from pipeline.simulation.drive import Drive, DriveParameters
from pipeline.spin_check import told_spin

UP, AHEAD = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
MIRRORED = np.array([1.0, -1.0, 1.0], dtype=np.float32)
S = 1_000_000_000
TURN_S = 0.1


@pytest.fixture(scope="module")
def sweeps(drive, street):
    """Five sweeps in a row without times, measured clockwise at some 10 m/s."""
    frames = [street, *(drive.frame(k) for k in range(5, 9))]
    return [(f.cloud_stamp_ns, dataclasses.replace(f.cloud, time=None)) for f in frames]


@pytest.fixture(scope="module")
def seldom():
    """Sweeps 0.3 s apart, each of them registered."""
    drive = Drive(DriveParameters(seed=5, duration=2.0))
    frames = [drive.frame(k) for k in range(1, 20, 3)]
    return [(f, f.cloud_stamp_ns, dataclasses.replace(f.cloud, time=None)) for f in frames]


def mirrored(sweeps):
    """The street in a mirror, where the beams go round the other way."""
    return [(stamp, dataclasses.replace(cloud, xyz=cloud.xyz * MIRRORED)) for stamp, cloud in sweeps]


def standing(sweeps):
    """The same sweep again and again."""
    return [(stamp, sweeps[0][1]) for stamp, _ in sweeps]


def driven(seldom, spin, mirror=1.0, *, stands=False, times=False):
    """What an ego with this sense configured holds against it after the drive."""
    ego = Ego(UP, AHEAD, spin)
    for frame, stamp, cloud in seldom:
        shown = seldom[0][2] if stands else cloud
        shown = dataclasses.replace(shown, xyz=shown.xyz * np.array([1, mirror, 1], dtype=np.float32))
        if times:
            shown = frame.cloud
        ego.straighten(FramePair("front", shown, frame.image, stamp, frame.image_stamp_ns, TURN_S))
    return ego.contradicted


@pytest.mark.parametrize("sweep_s", [TURN_S, None])
def test_sweeps_tell_their_sense(sweeps, sweep_s):
    assert told_spin(sweeps, sweep_s, UP) == "cw"
    assert told_spin(mirrored(sweeps), sweep_s, UP) == "ccw"
    # Seen from below they go round the other way.
    assert told_spin(sweeps, sweep_s, -UP) == "ccw"


def test_a_vehicle_that_stands_tells_none(sweeps):
    assert told_spin(standing(sweeps), TURN_S, UP) is None


def test_few_sweeps_or_sweeps_far_apart_tell_none(sweeps):
    assert told_spin(sweeps[:4], TURN_S, UP) is None
    far = [(stamp * 10, cloud) for stamp, cloud in sweeps]
    assert told_spin(far, TURN_S, UP) is None


def test_a_wrong_sense_is_contradicted_on_the_way(seldom):
    assert driven(seldom, "ccw") == "cw"
    assert driven(seldom, "cw", mirror=-1.0) == "ccw"


def test_a_right_one_is_not(seldom):
    assert driven(seldom, "cw") is None
    assert driven(seldom, "ccw", mirror=-1.0) is None


def test_nothing_is_held_against_a_sense_without_motion_or_where_times_rule(seldom):
    assert driven(seldom, "ccw", stands=True) is None
    assert driven(seldom, "ccw", times=True) is None
    assert driven(seldom, None) is None


def test_a_configured_sense_is_used_whatever_the_sweeps_say(seldom):
    frame, stamp, cloud = seldom[-1]
    ego = Ego(UP, AHEAD, "ccw")
    for earlier, stamp_ns, swept in seldom[:-1]:
        ego.straighten(FramePair("front", swept, earlier.image, stamp_ns, earlier.image_stamp_ns, TURN_S))
    assert ego.contradicted == "cw"
    fresh = Ego(UP, AHEAD, "ccw")
    fresh.straighten(
        FramePair("front", seldom[-2][2], seldom[-2][0].image, seldom[-2][1], frame.image_stamp_ns, TURN_S)
    )
    pair = FramePair("front", cloud, frame.image, stamp, frame.image_stamp_ns, TURN_S)
    np.testing.assert_allclose(ego.straighten(pair).cloud.xyz, fresh.straighten(pair).cloud.xyz, atol=0.05)
