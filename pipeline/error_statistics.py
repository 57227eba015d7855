"""How right a set of answers is, and how honest their covariances are, where the truth is known."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pipeline.records import Floats

CONFIDENT_SIGMAS = 4.0
"""An error beyond so many sigmas is a wrong answer given with confidence: 6e-5 of honest ones go there."""

_LEVEL = 0.95
"""Quantile of chi-square at which answers are counted."""


@dataclass(frozen=True, slots=True)
class Honesty:
    """Stated covariances against errors.

    Attributes:
        axes: Errors that were compared, those of observable axes.
        within_one: Share of them within one sigma; 0.683 where the covariance is right.
        within_two: Within two; 0.954.
        confident_wrong: How many lie beyond ``CONFIDENT_SIGMAS``.
        mean_square: Sum of the normalised squared errors over the sum of their degrees of freedom; 1.
        below_95: Share of answers below the 95 % point of chi-square; 0.95.
        p: Kolmogorov-Smirnov probability of so large a difference from chi-square by chance.
    """

    axes: int
    within_one: float
    within_two: float
    confident_wrong: int
    mean_square: float
    below_95: float
    p: float


def normalised_square(error: Floats, covariance: Floats, seen: NDArray[np.bool_]) -> float:
    """``e^T C^-1 e`` over the seen axes of an error (n,) with covariance (n,n): chi-square, their number."""
    e = error[seen]
    return float(e @ np.linalg.solve(covariance[np.ix_(seen, seen)], e))


def beyond(error: Floats, sigma: Floats, reference_sigma: Floats, seen: NDArray[np.bool_]) -> Floats:
    """Errors over the sigmas of answer and reference together, float64 (n,); NaN on axes not seen."""
    ratio = np.abs(error) / np.hypot(sigma, reference_sigma)
    return np.asarray(np.where(seen, ratio, np.nan), dtype=np.float64)


def honesty(
    errors: Sequence[Floats],
    covariances: Sequence[Floats],
    seen: Sequence[NDArray[np.bool_]],
    reference_sigmas: Sequence[Floats],
) -> Honesty | None:
    """Compares answers with what they say of themselves.

    Args:
        errors: float64 (6,) of each answer, rad and m.
        covariances: float64 (6,6) of each.
        seen: bool (6,) of each: axes that it calls observable.
        reference_sigmas: float64 (6,) of each: how well its truth is known; 0 in simulation.

    Returns:
        The comparison, or None where no axis of any answer is observable.
    """
    ratios = np.concatenate(
        [
            beyond(error, np.sqrt(np.diag(covariance)), sigma, mask)
            for error, covariance, mask, sigma in zip(
                errors, covariances, seen, reference_sigmas, strict=True
            )
        ]
        or [np.zeros(0)]
    )
    ratios = ratios[np.isfinite(ratios)]
    if len(ratios) == 0:
        return None
    squares, freedom = [], []
    for error, covariance, mask, sigma in zip(errors, covariances, seen, reference_sigmas, strict=True):
        if mask.any():
            squares.append(normalised_square(error, covariance + np.diag(sigma**2), mask))
            freedom.append(int(mask.sum()))
    # Answers see different numbers of axes: through their own distribution all of them become uniform.
    levels = np.asarray(stats.chi2.cdf(squares, freedom), dtype=np.float64)
    return Honesty(
        axes=len(ratios),
        within_one=float((ratios <= 1).mean()),
        within_two=float((ratios <= 2).mean()),
        confident_wrong=int((ratios > CONFIDENT_SIGMAS).sum()),
        mean_square=float(np.sum(squares) / np.sum(freedom)),
        below_95=float((levels <= _LEVEL).mean()),
        p=float(stats.kstest(levels, "uniform").pvalue),
    )


def mean_absolute(
    errors: Sequence[Floats], seen: Sequence[NDArray[np.bool_]] | None = None
) -> list[float | None]:
    """Mean absolute error of each axis over answers (6,), or over those that see it; None without any."""
    found: list[float | None] = []
    for axis in range(6):
        values = [
            abs(float(error[axis])) for i, error in enumerate(errors) if seen is None or bool(seen[i][axis])
        ]
        found.append(float(np.mean(values)) if values else None)
    return found


def clopper_pearson(hits: int, of: int, level: float = 0.95) -> tuple[float, float]:
    """Exact interval of a share (Clopper and Pearson 1934): at least ``level`` of such intervals hold it.

    Args:
        hits: How often.
        of: Out of how many; without any the share may be anything.
        level: Of confidence.
    """
    tail = 0.5 * (1.0 - level)
    low = float(stats.beta.ppf(tail, hits, of - hits + 1)) if hits > 0 else 0.0
    high = float(stats.beta.ppf(1.0 - tail, hits + 1, of - hits)) if hits < of else 1.0
    return low, high


@dataclass(frozen=True, slots=True)
class Balance:
    """How well two kinds are told apart, each counted by itself.

    Attributes:
        accuracy: Mean of the two shares that were told rightly.
        low: Both true shares lie above limits of this mean, at 95 %.
        high: Below, likewise.
    """

    accuracy: float
    low: float
    high: float


def balance(found: tuple[int, int], quiet: tuple[int, int]) -> Balance | None:
    """Balanced accuracy with an interval.

    Args:
        found: Wrong ones that were told wrong, and wrong ones in all.
        quiet: Healthy ones that were told healthy, and healthy ones in all.

    Returns:
        None where one of the two kinds is absent. The interval is that of two Clopper-Pearson intervals of
        97.5 % each, which both hold at 95 % whatever ties them.
    """
    if found[1] == 0 or quiet[1] == 0:
        return None
    ends = [clopper_pearson(*one, level=0.975) for one in (found, quiet)]
    return Balance(
        accuracy=0.5 * (found[0] / found[1] + quiet[0] / quiet[1]),
        low=0.5 * (ends[0][0] + ends[1][0]),
        high=0.5 * (ends[0][1] + ends[1][1]),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Roc:
    """What a threshold on a score gives.

    Attributes:
        false: float64 (n,), ascending: share of healthy ones above the threshold.
        found: float64 (n,), share of wrong ones above it.
        area: Under the curve: chance that a wrong one scores above a healthy one, ties by half.
        best: Highest balanced accuracy of any threshold, with hindsight.
    """

    false: Floats
    found: Floats
    area: float
    best: float


def roc(healthy: Sequence[float], wrong: Sequence[float]) -> Roc | None:
    """Receiver operating characteristic of scores, from no alarm to nothing but alarms; None without both."""
    if not healthy or not wrong:
        return None
    ones, others = np.sort(np.asarray(healthy)), np.sort(np.asarray(wrong))
    thresholds = np.unique(np.concatenate([ones, others]))[::-1]
    false, found = (
        np.concatenate([[0.0], 1.0 - np.searchsorted(scores, thresholds, side="left") / len(scores)])
        for scores in (ones, others)
    )
    return Roc(
        false=false,
        found=found,
        area=float(np.trapezoid(found, false)),
        best=float(np.max(0.5 * (found + 1.0 - false))),
    )
