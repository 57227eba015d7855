"""The model of ``simulation.evidence`` fitted to estimates of image-level drives, whose truth is known."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from pipeline.errors import InputError
from pipeline.records import Floats
from pipeline.scene_filter import Scene

_LEAST_STREETS = 4
"""Streets; fewer tell nothing of what differs between them."""

_LOG_BOUNDS = (
    (math.log(0.1), math.log(5.0)),
    (math.log(1e-3), math.log(5.0)),
    (math.log(5.0), math.log(2e3)),
)
"""Of ratio, share, and correlation in m."""

_FREEDOMS = np.array([3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 60.0, 200.0])
"""Degrees of freedom that are tried for the tails."""


@dataclass(frozen=True, slots=True, eq=False)
class EvidenceFit:
    """What the estimates of drives with an unmoved mount say; errors are estimates, since truth is zero.

    Attributes:
        streets: How many drives.
        scenes: Their scenes.
        ratio: Sigmas of the random error over the stated ones, and its 90 % interval.
        share: Sigmas of the systematic part over those of the floor, and its interval.
        correlation_m: Way over which it keeps 1/e, m, and its interval.
        freedom: Degrees of freedom of the tails.
        covariance: float64 (6,6), stated for a scene of middling worth.
        worth_spread: Standard deviation of the logarithm of stated sigmas.
        squares: float64 (scenes,), ascending: squared errors in sigmas of the fitted model, chi-square of six
            degrees where it is right.
        lag_m: float64 (m,), ways between two scenes of one street, m.
        lag_correlation: float64 (m,), correlation of their errors in sigmas, over axes and pairs.
    """

    streets: int
    scenes: int
    ratio: tuple[float, float, float]
    share: tuple[float, float, float]
    correlation_m: tuple[float, float, float]
    freedom: float
    covariance: Floats
    worth_spread: float
    squares: Floats
    lag_m: Floats
    lag_correlation: Floats


def fit(drives: Sequence[Sequence[Scene]], floor: Floats) -> EvidenceFit:
    """Maximum likelihood of ratio, share and correlation; intervals by the profile of each.

    Args:
        drives: Scenes of each drive with an unmoved mount, whose stored extrinsic is the true one.
        floor: float64 (6,6), shape of the systematic part.
    """
    drives = [drive for drive in drives if drive]
    if len(drives) < _LEAST_STREETS:
        raise InputError(
            f"{len(drives)} streets are too few to fit how they differ", hint=f"{_LEAST_STREETS} or more"
        )
    blocks = [_Block(drive, floor) for drive in drives]

    def cost(x: Floats) -> float:
        return sum(block.surprise(*np.exp(x)) for block in blocks)

    best = minimize(cost, np.log([1.0, 0.5, 60.0]), method="Nelder-Mead", bounds=_LOG_BOUNDS)
    intervals = [_interval(cost, best.x, best.fun, index) for index in range(3)]
    ratio, share, correlation_m = (float(v) for v in np.exp(best.x))
    squares = np.sort(np.concatenate([block.squares(ratio, share) for block in blocks]))
    worths = np.array([_log_worth(scene.covariance) for drive in drives for scene in drive])
    middling = np.mean(
        [scene.covariance / math.exp(2.0 * _log_worth(scene.covariance)) for d in drives for scene in d],
        axis=0,
    )
    lags, correlations = _lags(blocks)
    return EvidenceFit(
        streets=len(drives),
        scenes=len(squares),
        ratio=(ratio, *intervals[0]),
        share=(share, *intervals[1]),
        correlation_m=(correlation_m, *intervals[2]),
        freedom=_freedom(squares),
        covariance=middling * math.exp(2.0 * float(np.median(worths))),
        worth_spread=float(np.std(worths)),
        squares=squares,
        lag_m=lags,
        lag_correlation=correlations,
    )


class _Block:
    """The scenes of one street, with what the likelihood needs of them."""

    def __init__(self, drive: Sequence[Scene], floor: Floats) -> None:
        self.floor = floor
        self.drifts = np.array([scene.drift for scene in drive])
        self.covariances = np.array([scene.covariance for scene in drive])
        self.feigned = np.array([scene.feigned for scene in drive])
        way = np.array([scene.way_m for scene in drive])
        self.apart = np.abs(way[:, None] - way[None, :])

    def surprise(self, ratio: float, share: float, correlation_m: float) -> float:
        """Minus twice the logarithm of the likelihood, less a constant."""
        n = len(self.drifts)
        total = np.kron(np.exp(-self.apart / correlation_m), share**2 * self.floor)
        for index, covariance in enumerate(self.covariances):
            place = slice(6 * index, 6 * index + 6)
            total[place, place] += ratio**2 * covariance
        feigned = self.feigned.ravel()
        total += np.outer(feigned, feigned)
        error = self.drifts.ravel()
        sign, volume = np.linalg.slogdet(total)
        return float(volume + error @ np.linalg.solve(total, error)) if sign > 0 and n else math.inf

    def squares(self, ratio: float, share: float) -> Floats:
        """Squared error of each scene in sigmas, (n,)."""
        total = ratio**2 * self.covariances + share**2 * self.floor
        total = total + self.feigned[:, :, None] * self.feigned[:, None, :]
        whole = np.linalg.solve(total, self.drifts[..., None])[..., 0]
        return np.asarray(np.einsum("ni,ni->n", self.drifts, whole))

    def whitened(self) -> Floats:
        """Errors in stated sigmas, (n,6)."""
        roots = np.linalg.cholesky(self.covariances)
        return np.asarray(np.linalg.solve(roots, self.drifts[..., None])[..., 0])


def _interval(cost: object, best: Floats, least: float, index: int) -> tuple[float, float]:
    """90 % interval of one parameter: where minus twice the log-likelihood rises by chi-square's 2.71."""
    assert callable(cost)  # noqa: S101 - a closure of fit
    others = [i for i in range(3) if i != index]
    ends = []
    for sign in (-1.0, 1.0):
        value = float(best[index])
        while _LOG_BOUNDS[index][0] < value < _LOG_BOUNDS[index][1]:
            value += sign * 0.1

            def held(x: Floats, at: float = value) -> float:
                full = np.zeros(3)
                full[others], full[index] = x, at
                return float(cost(full))

            if minimize(held, best[others], method="Nelder-Mead").fun - least > chi2.isf(0.1, 1):
                break
        ends.append(math.exp(min(max(value, _LOG_BOUNDS[index][0]), _LOG_BOUNDS[index][1])))
    return ends[0], ends[1]


def _log_worth(covariance: Floats) -> float:
    """Mean logarithm of the sigmas along a covariance's axes."""
    return float(np.linalg.slogdet(covariance)[1]) / 12.0


def _freedom(squares: Floats) -> float:
    """Degrees of freedom of six-dimensional Student errors that make the squares likeliest."""
    n = _FREEDOMS[:, None]
    # Student of unit covariance: scale (n - 2) / n.
    likelihood = np.array(
        [math.lgamma((v + 6) / 2) - math.lgamma(v / 2) - 3 * math.log(v - 2) for v in _FREEDOMS]
    ) - ((n + 6) / 2 * np.log1p(squares[None, :] / (n - 2))).mean(axis=1)
    return float(_FREEDOMS[int(np.argmax(likelihood))])


def _lags(blocks: Sequence[_Block]) -> tuple[Floats, Floats]:
    """Correlation of errors against the way between scenes of one street."""
    ways, products = [], []
    scale = np.sqrt(np.mean(np.concatenate([block.whitened() for block in blocks]) ** 2, axis=0))
    for block in blocks:
        z = block.whitened() / scale
        for first in range(len(z)):
            for second in range(first + 1, len(z)):
                ways.append(block.apart[first, second])
                products.append(float(np.mean(z[first] * z[second])))
    bins = np.round(np.array(ways) / 20.0).astype(int)
    kinds = np.unique(bins)
    return 20.0 * kinds, np.array([np.mean(np.array(products)[bins == kind]) for kind in kinds])
