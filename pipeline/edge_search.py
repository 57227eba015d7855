"""Where a score is highest: climbs through the scales of the image, and the maxima that are followed.

A window changes by a frame at a time and its maxima with it, so they are followed from window to window;
others are sought anew once half of the frames have changed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from pipeline import se3, trust_region
from pipeline.edge_score import (
    UNITS,
    EdgeBatch,
    preference,
    score,
    score_and_gradient,
    score_only,
    seen_from,
)
from pipeline.records import Floats
from pipeline.trust_region import SearchParameters


@dataclass(frozen=True, slots=True)
class EdgeWitnessParameters:
    """How the maximum is sought and how sure it is.

    Attributes:
        step_limits: Longest step at each level of the pyramid, alert units: what its blur can bridge.
        search: When the climb of one level ends; its lengths are alert units.
        difference: Step of the differences that give the Hessian, alert units.
        eigenvalue_floor: Smallest eigenvalue of the Hessian as a share of the largest.
        sigma_factor: Scatter of window estimates over what the cells of the image say of it, k: 1.6 (90 %
            interval 1.3 to 1.9) over 58 scenes of simulated streets (docs/run_length.md), 1.5 on recorded
            drives (PROBE 4).
        least_gain: A maximum reached over a coarser level must score so much more to be preferred, share:
            coarse levels lead into false modes, which score up to 3 % more; real drifts gain over 12 %.
        stirring_gain: Where the best maximum scores so much more than the stored extrinsic, share, others are
            sought from further away: what looks like one small drift may be another, larger one.
        lost_gain: Where the nearest maximum scores so much more than the stored extrinsic, share, nothing
            speaks for the nearest any more: the highest of all is believed. Healthy windows gained less, on
            four drives (PROBE 5).
        wide_gain: A maximum found from further away must score so much more than the best near one: false
            modes score up to 3 % more than the truth (PROBE 6).
        least_preference: Standard errors by which the cells of the image, one by one, must prefer it too:
            chance gives so many in one case of twenty.
        wide_rad: Step of the turns from which it is sought: the coarsest level's blur reaches half of it.
        wide_m: Shift ahead and back from which it is sought.
        farthest_rad: A maximum further from the stored extrinsic is not believed: what the grid of turns
            holds, and the blur beyond it.
        farthest_m: Likewise.
        contrast_starts: Random extrinsics that tell the score of chance.
        contrast_rad: Their rotation: least and most.
        contrast_m: Their shift.
        most_edges: Edges of a window that are looked at: 600 a frame do as well as 1500 (PROBE 8).
    """

    step_limits: tuple[float, float, float] = (0.3, 0.6, 1.0)
    search: SearchParameters = field(default_factory=SearchParameters)
    difference: float = 0.3
    eigenvalue_floor: float = 0.01
    sigma_factor: float = 1.6
    least_gain: float = 0.02
    stirring_gain: float = 0.03
    lost_gain: float = 0.10
    wide_gain: float = 0.05
    least_preference: float = 1.64
    wide_rad: float = math.radians(0.75)
    wide_m: float = 0.3
    farthest_rad: float = math.radians(7.0)
    farthest_m: float = 1.0
    contrast_starts: int = 48
    contrast_rad: tuple[float, float] = (math.radians(3.0), math.radians(6.0))
    contrast_m: float = 0.3
    most_edges: int = 10_000


@dataclass(frozen=True, slots=True, eq=False)
class Rival:
    """A maximum other than the nearest one.

    Attributes:
        xi: float64 (6,), against the stored extrinsic, camera axes.
        gain: Share by which it must score more to be preferred.
    """

    xi: Floats
    gain: float


@dataclass(frozen=True, slots=True, eq=False)
class Maxima:
    """The maxima of a window that are followed into the next.

    Attributes:
        nearest: float64 (6,), the one that the climb from the stored extrinsic reaches, camera axes.
        rivals: Others that were preferred to it when they were found.
        searched_ns: Stamps of the window's frames when others were last sought.
        reach: Steps of the grid of turns, to each side, from which they were sought since then; 0: from none.
    """

    nearest: Floats
    rivals: tuple[Rival, ...]
    searched_ns: tuple[int, ...]
    reach: int


Top: TypeAlias = tuple[Floats, float]
"""A maximum, xi (6,), and its score."""

Scored: TypeAlias = tuple[float, Floats, Floats]
"""What :func:`edge_score.score` gives."""

_COARSE_STRIDE = 3
"""Every third edge leads through the coarse levels; all of them decide."""

_SAME_MODE = 1.0
"""Alert units; maxima nearer to each other are one, found twice."""


def find_maxima(
    batch: EdgeBatch,
    T_stored: Floats,
    stored: Scored,
    parameters: EdgeWitnessParameters,
    known: Maxima | None,
    curvature: Floats | None,
    *,
    far: bool,
) -> tuple[Maxima, Top]:
    """The maxima of a window, and the one to believe: the nearest, unless another scores clearly more.

    Args:
        batch: Edges and gradients.
        T_stored: float64 (4,4).
        stored: What :func:`edge_score.score` gives there.
        parameters: See there.
        known: Maxima of the window before, or None.
        curvature: float64 (6,6), alert units, of the score at the maximum of before, or None.
        far: Whether the true one may lie far off.
    """
    if known is None or _renewed(batch.stamps_ns, known.searched_ns):
        nearest = ascend(batch, T_stored, np.zeros(6), 0, parameters, stored)
        rivals = _followed(batch, T_stored, known, parameters, curvature) if known is not None else []
        rivals += [(top, parameters.least_gain) for top in _by_coarser(batch, T_stored, nearest, parameters)]
        searched, reach = batch.stamps_ns, 0
    else:
        nearest = ascend(batch, T_stored, known.nearest, 0, parameters, curvature=curvature)
        rivals = _followed(batch, T_stored, known, parameters, curvature)
        searched, reach = known.searched_ns, known.reach
    base = nearest if _near(nearest[0], parameters) and nearest[1] > stored[0] else (np.zeros(6), stored[0])
    lost = base[1] > stored[0] * (1.0 + parameters.lost_gain)
    best, kept = _preferred(batch, T_stored, base, rivals, parameters, lost=lost)
    wanted = _FAR_TICKS if far else _TICKS
    if reach < wanted and best[1] > stored[0] * (1.0 + parameters.stirring_gain):
        further = _from_further_away(batch, T_stored, best[0], parameters, wanted, lost=lost)
        best, kept = _preferred(
            batch, T_stored, base, [*rivals, (further, parameters.wide_gain)], parameters, lost=lost
        )
        reach = wanted
    return Maxima(nearest[0], kept, searched, reach), best


def _renewed(stamps_ns: Sequence[int], searched_ns: Sequence[int]) -> bool:
    """Whether half of the frames are others than those in which maxima were sought."""
    return 2 * len(set(stamps_ns) - set(searched_ns)) >= len(set(stamps_ns))


def _preferred(
    batch: EdgeBatch,
    T_stored: Floats,
    base: Top,
    rivals: Sequence[tuple[Top, float]],
    parameters: EdgeWitnessParameters,
    *,
    lost: bool,
) -> tuple[Top, tuple[Rival, ...]]:
    """The maximum to believe, and the rival that it is, if any; ``lost``: on balance is enough."""
    best, kept = base, None
    for top, gain in rivals:
        if not _near(top[0], parameters) or top[1] <= best[1]:
            continue
        clearly = lost or top[1] > best[1] * (1.0 + gain)
        wanted = 0.0 if lost else parameters.least_preference
        if clearly and _prefer(batch, T_stored, (top[0], best[0])) > wanted:
            best, kept = top, Rival(top[0], gain)
    return best, () if kept is None else (kept,)


def _prefer(batch: EdgeBatch, T_stored: Floats, places: tuple[Floats, Floats]) -> float:
    """How clearly the cells of the image prefer the first of two xi, standard errors."""
    better, worse = (score_only(batch, se3.retract(T_stored, xi), 0) for xi in places)
    return preference(batch, better, worse)


def _followed(
    batch: EdgeBatch,
    T_stored: Floats,
    known: Maxima,
    parameters: EdgeWitnessParameters,
    curvature: Floats | None,
) -> list[tuple[Top, float]]:
    """The rivals of the window before, in this one."""
    return [
        (ascend(batch, T_stored, rival.xi, 0, parameters, curvature=curvature), rival.gain)
        for rival in known.rivals
    ]


def _by_coarser(
    batch: EdgeBatch, T_stored: Floats, nearest: Top, parameters: EdgeWitnessParameters
) -> list[Top]:
    """Maxima other than the nearest that the coarser levels lead to from the stored extrinsic."""
    thin, tops = batch.thinned(_COARSE_STRIDE), []
    for schedule in ((1, 0), (2, 1, 0)):
        xi = np.zeros(6)
        for level in schedule:
            xi, _ = ascend(thin, T_stored, xi, level, parameters)
        if _apart(xi, nearest[0]) >= _SAME_MODE:
            tops.append(ascend(batch, T_stored, xi, 0, parameters))
    return tops


def _near(xi: Floats, parameters: EdgeWitnessParameters) -> bool:
    """Whether an answer lies where it may be believed."""
    turn, shift = float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))
    return turn <= parameters.farthest_rad and shift <= parameters.farthest_m


def _from_further_away(
    batch: EdgeBatch,
    T_stored: Floats,
    xi: Floats,
    parameters: EdgeWitnessParameters,
    ticks: int,
    *,
    lost: bool,
) -> Top:
    """The highest maximum reached from turns about all axes and from shifts ahead, or from ``xi``.

    Where the stored extrinsic is ``lost``, that maximum is climbed about once more, axis by axis.
    """
    thin = batch.thinned(max(1, len(batch) // _SEARCHED))
    top = (xi, score(thin, se3.retract(T_stored, xi), 0)[0])
    known = [xi]
    for begin in _promising(thin, T_stored, parameters, ticks):
        top = _climbed(thin, T_stored, begin, known, top, parameters)
    if lost:
        for step in np.concatenate([np.diag(UNITS), -np.diag(UNITS)]) * _HOP:
            top = _climbed(thin, T_stored, top[0] + step, known, top, parameters)
    return ascend(batch, T_stored, top[0], 0, parameters)


def _climbed(
    thin: EdgeBatch,
    T_stored: Floats,
    begin: Floats,
    known: list[Floats],
    top: Top,
    parameters: EdgeWitnessParameters,
) -> Top:
    """The maximum reached from ``begin`` where it is higher than ``top`` and none of the ``known`` ones."""
    reached, _ = ascend(thin, T_stored, begin, 1, parameters)
    if min(_apart(reached, other) for other in known) < _SAME_MODE:
        return top
    known.append(reached)
    reached, value = ascend(thin, T_stored, reached, 0, parameters)
    return (reached, value) if value > top[1] and _near(reached, parameters) else top


_HOP = 3.0
"""Alert units: beyond what the blur of level 1 bridges (0.75 deg, 15 cm)."""


def _promising(
    thin: EdgeBatch, T_stored: Floats, parameters: EdgeWitnessParameters, ticks: int
) -> list[Floats]:
    """Where climbs from further away begin: the best of a grid of turns, and shifts ahead and back.

    A shift aside looks like a turn at any one range, so turns lead to both (PROBE 3); only a shift along the
    optical axis looks like none.
    """
    steps = np.arange(-ticks, ticks + 1) * parameters.wide_rad
    turns = np.stack(np.meshgrid(steps, steps, steps[ticks % 2 :: 2], indexing="ij"), axis=-1).reshape(-1, 3)
    turns = turns[np.linalg.norm(turns, axis=1) <= (ticks + 0.5) * parameters.wide_rad]
    places = np.hstack([turns, np.zeros_like(turns)])
    level = len(thin.images) - 1
    heights = _heights(
        thin.thinned(_COARSE_STRIDE), [se3.retract(T_stored, place) for place in places], level
    )
    starts: list[Floats] = []
    for k in np.argsort(-heights, kind="stable"):
        if len(starts) == _PROMISING:
            break
        if all(np.abs(places[k] - start).max() > parameters.wide_rad * 1.01 for start in starts):
            starts.append(places[k])
    ahead = np.array([0.0, 0.0, 0.0, 0.0, 0.0, parameters.wide_m])
    return [*starts, ahead, -ahead]


def _heights(batch: EdgeBatch, extrinsics: Sequence[Floats], level: int) -> Floats:
    """Score (K,) under each extrinsic, up to a factor."""
    heights = []
    for k in range(0, len(extrinsics), _AT_ONCE):
        seen = seen_from(batch, extrinsics[k : k + _AT_ONCE])
        heights.append(np.bincount(seen.cell, score_only(seen, np.eye(4), level)))
    return np.concatenate(heights)


_AT_ONCE = 64
"""Extrinsics that are scored together: their edges fit the cache; all at once take five times as long."""

_SEARCHED = 1200
"""Edges that a search from further away looks at; all of them decide."""

_TICKS = 3
"""Steps of the grid to each side; every other one of roll, which is seen less sharply."""

_FAR_TICKS = 8
"""The same where the truth may lie far off, 6 deg: other maxima are false, some look like a small drift."""

_PROMISING = 5
"""Best places of the grid that are climbed from."""


def _apart(a: Floats, b: Floats) -> float:
    """Distance of two xi, alert units."""
    return float(np.linalg.norm((a - b) / UNITS))


def ascend(
    batch: EdgeBatch,
    T_stored: Floats,
    xi: Floats,
    level: int,
    parameters: EdgeWitnessParameters,
    scored: Scored | None = None,
    curvature: Floats | None = None,
) -> tuple[Floats, float]:
    """The top reached from ``xi``, whose score may be known, at one level of the pyramid; its score.

    Args:
        batch: Edges and gradients.
        T_stored: float64 (4,4), the extrinsic that ``xi`` perturbs.
        xi: float64 (6,), where the climb begins, camera axes.
        level: Of the pyramid.
        parameters: See there.
        scored: What :func:`edge_score.score` gives at ``xi``, where it is known.
        curvature: float64 (6,6), minus the Hessian of the score nearby, alert units, where it is known.
    """

    def negative(x: Floats) -> tuple[float, Floats]:
        s, gradient = score_and_gradient(batch, se3.retract(T_stored, x * UNITS), level)
        # Gradient by xi at a point away from the reference: retraction composes to first order (A2).
        return -s, -gradient * UNITS

    if curvature is None:
        value, gradient, share = scored or score(batch, se3.retract(T_stored, xi), level)
        curvature = start_curvature(share * UNITS, batch.weight, value)
        start = (-value, -gradient * UNITS)
    else:
        start = negative(xi / UNITS)
    x, least = trust_region.descend(
        negative, xi / UNITS, start, curvature, parameters.step_limits[level], parameters.search
    )
    return np.asarray(x * UNITS, dtype=np.float64), -least


def start_curvature(share: Floats, weight: Floats, value: float) -> Floats:
    """First guess of the curvature from the edges' gradients g (PROBE 1): 4/s sum w g g^T / sum w."""
    total = float(weight.sum())
    per_edge = share * (total / np.maximum(weight, 1e-12))[:, None]
    outer = (per_edge * (weight / total)[:, None]).T @ per_edge
    return np.asarray(4.0 / max(value, 1e-6) * outer + 1e-6 * np.eye(6), dtype=np.float64)
