"""When a drift began: the change point in a series of scores, with the interval that holds it.

A score is 0 where the mount stands as it is expected to and 1 where it stands as it is estimated now. Its
level before and after the change is free, its noise correlated in time. The likelihood is profiled over
levels, noise and shape (a step, or growth that takes time); the interval is what it does not exclude.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Floats


@dataclass(frozen=True, slots=True)
class OnsetParameters:
    """How sure the interval is, and which noise is allowed for.

    Attributes:
        excluded: Twice the loss of log likelihood at which a moment is excluded. For a step the loss follows
            the square of ``1 - exp(-x/2)`` (two random walks from the true moment): 95 %. For growth, with
            a beginning and an end, chi-square of two degrees makes it 97 %.
        gradual: Twice the gain of log likelihood by which growth must explain the scores better than a step:
            chi-square of one degree at 1e-3; who reads 'gradual' looks for a loose bolt, not for a blow.
        least: Scores below which nothing is said: two levels and a noise are to be told from them.
        most_beginnings: Moments tried for the beginning and the end of growth.
        correlation_s: Times over which noise may be correlated, s; 0 is white.
        white_shares: Shares of the noise's variance that may be white.
    """

    excluded: float = 7.35
    gradual: float = 10.83
    least: int = 4
    most_beginnings: int = 24
    correlation_s: tuple[float, ...] = (0.0, 0.3, 1.0, 3.0, 10.0)
    white_shares: tuple[float, ...] = (0.0, 0.5)


@dataclass(frozen=True, slots=True)
class Onset:
    """When a drift began: most likely stamp, and the interval that holds it, ns.

    A most likely stamp at the beginning of the interval says that nothing before it was free of the drift.

    Attributes:
        stamp_ns: Most likely moment.
        from_ns: Not before.
        to_ns: Not after.
        gradual: It grew rather than jumped; the moment is that of the first growth.
    """

    stamp_ns: int
    from_ns: int
    to_ns: int
    gradual: bool = False


_FREE = 0.5
"""A score below it is nearer to the expected mount than to the one that is estimated now."""


def change_point(stamps_ns: NDArray[np.int64], scores: Floats, parameters: OnsetParameters) -> Onset | None:
    """The moment at which scores rise from about 0 to about 1; None where there are too few of them.

    Args:
        stamps_ns: int64 (N,), ascending.
        scores: float64 (N,).
        parameters: See there.

    Returns:
        The change with its interval. Where all of the series may be from after a step, the interval begins
        with the series, and so does the most likely moment.
    """
    n = len(stamps_ns)
    if n < parameters.least:
        return None
    t = (stamps_ns - stamps_ns[0]) / 1e9
    series = _Series(t, scores - _FREE, parameters)
    # Step i: the first i scores are from before it. Step 0 happened before the series.
    steps = (np.arange(n)[None, :] >= np.arange(n)[:, None]).astype(np.float64)
    jumping = series.loss(steps)
    beginnings, ends = _growths(t, parameters.most_beginnings)
    span = np.maximum(t[ends] - t[beginnings], 1e-9)
    shapes = np.clip((t[None, :] - t[beginnings][:, None]) / span[:, None], 0.0, 1.0)
    growing = series.loss(shapes) if len(beginnings) else np.zeros(0)
    gradual = float(np.min(growing, initial=np.inf)) < float(jumping.min()) - parameters.gradual
    best = min(float(jumping.min()), float(np.min(growing, initial=np.inf)))
    kept = np.flatnonzero(jumping - best <= parameters.excluded)
    grown = beginnings[growing - best <= parameters.excluded]
    # Beginnings of growth are tried at some stamps only: the true one may lie between two of them.
    tried = np.unique(beginnings)
    lowest = np.concatenate([kept - 1, _neighbours(tried, grown, -1)])
    highest = np.concatenate([kept, _neighbours(tried, grown, +1)])
    first, last = max(int(lowest.min()), 0), min(int(highest.max()), n - 1)
    if gradual:
        stamp = int(stamps_ns[beginnings[np.argmin(growing)]])
    else:
        likely = int(np.argmin(jumping))
        stamp = (int(stamps_ns[max(likely - 1, 0)]) + int(stamps_ns[likely])) // 2
    if int(lowest.min()) < 0 and not gradual:
        # Nothing before was surely free of it.
        stamp = int(stamps_ns[0])
    stamp = max(stamp, int(stamps_ns[first]))
    return Onset(stamp, int(stamps_ns[first]), max(stamp, int(stamps_ns[last])), gradual)


def _neighbours(tried: NDArray[np.int64], chosen: NDArray[np.int64], side: int) -> NDArray[np.int64]:
    """For each chosen one of ascending ``tried`` the next one on that side, or itself at the end."""
    return tried[np.clip(np.searchsorted(tried, chosen) + side, 0, max(len(tried) - 1, 0))]


def _growths(t: Floats, most: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of indices at which growth may begin and end, with at least one score between them."""
    n = len(t)
    tried = np.unique(np.linspace(0, n - 1, min(n, most)).astype(np.int64))
    i, j = np.meshgrid(tried, tried, indexing="ij")
    apart = j - i >= _LEAST_GROWTH
    return i[apart], j[apart]


_LEAST_GROWTH = 2
"""Scores from the beginning of growth to its end: within fewer it is a step."""


class _Series:
    """Scores about 0 with noise that is correlated in time, and how well shapes explain them.

    Args:
        t: float64 (N,), s, ascending.
        y: float64 (N,): negative before, positive after.
        parameters: Which noise is allowed for.
    """

    def __init__(self, t: Floats, y: Floats, parameters: OnsetParameters) -> None:
        self._y = y
        apart = np.abs(t[:, None] - t[None, :])
        self._roots: list[Floats] = []
        for time in parameters.correlation_s:
            for white in parameters.white_shares if time > 0 else (1.0,):
                C = white * np.eye(len(t))
                if time > 0:
                    C = C + (1.0 - white) * np.exp(-apart / time)
                # A clock may give two stamps alike: the noise of their scores is never quite the same.
                self._roots.append(
                    np.asarray(np.linalg.cholesky(C + _NUGGET * np.eye(len(t))), dtype=np.float64)
                )

    def loss(self, shapes: Floats) -> Floats:
        """Twice the negative log likelihood, (M,), of shapes (M,N) that run from 0 to 1.

        Levels before and after are free, with the sign that 'before' and 'after' mean; noise is profiled out.
        """
        found = np.full(len(shapes), np.inf)
        n = len(self._y)
        degrees = max(n - _LEVELS, 1)
        for L in self._roots:
            columns = np.column_stack([self._y, np.ones(n), shapes.T])
            white = np.asarray(np.linalg.solve(L, columns), dtype=np.float64)
            rest = _unexplained(white[:, 0], white[:, 1], white[:, 2:])
            spread = 2.0 * float(np.log(np.diag(L)).sum())
            # Degrees of freedom that are left, so that few scores are not too sure.
            twice = degrees * np.log(np.maximum(rest, _EXACT * n) / degrees) + spread * degrees / n
            found = np.minimum(found, twice)
        return found


_LEVELS = 2
"""Free levels: before and after."""

_NUGGET = 1e-6
"""Share of the variance that is white in any case."""

_EXACT = 1e-6
"""Squared score: scores of one drive scatter by 0.05 at least, the square of a thousandth is none."""


def _unexplained(y: Floats, one: Floats, shapes: Floats) -> Floats:
    """Squared rest (M,) of ``y`` after the best levels ``a + (b - a) h`` with ``a <= 0 <= b``, whitened.

    The best unconstrained pair where it obeys, else the better of the two edges of what is allowed.
    """
    yy, y1, oo = float(y @ y), float(y @ one), float(one @ one)
    hy, ho, hh = y @ shapes, one @ shapes, np.einsum("nm,nm->m", shapes, shapes)
    # Regressors: before = one - h, after = h.
    bb, ba, by = oo - 2.0 * ho + hh, ho - hh, y1 - hy
    after_only = yy - np.where(hh > _TINY, np.maximum(hy, 0.0) ** 2 / np.maximum(hh, _TINY), 0.0)
    before_only = yy - np.where(bb > _TINY, np.minimum(by, 0.0) ** 2 / np.maximum(bb, _TINY), 0.0)
    rest = np.minimum(after_only, before_only)
    determinant = bb * hh - ba**2
    solvable = determinant > _TINY * np.maximum(bb * hh, _TINY)
    safe = np.where(solvable, determinant, 1.0)
    a, b = (by * hh - ba * hy) / safe, (bb * hy - ba * by) / safe
    obeys = solvable & (a <= 0.0) & (b >= 0.0)
    return np.asarray(np.where(obeys, yy - a * by - b * hy, rest), dtype=np.float64)


_TINY = 1e-12
"""Sums of squares below it are none: whitened columns are of the order of one."""
