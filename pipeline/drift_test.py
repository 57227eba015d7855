"""Is the stored extrinsic still true? Joint test of six axes, protection levels, smallest noticed drift.

Three kinds of error are kept apart (FORMULAS F, DESIGN 4): the random error of the window (its covariance),
the systematic floor between scenes (measured on drives of one calibration, PROBE 3), and the stored
extrinsic's own uncertainty. The last one widens the claim 'it moved', not the protection level.
"""

import dataclasses
import functools
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import chdtri, chndtr

from pipeline.records import AXES, Floats, read_only
from pipeline.run_length import AlarmBudget


@dataclass(frozen=True, slots=True)
class DriftTestParameters:
    """Thresholds of the test, each from a stated risk.

    Attributes:
        alarm: Joint statistic above which a window alone says 'moved': chi-square, 6 degrees of freedom, at
            1e-4, which is for the first scene of a drive; :func:`at_chance` raises it for later ones.
        suspicion: The same at 1e-3: more evidence is wanted.
        least_loss: Share of the best score that must be lost when the stored extrinsic may only move inside
            the floor: half as much again as the largest of 300 healthy windows on four drives (PROBE 5).
        suspicious_loss: Loss that is suspicious whatever the joint statistic says.
        least_preference: Standard errors by which the cells of the image, one by one, prefer the estimate to
            what only the floor explains: on simulated country roads false modes that a few dense objects
            prefer reach 0.5, at a loss of up to 0.1 and statistics of hundreds; drifts reach 2 to 8.
        least_contrast: Score at the estimate over chance, minus 1, below which image and cloud show nothing
            in common: three frames with nothing to say lay below 0.09, all others above 0.25 (PROBE 9).
        least_peak: Height of the maximum over chance, in sigma of the score at random extrinsics, below which
            it may be chance: the highest of a thousand independent places exceeds 3.7 sigma in one case of
            ten. Settled after looking: of
            21 recorded frames three lay below.
        far_rad: Turn beyond which a maximum was found by a search of many more places, rad: the near grid's
            2.25 deg and what is climbed from its edge.
        least_far_peak: The same as ``least_peak`` for such a maximum, sigma: the highest of a hundred
            thousand places exceeds it at 1e-4. Images of a second later gave 5.0, recorded drives that
            were off by 5 deg 6.4 to 21.
        K_fa: Two-sided quantile of a false alarm of 1e-5 per axis (FORMULAS F5).
        K_md: One-sided quantile of a missed drift of 1e-3 (FORMULAS F5).
        most_sigma: An axis is observable while its sigma is at most so many alert limits (DESIGN 4).
        floor_roll: Systematic floor of roll between scenes, rad.
        floor_bearing: Floor of the bearing up and down, and across, at ``bearing_range``, rad: what is sure.
        floor_m: Floor of forward, left, up, m.
        lines_floor_rad: Systematic floor of what lines say of one angle, rad: the middle of a mask is no more
            the middle of the paint than a few px, and lanes leave roll to the far end of a dash.
        lines_floor_m: The same of one shift, m.
        bearing_range: Range at which pitch and up, yaw and left make one bearing, m (PROBE 3).
        bound_rad: Bound of the systematic error of one angle between scenes, rad.
        bound_m: Bound of the systematic error of one shift between scenes, m.
    """

    alarm: float = 27.86
    suspicion: float = 22.46
    least_loss: float = 0.03
    suspicious_loss: float = 0.10
    least_preference: float = 2.0
    least_contrast: float = 0.15
    least_peak: float = 3.7
    far_rad: float = math.radians(2.5)
    least_far_peak: float = 6.0
    K_fa: float = 4.417
    K_md: float = 3.090
    most_sigma: float = 2.0
    floor_roll: float = math.radians(0.06)
    floor_bearing: float = math.radians(0.04)
    floor_m: tuple[float, float, float] = (0.03, 0.04, 0.03)
    lines_floor_rad: float = math.radians(0.3)
    lines_floor_m: float = 0.10
    bearing_range: float = 20.0
    bound_rad: float = math.radians(0.13)
    bound_m: float = 0.04

    def floor(self) -> Floats:
        """Structured floor Qz, float64 (6,6), vehicle axes: ``A^-1 diag^2 A^-T`` (PROBE 3)."""
        A = np.eye(6)
        A[1, 5] = -1.0 / self.bearing_range
        A[2, 4] = 1.0 / self.bearing_range
        sigma = np.array([self.floor_roll, self.floor_bearing, self.floor_bearing, *self.floor_m])
        inverse = np.linalg.inv(A)
        return np.asarray(inverse @ np.diag(sigma**2) @ inverse.T, dtype=np.float64)

    def lines_floor(self) -> Floats:
        """Systematic floor of the line witness, float64 (6,6), vehicle axes."""
        return np.diag([self.lines_floor_rad**2] * 3 + [self.lines_floor_m**2] * 3)

    def bound(self) -> Floats:
        """Bound b_j of the systematic error per axis, float64 (6,), rad and m (FORMULAS F5)."""
        return np.array([self.bound_rad] * 3 + [self.bound_m] * 3)


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What a window says, in vehicle axes.

    Attributes:
        drift: float64 (6,), motion of the mount against what is expected of it, rad and m.
        covariance: float64 (6,6), of its random error.
        loss: Share of the best score lost when only the floor may explain it (inf where no score exists).
        contrast: Score at the estimate over chance, minus 1.
        peak: Height of that score over chance, in sigma (inf where no score exists).
        preference: How clearly the cells of the image prefer the estimate to what only the floor explains,
            standard errors (inf where no score exists).
        persistent: Whether each part of the window by itself prefers the estimate.
        frames: Frames in the window.
        contradicted: Whether the two witnesses differ by more than their errors allow.
        feigned: float64 (6,), drift that one sigma of error in the time between sweep and image would feign:
            forward or sync can not be told apart by one window (FORMULAS G1).
    """

    drift: Floats
    covariance: Floats
    loss: float
    contrast: float
    peak: float
    preference: float
    persistent: bool
    frames: int
    contradicted: bool = False
    feigned: Floats = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """The test's result for one window. Arrays are float64 or bool (6,), in the order of ``records.AXES``.

    Attributes:
        drift: Estimate, rad and m.
        sigma: Its random error.
        protection_level: No drift beyond it is missed at the stated risk (FORMULAS F5).
        detectable: Smallest drift of this axis alone that the joint test would have noticed.
        observable: Sigma at most ``most_sigma`` alert limits.
        monitored: Protection level at or below the alert limit.
        excluded: Drift beyond the alert limit is excluded: ``|d| + K_md sigma + b <= limit``.
        statistic: Joint statistic T, chi-square of six degrees of freedom without drift.
        alarming: The window by itself says 'moved'.
        suspicious: More evidence is wanted.
        blind: Image and cloud show nothing in common, or nothing that one extrinsic alone explains.
        ambiguous: The latter: the estimate is far off, and most cells of the image prefer what is expected.
        contradicted: The witnesses contradict each other: nothing is claimed.
    """

    drift: Floats
    sigma: Floats
    protection_level: Floats
    detectable: Floats
    observable: NDArray[np.bool_]
    monitored: NDArray[np.bool_]
    excluded: NDArray[np.bool_]
    statistic: float
    alarming: bool
    suspicious: bool
    blind: bool
    ambiguous: bool
    contradicted: bool

    def __post_init__(self) -> None:
        for name in (
            "drift",
            "sigma",
            "protection_level",
            "detectable",
            "observable",
            "monitored",
            "excluded",
        ):
            object.__setattr__(self, name, read_only(getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class Expectation:
    """What the estimate of a mount that has not moved is expected to be; vehicle axes, rad and m.

    Attributes:
        mean: float64 (6,), against the stored extrinsic: no mount shows exactly what is stored of it.
        covariance: float64 (6,6), of that mean: C_ref of FORMULAS F2. Common to all windows.
        floor: float64 (6,6), by how much the mean differs between scenes: Q of FORMULAS F2.
        bound: float64 (6,), bound b_j of the difference between scenes (FORMULAS F5).
    """

    mean: Floats
    covariance: Floats
    floor: Floats
    bound: Floats


def expectation_of_stored(sigma_rad: float, sigma_m: float, parameters: DriftTestParameters) -> Expectation:
    """Of an extrinsic known to ``sigma_rad`` and ``sigma_m`` per axis, of whose rig no more is known."""
    covariance = np.diag([sigma_rad**2] * 3 + [sigma_m**2] * 3)
    return Expectation(np.zeros(6), covariance, parameters.floor(), parameters.bound())


_NOTICED = 0.99
"""Chance with which a drift that is called detectable is noticed."""


@functools.lru_cache(maxsize=1024)
def _noncentrality(alarm: float) -> float:
    """Squared drift in sigmas that exceeds ``alarm`` with chance ``_NOTICED`` (F2): 51.8 at 27.86."""

    def excess(noncentrality: float) -> float:
        return 1.0 - float(chndtr(alarm, len(AXES), noncentrality)) - _NOTICED

    return float(brentq(excess, 1e-6, 4.0 * alarm + 100.0, xtol=1e-3))


def at_chance(parameters: DriftTestParameters, budget: AlarmBudget, scene: int) -> DriftTestParameters:
    """The test for one window in scene number ``scene`` (1 is the first) of a drive."""
    alarm, suspicion = _levels(budget, min(scene, budget.settled))
    return dataclasses.replace(parameters, alarm=alarm, suspicion=suspicion)


@functools.lru_cache(maxsize=1024)
def _levels(budget: AlarmBudget, scene: int) -> tuple[float, float]:
    chance = budget.chance(scene)
    return float(chdtri(len(AXES), chance)), float(chdtri(len(AXES), budget.suspicion_factor * chance))


def judge(
    evidence: Evidence, expectation: Expectation, limits: Floats, parameters: DriftTestParameters
) -> Judgement:
    """Tests the evidence of one window against what is expected of an unmoved mount (FORMULAS F2, F5).

    Args:
        evidence: Estimate, relative to the expected mean, and its error, vehicle axes.
        expectation: Of a mount that has not moved.
        limits: float64 (6,), alert limits, rad and m.
        parameters: Thresholds.
    """
    sigma = np.sqrt(np.diag(evidence.covariance))
    P = evidence.covariance + np.outer(evidence.feigned, evidence.feigned)
    P = P + expectation.floor + expectation.covariance
    P_inverse = np.linalg.inv(P)
    statistic = float(evidence.drift @ P_inverse @ evidence.drift)
    bound = expectation.bound + 2.0 * np.abs(evidence.feigned)
    protection = (parameters.K_fa + parameters.K_md) * sigma + bound
    far = float(np.linalg.norm(evidence.drift[:3])) > parameters.far_rad
    least_peak = parameters.least_far_peak if far else parameters.least_peak
    in_common = evidence.contrast >= parameters.least_contrast and evidence.peak >= least_peak
    ambiguous = statistic > parameters.suspicion and evidence.preference <= 0.0
    seen = in_common and not ambiguous
    preferred = evidence.preference > parameters.least_preference
    convincing = evidence.loss > parameters.least_loss and preferred and evidence.persistent and seen
    # Without edges there is no score to lose: lines are judged by the joint statistic alone.
    lost = parameters.suspicious_loss < evidence.loss < math.inf
    return Judgement(
        drift=evidence.drift,
        sigma=sigma,
        protection_level=protection,
        detectable=np.sqrt(_noncentrality(parameters.alarm) / np.diag(P_inverse)),
        observable=seen & (sigma <= parameters.most_sigma * limits),
        monitored=seen & (protection <= limits),
        excluded=np.abs(evidence.drift) + parameters.K_md * sigma + bound <= limits,
        statistic=statistic,
        alarming=statistic > parameters.alarm and convincing and not evidence.contradicted,
        suspicious=seen and (statistic > parameters.suspicion or lost),
        blind=not seen,
        ambiguous=in_common and ambiguous,
        contradicted=evidence.contradicted,
    )
