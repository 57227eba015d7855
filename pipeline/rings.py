"""The scan pattern of a spinning LiDAR, found in its own data: rings, order along them, steps.

Nothing is set per sensor. A ring number in the cloud is used where there is one; else rings are read off the
order of the points (ring after ring) or off their elevation. A cloud without any such pattern gives None.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.medians import group_medians, grouped, median
from pipeline.records import Floats, PointCloud

_FEWEST_RINGS, _MOST_RINGS = 4, 512
"""Outside these numbers an order that was read off the data is no ring pattern."""

_RING_STRAYS = 0.05
"""Share of steps between points that may not go on along the ring: ends of rings, gaps, near objects."""

_OWN_SHARE = 0.05
"""Median distance of a point from its ring's elevation, as a share of the sensor's vertical field of view."""

_SHARP_SHARE = 0.1
"""The same as a share of the spacing of rings that were read off the elevations alone. Clouds of six sensors
that keep their elevation lay below 0.005, points in no order above 0.3."""

_RING_POINTS = 10
"""Points of the median ring that was read off the elevations; a peak of fewer is chance."""

_LEAST_STEP_RAD = 1e-6
"""Points nearer to each other on a ring are echoes of one beam, and no step."""

_STEPS_ASKED = 15_000
"""Points that tell the usual step and whether rings keep their elevation: some hundred a ring."""

_STEP_NOISE_RAD = 1e-3
"""So far azimuth may run back along a ring: rounding of coordinates to millimetres at 1 m."""

_LEVEL_SHARE = 0.03
"""Share of the range by which neighbours on one surface differ at most."""

_CUT_RAD = math.radians(20.0)
"""A longer way to the next point leads over a part of the turn that was cut out of the sweep."""

_SEAM_BINS = 720
"""Bins of the turn in which the end of the rings is sought: half a degree holds a step of every sensor."""

_ELEVATION_BIN_RAD = math.radians(0.02)
"""Bin of the elevation histogram; a tenth of the closest ring spacing on sale."""


_AXIS_POINTS = 6000
"""Points that are asked for the spin axis: a hundred a ring."""

_AXIS_SHARE = 0.3
"""Share of the strays about z that those about another axis must stay below."""

_TURNS = (
    np.eye(3),
    np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
)
"""Rotations that bring z, x and y to z."""

_TURN_OF = (1, 2, 0)
"""Which of them brings axis 0, 1, 2 to z."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanPattern:
    """Points ordered by ring from the lowest to the highest, and along each ring by azimuth.

    Attributes:
        index: int64 (M,), index of each ordered point in the cloud.
        ring: int64 (M,), rank of its ring by elevation, 0 lowest.
        azimuth: float64 (M,), rad about the spin axis, growing inside a ring.
        elevation: float64 (M,), rad above the plane across the spin axis.
        distance: float64 (M,), range from the sensor, m.
        azimuth_step: Median angle between neighbours on a ring, rad.
        ring_spacing: Median angle between neighbouring rings, rad.
    """

    index: NDArray[np.int64]
    ring: NDArray[np.int64]
    azimuth: Floats
    elevation: Floats
    distance: Floats
    azimuth_step: float
    ring_spacing: float


def has_rings(cloud: PointCloud) -> bool:
    """Whether the ring field tells rings apart; one number for all points is a converter's filler."""
    return cloud.ring is not None and len(cloud) > 0 and int(cloud.ring.min()) < int(cloud.ring.max())


def spin_turns(cloud: PointCloud) -> tuple[Floats, ...]:
    """Rotations (3,3) that may bring the spin axis of the sensor to z, the likeliest first.

    Messages name their axes as they like. Where rings are numbered, the spin axis is the one about which a
    ring keeps its elevation; else z is tried before the others.
    """
    if cloud.ring is None or not has_rings(cloud):
        return _TURNS
    few = slice(None, None, max(1, len(cloud) // _AXIS_POINTS))
    xyz, ring = cloud.xyz[few].astype(np.float64), cloud.ring[few].astype(np.int64)
    order = np.argsort(ring, kind="stable")
    ring = np.unique(ring[order], return_inverse=True)[1]
    slope = xyz[order] / np.maximum(np.linalg.norm(xyz[order], axis=1), 1e-9)[:, None]
    count = int(ring[-1]) + 1
    strays = [median(np.abs(s - group_medians(s, ring, count)[ring])) for s in slope.T]
    other = int(np.argmin(strays))
    # A sweep brought to one instant strays a little; only a much better axis is another one.
    elsewhere = strays[other] < _AXIS_SHARE * strays[2]
    return (_TURNS[_TURN_OF[other] if elsewhere else 0],)


def scan_pattern(cloud: PointCloud, keep: NDArray[np.bool_]) -> ScanPattern | None:
    """Orders the points that ``keep`` (N,) marks; None where the cloud shows no rings.

    The sensor is taken to stand at the origin of the cloud's frame and to spin about its z axis; a cloud in
    another frame is turned and moved before (the ring number and the order of points do not mind).
    """
    ring = ring_numbers(cloud)
    if ring is None:
        return None
    chosen = np.flatnonzero(keep & (ring >= 0))
    if chosen.size < _FEWEST_RINGS:
        return None
    x, y, z = np.ascontiguousarray(cloud.xyz.take(chosen, axis=0).T, dtype=np.float64)
    flat = np.hypot(x, y)
    azimuth = np.arctan2(y, x)
    # The cut of the circle is laid where no point is: opposite to the middle of what is kept.
    middle = math.atan2(float(np.sin(azimuth).mean()), float(np.cos(azimuth).mean()))
    azimuth = np.mod(azimuth - middle + math.pi, 2.0 * math.pi)
    elevation = np.arctan2(z, flat)
    rank, medians = _rank_by_elevation(ring.take(chosen), elevation)
    # Ring by ring first: a file goes on along a ring, and what is all but in order is sorted quickly.
    order = grouped(rank)
    order = order[np.argsort((4.0 * math.pi * rank + azimuth)[order], kind="stable")]
    spacing = np.diff(medians)
    rank, azimuth = rank[order], azimuth[order]
    # Where both echoes of a beam are one and the same, the second is no neighbour of the first.
    twin = np.flatnonzero((np.diff(azimuth) == 0.0) & (np.diff(rank) == 0))
    here, there = order[twin], order[twin + 1]
    again = twin[(x[here] == x[there]) & (y[here] == y[there]) & (z[here] == z[there])] + 1
    if again.size:
        order, rank, azimuth = (np.delete(values, again) for values in (order, rank, azimuth))
    step = np.diff(azimuth)[np.diff(rank) == 0]
    step = step[step > _LEAST_STEP_RAD]
    if step.size == 0 or spacing.size == 0:
        return None
    return ScanPattern(
        index=chosen[order],
        ring=rank,
        azimuth=azimuth,
        elevation=elevation[order],
        distance=np.hypot(flat, z)[order],
        azimuth_step=median(step),
        ring_spacing=median(spacing),
    )


def ring_numbers(cloud: PointCloud) -> NDArray[np.int64] | None:
    """A ring number for each point (-1: none), from the cloud's own field, its order or its elevations."""
    if cloud.ring is not None and has_rings(cloud):
        return cloud.ring.astype(np.int64)
    return _read_off(cloud)[0]


def elevation_rings(cloud: PointCloud) -> NDArray[np.int64] | None:
    """A ring number for each point where nothing but their elevations tells it, else None.

    A sweep that is brought to one instant loses these: its points no longer keep their elevation.
    """
    if has_rings(cloud):
        return None
    ring, by_order = _read_off(cloud)
    return None if by_order else ring


def _read_off(cloud: PointCloud) -> tuple[NDArray[np.int64] | None, bool]:
    """A ring number for each point of a cloud that names none, or None; whether their order told it."""
    if len(cloud) < _FEWEST_RINGS:
        return None, False
    x, y, z = np.ascontiguousarray(cloud.xyz.T)
    azimuth = np.arctan2(y, x).astype(np.float64)
    across = x * x + y * y
    distance = np.sqrt(across + z * z)
    elevation = np.arctan2(z, np.sqrt(across, out=across)).astype(np.float64)
    by_order = _rings_by_order(azimuth, elevation, distance)
    if by_order is not None and _believable(by_order, elevation):
        return by_order, True
    by_elevation = _rings_by_elevation(elevation)
    if by_elevation is not None and _sharp(by_elevation, elevation):
        return by_elevation, False
    return None, False


def _rings_by_order(
    azimuth: Floats, elevation: Floats, distance: NDArray[np.float32]
) -> NDArray[np.int64] | None:
    """Ring number where the file holds ring after ring: each turn of the azimuth begins a new one."""
    step = _wrapped(np.diff(azimuth))
    middle = median(step[:: max(1, len(step) // _STEPS_ASKED)])
    sense = math.copysign(1.0, middle)
    step *= sense
    # Ring after ring means small steps forward nearly always; column after column does not.
    forward = np.count_nonzero((step > -_STEP_NOISE_RAD) & (step < math.radians(5.0)))
    if forward < (1.0 - _RING_STRAYS) * len(step):
        return None
    cut = np.flatnonzero(np.abs(step) > _CUT_RAD)
    # In a sweep cut to a part of the turn the way over what was cut is still a way forward.
    step[cut] = np.mod(step[cut], 2.0 * math.pi)
    turns = np.empty(len(azimuth))
    turns[0] = 0.0
    np.cumsum(step, out=turns[1:])
    count = float(turns[-1]) / (2.0 * math.pi)
    if not _FEWEST_RINGS <= count <= _MOST_RINGS:
        return None
    turned = azimuth * sense
    turned[turned < 0.0] += 2.0 * math.pi
    turns += azimuth[0] * sense - _seam(turned, elevation, distance, cut, count)
    turns /= 2.0 * math.pi
    whole = np.floor(turns)
    ring = whole.astype(np.int64)
    ring -= ring[0]
    # Where a ring ends a point's ring is not sure, and no edge may be seen between it and the next.
    turns -= whole
    nearest = abs(middle) / math.pi
    ring[(turns < nearest) | (turns > 1.0 - nearest)] = -1
    return ring


def _seam(
    azimuth: Floats,
    elevation: Floats,
    distance: NDArray[np.float32],
    cut: NDArray[np.int64],
    turns: float,
) -> float:
    """Azimuth in 0..2 pi at which one ring ends and the next begins: the elevation jumps there every turn.

    Inside a ring it jumps only where the range does (lasers sit some centimetres apart) and comes back, so
    steps of range are left out, but for those over a ``cut`` (indices), and the rest is summed with its sign.
    """
    change = np.diff(elevation)
    spacing = float(np.ptp(elevation)) / turns
    size = np.abs(change)
    jumps = np.flatnonzero((size > 0.25 * spacing) & (size < 5.0 * spacing))
    level = np.abs(distance[jumps + 1] - distance[jumps]) < _LEVEL_SHARE * distance[jumps + 1]
    jumps = jumps[level | np.isin(jumps, cut)]
    sums, borders = np.histogram(
        azimuth[jumps + 1], bins=_SEAM_BINS, range=(0.0, 2.0 * math.pi), weights=change[jumps]
    )
    best = int(np.argmax(np.abs(sums + np.roll(sums, 1) + np.roll(sums, -1))))
    offset = _wrapped(azimuth[jumps + 1] - borders[best])
    near = offset[np.abs(offset) < 2.0 * (borders[1] - borders[0])]
    seam = borders[best] + (median(near) if near.size else 0.0)
    return float(np.mod(seam - 0.5 * _empty_before(azimuth, best), 2.0 * math.pi))


def _wrapped(angle: Floats) -> Floats:
    """Angles (N,) less whole turns, in -pi..pi."""
    return np.asarray(angle - 2.0 * math.pi * np.rint(angle / (2.0 * math.pi)))


def _empty_before(azimuth: Floats, seam_bin: int) -> float:
    """Width of the part of the turn without points that ends at the seam, rad; 0 for a whole turn.

    In a sweep that was cut there, the first points of the rings lie along the cut and not at one azimuth.
    """
    place = (azimuth * (_SEAM_BINS / (2.0 * math.pi))).astype(np.int16)
    # A whole turn, to the last digit, belongs to the last bin.
    empty = np.ones(_SEAM_BINS + 1, dtype=bool)
    empty[place] = False
    empty[_SEAM_BINS - 1] &= empty[_SEAM_BINS]
    empty = empty[:_SEAM_BINS]
    before = np.roll(empty, _SEAM_BINS - seam_bin - 1)[::-1]
    # The cut may pass through the bin of the seam, or one beside it.
    first = int(np.argmax(before[:3]))
    run = int(np.argmin(before[first:])) if before[first] else 0
    return run * 2.0 * math.pi / _SEAM_BINS


def _rings_by_elevation(elevation: Floats) -> NDArray[np.int64] | None:
    """Ring number where each laser keeps its elevation: peaks of the histogram, parted at its valleys."""
    low, high = float(elevation.min()), float(elevation.max())
    bins = max(8, int((high - low) / _ELEVATION_BIN_RAD))
    counts, borders = np.histogram(elevation, bins=bins)
    smooth = np.convolve(counts, [0.25, 0.5, 0.25], mode="same")
    filled = smooth > 0.1 * np.median(smooth[smooth > 0]) if (smooth > 0).any() else smooth > 0
    rising = np.flatnonzero(np.diff(np.concatenate([[0], filled.astype(np.int8)])) == 1)
    if not _FEWEST_RINGS <= rising.size <= _MOST_RINGS:
        return None
    return np.searchsorted(borders[rising], elevation, side="right").astype(np.int64) - 1


def _believable(ring: NDArray[np.int64], elevation: Floats) -> bool:
    """Whether the points of a ring keep to its elevation better than to those of other rings.

    Judged by the median point: lasers sit some centimetres apart, which bends a ring by degrees on near
    objects.
    """
    sure = np.flatnonzero(ring >= 0)
    sure = sure[:: max(1, len(sure) // _STEPS_ASKED)]
    ring, elevation = ring[sure], elevation[sure]
    order = grouped(ring)
    medians = group_medians(elevation[order], ring[order], int(ring.max()) + 1)
    own = median(np.abs(elevation - medians[ring]))
    medians = medians[np.isfinite(medians)]
    return bool(own < _OWN_SHARE * np.ptp(medians) and len(medians) >= _FEWEST_RINGS)


def _sharp(ring: NDArray[np.int64], elevation: Floats) -> bool:
    """Whether peaks of the elevation are rings: of many points, each far nearer to its own than to the next.

    Points in no order make peaks too, as wide as the valleys between them.
    """
    sure = ring >= 0
    ring, elevation = ring[sure], elevation[sure]
    order = grouped(ring)
    medians = group_medians(elevation[order], ring[order], int(ring.max()) + 1)
    off = median(np.abs(elevation - medians[ring]))
    counts = np.bincount(ring)
    if np.median(counts[counts > 0]) < _RING_POINTS or np.isfinite(medians).sum() < _FEWEST_RINGS:
        return False
    return off < _SHARP_SHARE * float(np.median(np.diff(medians[np.isfinite(medians)])))


def _rank_by_elevation(ring: NDArray[np.int64], elevation: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Ring numbers replaced by their rank from the lowest ring up, whatever the sensor's own order.

    With the median elevation of each rank, rad.
    """
    order = grouped(ring)
    numbers = int(ring.max()) + 1
    # Numbers that are absent have no median; they are sorted to the end and name no point.
    medians = group_medians(elevation[order], ring[order], numbers)
    rank = np.empty(numbers, dtype=np.int64)
    upwards = np.argsort(medians)
    rank[upwards] = np.arange(numbers)
    return rank[ring], medians[upwards[np.isfinite(medians[upwards])]]
