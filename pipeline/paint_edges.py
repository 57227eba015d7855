"""Borders of bright strips on the road, along any line of points that crosses it (PROBE section 1)."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.edge_parameters import EdgeParameters
from pipeline.ground import Ground
from pipeline.medians import median
from pipeline.records import Floats
from pipeline.strips import StripShape, strips_about

_FEWEST_ON_GROUND = 10
"""Points of ground below which nothing is known of its brightness."""


def paint_borders(
    xyz: Floats,
    tangent: Floats,
    intensity: Floats,
    distance: Floats,
    joined: NDArray[np.bool_],
    way: Floats,
    ground: Ground,
    parameters: EdgeParameters,
) -> tuple[Floats, Floats]:
    """Both borders of each bright strip on the ground, at half of its rise: positions, directions (K,3).

    Args:
        xyz: float64 (N,3), m, points in the order in which they follow each other across the road.
        tangent: float64 (N,3), unit, the way on at each.
        intensity: float64 (N,).
        distance: float64 (N,), m, from the sensor or the camera.
        joined: bool (N-1,), whether a point and the next are neighbours.
        way: float64 (N-1,), m, from a point to the next.
        ground: The plane.
        parameters: What counts as paint.
    """
    on_ground = np.abs(ground.heights(xyz)) < parameters.ground_band_m
    on_ground &= (distance > parameters.paint_nearest_m) & (distance < parameters.paint_farthest_m)
    if int(on_ground.sum()) < _FEWEST_ON_GROUND:
        return np.zeros((0, 3)), np.zeros((0, 3))
    pairs = joined & on_ground[1:] & on_ground[:-1]
    noise = 1.48 * median(np.abs(np.diff(intensity)[pairs])) / math.sqrt(2.0) if pairs.any() else 0.0
    road = median(intensity[on_ground])
    least = max(parameters.paint_noise * noise, parameters.paint_contrast * road)
    if least <= 0.0:
        # Most of a dark road reads nothing: what reads least of the rest is noise.
        rest = intensity[on_ground & (intensity > 0.0)]
        least = parameters.paint_noise * float(rest.min()) if rest.size else 0.0
    # Stretches of ground without a gap; strips are sought inside each.
    starts = np.flatnonzero(np.concatenate([[True], ~pairs]))
    stretch = np.cumsum(np.concatenate([[True], ~pairs])) - 1
    along = np.concatenate([[0.0], np.cumsum(np.where(pairs, way, 0.0))])
    peak = np.flatnonzero(
        on_ground
        & (intensity > road + least)
        & (intensity >= np.concatenate([[-np.inf], np.where(pairs, intensity[:-1], -np.inf)]))
        & (intensity > np.concatenate([np.where(pairs, intensity[1:], -np.inf), [-np.inf]]))
    )
    ends = np.concatenate([starts[1:], [len(xyz)]])
    reach = parameters.strip_widest_m + parameters.background_m
    first = np.maximum(starts[stretch[peak]], np.searchsorted(along, along[peak] - reach))
    last = np.minimum(ends[stretch[peak]], np.searchsorted(along, along[peak] + reach))
    shape = StripShape(
        least,
        parameters.paint_asymmetry,
        parameters.strip_narrowest_m,
        parameters.strip_widest_m,
        parameters.background_m,
    )
    borders: list[float] = []
    last_end = -1
    for p, end, left, right in strips_about(along, intensity, (peak, first, last), shape):
        if p > last_end:
            last_end = int(end)
            borders.extend((left, right))
    if not borders:
        return np.zeros((0, 3)), np.zeros((0, 3))
    place = np.array(borders)
    whole = np.floor(place).astype(np.int64)
    part = (place - whole)[:, None]
    nxt = np.minimum(whole + 1, len(xyz) - 1)
    return (1.0 - part) * xyz[whole] + part * xyz[nxt], tangent[whole]
