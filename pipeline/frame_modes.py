"""Where near a first guess the edges of some frames fit their images, and which fit may be true.

One look at a street often fits twice: shifted by a window, a lamp post, a ring of the sensor, or turned about
what stands at one distance. Which fit is right is asked of the parts of the picture: a true one is better in
most parts, a false one in a few. Errors come from the same question, asked of the place of the maximum.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from pipeline import edge_witness, se3
from pipeline.edge_witness import UNITS, EdgeBatch, EdgeWitnessParameters
from pipeline.edges import CELL_COLUMNS, CELLS, KIND_NAMES
from pipeline.records import Floats

Top: TypeAlias = tuple[Floats, float]
"""A maximum: xi (6,) against the first guess in camera axes, and its score."""


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
        hops_rad: Turns from the best maximum along its valleys, rad.
        hop_ranges_m: Distances that stay where they are in such a turn, m: what is near, and what is far.
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
    hops_rad: tuple[float, ...] = (math.radians(0.5), math.radians(1.2))
    hop_ranges_m: tuple[float, ...] = (9.0, 20.0)
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


def balanced(
    batch: EdgeBatch, T_cam_lidar: Floats, parameters: ModeParameters, rng: np.random.Generator
) -> EdgeBatch:
    """The same edges, each kind with the weight by which it tells a fit from chance.

    Upright edges are many, but slide along what is upright in the image: under them a wrong pitch fits as
    well as the right one, or better. The mean response of a kind scatters by chance, from place to place,
    with a variance that says how many independent edges the kind is worth; its inverse is the kind's weight
    (of independent means with a common signal that sum is the best one).

    Args:
        batch: Edges and gradients.
        T_cam_lidar: float64 (4,4), around which chance is asked.
        parameters: See there.
        rng: Draws places.
    """
    plain = dataclasses.replace(batch, weight=np.ones(len(batch)))
    places = edge_witness.far_extrinsics(T_cam_lidar, parameters.edge_witness, rng)
    responses = np.stack([edge_witness.score_only(plain, T, 0) for T in places])
    weight = np.zeros(len(batch))
    for kind in range(len(KIND_NAMES)):
        of_kind = batch.kind == kind
        count = int(of_kind.sum())
        if count == 0:
            continue
        seen = responses[:, of_kind]
        # A mean of n can not scatter less than n independent ones do; a few places may not show it.
        variance = max(float(np.var(seen.mean(axis=1))), float(np.var(seen, axis=1).mean()) / count, 1e-12)
        weight[of_kind] = 1.0 / (variance * count)
    return dataclasses.replace(batch, weight=weight / weight.mean())


def weighed(
    batch: EdgeBatch,
    T_guess: Floats,
    tops: Sequence[Top],
    prior: Prior,
    parameters: ModeParameters,
    rng: np.random.Generator,
) -> EdgeModes:
    """Climbs to the top of each mode, weighs them against each other, says how well the best is known.

    Args:
        batch: Edges, picked where the best mode sees them, and gradients.
        T_guess: float64 (4,4), the first guess.
        tops: Maxima to begin at, at least one.
        prior: How far off the first guess may be.
        parameters: See there.
        rng: Draws weights.
    """
    tops = _refined(batch, T_guess, tops, parameters)
    part = _parts(batch)
    scores = np.stack([_by_part(batch, part, se3.retract(T_guess, xi)) for xi, _ in tops])
    weights = rng.exponential(size=(parameters.draws_of_shares, scores.shape[1]))
    wins = np.bincount(np.argmax(weights @ scores.T, axis=1), minlength=len(tops))
    distance = np.array([np.sum((xi / prior.sigma) ** 2) for xi, _ in tops])
    shares = wins * np.exp(-0.5 * (distance - distance[wins > 0].min()))
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
    hops = [(best + hop, (0,)) for hop in _hops(parameters)]
    _climb(thin, T_guess, hops, tops, prior, parameters)
    tops.sort(key=lambda top: -top[1])
    # A first guess within whose reach no maximum lies stands for itself.
    return _refined(batch, T_guess, tops[: parameters.refined] or [(guess, 0.0)], parameters)


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
    level = len(thin.stacks) - 1
    heights = [edge_witness.score_only(thin, se3.retract(T_guess, xi), level).sum() for xi in places]
    picked: list[Floats] = []
    for index in np.argsort(heights)[::-1]:
        if len(picked) == parameters.climbed:
            break
        if all(np.linalg.norm((places[index] - other) / UNITS) > parameters.spread for other in picked):
            picked.append(places[index])
    return picked


def _hops(parameters: ModeParameters) -> list[Floats]:
    """Turns up or aside, with the shift that leaves what stands at some distance where it is, camera axes."""
    hops = []
    for turn in parameters.hops_rad:
        for distance in (*parameters.hop_ranges_m, math.inf):
            shift = 0.0 if math.isinf(distance) else turn * distance
            for sign in (-1.0, 1.0):
                # phi_x moves a point at depth z by -z phi_x along y; phi_y by +z phi_y along x (A2).
                hops.append(sign * np.array([turn, 0.0, 0.0, 0.0, shift, 0.0]))
                hops.append(sign * np.array([0.0, turn, 0.0, -shift, 0.0, 0.0]))
    return hops


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
    D = np.stack(moved)
    return np.asarray(D.T @ D / len(D), dtype=np.float64)
