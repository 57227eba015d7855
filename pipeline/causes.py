"""Mount, clock or lens? What moved when clouds and images no longer fit (FORMULAS G).

A camera that exposes ``dt`` later than its stamp says sees a mount that is off by ``dt`` times the motion of
the vehicle (G1); a lens of another focal length magnifies. Both look like a moved mount to one window at one
speed. Here the six unknowns of the mount are joined by these two, over many sections of road: what was
driven at another speed, or was seen at another range, tells them apart. What is not,
stays open, and the report says so.

The estimate is the generalised method of moments. A section gives the slope of its score by the eight
unknowns: ``pull - curvature theta``, zero on average at the true theta, with its own covariance. The misfit
is the weighted sum of their squares, chi-square distributed, and its drop when a cause is set free decides
(G2).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from pipeline.records import Floats, read_only

SOURCES = ("mount", "clock", "lens")
"""What may have changed; unknowns 0-5 (drift, vehicle axes), 6 (s) and 7 (log of the focal length)."""

Cause: TypeAlias = Literal["mount", "time_offset", "intrinsics_changed", "forward_or_sync", "cause_open"]
"""What the evidence names, closed list.

mount: the mount moved, whatever else did, or it explains the evidence as well as the lens.
time_offset: the clocks alone explain it, far better than the mount or the lens.
intrinsics_changed: the lens alone explains it, far better than the mount or the clocks.
forward_or_sync: mount or clocks, each alone explains it: more speeds are wanted.
cause_open: clocks or lens explain it, or no single cause does.
"""

CLOCK, LENS = 6, 7
"""Places of time offset and focal length among the unknowns."""

UNKNOWNS = 8

_BLOCKS = (slice(0, 6), slice(CLOCK, CLOCK + 1), slice(LENS, LENS + 1))

_WIDE = np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0, 1.0, 1.0])
"""rad, m, s, 1; a prior so wide that it only keeps a direction without any information invertible."""


@dataclass(frozen=True, slots=True)
class CauseParameters:
    """Thresholds, each from a stated risk of 1e-4: naming the wrong cause is an alarm of its own.

    Attributes:
        mount: Misfit that a mount at rest must add to be called moved: chi-square, 6 degrees of freedom.
        single: The same for the clock or the lens: 1 degree of freedom.
        mount_alone: Misfit up to which the mount alone explains: 2 degrees of freedom are given up.
        single_alone: The same for the clock or the lens alone: 7 degrees of freedom.
        zoom: Uncertainty of a sound focal length, as a share: 0.2 % is one px at the border of an image of
            1000 px, the blur of its gradients.
        rival: Misfit by which one cause must explain better than another to be preferred: chi-square, one
            degree of freedom, at 1e-3, odds of two hundred to one.
        mount_rival: The same for the mount over a clock that explains more than chance: five degrees of
            freedom, the unknowns it has more, at 1e-4.
        separable_sigmas: The time offset is separable when one that feigns a drift of an alert limit would
            stand out by so many sigma.
    """

    mount: float = 27.86
    single: float = 15.14
    mount_alone: float = 18.42
    single_alone: float = 29.88
    rival: float = 10.83
    mount_rival: float = 25.74
    zoom: float = 0.002
    separable_sigmas: float = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """What the frames of one section of road say of the eight unknowns, linearised.

    Attributes:
        from_ns: Stamp of its first frame.
        to_ns: Stamp of its last frame.
        curvature: float64 (8,8), minus the second derivative of the score; (drift, s, log f).
        pull: float64 (8,), ``curvature theta`` at the maximum.
        certainty: float64 (8,8), inverse covariance of the slope.
        motion: float64 (6,), drift that a second of delay would feign, vehicle axes: its largest size on each
            axis.
        speed: Mean, m/s.
        sync_s: How well the time between points and exposure is known, one sigma, s.
        tracked: Whether the motion was measured; an assumed one tells no clock from a mount.
    """

    from_ns: int
    to_ns: int
    curvature: Floats
    pull: Floats
    certainty: Floats
    motion: Floats
    speed: float
    sync_s: float
    tracked: bool = True

    def __post_init__(self) -> None:
        for name in ("curvature", "pull", "certainty", "motion"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """What the sections say of mount, clock and lens.

    Attributes:
        time_offset_s: The camera exposes so much later than its stamp says; mount free.
        time_sigma_s: Its standard deviation; wide where mount and clock can not be told apart.
        time_alone_s: The time offset that would come nearest to explain all by itself.
        separable: Whether a time offset that matters would be told from a moved mount.
        zoom: Logarithm of the true focal length over the stored one; mount free.
        zoom_sigma: Its standard deviation.
        motion: float64 (6,), drift that a second of delay would feign, its largest size on each axis.
        needed: float64 (3,), misfit that each of ``SOURCES`` adds when it alone must be sound.
        alone: float64 (3,), misfit that is left when each alone may have changed.
        unexplained: Misfit that is left when nothing has changed.
        sections: Number of sections.
    """

    time_offset_s: float
    time_sigma_s: float
    time_alone_s: float
    separable: bool
    zoom: float
    zoom_sigma: float
    motion: Floats
    needed: Floats
    alone: Floats
    unexplained: float
    sections: int

    def __post_init__(self) -> None:
        for name in ("motion", "needed", "alone"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def cause(self, parameters: CauseParameters) -> Cause:
        """What is to be named for evidence that a sound mount, clock and lens do not explain."""
        # Where the sections show too little to choose by, they have nothing to say against the mount.
        if self.needed[0] > parameters.mount or self.unexplained <= parameters.rival:
            return "mount"
        most = (parameters.mount_alone, parameters.single_alone, parameters.single_alone)
        best = int(np.argmin(self.alone))
        if self.alone[best] > most[best]:
            return "cause_open"
        rivals = self.alone <= self.alone[best] + parameters.rival
        if SOURCES[best] == "mount" and self.unexplained > self.alone[1] + parameters.rival:
            # The clock explains something. Blaming the mount instead is an alarm, with five unknowns more.
            rivals[1] |= self.alone[1] <= self.alone[0] + parameters.mount_rival
        named: dict[tuple[str, ...], Cause] = {
            ("mount",): "mount",
            ("clock",): "time_offset",
            ("lens",): "intrinsics_changed",
            ("mount", "clock"): "forward_or_sync",
            # Mounts move more often than lenses: what only a lens explains as well is held against the mount.
            ("mount", "lens"): "mount",
            ("mount", "clock", "lens"): "forward_or_sync",
        }
        fit = tuple(name for name, rival in zip(SOURCES, rivals, strict=True) if rival)
        return named.get(fit, "cause_open")

    def changed(self, source: Literal["clock", "lens"], parameters: CauseParameters) -> bool:
        """Whether clock or lens has surely changed, whatever the mount did."""
        return bool(self.needed[SOURCES.index(source)] > parameters.single)


def explain(
    sections: Sequence[Section], covariance: Floats, limits: Floats, parameters: CauseParameters
) -> Explanation:
    """Regression of all sections on mount, clock and lens (FORMULAS G2, with the lens as an eighth unknown).

    Args:
        sections: At least one, linearised against the same expected extrinsic.
        covariance: float64 (6,6), of the drift of an unmoved mount, vehicle axes: the uncertainty of
            the expected extrinsic and the floor.
        limits: float64 (6,), alert limits, rad and m.
        parameters: Thresholds.
    """
    regression = _regression(sections, covariance, parameters)
    every = frozenset(SOURCES)
    least = regression.misfit(every)
    by_clock, clock_covariance = regression.solved(every - {"lens"})
    by_lens, lens_covariance = regression.solved(every - {"clock"})
    offset_sigma = math.sqrt(float(clock_covariance[CLOCK, CLOCK]))
    motion = np.max([section.motion for section in sections], axis=0)
    tracked = bool(motion.any()) and all(section.tracked for section in sections)
    feigned = parameters.separable_sigmas * offset_sigma * motion
    return Explanation(
        time_offset_s=float(by_clock[CLOCK]),
        time_sigma_s=offset_sigma,
        time_alone_s=float(regression.solved(frozenset({"clock"}))[0][CLOCK]),
        separable=tracked and bool(np.all(feigned <= limits)),
        zoom=float(by_lens[LENS]),
        zoom_sigma=math.sqrt(float(lens_covariance[LENS, LENS])),
        motion=motion,
        needed=np.array([regression.misfit(every - {name}) - least for name in SOURCES]),
        alone=np.array([regression.misfit(frozenset({name})) - least for name in SOURCES]),
        unexplained=regression.misfit(frozenset()) - least,
        sections=len(sections),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Regression:
    """Normal equations of the unknowns, and what is known of each source while it is sound.

    Attributes:
        information: float64 (8,8).
        pull: float64 (8,), right side.
        sound: Inverse covariance of each source's own unknowns.
    """

    information: Floats
    pull: Floats
    sound: dict[str, Floats]

    def solved(self, free: frozenset[str]) -> tuple[Floats, Floats]:
        """The best unknowns (8,) when only ``free`` may have changed, and their covariance (8,8)."""
        total = self.information + np.diag(_WIDE**-2)
        for name, block in zip(SOURCES, _BLOCKS, strict=True):
            if name not in free:
                total[block, block] += self.sound[name]
        # Scaled to a diagonal of ones, the matrix is well conditioned whatever the units of rad, m and s.
        scale = np.sqrt(np.outer(np.diag(total), np.diag(total)))
        covariance = np.linalg.inv(total / scale) / scale
        return covariance @ self.pull, covariance

    def misfit(self, free: frozenset[str]) -> float:
        """Least misfit when only ``free`` may have changed, up to what is common to all ``free``."""
        # At the minimum a quadratic form is half of its linear term.
        return -float(self.pull @ self.solved(free)[0])


def _regression(sections: Sequence[Section], covariance: Floats, parameters: CauseParameters) -> _Regression:
    information, pull = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
    for section in sections:
        weighted = section.curvature.T @ section.certainty
        information += weighted @ section.curvature
        pull += weighted @ section.pull
    sync = float(np.mean([section.sync_s**2 for section in sections]))
    sound = {
        "mount": np.linalg.inv(covariance),
        "clock": np.array([[1.0 / sync]]),
        "lens": np.array([[parameters.zoom**-2]]),
    }
    return _Regression(information, pull, sound)
