"""A rig's own bias, learned on healthy drives, and how far scenes pull it (FORMULAS F2, F5; PROBE 3).

Stretches of road are the samples, windows of one street are not. Windows that share no frame show
``y_k = bias + scene_k + random_k``, ``scene_k ~ N(0, spread)``, ``random_k`` with its stated covariance; how
alike the scenes of one stretch are is not known, so together they weigh as one. Bias and spread are those of
the largest restricted posterior, the spread drawn towards the floor that holds for any rig; what is handed to
the test is narrower than that floor only where the stretches prove it.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special

from pipeline.drift_test import DriftTestParameters, Expectation
from pipeline.errors import InputError
from pipeline.records import Floats
from pipeline.road_samples import RoadSample, Scatter, Street, WindowEstimates, samples_of, stretches_of
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
        deviation: float64 (6,), root mean square of the windows from the bias.
        own: float64 (6,), root mean square of the windows' stated sigma: what of that is not the scene.
        scatter: Random error of windows inside a stretch.
        stretches: The samples in short, sorted by recording.
        tail: Of the joint statistic over healthy stretches: what a wanted run length takes.
    """

    bias: Floats
    covariance: Floats
    spread: Floats
    deviation: Floats
    own: Floats
    scatter: Scatter
    stretches: tuple[Street, ...]
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
        """b_j (6,): narrowed to what 95 % of streets surely keep, widened to what they surely do not."""
        if self._support == 1:
            return bound
        bound = np.minimum(bound, tolerance_factor(self._support) * self.deviation)
        scene = np.sqrt(np.maximum(self.deviation**2 - self.own**2, 0.0))
        return np.maximum(bound, exceeded_factor(self._support) * scene)


def tolerance_factor(count: int) -> float:
    """Standard deviations of ``count`` samples that hold 95 % of all others with 95 % confidence (Howe).

    38 for two samples, 10 for three, 3.4 for ten, 2.1 for two hundred: few streets narrow no bound.
    """
    quantile = float(special.ndtri(0.5 * (1.0 + _CONFIDENCE)))
    low = float(special.chdtri(count - 1, _CONFIDENCE))
    return quantile * math.sqrt((count - 1) * (1.0 + 1.0 / count) / low)


def exceeded_factor(count: int) -> float:
    """Standard deviations of ``count`` samples that 5 % of all others exceed, with 95 % confidence."""
    quantile = float(special.ndtri(0.5 * (1.0 + _CONFIDENCE)))
    return quantile * math.sqrt((count - 1) / float(special.chdtri(count - 1, 1.0 - _CONFIDENCE)))


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
    samples, scatter = samples_of(drives)
    if not samples:
        raise InputError("no window was judged in any recording", hint="longer healthy recordings")
    fit = _fitted(samples, parameters.floor())
    weights = _weights(samples)
    away = np.concatenate([sample.drift for sample in samples]) - fit.bias
    variances = np.concatenate([sample.covariance for sample in samples]).diagonal(axis1=1, axis2=2)
    return Baseline(
        bias=fit.bias,
        covariance=fit.covariance,
        spread=fit.spread,
        deviation=np.sqrt(weights @ away**2 / max(len(samples) - 1, 1)),
        own=np.sqrt(weights @ variances / len(samples)),
        scatter=scatter,
        stretches=tuple(sample.street for sample in samples),
        tail=_tail(drives, samples, scatter, parameters, (wanted_s, rng)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Bias (6,), its covariance (6,6), and the spread (6,6)."""

    bias: Floats
    covariance: Floats
    spread: Floats


def _weights(samples: Sequence[RoadSample]) -> Floats:
    """Weight of each window: those of one stretch weigh 1 together."""
    return np.concatenate([np.full(len(sample.drift), 1.0 / len(sample.drift)) for sample in samples])


def _fitted(samples: Sequence[RoadSample], floor: Floats) -> _Fit:
    """Bias, its covariance, and spread by restricted expectation and maximisation.

    The spread's prior is inverse Wishart about ``floor`` with the weight of ``PRIOR_SCENES`` stretches. With
    exact means it comes to ``(8 floor + sum of squares) / (8 + n - 1)``: one stretch says nothing of it.
    """
    # Whitened by the floor: radians and metres of one size, and the prior the unit matrix.
    root = np.linalg.cholesky(floor)
    unwhiten = np.linalg.inv(root)
    values = np.concatenate([sample.drift for sample in samples]) @ unwhiten.T
    noises = unwhiten @ np.concatenate([sample.covariance for sample in samples]) @ unwhiten.T
    weights = _weights(samples)
    spread = np.eye(6)
    for _ in range(_ROUNDS if len(samples) > 1 else 0):
        renewed = _renewed(spread, values, noises, weights)
        change = float(np.abs(renewed - spread).max() / np.abs(spread).max())
        if change < _SETTLED:
            spread = renewed
            break
        spread = _ahead(spread, renewed, _renewed(renewed, values, noises, weights))
    bias, covariance = _mean(weights, np.linalg.inv(spread + noises), values)
    return _Fit(root @ bias, root @ covariance @ root.T, root @ spread @ root.T)


def _renewed(spread: Floats, values: Floats, noises: Floats, weights: Floats) -> Floats:
    """The spread (6,6) after one round of expectation and maximisation, whitened by the floor.

    Args:
        spread: float64 (6,6), before it.
        values: float64 (N,6), of the windows.
        noises: float64 (N,6,6), covariance of their errors apart from the scene.
        weights: float64 (N,), 1 for the windows of one stretch together.
    """
    precision = np.asarray(np.linalg.inv(spread + noises), dtype=np.float64)
    bias, covariance = _mean(weights, precision, values)
    scene = np.einsum("nij,nj->ni", precision, values - bias)
    # Sums over the windows before products with the spread, which is the same for all of them.
    halves = np.sqrt(weights)[:, None, None] * (precision @ np.linalg.cholesky(covariance))
    halves = halves.transpose(1, 0, 2).reshape(6, -1)
    inner = (weights * scene.T) @ scene + halves @ halves.T - np.einsum("n,nij->ij", weights, precision)
    squares = float(weights.sum()) * spread + spread @ inner @ spread
    renewed = (PRIOR_SCENES * np.eye(6) + squares) / (PRIOR_SCENES + float(weights.sum()))
    return np.asarray(0.5 * (renewed + renewed.T), dtype=np.float64)


def _ahead(first: Floats, second: Floats, third: Floats) -> Floats:
    """Where three rounds lead, by squared extrapolation (Varadhan and Roland 2008): a tenth of the rounds.

    The rounds approach their end as a geometric series does. An extrapolation that is no covariance is left.
    """
    step = second - first
    bend = third - second - step
    length = float(np.linalg.norm(step)) / max(float(np.linalg.norm(bend)), 1e-300)
    if length <= 1.0:
        return third
    there = first + 2.0 * length * step + length**2 * bend
    # Each round keeps at least the prior's share of the unit matrix.
    return there if float(np.linalg.eigvalsh(there)[0]) > 0.0 else third


def _mean(weights: Floats, precision: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Weighted mean by information (6,), and its covariance (6,6)."""
    covariance = np.linalg.inv(np.einsum("n,nij->ij", weights, precision))
    return covariance @ np.einsum("n,nij,nj->i", weights, precision, values, optimize=True), covariance


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


def left_out(drives: Sequence[WindowEstimates], parameters: DriftTestParameters) -> tuple[LeftOut, ...]:
    """Each recording against the baseline of all others; nothing where there is only one recording.

    However long it is, a recording counts as one scene: it has one load, weather, and traffic.
    """
    samples, _ = samples_of(drives)
    results = []
    for name, own, others in _split(samples):
        fit = _fitted(others, parameters.floor())
        weights = _weights(own)
        precision = np.linalg.inv(np.concatenate([sample.covariance for sample in own]))
        mean, random = _mean(weights / weights.sum(), precision, np.concatenate([s.drift for s in own]))
        P = random + supported_floor(fit.spread, parameters.floor(), len(others)) + fit.covariance
        difference = mean - fit.bias
        results.append(
            LeftOut(
                recording=name,
                difference=difference,
                sigma=np.sqrt(np.diag(P)),
                statistic=float(difference @ np.linalg.solve(P, difference)),
            )
        )
    return tuple(results)


def _split(samples: Sequence[RoadSample]) -> Iterator[tuple[str, list[RoadSample], list[RoadSample]]]:
    """Each recording by name with its own samples and those of all others; nothing of a single one."""
    names = sorted({sample.street.recording for sample in samples})
    for name in names if len(names) > 1 else ():
        own = [sample for sample in samples if sample.street.recording == name]
        yield name, own, [sample for sample in samples if sample.street.recording != name]


def _tail(
    drives: Sequence[WindowEstimates],
    samples: Sequence[RoadSample],
    scatter: Scatter,
    parameters: DriftTestParameters,
    wanted: tuple[float, np.random.Generator],
) -> Tail:
    """The tail over stretches, each against the baseline of other recordings.

    Unknown where there is only one recording: against its own mean a drive looks better than it is.
    """
    wanted_s, rng = wanted
    seconds = np.array([sample.street.seconds for sample in samples])
    unknown = unknown_tail(seconds, wanted_s)
    if len(samples) < unknown.needed or len({sample.street.recording for sample in samples}) == 1:
        return unknown
    return tail_of(_largest_statistics(drives, samples, scatter, parameters), seconds, wanted_s, rng)


def _largest_statistics(
    drives: Sequence[WindowEstimates],
    samples: Sequence[RoadSample],
    scatter: Scatter,
    parameters: DriftTestParameters,
) -> Floats:
    """Per stretch the largest joint statistic of its windows against the baseline of other recordings."""
    floor = parameters.floor()
    by_name = {drive.recording: drive for drive in drives}
    largest = []
    for name, _, others in _split(samples):
        fit = _fitted(others, floor)
        common = supported_floor(fit.spread, floor, len(others)) + fit.covariance
        for part in stretches_of(by_name[name]):
            P = max(scatter.noise, 1.0) ** 2 * part.covariance + common
            P = P + part.feigned[:, :, None] * part.feigned[:, None, :]
            away = part.drift - fit.bias
            solved = np.linalg.solve(P, away[:, :, None])[:, :, 0]
            largest.append(float(np.einsum("ni,ni->n", away, solved).max()))
    return np.array(largest)
