"""The sense of rotation, told by the bend of simulated and recorded sweeps."""

import numpy as np
import pytest

from pipeline.records import PointCloud
from pipeline.spin_sense import SpinEvidence, spin_evidence, spin_sense
from pipeline.surfels import surfels
from tests.pipeline.test_motion import DRIVE, STILL, SWEEP_S, UP, pair, recorded, sweeps


@pytest.mark.parametrize(("clockwise", "sense"), [(True, "cw"), (False, "ccw")])
def test_spin_sense_of_a_sensor_in_motion(clockwise, sense):
    found = [
        spin_evidence(*pair(clockwise=clockwise, gap=2, seed=seed), 0.2, 0.1, UP, DRIVE)
        for seed in (1, 5, 6, 7)
    ]
    evidence = [e for e in found if isinstance(e, SpinEvidence)]
    assert spin_sense(evidence) == sense


def test_straightened_sweeps_are_of_one_instant():
    evidence = []
    for gap, seed in ((2, 1), (2, 5), (2, 6)):
        rng = np.random.default_rng(seed)
        boxes = sweeps.street(rng)
        motion = {"omega": DRIVE.omega, "velocity": DRIVE.velocity, "period": 1e-6}
        first, second = (sweeps.sweep(boxes, rng, start=t, **motion) for t in (0.0, 0.1 * gap))
        evidence.append(spin_evidence(first, second, 0.1 * gap, 0.1, UP, DRIVE))
    assert spin_sense(evidence) == "one instant"


def test_a_standing_vehicle_tells_no_spin_sense():
    found = spin_evidence(*pair(twist=STILL), 0.1, 0.1, UP, STILL)
    assert isinstance(found, SpinEvidence)
    assert found.sigma > 1.0
    assert spin_sense([found] * 3) is None


@pytest.mark.parametrize(
    ("turns", "sigma", "sense"),
    [
        ([-0.9, -1.1, -1.0], 0.1, "cw"),
        ([0.9, 1.1, 1.0], 0.1, "ccw"),
        ([0.1, -0.1, 0.0], 0.1, "one instant"),
        ([-1.0, -1.0], 0.1, None),  # too few to show a scatter
        ([-1.0, -1.0, -1.0], 0.4, None),  # not sure
        ([-0.5, -0.5, -0.5], 0.01, None),  # between two
        ([-1.0, 1.0, -1.0, 1.0], 0.05, None),  # contradict each other
        ([2.0, 2.0, 2.0], 0.05, None),  # no sensor turns twice in a turn
        ([], 0.1, None),
    ],
)
def test_spin_sense_asks_for_agreement(turns, sigma, sense):
    assert spin_sense([SpinEvidence(t, sigma) for t in turns]) == sense


@pytest.mark.recordings
def test_recorded_spin_senses():
    """KITTI's raw sweeps run clockwise; those of its odometry benchmark are straightened already."""
    for name, sense in (("kitti_raw_0009_a", "cw"), ("kitti_odom_03_a", "one instant")):
        clouds = [surfels(PointCloud(xyz)) for xyz in recorded(name)[:10]]
        evidence = [
            spin_evidence(a, b, 3 * SWEEP_S, SWEEP_S, UP, None)
            for a, b in zip(clouds, clouds[3:], strict=False)
        ]
        assert spin_sense([e for e in evidence if isinstance(e, SpinEvidence)]) == sense
