"""The model of ``simulation.evidence`` fitted to estimates of image-level drives, whose truth is known."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, minimize
from scipy.stats import chi2

from pipeline.errors import InputError
from pipeline.records import Floats
from pipeline.scene_filter import Scene

_LEAST_STREETS = 4
"""Streets; fewer tell nothing of what differs between them."""

_BOUNDS = ((0.05, 5.0), (1e-3, 5.0), (1e-3, 0.99), (5.0, 2000.0))
"""Of ratio, share, common, and correlation in m."""

_STEP = 0.2
"""First step of the search for the ends of an interval, in the logarithm; each is half as long again."""

_START = (0.8, 0.3, 0.3, 60.0)
"""Where the likeliest are sought from."""

_RIDDEN = 4.0
"""Mean square error in stated sigmas beyond which the scenes of a street lie in false modes: the mean of
honest ones is one."""

_REACH = 1.645
"""Standard errors to each side that hold 90 %."""

_FREEDOMS = np.array([3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 60.0, 200.0])
"""Degrees of freedom that are tried for the tails."""


@dataclass(frozen=True, slots=True, eq=False)
class EvidenceFit:
    """What the estimates of drives with an unmoved mount say; errors are estimates, since truth is zero.

    Attributes:
        streets: How many drives.
        ridden: How many of them lie in false modes; ratio, share, correlation and tails are of the others.
        ridden_ratio: Sigmas of the random error over the stated ones in those; 0 where there are none.
        within: Share of the errors of all streets, axis by axis, within one stated sigma and within two, each
            with its 90 % interval.
        scenes: Scenes of the others.
        ratio: Sigmas of the random error over the stated ones, and its 90 % interval.
        share: Sigmas of the systematic part, the same in all scenes of a street, over those of the floor, and
            its interval.
        common: Share of the random error's variance that neighbouring scenes have in common, and its
            interval.
        correlation_m: Way over which that keeps 1/e, m, and its interval.
        freedom: Degrees of freedom of the tails.
        covariance: float64 (6,6), stated for a scene of middling worth.
        worth_spread: Standard deviation of the logarithm of stated sigmas.
        squares: float64 (scenes,), ascending: squared errors in sigmas of the fitted model, chi-square of six
            degrees where it is right.
        lag_m: float64 (m,), ways between two scenes of one street, m.
        lag_correlation: float64 (m,), correlation of their errors in sigmas, over axes and pairs.
    """

    streets: int
    ridden: int
    ridden_ratio: float
    within: tuple[tuple[float, float, float], tuple[float, float, float]]
    scenes: int
    ratio: tuple[float, float, float]
    share: tuple[float, float, float]
    common: tuple[float, float, float]
    correlation_m: tuple[float, float, float]
    freedom: float
    covariance: Floats
    worth_spread: float
    squares: Floats
    lag_m: Floats
    lag_correlation: Floats


def fit(drives: Sequence[Sequence[Scene]], floor: Floats) -> EvidenceFit:
    """Maximum likelihood of ratio, share, common and correlation; intervals by the profile of each.

    Args:
        drives: Scenes of each drive with an unmoved mount, whose stored extrinsic is the true one.
        floor: float64 (6,6), shape of the systematic part.
    """
    drives = [drive for drive in drives if drive]
    if len(drives) < _LEAST_STREETS:
        raise InputError(
            f"{len(drives)} streets are too few to fit how they differ", hint=f"{_LEAST_STREETS} or more"
        )
    every = [_Block(drive, floor) for drive in drives]
    blocks = [block for block in every if block.mean_square() <= _RIDDEN]
    ridden = [block for block in every if block.mean_square() > _RIDDEN]
    if not blocks:
        raise InputError(
            "every street lies in false modes", hint="look at the drives: is the extrinsic true?"
        )

    def cost(x: Floats) -> float:
        return sum(block.surprise(*np.exp(x)) for block in blocks)

    bounds = np.log(_BOUNDS)
    best = minimize(
        cost,
        np.log(_START),
        method="Nelder-Mead",
        bounds=_bounds(),
        options={"maxiter": 2000, "xatol": 1e-3, "fatol": 1e-3},
    )
    middle = [float(value) for value in np.exp(best.x)]
    found = [(value, *_interval(cost, best.x, best.fun, index, bounds)) for index, value in enumerate(middle)]
    ratio, share, common, correlation_m = found
    squares = np.sort(np.concatenate([block.squares(ratio[0], share[0]) for block in blocks]))
    worths = np.array([_log_worth(scene.covariance) for drive in drives for scene in drive])
    middling = np.mean(
        [scene.covariance / math.exp(2.0 * _log_worth(scene.covariance)) for d in drives for scene in d],
        axis=0,
    )
    lags, correlations = _lags(blocks)
    return EvidenceFit(
        streets=len(drives),
        ridden=len(ridden),
        ridden_ratio=math.sqrt(np.mean([block.mean_square() for block in ridden])) if ridden else 0.0,
        within=(_within(every, 1.0), _within(every, 2.0)),
        scenes=len(squares),
        ratio=ratio,
        share=share,
        common=common,
        correlation_m=correlation_m,
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
        self.roots = np.linalg.cholesky(self.covariances)
        way = np.array([scene.way_m for scene in drive])
        self.apart = np.abs(way[:, None] - way[None, :])

    def surprise(self, ratio: float, share: float, common: float, correlation_m: float) -> float:
        """Minus twice the logarithm of the likelihood, less a constant."""
        n = len(self.drifts)
        alike = common * np.exp(-self.apart / correlation_m)
        np.fill_diagonal(alike, 1.0)
        shaped = np.einsum("kl,kij,lmj->kilm", ratio**2 * alike, self.roots, self.roots)
        feigned = self.feigned.ravel()
        total = shaped.reshape(6 * n, 6 * n) + np.outer(feigned, feigned)
        total += np.kron(np.ones((n, n)), share**2 * self.floor)
        error = self.drifts.ravel()
        return float(np.linalg.slogdet(total)[1] + error @ np.linalg.solve(total, error))

    def squares(self, ratio: float, share: float) -> Floats:
        """Squared error of each scene in sigmas, (n,)."""
        total = ratio**2 * self.covariances + share**2 * self.floor
        total = total + self.feigned[:, :, None] * self.feigned[:, None, :]
        whole = np.linalg.solve(total, self.drifts[..., None])[..., 0]
        return np.asarray(np.einsum("ni,ni->n", self.drifts, whole))

    def mean_square(self) -> float:
        """Of the errors in stated sigmas, over scenes and axes."""
        return float(np.mean(self.whitened() ** 2))

    def inside(self, sigmas: float) -> int:
        """How many errors lie within so many stated sigmas, over scenes and axes."""
        stated = np.sqrt(np.diagonal(self.covariances, axis1=1, axis2=2))
        return int(np.count_nonzero(np.abs(self.drifts) < sigmas * stated))

    def whitened(self) -> Floats:
        """Errors in stated sigmas, (n,6)."""
        return np.asarray(np.linalg.solve(self.roots, self.drifts[..., None])[..., 0])


def _within(blocks: Sequence[_Block], sigmas: float) -> tuple[float, float, float]:
    """Share of errors within so many stated sigmas, and its 90 % interval by leaving out street by street.

    Scenes of one street see the same things: streets are what is independent.
    """
    inside = np.array([block.inside(sigmas) for block in blocks], dtype=np.float64)
    size = np.array([block.drifts.size for block in blocks], dtype=np.float64)
    share = float(inside.sum() / size.sum())
    without = (inside.sum() - inside) / (size.sum() - size)
    streets = len(blocks)
    reach = _REACH * math.sqrt((streets - 1) / streets * float(np.sum((without - without.mean()) ** 2)))
    return share, max(0.0, share - reach), min(1.0, share + reach)


def _interval(
    cost: Callable[[Floats], float], best: Floats, least: float, index: int, bounds: Floats
) -> tuple[float, float]:
    """90 % interval of one parameter: where minus twice the log-likelihood rises by chi-square's 2.71."""
    others = [i for i in range(len(best)) if i != index]
    ends = []
    for sign in (-1.0, 1.0):
        value, step = float(best[index]), _STEP

        def surplus(at: float) -> float:
            def held(x: Floats) -> float:
                return cost(np.insert(x, index, at))

            # Of the other parameters, hundredths of 2.71 are enough.
            found = minimize(
                held,
                best[others],
                method="Nelder-Mead",
                bounds=_bounds(others),
                options={"maxiter": 150, "xatol": 0.02, "fatol": 0.02},
            )
            return float(found.fun) - least

        while bounds[index][0] < value < bounds[index][1] and surplus(value) < chi2.isf(0.1, 1):
            value, step = value + sign * step, 1.5 * step
        ends.append(math.exp(min(max(value, bounds[index][0]), bounds[index][1])))
    return ends[0], ends[1]


def _bounds(places: Sequence[int] = range(4)) -> Bounds:
    """Of the logarithms of the parameters at these places."""
    low, high = np.log([_BOUNDS[place] for place in places]).T
    return Bounds(low, high)


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
