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
from pipeline.edge_score import UNITS, EdgeBatch, score, score_and_gradient
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
        sigma_factor: Scatter of window estimates over their stated sigma on four drives (PROBE 4): k.
        least_gain: A maximum reached over a coarser level must score so much more to be preferred, share:
            coarse levels lead into false modes, which score up to 3 % more; real drifts gain over 12 %.
        stirring_gain: Where the best maximum scores so much more than the stored extrinsic, share, others are
            sought from further away: what looks like one small drift may be another, larger one.
        wide_gain: A maximum found from further away must score so much more than the best near one: false
            modes score up to 3 % more than the truth (PROBE 6).
        wide_rad: Turn about each axis from which it is sought.
        wide_m: Shift along each axis from which it is sought.
        farthest_rad: A maximum further from the stored extrinsic is not believed.
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
    sigma_factor: float = 2.0
    least_gain: float = 0.02
    stirring_gain: float = 0.03
    wide_gain: float = 0.05
    wide_rad: float = math.radians(1.0)
    wide_m: float = 0.3
    farthest_rad: float = math.radians(5.0)
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
        widely: Whether they were sought from further away then.
    """

    nearest: Floats
    rivals: tuple[Rival, ...]
    searched_ns: tuple[int, ...]
    widely: bool


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
) -> tuple[Maxima, Top]:
    """The maxima of a window, and the one to believe: the nearest, unless another scores clearly more.

    Args:
        batch: Edges and gradients.
        T_stored: float64 (4,4).
        stored: What :func:`edge_score.score` gives there.
        parameters: See there.
        known: Maxima of the window before, or None.
        curvature: float64 (6,6), alert units, of the score at the maximum of before, or None.
    """
    if known is None or _renewed(batch.stamps_ns, known.searched_ns):
        nearest = ascend(batch, T_stored, np.zeros(6), 0, parameters, stored)
        rivals = _followed(batch, T_stored, known, parameters, curvature) if known is not None else []
        rivals += [(top, parameters.least_gain) for top in _by_coarser(batch, T_stored, nearest, parameters)]
        searched, widely = batch.stamps_ns, False
    else:
        nearest = ascend(batch, T_stored, known.nearest, 0, parameters, curvature=curvature)
        rivals = _followed(batch, T_stored, known, parameters, curvature)
        searched, widely = known.searched_ns, known.widely
    base = nearest if _near(nearest[0], parameters) and nearest[1] > stored[0] else (np.zeros(6), stored[0])
    best, kept = _preferred(base, rivals, parameters)
    if not widely and best[1] > stored[0] * (1.0 + parameters.stirring_gain):
        further = (_from_further_away(batch, T_stored, best[0], parameters), parameters.wide_gain)
        best, kept = _preferred(base, [*rivals, further], parameters)
        widely = True
    return Maxima(nearest[0], kept, searched, widely), best


def _renewed(stamps_ns: Sequence[int], searched_ns: Sequence[int]) -> bool:
    """Whether half of the frames are others than those in which maxima were sought."""
    return 2 * len(set(stamps_ns) - set(searched_ns)) >= len(set(stamps_ns))


def _preferred(
    base: Top, rivals: Sequence[tuple[Top, float]], parameters: EdgeWitnessParameters
) -> tuple[Top, tuple[Rival, ...]]:
    """The maximum to believe, and the rivals that were better than all before them."""
    best, kept = base, []
    for top, gain in rivals:
        if top[1] > best[1] * (1.0 + gain) and _near(top[0], parameters):
            best = top
            kept.append(Rival(top[0], gain))
    return best, tuple(kept[-1:])


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
        if np.linalg.norm((xi - nearest[0]) / UNITS) >= _SAME_MODE:
            tops.append(ascend(batch, T_stored, xi, 0, parameters))
    return tops


def _near(xi: Floats, parameters: EdgeWitnessParameters) -> bool:
    """Whether an answer lies where it may be believed."""
    turn, shift = float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))
    return turn <= parameters.farthest_rad and shift <= parameters.farthest_m


def _from_further_away(
    batch: EdgeBatch, T_stored: Floats, xi: Floats, parameters: EdgeWitnessParameters
) -> Top:
    """The highest maximum reached from turns and shifts of each axis, both ways, or from ``xi``."""
    thin = batch.thinned(_COARSE_STRIDE)
    steps = np.diag([parameters.wide_rad] * 3 + [parameters.wide_m] * 3)
    top, height = xi, score(thin, se3.retract(T_stored, xi), 0)[0]
    for start in np.concatenate([steps, -steps]):
        reached, _ = ascend(thin, T_stored, start, 1, parameters)
        reached, value = ascend(thin, T_stored, reached, 0, parameters)
        if value > height and _near(reached, parameters):
            top, height = reached, value
    return ascend(batch, T_stored, top, 0, parameters)


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
