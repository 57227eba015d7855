"""Straight edges of bodies where the range jumps: along a ring from beam to beam, and from ring to ring.

The true edge lies somewhere between the last beam on the body and the first beside it. It is taken in the
middle; the error is uniform over that gap, and because the beams of a spinning sensor often form columns,
much of it is common to a whole line: it is not averaged over the rings but enters the covariance at both
ends.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.plane_edges import MIN_LENGTH_M, MIN_LENGTH_RAD
from pipeline.records import Floats
from pipeline.rings import ScanPattern
from pipeline.uncertain_lines import UncertainLine, across, ends_covariance

JUMP_M, JUMP_SHARE = 0.5, 0.06
"""m and share of the range; the least jump along a ring: the depth of a parked car's flank, and what noise
and slant make of ranges far away."""
JUMP_UP_M, JUMP_UP_SHARE = 1.0, 0.10
"""The same between rings, which lie further apart on a slanted surface."""
GAP_STEPS = 2.6
"""A gap along a ring of more steps breaks it: what lies there was not seen."""
SKY_STEPS = 5.0
"""Steps of a gap along a ring from which on it is the sky or a thing that gives no returns: five beams in a
row are not lost by chance."""
SPARSEST_RAD = math.radians(0.8)
"""rad; between rings further apart an edge is known to worse than 3 px (10 px over sqrt 12 at f = 720 px)."""
BEAM_RAD = 0.002
"""rad; width of a beam (2 to 3 mrad on data sheets): a beam that grazes a body still returns from it."""
COMMON_DEPTH_M = 0.03
"""m; accuracy of ranges on data sheets, common to all points of a line."""
STEP_M, STEP_SHARE = 0.3, 0.02
"""m and share of the range by which neighbouring points of one edge differ in range."""
LEAN = 1.0
"""Slope (45 deg) up to which an edge leans from ring to ring, and an edge along a ring rises."""
MIN_RINGS = 5
"""Points of an edge across rings, at least: two directions and a bend are 4."""
MIN_COLUMNS = 8
"""Points of an edge along a ring, at least."""
MOST_EDGES = 8000
"""Edge points of either kind, the nearest first, that are looked at: a street has 2000. Bounds the time."""
ACROSS_RINGS = np.array([[1.0, 0.5], [0.5, 1.0]]) / 12.0
"""Covariance of the errors of both ends of an edge across rings, in gaps: uniform, and common to both where
the beams form columns and the edge is parallel to them."""
ALONG_RINGS = np.eye(2) / 6.0
"""The same of an edge along rings: it slowly crosses from one ring to the next, and a line through one such
tooth errs by half a gap to opposite sides at its ends: between uniform (1/12) and the worst case (1/4)."""
_DEPTH_RMS_M = 0.08
"""m; points of an edge scatter less in depth: three times range noise, and the roundness of a body."""
_MAX_DEPTH_M = 0.3
"""m; a point further from the line in depth bends it."""
_SIDE_RMS_GAPS = 0.45
"""Gaps; points of an edge scatter less sideways: uniform over a gap have 0.29, leaves more."""
_FILLED = 0.7
"""Share of the rings (of an edge along rings: of the columns) between its ends on which an edge shows."""
_FADED = 1e-4
"""1/m; inverse range of what no sensor sees."""
_ECHO_RAD = 1e-6
"""rad; points nearer along a ring are echoes of one beam."""


@dataclass(frozen=True, slots=True, eq=False)
class _EdgePoints:
    """Points (M) where the range jumps.

    Attributes:
        at: Index of the nearer point in the scan pattern.
        position: (M,3), m, in the middle of the gap at the range of the nearer point.
        ring: Rank of the ring.
        azimuth: rad, of the scan pattern.
        elevation: rad.
        distance: m.
        side: 1 or -1, on which side the range grows.
        gap: rad, from the nearer point's beam to the other.
    """

    at: NDArray[np.int64]
    position: Floats
    ring: NDArray[np.int64]
    azimuth: Floats
    elevation: Floats
    distance: Floats
    side: NDArray[np.int64]
    gap: Floats


def jump_lines(xyz: Floats, pattern: ScanPattern) -> list[UncertainLine]:
    """Straight edges across the rings and along them.

    Args:
        xyz: float64 (N,3), m; the sensor stands at the origin and spins about z.
        pattern: Its scan pattern.
    """
    upright = _along_rings(xyz, pattern)
    lines = _lines(pattern, upright, _linked_across(upright, pattern), MIN_RINGS, ACROSS_RINGS)
    if pattern.ring_spacing <= SPARSEST_RAD:
        level = _between_rings(xyz, pattern)
        lines += _lines(pattern, level, _linked_along(level, pattern), MIN_COLUMNS, ALONG_RINGS)
    return lines


def _goes_on(near: Floats, far: Floats, before: Floats, ratio: Floats) -> Floats:
    """Range (M,) that a plane through the nearer point and the one before it has at the far beam.

    Along equal steps of angle the inverse range of a plane is linear, but for terms of second order.
    """
    inverse = 1.0 / near + np.minimum(1.0 / near - 1.0 / before, 0.0) * ratio
    # A plane that runs out of sight before the far beam may be what that beam sees.
    return np.where(inverse > 1.0 / far, 1.0 / np.maximum(inverse, _FADED), far)


def _ends_there(near: Floats, before: Floats, ratio: Floats) -> NDArray[np.bool_]:
    """Whether a surface (M,) that gives no further return would have given one: a road only fades away."""
    on = _goes_on(near, np.full(len(near), np.inf), before, ratio)
    return on <= near + np.maximum(JUMP_M, JUMP_SHARE * near)


def _one_body(near: Floats, before: Floats) -> NDArray[np.bool_]:
    """Whether two neighbours (M,) lie on one surface: a leaf has no neighbour, a body has."""
    return np.asarray(np.abs(near - before) <= STEP_M + STEP_SHARE * near)


def _along_rings(xyz: Floats, pattern: ScanPattern) -> _EdgePoints:
    """Jumps between neighbours on a ring, at the azimuth between them."""
    r, azimuth = pattern.distance, pattern.azimuth
    gap = np.diff(azimuth)
    beside = (np.diff(pattern.ring) == 0) & (gap > _ECHO_RAD) & (gap < GAP_STEPS * pattern.azimuth_step)
    nearest = np.minimum(r[:-1], r[1:])
    least = np.maximum(JUMP_M, JUMP_SHARE * nearest)
    edge = np.flatnonzero(beside & (np.abs(np.diff(r)) > least))
    side = np.where(r[edge + 1] > r[edge], 1, -1)
    near, far = np.where(side > 0, edge, edge + 1), np.where(side > 0, edge + 1, edge)
    # The pair before the nearer point, if it is on the ring and near it.
    pair = np.clip(np.where(side > 0, edge - 1, edge + 1), 0, max(len(gap) - 1, 0))
    before = np.clip(near - side, 0, len(r) - 1)
    known = beside[pair] & (pair != edge)
    ratio = gap[edge] / np.maximum(gap[pair], _ECHO_RAD)
    on = _goes_on(r[near], r[far], np.where(known, r[before], r[near]), ratio)
    real = (r[far] - on > least[edge]) & known & _one_body(r[near], r[before])
    # What is seen beside a body goes on for a beam or two; between leaves it comes and goes.
    farther = np.clip(far + side, 0, len(r) - 1)
    on_ring = pattern.ring[farther] == pattern.ring[near]
    real &= ~on_ring | (r[farther] - r[near] > 0.5 * least[edge])
    near, side, width = near[real], side[real], gap[edge[real]]
    # Before the sky, and before what swallows the beam, both points beside the gap are borders.
    hole = np.flatnonzero((np.diff(pattern.ring) == 0) & (gap >= SKY_STEPS * pattern.azimuth_step))
    last = np.concatenate([hole, hole + 1])
    sense = np.repeat(np.array([1, -1]), len(hole))
    inner = np.clip(last - sense, 0, len(r) - 1)
    pair = np.clip(np.minimum(last, inner), 0, max(len(gap) - 1, 0))
    ends = beside[pair] & _one_body(r[last], r[inner])
    ends &= _ends_there(r[last], r[inner], pattern.azimuth_step / np.maximum(gap[pair], _ECHO_RAD))
    near = np.concatenate([near, last[ends]])
    side = np.concatenate([side, sense[ends]])
    width = np.concatenate([width, np.full(int(ends.sum()), pattern.azimuth_step)])
    half = 0.5 * side * width
    x, y, z = xyz[pattern.index[near]].T
    turned = np.column_stack([x * np.cos(half) - y * np.sin(half), x * np.sin(half) + y * np.cos(half), z])
    azimuth, elevation = pattern.azimuth[near] + half, pattern.elevation[near]
    return _nearest_first(
        _EdgePoints(near, turned, pattern.ring[near], azimuth, elevation, r[near], side, width)
    )


def _between_rings(xyz: Floats, pattern: ScanPattern) -> _EdgePoints:
    """Jumps between a point and the one above or below it on the next ring, at the elevation between them."""
    parts = []
    r = pattern.distance
    beyond = {upward: _next_ring(pattern, upward) for upward in (1, -1)}
    for upward in (1, -1):
        far, before = beyond[upward][0], beyond[-upward][0]
        near = np.flatnonzero((far >= 0) & (before >= 0))
        far, before = far[near], before[near]
        gap = upward * (pattern.elevation[far] - pattern.elevation[near])
        back = upward * (pattern.elevation[near] - pattern.elevation[before])
        fair = (gap > 0.2 * pattern.ring_spacing) & (gap < SPARSEST_RAD) & (back > 0.2 * pattern.ring_spacing)
        near, far, before = near[fair], far[fair], before[fair]
        gap, back = gap[fair], back[fair]
        on = _goes_on(r[near], r[far], r[before], gap / back)
        edge = r[far] - on > np.maximum(JUMP_UP_M, JUMP_UP_SHARE * r[near])
        edge &= _one_body(r[near], r[before])
        parts.append(_above(xyz, pattern, near[edge], upward, gap[edge]))
    # Roofs before the sky: the ring above is there, but not here.
    level = _ring_elevations(pattern)
    near = np.flatnonzero(beyond[1][1] & (beyond[-1][0] >= 0))
    before = beyond[-1][0][near]
    gap = level[pattern.ring[near] + 1] - pattern.elevation[near]
    back = pattern.elevation[near] - pattern.elevation[before]
    fair = (gap > 0.2 * pattern.ring_spacing) & (gap < SPARSEST_RAD) & (back > 0.2 * pattern.ring_spacing)
    fair &= _one_body(r[near], r[before])
    fair[fair] = _ends_there(r[near[fair]], r[before[fair]], gap[fair] / back[fair])
    parts.append(_above(xyz, pattern, near[fair], 1, gap[fair]))
    joined = _EdgePoints(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in _EdgePoints.__slots__)
    )
    return _nearest_first(joined)


def _above(
    xyz: Floats, pattern: ScanPattern, near: NDArray[np.int64], upward: int, gap: Floats
) -> _EdgePoints:
    """Edge points half a gap (M,) above or below the points ``near`` of the pattern."""
    elevation = pattern.elevation[near] + 0.5 * upward * gap
    x, y = xyz[pattern.index[near], :2].T
    around = np.arctan2(y, x)
    distance = pattern.distance[near]
    position = distance[:, None] * np.column_stack(
        [np.cos(elevation) * np.cos(around), np.cos(elevation) * np.sin(around), np.sin(elevation)]
    )
    side = np.full(len(near), upward)
    return _EdgePoints(
        near, position, pattern.ring[near], pattern.azimuth[near], elevation, distance, side, gap
    )


def _ring_elevations(pattern: ScanPattern) -> Floats:
    """Mean elevation of each ring (R,), NaN for ranks without points."""
    count = np.bincount(pattern.ring)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.bincount(pattern.ring, weights=pattern.elevation) / count)


def _nearest_first(edges: _EdgePoints) -> _EdgePoints:
    """At most ``MOST_EDGES`` of the points, the nearest."""
    if len(edges.at) <= MOST_EDGES:
        return edges
    return _taken(edges, np.sort(np.argsort(edges.distance, kind="stable")[:MOST_EDGES]))


def _taken(edges: _EdgePoints, index: NDArray[np.int64]) -> _EdgePoints:
    return _EdgePoints(*(getattr(edges, name)[index] for name in _EdgePoints.__slots__))


_KEY_TURN = 4.0 * math.pi
"""More than a turn, so that rings do not touch in a common key."""


def _next_ring(pattern: ScanPattern, upward: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """For each point the one beside it on the next ring up or down, -1 for none.

    Also whether there is such a ring and nothing on it within ``SKY_STEPS``.
    """
    key = pattern.ring * _KEY_TURN + pattern.azimuth
    wanted = key + upward * _KEY_TURN
    right = np.clip(np.searchsorted(key, wanted), 1, max(len(key) - 1, 1)) % len(key)
    partner = np.where(wanted - key[right - 1] < key[right] - wanted, right - 1, right)
    off = np.abs(key[partner] - wanted)
    ring = pattern.ring + upward
    empty = (off >= SKY_STEPS * pattern.azimuth_step) & (ring >= 0) & (ring <= int(pattern.ring.max()))
    return np.where(off < 0.6 * pattern.azimuth_step, partner, -1), empty


def _linked_across(edges: _EdgePoints, pattern: ScanPattern) -> NDArray[np.int64]:
    """Pairs (2,P) of points of one edge on neighbouring rings, or with one ring between them."""
    pairs = []
    for side in (1, -1):
        own = np.flatnonzero(edges.side == side)
        own = own[np.lexsort((edges.azimuth[own], edges.ring[own]))]
        for skip in (1, 2):
            partner = _partners(edges, own, skip, 0.0)
            off = np.abs(edges.azimuth[partner] - edges.azimuth[own])
            # Some lasers sit further apart than the median.
            rise = np.maximum(
                skip * pattern.ring_spacing, np.abs(edges.elevation[partner] - edges.elevation[own])
            )
            near = off <= LEAN * rise + 1.5 * pattern.azimuth_step
            pairs.append(_level(edges, own[near], partner[near], skip))
    return np.concatenate(pairs, axis=1)


def _linked_along(edges: _EdgePoints, pattern: ScanPattern) -> NDArray[np.int64]:
    """Pairs (2,P) of points of one edge in neighbouring columns, on one ring or on neighbouring ones."""
    pairs = []
    step = pattern.azimuth_step
    for side in (1, -1):
        own = np.flatnonzero(edges.side == side)
        own = own[np.lexsort((edges.azimuth[own], edges.ring[own]))]
        for climb in (-1, 0, 1):
            partner = _partners(edges, own, climb, step)
            ahead = edges.azimuth[partner] - edges.azimuth[own]
            near = (ahead > 0.3 * step) & (ahead < GAP_STEPS * step)
            pairs.append(_level(edges, own[near], partner[near], climb))
    return np.concatenate(pairs, axis=1)


def _partners(edges: _EdgePoints, own: NDArray[np.int64], climb: int, ahead: float) -> NDArray[np.int64]:
    """For each of ``own`` (sorted by ring and azimuth) that one ``climb`` rings up nearest to its azimuth."""
    if len(own) == 0:
        return own
    key = edges.ring[own] * _KEY_TURN + edges.azimuth[own]
    wanted = key + climb * _KEY_TURN + ahead
    right = np.clip(np.searchsorted(key, wanted), 1, max(len(key) - 1, 1)) % len(key)
    return own[np.where(wanted - key[right - 1] < key[right] - wanted, right - 1, right)]


def _level(edges: _EdgePoints, a: NDArray[np.int64], b: NDArray[np.int64], climb: int) -> NDArray[np.int64]:
    """Those pairs (2,P) that differ in range by no more than one edge does, and lie where they should."""
    step = np.abs(edges.distance[a] - edges.distance[b])
    fits = (step <= STEP_M + STEP_SHARE * edges.distance[a]) & (edges.ring[b] - edges.ring[a] == climb)
    return np.stack([a[fits], b[fits]])


def _lines(
    pattern: ScanPattern, edges: _EdgePoints, pairs: NDArray[np.int64], least: int, quantum: Floats
) -> list[UncertainLine]:
    """Straight lines of the connected groups of edge points."""
    count = len(edges.at)
    graph = coo_array((np.ones(pairs.shape[1], dtype=np.int8), (pairs[0], pairs[1])), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    members = np.flatnonzero(np.bincount(label, minlength=1)[label] >= least)
    order: NDArray[np.int64] = members[np.argsort(label[members], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    lines = []
    for group in groups:
        parts = _straight_parts(edges, group, least, pattern.azimuth_step)
        lines += [line for part in parts if (line := _line(edges, part, pattern, quantum)) is not None]
    return lines


def _straight_parts(
    edges: _EdgePoints, group: NDArray[np.int64], least: int, step: float
) -> list[NDArray[np.int64]]:
    """A chain of edge points split where it bends more than its gaps allow."""
    waiting, parts = [group], []
    while waiting:
        chain = waiting.pop()
        if len(chain) < least:
            continue
        mean, direction, along = _axis(edges.position[chain])
        sideways, depth = ((edges.position[chain] - mean) @ across(direction, mean).T).T
        allowed = edges.distance[chain] * (0.75 * np.maximum(edges.gap[chain], step) + BEAM_RAD)
        excess = np.maximum(np.abs(sideways) / allowed, np.abs(depth) / (_MAX_DEPTH_M))
        if excess.max() <= 1.0:
            parts.append(chain)
            continue
        order = np.argsort(along)
        # Cut where the chain is farthest from the line from its first point to its last.
        first, last = edges.position[chain[order[0]]], edges.position[chain[order[-1]]]
        chord = (last - first) / max(float(np.linalg.norm(last - first)), 1e-9)
        off = edges.position[chain[order]] - first
        off = off - (off @ chord)[:, None] * chord
        off = (off * off).sum(axis=1)
        cut = int(np.clip(off.argmax(), 1, len(chain) - 1))
        waiting += [chain[order[:cut]], chain[order[cut:]]]
    return parts


def _axis(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean (3,), direction (3,) and positions (M,) along the line of least squares through points (M,3)."""
    mean = points.sum(axis=0) / len(points)
    centred = points - mean
    direction = np.asarray(np.linalg.eigh(centred.T @ centred)[1][:, 2])
    return mean, direction, np.asarray(centred @ direction)


def _filled(edges: _EdgePoints, part: NDArray[np.int64], pattern: ScanPattern) -> bool:
    """Whether an edge shows on nearly every ring between its ends, or else in every column."""
    rings = np.unique(edges.ring[part])
    columns = np.unique(np.rint(edges.azimuth[part] / pattern.azimuth_step))
    return bool(
        len(rings) >= max(MIN_RINGS, _FILLED * (rings[-1] - rings[0] + 1))
        or len(columns) >= max(MIN_COLUMNS, _FILLED * (columns[-1] - columns[0] + 1))
    )


def _line(
    edges: _EdgePoints, part: NDArray[np.int64], pattern: ScanPattern, quantum: Floats
) -> UncertainLine | None:
    """The line through a straight part, or None where it is too short or ragged."""
    points = edges.position[part]
    mean, direction, along = _axis(points)
    low, high = float(along.min()), float(along.max())
    distance = float(edges.distance[part].mean())
    if high - low < max(MIN_LENGTH_M, MIN_LENGTH_RAD * distance):
        return None
    sideways, depth = ((points - mean) @ across(direction, mean).T).T
    freedom = max(len(part) - 2, 1)
    rms = np.sqrt(np.array([sideways @ sideways, depth @ depth]) / freedom)
    gap = distance * math.hypot(float(np.sqrt((edges.gap[part] ** 2).mean())), BEAM_RAD)
    if rms[1] > _DEPTH_RMS_M or rms[0] > _SIDE_RMS_GAPS * gap or not _filled(edges, part, pattern):
        return None
    ends = (low, high)
    common = gap**2 * quantum
    covariance = np.zeros((4, 4))
    covariance[::2, ::2] = ends_covariance(along, ends, float(rms[0])) + common
    covariance[1::2, 1::2] = ends_covariance(along, ends, float(rms[1])) + COMMON_DEPTH_M**2
    return UncertainLine(
        "jump",
        mean + low * direction,
        mean + high * direction,
        np.sort(pattern.index[edges.at[part]]),
        covariance,
    )
