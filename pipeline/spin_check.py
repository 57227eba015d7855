"""The sense of rotation that a few sweeps in a row tell by their bend, to hold a configured one against."""

from collections.abc import Sequence

import numpy as np

from pipeline.motion import LONGEST_S, Motion, estimate_twist
from pipeline.records import Floats, PointCloud
from pipeline.spin_sense import TELLING_M_S, SpinEvidence, ToldSpin, spin_evidence, spin_sense
from pipeline.surfels import surfels

_APART = 2
"""Sweeps from one to that which it is held against: the bend that tells the sense grows with the way."""


def told_spin(
    sweeps: Sequence[tuple[int, PointCloud]], sweep_s: float | None, axis: Floats
) -> ToldSpin | None:
    """What sweeps say of the rotation; None where they leave it open, as those of a vehicle that stands do.

    Args:
        sweeps: Stamps, ns, and sweeps as they were measured, five at least.
        sweep_s: Duration of a turn, s; None: the time from one sweep to the next.
        axis: float64 (3,), unit, LiDAR frame: the spin axis, upwards.
    """
    start = None
    found, planes = [], [(stamp_ns, surfels(cloud)) for stamp_ns, cloud in sweeps]
    for (before_ns, before), (now_ns, now) in zip(planes, planes[_APART:], strict=False):
        seconds = (now_ns - before_ns) / 1e9
        if not 0.0 < seconds <= LONGEST_S:
            continue
        motion = estimate_twist(before, now, seconds, start)
        start = motion.twist if isinstance(motion, Motion) else None
        if start is None or float(np.linalg.norm(start.velocity)) < TELLING_M_S:
            continue
        answer = spin_evidence(before, now, seconds, sweep_s or seconds / _APART, axis, start)
        if isinstance(answer, SpinEvidence):
            found.append(answer)
    return spin_sense(found)
