"""A rig's own bias, learned on healthy drives, and how far scenes pull it (FORMULAS F2, F5; PROBE 3).

Stretches of road are the samples, windows of one street are not. A stretch ``s`` shows
``y_s = bias + scene_s + random_s``, ``scene_s ~ N(0, spread)``, ``random_s`` with its stated covariance. Bias
and spread are those of the largest restricted posterior, the spread drawn towards the floor that holds for
any rig; what is handed to the test is narrower than that floor only where the stretches prove it.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from pipeline.drift_test import DriftTestParameters, Expectation
from pipeline.errors import InputError
from pipeline.records import Floats
from pipeline.road_samples import (
    RoadSample,
    Scatter,
    WindowEstimates,
    sample_of,
    scatter_of,
    stretches_of,
)
from pipeline.run_tail import Tail, tail_of, unknown_tail

PRIOR_SCENES = 8.0
"""Scenes that the floor for any rig was drawn from, two drives and six single frames (PROBE 3): it weighs as
much as eight stretches of the rig's own."""

_CONFIDENCE = 0.95
"""Of the upper limit of a spread, and of the bound that 95 % of stretches keep."""

_ROUNDS, _SETTLED = 2000, 1e-7
"""Rounds of expectation and maximisation at most, and the relative change that ends them."""


@dataclass(frozen=True, slots=True, eq=False)
class Baseline:
    """What healthy drives taught about one mount; vehicle axes, rad and m.

    Attributes:
        bias: float64 (6,), estimate of the unmoved mount against the stored extrinsic.
        covariance: float64 (6,6), of the bias.
        spread: float64 (6,6), covariance of what the scene adds, drawn towards the floor for any rig.
        departure: float64 (6,), largest departure of a stretch from the bias beyond two sigma of its own.
        deviation: float64 (6,), standard deviation of the stretches' means; 0 for one stretch.
        scatter: Random error of windows inside a stretch.
        stretches: The samples, sorted by recording.
        tail: Of the joint statistic over healthy stretches: what a wanted run length takes.
    """

    bias: Floats
    covariance: Floats
    spread: Floats
    departure: Floats
    deviation: Floats
    scatter: Scatter
    stretches: tuple[RoadSample, ...]
    tail: Tail

    @property
    def samples(self) -> float:
        """Independent windows that all stretches are worth."""
        return sum(stretch.samples for stretch in self.stretches)

    def expectation(self, parameters: DriftTestParameters) -> Expectation:
        """What the test expects of the mount while it has not moved (FORMULAS F2, F5)."""
        floor = supported_floor(self.spread, parameters.floor(), self._support)
        return Expectation(self.bias, self.covariance, floor, self._bound(parameters.bound()))

    @property
    def _support(self) -> int:
        """Stretches that may narrow what holds for any rig: one drive has one weather, load and traffic."""
        return len(self.stretches) if len({stretch.recording for stretch in self.stretches}) > 1 else 1

    def thresholds(self, parameters: DriftTestParameters) -> DriftTestParameters:
        """The test with the alarm of the wanted run length, where the stretches suffice to tell it."""
        if self.tail.threshold is None:
            return parameters
        return dataclasses.replace(parameters, alarm=max(self.tail.threshold, parameters.suspicion))

    def _bound(self, bound: Floats) -> Floats:
        """b_j (6,): narrowed to what the stretches are sure to keep, widened to what one did not keep."""
        if self._support > 1:
            bound = np.minimum(bound, tolerance_factor(self._support) * self.deviation)
        return np.maximum(bound, self.departure)


def tolerance_factor(count: int) -> float:
    """Standard deviations of ``count`` samples that hold 95 % of all others with 95 % confidence (Howe).

    38 for two samples, 10 for three, 3.4 for ten, 2.1 for two hundred: few streets narrow no bound.
    """
    quantile = float(special.ndtri(0.5 * (1.0 + _CONFIDENCE)))
    low = float(special.chdtri(count - 1, _CONFIDENCE))
    return quantile * math.sqrt((count - 1) * (1.0 + 1.0 / count) / low)


def supported_floor(spread: Floats, floor: Floats, count: int) -> Floats:
    """The floor (6,6) that ``count`` stretches support in place of the one for any rig.

    Direction by direction, in units of that floor: wider where the stretches spread more; narrower only as
    far as the upper limit of their spread, with the floor's own scenes counted in. One alone narrows nothing.
    """
    root = np.linalg.cholesky(floor)
    whitened = np.linalg.solve(root, np.linalg.solve(root, spread).T)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    degrees = PRIOR_SCENES + count - 1.0
    upper = values * degrees / float(special.chdtri(degrees, _CONFIDENCE)) if count > 1 else 1.0
    values = np.where(values < 1.0, np.minimum(upper, 1.0), values)
    scaled = root @ vectors
    return np.asarray((scaled * values) @ scaled.T, dtype=np.float64)


def learn(
    drives: Sequence[WindowEstimates],
    parameters: DriftTestParameters,
    wanted_s: float,
    rng: np.random.Generator,
) -> Baseline:
    """Learns from the window estimates of healthy drives; their order does not matter.

    Args:
        drives: One per recording, names unique, each with at least one window.
        parameters: Of the test: its floor is what the spread is drawn towards.
        wanted_s: Wanted run length between two false alarms, s.
        rng: Draws the bootstrap of the threshold.

    Raises:
        InputError: There is no window at all.
    """
    parts = [part for drive in sorted(drives, key=lambda d: d.recording) for part in stretches_of(drive)]
    if not parts:
        raise InputError("no window was judged in any recording", hint="longer healthy recordings")
    scatter = scatter_of(parts)
    stretches = tuple(sample_of(part, scatter) for part in parts)
    bias, covariance, spread = _fitted(stretches, parameters.floor())
    means = np.array([stretch.mean for stretch in stretches])
    own = 2.0 * np.sqrt([np.diag(stretch.covariance) for stretch in stretches])
    deviation = means.std(axis=0, ddof=1) if len(means) > 1 else np.zeros(6)
    return Baseline(
        bias=bias,
        covariance=covariance,
        spread=spread,
        departure=np.maximum(np.abs(means - bias) - own, 0.0).max(axis=0),
        deviation=np.asarray(deviation, dtype=np.float64),
        scatter=scatter,
        stretches=stretches,
        tail=_tail(parts, stretches, scatter, parameters, (wanted_s, rng)),
    )


def _fitted(stretches: Sequence[RoadSample], floor: Floats) -> tuple[Floats, Floats, Floats]:
    """Bias (6,), its covariance (6,6), and spread (6,6) by restricted expectation and maximisation.

    The spread's prior is inverse Wishart about ``floor`` with the weight of ``PRIOR_SCENES`` stretches. With
    exact means it comes to ``(8 floor + sum of squares) / (8 + n - 1)``: one stretch says nothing of it.
    """
    # Whitened by the floor: radians and metres of one size, and the prior the unit matrix.
    root = np.linalg.cholesky(floor)
    unwhiten = np.linalg.inv(root)
    means = np.array([s.mean for s in stretches]) @ unwhiten.T
    noises = unwhiten @ np.array([s.covariance for s in stretches]) @ unwhiten.T
    spread = np.eye(6)
    for _ in range(_ROUNDS):
        precision = np.linalg.inv(spread + noises)
        covariance = np.linalg.inv(precision.sum(axis=0))
        bias = covariance @ np.einsum("nij,nj->i", precision, means)
        gain = spread @ precision
        scene = np.einsum("nij,nj->ni", gain, means - bias)
        left = spread - gain @ spread + gain @ covariance @ gain.transpose(0, 2, 1)
        renewed = (PRIOR_SCENES * np.eye(6) + scene.T @ scene + left.sum(axis=0)) / (
            PRIOR_SCENES + len(stretches)
        )
        change = float(np.abs(renewed - spread).max() / np.abs(spread).max())
        spread = 0.5 * (renewed + renewed.T)
        if change < _SETTLED:
            break
    precision = np.linalg.inv(spread + noises)
    covariance = np.linalg.inv(precision.sum(axis=0))
    bias = covariance @ np.einsum("nij,nj->i", precision, means)
    return root @ bias, root @ covariance @ root.T, root @ spread @ root.T


@dataclass(frozen=True, slots=True, eq=False)
class LeftOut:
    """A recording against the baseline of the others.

    Attributes:
        recording: Its name.
        difference: float64 (6,), its own mean minus the bias of the others, rad and m.
        sigma: float64 (6,), of that difference, the spread of scenes included.
        statistic: Joint statistic of the difference, chi-square of six degrees of freedom for like mounts.
    """

    recording: str
    difference: Floats
    sigma: Floats
    statistic: float


def left_out(stretches: Sequence[RoadSample], parameters: DriftTestParameters) -> tuple[LeftOut, ...]:
    """Each recording against the baseline of all others; nothing where there is only one recording.

    However long it is, a recording counts as one scene: it has one load, weather, and traffic.
    """
    names = sorted({stretch.recording for stretch in stretches})
    results = []
    for name in names if len(names) > 1 else ():
        own = [stretch for stretch in stretches if stretch.recording == name]
        others = [stretch for stretch in stretches if stretch.recording != name]
        bias, covariance, spread = _fitted(others, parameters.floor())
        floor = supported_floor(spread, parameters.floor(), len(others))
        mean, random = _joined(own)
        P = random + floor + covariance
        difference = mean - bias
        results.append(
            LeftOut(
                recording=name,
                difference=difference,
                sigma=np.sqrt(np.diag(P)),
                statistic=float(difference @ np.linalg.solve(P, difference)),
            )
        )
    return tuple(results)


def _joined(stretches: Sequence[RoadSample]) -> tuple[Floats, Floats]:
    """Mean of several stretches by information, and its random covariance."""
    information = np.linalg.inv([stretch.covariance for stretch in stretches])
    covariance = np.linalg.inv(information.sum(axis=0))
    means = np.array([stretch.mean for stretch in stretches])
    return covariance @ np.einsum("nij,nj->i", information, means), covariance


def _tail(
    parts: Sequence[WindowEstimates],
    stretches: Sequence[RoadSample],
    scatter: Scatter,
    parameters: DriftTestParameters,
    wanted: tuple[float, np.random.Generator],
) -> Tail:
    """The tail over stretches, each against the baseline of other recordings.

    Unknown where there is only one recording: against its own mean a drive looks better than it is.
    """
    wanted_s, rng = wanted
    seconds = np.array([stretch.seconds for stretch in stretches])
    unknown = unknown_tail(seconds, wanted_s)
    if len(stretches) < unknown.needed or len({stretch.recording for stretch in stretches}) == 1:
        return unknown
    return tail_of(_largest_statistics(parts, stretches, scatter, parameters), seconds, wanted_s, rng)


def _largest_statistics(
    parts: Sequence[WindowEstimates],
    stretches: Sequence[RoadSample],
    scatter: Scatter,
    parameters: DriftTestParameters,
) -> Floats:
    """Per stretch the largest joint statistic of its windows against the baseline of other recordings."""
    floor = parameters.floor()
    largest = np.zeros(0)
    for name in sorted({stretch.recording for stretch in stretches}):
        others = [stretch for stretch in stretches if stretch.recording != name]
        bias, covariance, spread = _fitted(others, floor)
        common = supported_floor(spread, floor, len(others)) + covariance
        for part in parts:
            if part.recording == name:
                P = max(scatter.noise, 1.0) ** 2 * part.covariance + common
                P = P + part.feigned[:, :, None] * part.feigned[:, None, :]
                away = part.drift - bias
                solved = np.linalg.solve(P, away[:, :, None])[:, :, 0]
                largest = np.append(largest, np.einsum("ni,ni->n", away, solved).max())
    return largest
