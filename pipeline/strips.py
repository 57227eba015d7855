"""Bright strips along a line of points: paint on the road as a ring of a LiDAR crosses it.

All peaks of a sweep are weighed at once, each in a row of a table.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Floats

_MOST_POINTS = 4096
"""Points about a peak beyond which it is let go: so many on two metres of road are no line of points."""

_TABLE = 2_000_000
"""Places of the table in which peaks are weighed at once: 16 MB for each of some such tables."""

_ROAD_POINTS = 2
"""Points of road beside a strip, at least: one alone may be paint or a stone."""


@dataclass(frozen=True, slots=True)
class StripShape:
    """What counts as a strip.

    Attributes:
        rise: Smallest rise of its peak over its road.
        asymmetry: Largest difference of the road on both sides as a share of the rise.
        narrowest_m: Narrower is noise, m.
        widest_m: Wider is no strip, m.
        background_m: Width of road on each side with which it is compared, m.
    """

    rise: float
    asymmetry: float
    narrowest_m: float
    widest_m: float
    background_m: float


def strips_about(
    along: Floats,
    intensity: Floats,
    windows: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    shape: StripShape,
) -> list[list[float]]:
    """The strips about peaks: peak, end of the half level, and both borders, as (fractional) indices.

    Args:
        along: float64 (N,), way along the ring, m.
        intensity: float64 (N,).
        windows: int64 (P,) each: index of each peak, and first and past-the-last index of what may be
            compared with it.
        shape: What counts as a strip.
    """
    few = np.flatnonzero(windows[2] - windows[1] <= _MOST_POINTS)
    if few.size == 0:
        return []
    widest = int((windows[2] - windows[1])[few].max())
    found: list[list[float]] = []
    for block in np.array_split(few, 1 + few.size * widest // _TABLE):
        peak, first, last = (values[block] for values in windows)
        found += _weighed(along, intensity, (peak, first, last), shape)
    return found


def _weighed(
    along: Floats,
    intensity: Floats,
    windows: tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]],
    shape: StripShape,
) -> list[list[float]]:
    """The strips about some peaks, at least one, with a table of all of their windows."""
    peak, first, last = windows
    # A table with a row per peak; windows end at gaps of the ring, so rows are filled up with nothing.
    column = np.arange(int((last - first).max()))
    index = first[:, None] + column
    inside = index < last[:, None]
    np.minimum(index, len(along) - 1, out=index)
    values = np.where(inside, intensity[index], np.inf)
    where = along[index] - along[peak][:, None]
    level, middle = intensity[peak], (peak - first)[:, None]
    # First guess of the road from beyond the widest strip, then the half level, then each side's own road.
    outside = inside & (np.abs(where) > 0.5 * shape.widest_m)
    half = 0.5 * (level + _row_medians(values, outside))
    below = values < half[:, None]
    i = np.where(below & (column < middle), column, -1).max(axis=1)
    j = np.where(below & (column > middle), column, len(column)).min(axis=1)
    seen = np.flatnonzero((i >= 0) & (j < len(column)) & outside.any(axis=1))
    peak, first, level, i, j = peak[seen], first[seen], level[seen], i[seen], j[seen]
    values, where, inside = values[seen], where[seen], inside[seen]
    row = np.arange(len(seen))
    begin, end = where[row, i + 1], where[row, j - 1]
    good = ((j - i > 2) | (end >= begin)) & (end - begin <= shape.widest_m)
    low_left, left_points = _road(
        values, inside & (where < begin[:, None]) & (where > (begin - shape.background_m)[:, None])
    )
    low_right, right_points = _road(
        values, inside & (where > end[:, None]) & (where < (end + shape.background_m)[:, None])
    )
    rise = level - 0.5 * (low_left + low_right)
    good &= (left_points >= _ROAD_POINTS) & (right_points >= _ROAD_POINTS) & (rise >= shape.rise)
    good &= np.abs(low_left - low_right) <= shape.asymmetry * rise
    left = i + _crossing(values[row, i], values[row, i + 1], 0.5 * (level + low_left))
    right = j - 1 + _crossing(values[row, j - 1], values[row, j], 0.5 * (level + low_right))
    good &= _between(where, right) - _between(where, left) >= shape.narrowest_m
    found: list[list[float]] = np.column_stack([peak, first + j, first + left, first + right])[good].tolist()
    return found


def _row_medians(values: Floats, chosen: NDArray[np.bool_]) -> Floats:
    """Median (P,) of the chosen finite values of each row (P,W); infinite where there are none."""
    table = np.sort(np.where(chosen, values, np.inf), axis=1)
    count, row = chosen.sum(axis=1), np.arange(len(values))
    return 0.5 * np.asarray(table[row, np.maximum(count - 1, 0) // 2] + table[row, count // 2])


def _road(values: Floats, chosen: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.int64]]:
    """Mean (P,) of the chosen values of each row (P,W), and their number; 0 where there are none."""
    count = chosen.sum(axis=1)
    return np.where(chosen, values, 0.0).sum(axis=1) / np.maximum(count, 1), count


def _between(values: Floats, place: Floats) -> Floats:
    """The values (P,) of the rows (P,W) at fractional columns (P,) inside them."""
    row, whole = np.arange(len(values)), place.astype(np.int64)
    below, above = values[row, whole], values[row, np.minimum(whole + 1, values.shape[1] - 1)]
    return np.asarray(below + (place - whole) * (above - below))


def _crossing(low: Floats, high: Floats, level: Floats) -> Floats:
    """How far (P,), 0..1, from the low to the high value of each pair the level is passed."""
    rise = high - low
    share = np.divide(level - low, rise, out=np.zeros_like(low), where=rise != 0.0)
    return np.asarray(np.clip(share, 0.0, 1.0))
