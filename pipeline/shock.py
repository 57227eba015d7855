"""A sudden move within one stretch of road: the newest frames against those just before.

Both show the same objects. What is systematic in a scene, and how well the stored extrinsic is known, is
common to both and falls out of their difference, so that a small step shows within a second, long before it
stands out from the floor between scenes.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from pipeline import edge_search, edge_witness, se3
from pipeline.edge_score import (
    NEW_SCENE_M,
    UNITS,
    batch_of,
    curvatures,
    mean_responses,
    preference,
    score,
    score_only,
)
from pipeline.edge_search import EdgeWitnessParameters
from pipeline.edge_witness import EdgeBatch, EdgeFrame
from pipeline.records import AXES, CameraModel, Floats
from pipeline.run_length import AlarmBudget

_STANDSTILL = 1e-6
"""Squared drift, in sigmas, that a wrong time feigns; below it the vehicle stands and time moves nothing."""


@dataclass(frozen=True, slots=True)
class ShockParameters:
    """When a step is looked for, and when it is believed.

    Attributes:
        before: Frames whose mean response is what a frame is expected to have, at most.
        least_before: The same at least: where a recording begins, a step may come soon.
        newest: Frames that must fall below it together: one may be dazzled.
        fall: By so many standard errors; asking in vain costs a second of judgements, so it may be low.
        open_ns: A step is looked for so long; by then the window holds frames from after it alone.
        least_frames: Frames on each side: single frames are off by 0.2 deg (PROBE 2).
        most_frames: Frames on each side at most.
        least_lost: Share of its score that each side must lose under the extrinsic of the other (PROBE 5).
        least_preference: Standard errors by which the cells of each side must prefer its own.
        least_contrast: Score of each side under its own extrinsic over chance, minus 1, and ...
        least_peak: ... height over chance, sigma: below them a side shows nothing (``DriftTestParameters``).
        confirmations: Judgements in a row that must find it.
    """

    before: int = 8
    least_before: int = 5
    newest: int = 3
    fall: float = 3.0
    open_ns: int = 2_000_000_000
    least_frames: int = 5
    most_frames: int = 10
    least_lost: float = 0.03
    least_preference: float = 2.0
    least_contrast: float = 0.15
    least_peak: float = 3.7
    confirmations: int = 2


@dataclass(frozen=True, slots=True, eq=False)
class Alertness:
    """How the newest frames respond, and whether a step is being looked for.

    Attributes:
        responses: Stamp and mean response of frames under what is believed, oldest first.
        since_ns: Stamp of the first frame that may come after a step, or None.
        after: Frames since then.
        xi: float64 (6,), what was believed when that was suspected, against the expected extrinsic.
        found: Judgements in a row that found a step.
    """

    responses: tuple[tuple[int, float], ...] = ()
    since_ns: int | None = None
    after: int = 0
    xi: Floats | None = None
    found: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Shock:
    """A step between two groups of frames, camera axes, rad and m.

    Attributes:
        xi: float64 (6,), of the mount's estimate after against before.
        covariance: float64 (6,6), of its random error, and of what a step of one sigma in the time between
            sweep and image would feign; nothing else is left in a difference.
        statistic: Squared step in sigmas, chi-square of six degrees without one.
        apart: What is left of it when the time between sweep and image may have jumped instead, chi-square of
            five degrees.
        lost: Share of its score that each side at least loses under the extrinsic of the other.
        preference: Standard errors by which the cells of each side at least prefer its own.
        contrast: Score of each side at least, under its own, over chance, minus 1.
        peak: Height of that over chance, in sigma of the scores of chance.
        before_ns: Stamp of the newest frame before it.
        since_ns: Stamp of the oldest frame after it.
    """

    xi: Floats
    covariance: Floats
    statistic: float
    apart: float
    lost: float
    preference: float
    contrast: float
    peak: float
    before_ns: int
    since_ns: int


def heeded(
    alertness: Alertness, stamp_ns: int, response: float, xi: Floats, parameters: ShockParameters
) -> Alertness:
    """The alertness after one more frame.

    Args:
        alertness: Before it.
        stamp_ns: Of the frame.
        response: Its mean response under what is believed.
        xi: float64 (6,), what is believed, against the expected extrinsic.
        parameters: See there.
    """
    responses = (*alertness.responses, (stamp_ns, response))[-parameters.before - parameters.newest :]
    if alertness.since_ns is not None:
        if stamp_ns - alertness.since_ns <= parameters.open_ns:
            return dataclasses.replace(alertness, responses=responses, after=alertness.after + 1)
        # What is believed has changed since then, and with it what a response is compared with.
        responses = ((stamp_ns, response),)
    count = len(responses) - parameters.newest
    if count < parameters.least_before:
        return Alertness(responses)
    values = np.array([value for _, value in responses])
    before, newest = values[:count], values[count:]
    error = float(before.std(ddof=1)) * math.sqrt(1.0 / len(before) + 1.0 / len(newest))
    # The median: a frame that is dazzled, or behind a wiper, does not speak for those beside it.
    level, fallen = float(before.mean()), float(np.median(newest))
    if fallen < level - parameters.fall * error:
        first = count + int(np.argmax(newest < 0.5 * (level + fallen)))
        return Alertness(responses, responses[first][0], len(responses) - first, xi)
    return Alertness(responses)


def find_shock(
    frames: Sequence[EdgeFrame],
    alertness: Alertness,
    camera: CameraModel,
    T_expected: Floats,
    B: Floats,
    places: Sequence[Floats],
    settings: EdgeWitnessParameters,
    parameters: ShockParameters,
) -> Shock | None:
    """The step that is being looked for; None where too few frames lie on one side of it.

    Args:
        frames: The window's frames with edges, ascending in time.
        alertness: With the moment of the step.
        camera: Intrinsics.
        T_expected: float64 (4,4), the extrinsic that ``alertness.xi`` is against.
        B: float64 (6,6), turns xi into vehicle axes (``se3.vehicle_block``).
        places: float64 (4,4) each, extrinsics of chance.
        settings: Of the edge witness.
        parameters: See there.
    """
    since_ns = alertness.since_ns
    if since_ns is None or alertness.xi is None:
        return None
    before = [f for f in frames if f.stamp_ns < since_ns][-parameters.most_frames :]
    after = [f for f in frames if f.stamp_ns >= since_ns][-parameters.most_frames :]
    if before and after:
        # Only what shows the same objects has the same systematic error.
        border = after[0].distance_m
        before = [f for f in before if border - f.distance_m <= NEW_SCENE_M]
        after = [f for f in after if f.distance_m - border <= NEW_SCENE_M]
    if min(len(before), len(after)) < parameters.least_frames:
        return None
    old, new = (batch_of(side, camera, settings.most_edges) for side in (before, after))
    xi, _ = edge_search.ascend(old, T_expected, alertness.xi, 0, settings)
    T_old = se3.retract(T_expected, xi)
    _, (step, _) = edge_search.find_maxima(new, T_old, score(new, T_old, 0), settings, None, None, far=False)
    T_new = se3.retract(T_old, step)
    covariance = _mean_covariance(old, T_old, settings) + _mean_covariance(new, T_new, settings)
    feigned = B.T @ np.mean([frame.feigned for frame in after], axis=0)
    covariance = covariance + np.outer(feigned, feigned)
    statistic, apart = _with_time_free(step, covariance, feigned)
    sides = ((old, T_old, T_new), (new, T_new, T_old))
    own, other = zip(*((score_only(b, T, 0), score_only(b, T_off, 0)) for b, T, T_off in sides), strict=True)
    contrast, peak = zip(*(_over_chance(b, T, places) for b, T, _ in sides), strict=True)
    return Shock(
        xi=step,
        covariance=covariance,
        statistic=statistic,
        apart=apart,
        lost=min(
            1.0 - float(b.sum() / a.sum()) if a.sum() > 0 else 0.0 for a, b in zip(own, other, strict=True)
        ),
        preference=min(preference(side[0], a, b) for side, a, b in zip(sides, own, other, strict=True)),
        contrast=min(contrast),
        peak=min(peak),
        before_ns=before[-1].stamp_ns,
        since_ns=since_ns,
    )


def _over_chance(batch: EdgeBatch, T_cam_lidar: Floats, places: Sequence[Floats]) -> tuple[float, float]:
    """Score of a side over chance, minus 1, and its height over chance in sigma.

    What covers a lens has a texture too, in which some extrinsic scores more than another.
    """
    weights = batch.weights()
    best, *by_chance = (weights @ mean_responses(batch, [T_cam_lidar, *places])) / weights.sum()
    background, spread = float(np.mean(by_chance)), float(np.std(by_chance))
    if background <= 0.0 or spread <= 0.0:
        return 0.0, 0.0
    return float(best) / background - 1.0, (float(best) - background) / spread


def _with_time_free(step: Floats, covariance: Floats, feigned: Floats) -> tuple[float, float]:
    """Squared step in sigmas, and what is left of it when the time may have jumped.

    Sweeps and images that suddenly come apart in time look like a step along the motion (FORMULAS G1).
    """
    statistic = float(step @ np.linalg.solve(covariance, step))
    towards = np.linalg.solve(covariance, feigned)
    length = float(feigned @ towards)
    if length < _STANDSTILL:
        return statistic, statistic
    return statistic, statistic - float(towards @ step) ** 2 / length


def _mean_covariance(batch: EdgeBatch, T_cam_lidar: Floats, settings: EdgeWitnessParameters) -> Floats:
    """Covariance (6,6) of the estimate of some frames: the cells' share of it, and the frames' own scatter.

    A mount that vibrates lies elsewhere in each frame; its mean over a few wanders by what they scatter.
    """
    weights = batch.weights()
    H = np.tensordot(weights / weights.sum(), curvatures(batch, T_cam_lidar, settings.difference), 1)
    share = score(batch, T_cam_lidar, 0)[2]
    pulls = np.stack([np.bincount(batch.slot, column, len(weights)) for column in (share * UNITS).T])
    moves = UNITS[:, None] * (edge_witness.inverse_curvature(H, settings) @ pulls)
    return np.asarray(edge_witness.sandwich(batch, H, share, settings) + moves @ moves.T, dtype=np.float64)


def weighed(
    alertness: Alertness, shock: Shock | None, budget: AlarmBudget, parameters: ShockParameters
) -> Alertness:
    """The alertness after a judgement that looked for a step: a step far from any belief is let go."""
    if shock is None:
        return alertness
    if shock.statistic < 0.5 * _level(budget):
        # The responses stay: a step may have come just after what was taken for one.
        return Alertness(alertness.responses)
    found = alertness.found + 1 if believed(shock, budget, parameters) else 0
    return dataclasses.replace(alertness, found=found)


def believed(shock: Shock, budget: AlarmBudget, parameters: ShockParameters) -> bool:
    """Whether a step is no chance: at the rate that a year of driving allows, and both sides say so."""
    clear = shock.lost > parameters.least_lost and shock.preference > parameters.least_preference
    seen = shock.contrast >= parameters.least_contrast and shock.peak >= parameters.least_peak
    return clear and seen and shock.statistic > _level(budget)


def moved(shock: Shock, budget: AlarmBudget) -> bool:
    """Whether a step that is believed can not be one of the clocks."""
    return shock.apart > _level(budget, len(AXES) - 1)


@functools.lru_cache(maxsize=16)
def _level(budget: AlarmBudget, degrees: int = len(AXES)) -> float:
    return float(chdtri(degrees, budget.yearly_alarms / budget.yearly_scenes))
