"""Where the beams of one sweep pass over paint: narrow rises of brightness against both sides (CRLF (3)).

Neither angle nor range nor laser leaves intensities alike, and paint is often hardly brighter than
the road around it. So brightness is compared along the track of one beam only, where all three stay the same:
the mean over the width of paint against the means of the road on its left and on its right.
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Floats

Indices: TypeAlias = NDArray[np.int64]

INNER_M = 0.10
"""m to each side of a place; with the beam's footprint paint of 0.10 to 0.20 m fills it."""
FLANK_M = (0.20, 1.0)
"""m beside a place that are its surroundings: beyond the paint, before the next line of the lane."""
MIN_FLANK = 3
"""Points of a flank below which its mean says nothing."""
RISE_SIGMAS = 2.0
"""Standard errors above the brighter flank from which on a place is taken for paint: 1 % by chance."""
MOST_RISE = 6.0
"""Standard errors that count: one reflector does not make a line."""
MAX_WIDTH_M = 0.7
"""m along the track: lines of 0.3 m crossed at 40 deg, with the inner window around them."""
TRACK_RAD = math.radians(0.4)
"""rad of depression that a track takes in where rings have no number: about one ring of a 64-beam sensor."""
LEAST_HEIGHT_M = 1.0
"""m; taken for the sensor's height where it seems lower: a cloud may be told from a place on the ground."""
_SPLIT_M = 0.3
"""m between points of a track beyond which marks are two; farther rays of a sensor lie 0.2 m apart."""
_FAR_M = 1e3
"""m; tracks are laid one behind the other at this distance, so that no window reaches into the next."""
_FLOOR = 0.25
"""Of the median variance of flanks: quantised intensities may not vary at all over a metre."""


@dataclass(frozen=True, slots=True, eq=False)
class PaintMarks:
    """What may be paint, along tracks.

    Attributes:
        plan: float64 (M,2), middle of each mark in the plan, m.
        track: int64 (M,), the track that it lies on.
        rise: float64 (M,), its brightness above the brighter flank, in standard errors.
        of_point: int64 (N,), mark of each point of the ground, -1: none.
        track_of_point: int64 (N,), track of each point.
        rise_of_point: float64 (N,), as ``rise`` at each point, within +-``MOST_RISE``; 0 where not known.
    """

    plan: Floats
    track: Indices
    rise: Floats
    of_point: Indices
    track_of_point: Indices
    rise_of_point: Floats


def along_tracks(plan: Floats, shade: Floats, ring: Indices | None, height: float) -> PaintMarks:
    """Marks along the tracks of the lasers: what lies across them, as lane lines do.

    Args:
        plan: float64 (N,2), points of the ground in the plan, the sensor's foot at the origin, m.
        shade: float64 (N,), their intensity in any unit.
        ring: int64 (N,), their laser; None: told by the depression below the sensor.
        height: Of the sensor above the ground, m.
    """
    reach = np.hypot(plan[:, 0], plan[:, 1])
    if ring is None:
        ring = np.floor(np.arctan2(max(abs(height), LEAST_HEIGHT_M), reach) / TRACK_RAD).astype(np.int64)
    azimuth = _azimuth(plan)
    order = np.lexsort((azimuth, ring))
    step = np.diff(azimuth[order]) * np.minimum(reach[order][1:], reach[order][:-1])
    return _marks(plan, shade, ring, order, step)


def _azimuth(plan: Floats) -> Floats:
    """Azimuth (N,), its cut opposite to the middle of the points, rad, 0 to 2 pi."""
    if len(plan) == 0:
        return np.zeros(0)
    middle = plan.mean(axis=0)
    azimuth = np.arctan2(plan[:, 1], plan[:, 0]) - math.atan2(middle[1], middle[0])
    return np.asarray(np.mod(azimuth + math.pi, 2.0 * math.pi))


def _marks(plan: Floats, shade: Floats, track: Indices, order: Indices, step: Floats) -> PaintMarks:
    """The marks of points whose ``order`` (N,) runs along tracks in steps (N-1,) of m."""
    sorted_track = track[order]
    step = np.where(np.diff(sorted_track) != 0, _FAR_M, step)
    place = np.concatenate([[0.0], np.cumsum(step)])[: len(order)]
    rise = _rises(place, shade[order])
    run = _runs(place, rise)
    count = int(run.max(initial=-1)) + 1
    inside = run >= 0
    weight = rise[inside]
    total = np.bincount(run[inside], weights=weight, minlength=count)
    middle = np.column_stack(
        [np.bincount(run[inside], weights=weight * x[order][inside], minlength=count) for x in plan.T]
    ) / total.reshape(-1, 1)
    highest = np.zeros(count)
    np.maximum.at(highest, run[inside], weight)
    track_of_mark = np.zeros(count, dtype=np.int64)
    track_of_mark[run[inside]] = sorted_track[inside]
    of_point, rise_of_point = np.full(len(order), -1, dtype=np.int64), np.zeros(len(order))
    of_point[order], rise_of_point[order] = run, rise
    return PaintMarks(middle.reshape(-1, 2), track_of_mark, highest, of_point, track, rise_of_point)


def _rises(place: Floats, shade: Floats) -> Floats:
    """Brightness (N,) of each place above its brighter flank, in standard errors, within +-``MOST_RISE``."""
    if len(place) == 0:
        return np.zeros(0)
    borders = (-FLANK_M[1], -FLANK_M[0], -INNER_M, INNER_M, FLANK_M[0], FLANK_M[1])
    at = [np.searchsorted(place, place + border) for border in borders]
    # Sums about the overall mean: squares of small differences keep their digits.
    centred = shade - shade.mean()
    sums, squares = (np.concatenate([[0.0], np.cumsum(x)]) for x in (centred, centred**2))

    def moments(low: Indices, high: Indices) -> tuple[Indices, Floats, Floats]:
        count = high - low
        safe = np.maximum(count, 1)
        mean = (sums[high] - sums[low]) / safe
        return count, mean, np.maximum((squares[high] - squares[low]) / safe - mean**2, 0.0)

    inner, inner_mean, _ = moments(at[2], at[3])
    flanks = (moments(at[0], at[1]), moments(at[4], at[5]))
    known = (flanks[0][0] >= MIN_FLANK) & (flanks[1][0] >= MIN_FLANK) & (inner > 0)
    if not known.any():
        return np.zeros(len(place))
    counts = flanks[0][0] + flanks[1][0]
    spread = (flanks[0][0] * flanks[0][2] + flanks[1][0] * flanks[1][2]) / np.maximum(counts, 1)
    spread = np.maximum(spread, _FLOOR * float(np.median(spread[known])) + np.finfo(np.float32).eps)
    rise = np.full(len(place), np.inf)
    for count, mean, _ in flanks:
        error = np.sqrt(spread * (1.0 / np.maximum(inner, 1) + 1.0 / np.maximum(count, 1)))
        rise = np.minimum(rise, (inner_mean - mean) / error)
    return np.where(known, np.clip(rise, -MOST_RISE, MOST_RISE), 0.0)


def _runs(place: Floats, rise: Floats) -> Indices:
    """Number (N,) of the narrow run of risen places that each belongs to, -1: none."""
    risen = np.flatnonzero(rise >= RISE_SIGMAS)
    run = np.full(len(place), -1, dtype=np.int64)
    if len(risen) == 0:
        return run
    begins = np.concatenate([[True], (np.diff(place[risen]) > _SPLIT_M) | (np.diff(risen) > 1)])
    number = np.cumsum(begins) - 1
    first = np.flatnonzero(begins)
    last = np.append(first[1:], len(risen)) - 1
    narrow = place[risen[last]] - place[risen[first]] <= MAX_WIDTH_M
    renumbered = np.where(narrow, np.cumsum(narrow) - 1, -1)
    run[risen] = renumbered[number]
    return run
