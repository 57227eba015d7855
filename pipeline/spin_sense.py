"""In which sense the beams of a LiDAR go round, by the bend of sweeps that were measured while it moved."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from pipeline.deskew import Twist
from pipeline.ground import plane_basis
from pipeline.motion import ITERATIONS, VARIANCE_INFLATION, MotionUnknown, estimate_twist, settled
from pipeline.records import Floats, PointCloud
from pipeline.surfel_matches import compared, jacobian, paired
from pipeline.surfels import Surfels, surfels

_TURN = 2.0 * math.pi
_HALF_WAY = 0.5
"""Turns; the border between two of -1, 0 and +1."""
_SURE = 3.0
"""Standard deviations by which a spin sense must be told."""
_LEAST_PAIRS = 3
"""Pairs of sweeps behind a spin sense: fewer show no scatter, and one distorted sweep would decide."""

TELLING_M_S = 3.0
"""m/s; slower sweeps are not bent enough to hold a configured sense of rotation against them."""


@dataclass(frozen=True, slots=True, eq=False)
class SpinEvidence:
    """In which sense the beams went round, told by the bend of the sweeps.

    Attributes:
        turns: +1 where the sweep was measured counter-clockwise, -1 clockwise, 0 where it is all of one
            instant (motion compensated, or a flash).
        sigma: Standard deviation of ``turns``.
    """

    turns: float
    sigma: float


def spin_evidence(
    previous: PointCloud | Surfels,
    current: PointCloud | Surfels,
    seconds: float,
    sweep_s: float,
    axis: Floats,
    start: Twist | None,
) -> SpinEvidence | MotionUnknown:
    """Measures in which sense a moving LiDAR spins, by a seventh unknown of the registration.

    A thing that the vehicle passes is seen in another direction by the later sweep, so at another time of
    the turn: ``tau = seconds + turns sweep_s (azimuth difference) / 2 pi``. A wrong ``turns`` leaves
    residuals that grow with the square of the speed: a pair of sweeps at 10 m/s gives it to 0.3, at 3 m/s
    it gives nothing. Times of the clouds are left aside.

    Args:
        previous: The earlier sweep, NOT straightened, or its surfels.
        current: The later sweep, likewise.
        seconds: Stamp of the later sweep minus that of the earlier, > 0.
        sweep_s: Duration of a turn, s.
        axis: float64 (3,), unit, LiDAR frame: the spin axis, upwards.
        start: The last twist, or None.
    """
    earlier = _timeless(previous)
    later = _timeless(current)
    motion = estimate_twist(earlier, later, seconds, start)
    if isinstance(motion, MotionUnknown):
        return motion
    tree = cKDTree(earlier.centre)
    azimuths = [_azimuth(s.centre, axis) for s in (earlier, later)]
    twist, turns = motion.twist, 0.0
    for _ in range(ITERATIONS):
        pairs = paired(earlier, later, tree, seconds, twist)
        angle = azimuths[1][pairs[0]] - azimuths[0][pairs[1]]
        share = angle / _TURN - np.round(angle / _TURN)
        matches = compared(earlier, later, pairs, seconds + turns * sweep_s * share, twist)
        rate = np.cross(twist.omega, matches.moved) + twist.velocity
        bend = np.einsum("ij,ij->i", matches.normal, rate) * sweep_s * share / matches.sigma
        J = np.column_stack([jacobian(matches), bend])
        weighted = J * matches.weight[:, None]
        information = weighted.T @ J
        ridge = 1e-9 * float(np.trace(information)) * np.eye(7)
        step = -np.linalg.solve(information + ridge, weighted.T @ matches.error)
        twist = Twist(twist.omega + step[:3], twist.velocity + step[3:6])
        turns += float(step[6])
        if settled(step[:6], seconds):
            break
    variance = VARIANCE_INFLATION * matches.scale**2 * float(np.linalg.inv(information + ridge)[6, 6])
    return SpinEvidence(turns, math.sqrt(variance))


ToldSpin: TypeAlias = Literal["cw", "ccw", "one instant"]
"""What sweeps say of the rotation; one instant: their points were brought to one, or are a flash's."""


def spin_sense(evidence: Sequence[SpinEvidence]) -> ToldSpin | None:
    """What several pairs of sweeps say together; None while they leave it open.

    The weighted mean must lie nearer to -1, 0 or +1 than to the next of them by three standard deviations,
    which are widened where the pairs scatter more than they claim.
    """
    if len(evidence) < _LEAST_PAIRS:
        return None
    turns = np.array([e.turns for e in evidence])
    weight = np.array([e.sigma for e in evidence]) ** -2.0
    mean = float(turns @ weight / weight.sum())
    scatter = float(((turns - mean) ** 2) @ weight) / (len(turns) - 1)
    nearest = round(mean)
    if abs(mean - nearest) + _SURE * math.sqrt(max(1.0, scatter) / float(weight.sum())) > _HALF_WAY:
        return None
    senses: dict[int, ToldSpin] = {-1: "cw", 0: "one instant", 1: "ccw"}
    return senses.get(nearest)


def _timeless(sweep: PointCloud | Surfels) -> Surfels:
    found = sweep if isinstance(sweep, Surfels) else surfels(sweep)
    return dataclasses.replace(found, time=None)


def _azimuth(points: Floats, axis: Floats) -> Floats:
    """Angle (N,) about ``axis``, counter-clockwise from anywhere, rad."""
    plan = points @ plane_basis(axis).T
    return np.arctan2(plan[:, 1], plan[:, 0])
