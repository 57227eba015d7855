"""Where near a first guess the edges of some frames fit their images, and which fit may be true.

One look at a street often fits twice: shifted by a window, a lamp post, a ring of the sensor, or turned about
what stands at one distance. Which fit is right is asked of the parts of the picture: a true one is better in
most parts, a false one in a few. Errors come from the same question, asked of the place of the maximum.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from pipeline import edge_witness, se3
from pipeline.edge_parameters import KIND_NAMES
from pipeline.edge_witness import UNITS, EdgeBatch, EdgeWitnessParameters
from pipeline.edges import CELL_COLUMNS, CELLS
from pipeline.records import Floats

Top: TypeAlias = tuple[Floats, float]
"""A maximum: xi (6,) against the first guess in camera axes, and its score."""
Judge: TypeAlias = Callable[[Floats, np.random.Generator], Floats]
"""How likely each of the extrinsics (M,4,4) is, (M,), above 0."""


@dataclass(frozen=True, slots=True)
class Prior:
    """How far the truth may be from the first guess, one sigma.

    Attributes:
        sigma_rad: Per angle, rad.
        sigma_m: Per shift, m.
    """

    sigma_rad: float = math.radians(1.0)
    sigma_m: float = 0.15

    @property
    def sigma(self) -> Floats:
        """Float64 (6,), rad and m."""
        return np.array([self.sigma_rad] * 3 + [self.sigma_m] * 3)


@dataclass(frozen=True, slots=True)
class ModeParameters:
    """How modes are sought and compared.

    Attributes:
        reach: Sigmas of the prior that are searched: 95 % of each axis.
        farthest: Sigmas of the prior; a maximum further off is not believed.
        usual_m: Distance of what most edges show, m: a shift looks like the turn by the same bearing there.
        draws: Turns at which the coarsest level is looked at; a power of two.
        climbed: The best of them that are climbed from.
        spread: Alert units between places that are climbed from: the coarsest level's blur.
        valley_turns: Steps each way of the turns that are looked at beside the best maximum.
        valley_shifts: Steps each way of the shifts that are looked at with each of them.
        valley_climbed: The best of these places, of each of the two planes, that are climbed from.
        refined: Maxima that are refined on all edges.
        apart: Alert units; maxima nearer to each other are one.
        searched: So many edges, evenly picked, lead to the maxima; all of them decide.
        draws_of_shares: Draws of the weights of the picture's parts that tell which mode is right.
        draws_of_place: Draws in which the maximum is sought again; six axes from them, to a seventh of sigma.
        edge_witness: Of the climbs, and of what chance gives.
    """

    reach: float = 2.0
    farthest: float = 4.0
    usual_m: float = 15.0
    draws: int = 256
    climbed: int = 10
    spread: float = 4.0
    valley_turns: int = 7
    valley_shifts: int = 3
    valley_climbed: int = 4
    refined: int = 6
    apart: float = 1.0
    searched: int = 500
    draws_of_shares: int = 512
    draws_of_place: int = 24
    edge_witness: EdgeWitnessParameters = field(default_factory=EdgeWitnessParameters)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeModes:
    """Where the edges of some frames fit.

    Attributes:
        tops: Distinct maxima, the most likely first.
        shares: float64 (M,), how likely each is the right one; they add up to 1.
        covariance: float64 (6,6) of the first one's xi, the rivals included, camera axes.
        contrast: Its score over that of chance, minus 1.
        peak: Its height over chance in sigma of the score at random extrinsics.
    """

    tops: tuple[Top, ...]
    shares: Floats
    covariance: Floats
    contrast: float
    peak: float


def evened(batch: EdgeBatch) -> EdgeBatch:
    """The same edges, each weighing by the root of how few of its kind share its cell of the image.

    One object is one witness, not as many as the sensor has rings on it (PROBE 6). Upright edges are many,
    but slide along what is upright in the image: under them alone a wrong pitch fits as well as the right.
    """
    group = batch.cell * len(KIND_NAMES) + batch.kind
    _, index, count = np.unique(group, return_inverse=True, return_counts=True)
    weight = count[index] ** -0.5
    return dataclasses.replace(batch, weight=weight / weight.mean())


def weighed(
    batch: EdgeBatch,
    T_guess: Floats,
    tops: Sequence[Top],
    prior: Prior,
    parameters: ModeParameters,
    rng: np.random.Generator,
    second: Judge | None = None,
) -> EdgeModes:
    """Climbs to the top of each mode, weighs them against each other, says how well the best is known.

    Args:
        batch: Edges, picked where the best mode sees them, and gradients.
        T_guess: float64 (4,4), the first guess.
        tops: Maxima to begin at, at least one.
        prior: How far off the first guess may be.
        parameters: See there.
        rng: Draws weights.
        second: Another judge, whose evidence is not of edges; None: there is none.
    """
    tops = _refined(batch, T_guess, tops, parameters)
    part = _parts(batch)
    scores = np.stack([_by_part(batch, part, se3.retract(T_guess, xi)) for xi, _ in tops])
    weights = rng.exponential(size=(parameters.draws_of_shares, scores.shape[1]))
    wins = np.bincount(np.argmax(weights @ scores.T, axis=1), minlength=len(tops))
    distance = np.array([np.sum((xi / prior.sigma) ** 2) for xi, _ in tops])
    shares = wins * np.exp(-0.5 * (distance - distance[wins > 0].min()))
    if second is not None:
        shares = shares * second(np.stack([se3.retract(T_guess, xi) for xi, _ in tops]), rng)
    shares = shares / shares.sum()
    order = np.argsort(-shares, kind="stable")
    tops, shares = [tops[k] for k in order], shares[order]
    offset = np.stack([xi - tops[0][0] for xi, _ in tops])
    rivals = (offset * shares[:, None]).T @ offset
    chance, spread = _chance(batch, se3.retract(T_guess, tops[0][0]), parameters, rng)
    return EdgeModes(
        tops=tuple(tops),
        shares=shares,
        covariance=_scatter(batch, part, T_guess, tops[0][0], parameters, rng) + rivals,
        contrast=tops[0][1] / chance - 1.0 if chance > 0 else 0.0,
        peak=(tops[0][1] - chance) / spread if spread > 0 else 0.0,
    )


def find_tops(
    batch: EdgeBatch, T_guess: Floats, prior: Prior, parameters: ModeParameters, rng: np.random.Generator
) -> list[Top]:
    """Distinct maxima of the score within reach of the prior, the highest first; at least one.

    Climbs begin at the first guess and at the best of many places, at several levels of the pyramid: coarse
    levels reach far but lean to what is large. From the best maximum they begin again along its valleys.
    """
    thin = batch.thinned(max(1, len(batch) // parameters.searched))
    guess = np.zeros(6)
    picked = _promising(thin, T_guess, prior, parameters, rng)
    climbs = [(guess, levels) for levels in ((0,), (1, 0), (2, 1, 0))]
    climbs += [(place, levels) for place in picked for levels in ((1, 0), (2, 1, 0))]
    tops: list[Top] = []
    _climb(thin, T_guess, climbs, tops, prior, parameters)
    best = max(tops, key=lambda top: top[1], default=(guess, 0.0))[0]
    elsewhere = _along_valleys(thin, T_guess, best, prior, parameters)
    _climb(thin, T_guess, [(place, (1, 0)) for place in elsewhere], tops, prior, parameters)
    tops.sort(key=lambda top: -top[1])
    # A first guess within whose reach no maximum lies stands for itself.
    return _refined(batch, T_guess, tops[: parameters.refined] or [(guess, 0.0)], parameters)


def joined_by(
    summits: Floats,
    places: Floats,
    batch: EdgeBatch,
    T_guess: Floats,
    tops: Sequence[Top],
    prior: Prior,
    parameters: ModeParameters,
) -> list[Top]:
    """The maxima and those to which climbs from where another witness fits lead.

    Args:
        summits: float64 (S,4,4), extrinsics that are each climbed from on all edges.
        places: float64 (P,4,4), extrinsics of which those where the edges begin to fit are climbed from.
        batch: Edges and gradients.
        T_guess: float64 (4,4), the first guess.
        tops: Maxima that are known.
        prior: How far off the first guess may be.
        parameters: See there.
    """
    thin = batch.thinned(max(1, len(batch) // parameters.searched))
    heights = [edge_witness.score_only(thin, T, 1).sum() for T in places]
    steps = np.array([se3.local(T_guess, T) for T in places]).reshape(-1, 6)
    # Half as far apart as climbs of the edges alone: these places hold six axes, not the turns only.
    picked = _apart(steps, heights, parameters.climbed, 0.5 * parameters.spread, [])
    found: list[Top] = []
    _climb(thin, T_guess, [(xi, (1, 0)) for xi in picked], found, prior, parameters)
    found.sort(key=lambda top: -top[1])
    further = [*found[: parameters.refined], *((se3.local(T_guess, T), 0.0) for T in summits)]
    joined = list(tops)
    for top in _refined(batch, T_guess, further, parameters):
        if np.all(np.abs(top[0]) <= parameters.farthest * prior.sigma):
            _keep(joined, top, parameters.apart)
    return joined


def _refined(batch: EdgeBatch, T_guess: Floats, tops: Sequence[Top], parameters: ModeParameters) -> list[Top]:
    """The maxima on all edges to which the given ones lead, the highest first."""
    fine: list[Top] = []
    for xi, _ in tops:
        _keep(fine, edge_witness.ascend(batch, T_guess, xi, 0, parameters.edge_witness), parameters.apart)
    return sorted(fine, key=lambda top: -top[1])


def _promising(
    thin: EdgeBatch, T_guess: Floats, prior: Prior, parameters: ModeParameters, rng: np.random.Generator
) -> list[Floats]:
    """The best of evenly drawn turns at the coarsest level, apart from each other.

    Only turns are drawn: what is seen of a shift at the usual distance is the turn by the same bearing, and
    three axes are filled more densely than six.
    """
    drawn = qmc.Sobol(3, rng=rng).random(parameters.draws)
    widest = parameters.reach * math.hypot(prior.sigma_rad, prior.sigma_m / parameters.usual_m)
    places = np.zeros((parameters.draws, 6))
    places[:, :3] = (2.0 * drawn - 1.0) * widest
    level = len(thin.images) - 1
    heights = [edge_witness.score_only(thin, se3.retract(T_guess, xi), level).sum() for xi in places]
    return _apart(places, heights, parameters.climbed, parameters.spread, [])


def _along_valleys(
    thin: EdgeBatch, T_guess: Floats, best: Floats, prior: Prior, parameters: ModeParameters
) -> list[Floats]:
    """The best places beside a maximum that differ by a turn up or aside and the shift that looks like it.

    In these two planes an extrinsic is least sure (PROBE 3), and false fits lie in them (PROBE 6).
    """
    turns = np.arange(-1.0, 1.0 + 1e-9, 1.0 / parameters.valley_turns) * parameters.reach * prior.sigma_rad
    shifts = np.arange(-1.0, 1.0 + 1e-9, 1.0 / parameters.valley_shifts) * parameters.reach * prior.sigma_m
    picked: list[Floats] = []
    for turn_axis, shift_axis in ((0, 4), (1, 3)):
        places = np.tile(best, (len(turns) * len(shifts), 1))
        places[:, turn_axis] += np.repeat(turns, len(shifts))
        places[:, shift_axis] += np.tile(shifts, len(turns))
        heights = [edge_witness.score_only(thin, se3.retract(T_guess, xi), 1).sum() for xi in places]
        picked += _apart(places, heights, parameters.valley_climbed, parameters.spread, [best])
    return picked


def _apart(
    places: Floats, heights: Sequence[float], most: int, spread: float, known: Sequence[Floats]
) -> list[Floats]:
    """The highest of the places that lie apart from each other and from known ones, at most so many."""
    picked: list[Floats] = []
    for index in np.argsort(heights)[::-1]:
        if len(picked) == most:
            break
        if all(np.linalg.norm((places[index] - other) / UNITS) > spread for other in (*known, *picked)):
            picked.append(places[index])
    return picked


def _climb(
    thin: EdgeBatch,
    T_guess: Floats,
    climbs: Sequence[tuple[Floats, tuple[int, ...]]],
    tops: list[Top],
    prior: Prior,
    parameters: ModeParameters,
) -> None:
    """Climbs from each start through its levels and adds to ``tops`` what lies within reach."""
    for start, levels in climbs:
        xi, value = start, 0.0
        for level in levels:
            xi, value = edge_witness.ascend(thin, T_guess, xi, level, parameters.edge_witness)
        if np.all(np.abs(xi) <= parameters.farthest * prior.sigma):
            _keep(tops, (xi, value), parameters.apart)


def _keep(tops: list[Top], top: Top, apart: float) -> None:
    """Adds a maximum unless it is known; the higher of two that are one stays."""
    for index, (known, height) in enumerate(tops):
        if np.linalg.norm((top[0] - known) / UNITS) < apart:
            if top[1] > height:
                tops[index] = top
            return
    tops.append(top)


def _chance(
    batch: EdgeBatch, T_best: Floats, parameters: ModeParameters, rng: np.random.Generator
) -> tuple[float, float]:
    """Mean and standard deviation of the score at random extrinsics far from the best."""
    places = edge_witness.far_extrinsics(T_best, parameters.edge_witness, rng)
    scores = np.array([edge_witness.score_only(batch, T, 0).sum() for T in places]) / batch.weight.sum()
    return float(scores.mean()), float(scores.std())


_PART_CELLS = 2
"""Cells of the image, each way, that make one part: a car or a front of a house covers several cells."""


def _parts(batch: EdgeBatch) -> NDArray[np.int64]:
    """Number of the part of the picture, on its stretch of road, of each edge, (N,), without gaps."""
    stretch, cell = np.divmod(batch.cell, CELLS)
    row, column = np.divmod(cell, CELL_COLUMNS)
    part = stretch * CELLS + (row // _PART_CELLS) * CELL_COLUMNS + column // _PART_CELLS
    return np.asarray(np.unique(part, return_inverse=True)[1], dtype=np.int64)


def _by_part(batch: EdgeBatch, part: NDArray[np.int64], T: Floats) -> Floats:
    """Sum of the weighted responses of each part of the picture, (parts,)."""
    sums = np.bincount(part, weights=edge_witness.score_only(batch, T, 0))
    return np.asarray(sums, dtype=np.float64)


def _scatter(
    batch: EdgeBatch,
    part: NDArray[np.int64],
    T_guess: Floats,
    xi: Floats,
    parameters: ModeParameters,
    rng: np.random.Generator,
) -> Floats:
    """Covariance (6,6) of a maximum: where it goes when the parts of the picture are weighed anew.

    The weights are exponential (Bayesian bootstrap); each maximum is sought from the given one. Unlike the
    sandwich it sees that a maximum is flat on top, or has a neighbour.
    """
    moved = []
    for weights in rng.exponential(size=(parameters.draws_of_place, int(part.max()) + 1)):
        redrawn = dataclasses.replace(batch, weight=batch.weight * weights[part])
        moved.append(edge_witness.ascend(redrawn, T_guess, xi, 0, parameters.edge_witness)[0] - xi)
    return shrunk_moments(np.stack(moved))


def shrunk_moments(D: Floats) -> Floats:
    """Second moments (6,6) of draws (N,6), their correlations shrunk by what chance gives them.

    Chance correlations of few draws leave directions in which hardly any error seems possible. The share to
    leave is that of least mean square error (Schaefer and Strimmer): the variance of all correlations, by the
    normal approximation (1 - r^2)^2 / N, over the sum of their squares.
    """
    C = np.asarray(D.T @ D / len(D), dtype=np.float64)
    sigma = np.sqrt(np.maximum(np.diag(C), np.finfo(np.float64).tiny))
    r = (C / np.outer(sigma, sigma))[np.triu_indices(len(C), 1)]
    squares = float((r**2).sum())
    share = min(1.0, float(((1.0 - r**2) ** 2).sum()) / len(D) / squares) if squares > 0.0 else 0.0
    return (1.0 - share) * C + share * np.diag(np.diag(C))
