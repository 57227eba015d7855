"""Lane lines and poles of one sweep, as segments with their noise (CRLF (3), (5), (6); FORMULAS B).

Works on unorganised clouds in any LiDAR frame: heights and the plan view come from the fitted ground, never
from an axis or a ring of the sensor.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import pdtrc

from pipeline.ground import Ground, plane_basis
from pipeline.records import CloudLine, Floats, LineLabel, PointCloud

Indices = NDArray[np.int64]

# Lane paint.
LANE_RANGE_M = (2.0, 50.0)
"""m, horizontal; nearer is the vehicle itself, further a lane line has less than one ring per dash."""
CELL_M = 0.5
"""m; cell of the plan in which brightness is compared, and of the pole grid (CRLF III-B)."""
BOX_CELLS = 7
"""Cells; the 3.5 m around a point are its background: one lane, of which paint fills 4 %."""
BRIGHT_SIGMAS = 2.0
"""CRLF takes mean + sigma of all ground; above the local background paint that fills 4 % stands 5."""
MIN_BACKGROUND = 10
"""Points in the box below which its mean and sigma mean nothing."""
MAX_BRIGHT = 1000
"""Bright points kept for the search of lines; more only cost time."""
HYPOTHESES = 400
"""Point pairs tried per line: a line that holds 10 % of the bright points is missed with 2 %."""
PAIR_M = (3.0, 30.0)
"""m; a shorter pair has no direction, a longer one bends with the road."""
STROKE_M = 0.12
"""m; half width of a stroke with the range noise: paint is 0.10 to 0.20 m wide."""
FLANK_M = (0.25, 0.60)
"""m; beside a stroke nothing is bright; a patch of bright ground has no such flanks."""
CHANCE = 1e-6
"""Probability that the flanks' density fills the stroke so much: some 1e5 pairs of points are tried."""
CLAIM_M = 0.30
"""m; D0 of CRLF (3): bright points so near to a found line belong to it, and to no second one."""
MAX_GAP_M = 13.0
"""m; dashes of one line stand at most 12 m apart (9 to 12 m on motorways)."""
MIN_LANE_M = 5.0
"""m; a shorter stroke is an arrow, a letter or a cover."""
MIN_LANE_POINTS = 12
MIN_LANE_METRES = 4
"""Metres along the line with a bright point in them: a few echoes of one cover are no line."""
MIN_RADIAL = 0.5
"""Change of range over length, at least: lines along a scan ring may be one laser that reads bright."""
MAX_LANES = 12
"""Lines per sweep; a road of six lanes has seven."""
MAX_FAILURES = 6
"""Strokes that turned out to be none before the search ends: the strongest come first."""

# Poles.
POLE_RANGE_M = 60.0
"""m; further a thin pole gets less than one return per ring."""
BOTTOM_M = 0.73
"""m above ground; H0' of FORMULAS B: kerbs, bases and cars' bonnets stay below."""
TOP_M = 3.0
"""m above ground; H1' of FORMULAS B where the sensor can see so high."""
CEILING_M = 4.0
"""m above ground; above begin arms, lamps and crowns."""
MIN_EXTENT_M = 1.0
"""m; seen height of a pole, at least (FORMULAS B)."""
MAX_SPREAD_M = 0.15
"""m rms across; a trunk half a metre thick has 0.144."""
MAX_TILT = math.radians(5.0)
"""rad; poles stand (FORMULAS B)."""
AXIS_M = 0.35
"""m; returns further from the axis are plates, arms or neighbours."""
RING_M = (0.5, 1.0)
"""m; a pole has this ring around it to itself: walls, hedges and vehicles do not (FORMULAS B)."""
RING_SHARE = 0.1
"""Returns in the ring over returns of the pole, at most."""
MIN_POLE_POINTS = 8
MIN_LEVELS = 4
"""Height bins of 0.15 m with returns, at least: a line needs more than two rings."""
_LEVEL_M = 0.15
_POLE_REFITS = 3
"""Rounds of fit and trim; the third changes no point in practice."""
_MAX_POLE_CELLS = 2
"""Cells across: a pole on a corner of the grid fills 2 x 2."""
_TOP_SLACK_M = 0.3
"""m; FORMULAS B: the highest beam may pass just above a return."""
MAX_RADIUS_M = 0.3
"""m; thicker than any street pole: a limit to the shift from the front surface to the axis."""


@dataclass(frozen=True, slots=True, eq=False)
class _Axis:
    """A fitted 3-D line: mean, unit direction, signed positions of its points, rms across per axis."""

    mean: Floats
    direction: Floats
    along: Floats
    sigma: float


def _total_least_squares(points: Floats) -> _Axis:
    mean = points.mean(axis=0)
    centred = points - mean
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    along = centred @ direction
    across = centred - along[:, None] * direction
    # Two axes across, four parameters taken from 2 m coordinates.
    sigma = math.sqrt(float((across**2).sum()) / max(2 * len(points) - 4, 1))
    return _Axis(mean, direction, along, sigma)


def _line(label: LineLabel, axis: _Axis, points: Indices) -> CloudLine:
    low, high = float(axis.along.min()), float(axis.along.max())
    return CloudLine(
        label,
        axis.mean + low * axis.direction,
        axis.mean + high * axis.direction,
        points.astype(np.int64),
        axis.sigma,
        float((axis.along**2).sum()),
        -low,
    )


def find_lanes(
    cloud: PointCloud, ground: Ground, seen: NDArray[np.bool_], rng: np.random.Generator
) -> list[CloudLine]:
    """Painted lines on the ground: bright against their surroundings, straight, narrow (CRLF (3)).

    Args:
        cloud: The sweep; without intensity there is no paint to see and the list is empty.
        ground: Its ground plane.
        seen: bool (N,), points that may take part (those in view of the camera).
        rng: Draws the pairs.

    Returns:
        Lines in no particular order; dashes of one line are one line.
    """
    if cloud.intensity is None:
        return []
    index = np.flatnonzero(ground.inliers & seen)
    plan = np.asarray(cloud.xyz[index], dtype=np.float64) @ plane_basis(ground.normal).T
    reach = np.hypot(plan[:, 0], plan[:, 1])
    near = (reach > LANE_RANGE_M[0]) & (reach < LANE_RANGE_M[1])
    index, plan = index[near], plan[near]
    bright = _bright(plan, np.asarray(cloud.intensity[index], dtype=np.float64))
    index, plan = index[bright], plan[bright]
    if len(index) > MAX_BRIGHT:
        kept = rng.choice(len(index), MAX_BRIGHT, replace=False)
        index, plan = index[kept], plan[kept]
    lines: list[CloudLine] = []
    free = np.ones(len(index), dtype=bool)
    failures = 0
    while len(lines) < MAX_LANES and failures < MAX_FAILURES and free.sum() >= MIN_LANE_POINTS:
        members = _best_stroke(plan, free, rng)
        if members is None:
            break
        claimed, line = _stroke_line(cloud, index, plan, members)
        if line is None:
            failures += 1
        else:
            lines.append(line)
        free &= ~(claimed | members)
    return lines


def _bright(plan: Floats, intensity: Floats) -> NDArray[np.bool_]:
    """Points (N,) brighter than the ground around them, in a plan (N,2) of cells with box filters."""
    if len(plan) == 0:
        return np.zeros(0, dtype=bool)
    low = plan.min(axis=0)
    column, row = np.floor((plan - low) / CELL_M).astype(np.int64).T
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    cell = row * shape[1] + column

    def box(weights: Floats | None) -> Floats:
        sums = np.bincount(cell, weights=weights, minlength=shape[0] * shape[1]).reshape(shape)
        filtered = cv2.boxFilter(
            sums.astype(np.float64),
            -1,
            (BOX_CELLS, BOX_CELLS),
            normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        )
        return np.asarray(filtered.ravel()[cell], dtype=np.float64)

    count = box(None)
    # Sums about the overall mean: squares of small differences keep their digits.
    centred = intensity - intensity.mean()
    mean = box(centred) / count
    sigma = np.sqrt(np.maximum(box(centred**2) / count - mean**2, 0.0))
    bright = (count >= MIN_BACKGROUND) & (centred > mean + BRIGHT_SIGMAS * sigma) & (sigma > 0)
    return np.asarray(bright)


def _best_stroke(plan: Floats, free: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.bool_] | None:
    """Members (N,) of the line through two free points of the plan (N,2) that covers most metres."""
    where = np.flatnonzero(free)
    first, second = where[rng.integers(0, len(where), (2, HYPOTHESES))]
    span = plan[second] - plan[first]
    length = np.hypot(span[:, 0], span[:, 1])
    fit = (length > PAIR_M[0]) & (length < PAIR_M[1])
    if not fit.any():
        return None
    origin, direction = plan[first[fit]], span[fit] / length[fit, None]
    normal = np.column_stack([-direction[:, 1], direction[:, 0]])
    points = plan[where]
    # Far points are sparse in proportion to range and as good as near ones.
    weight = np.hypot(points[:, 0], points[:, 1])
    inside = np.abs(points @ normal.T - (origin * normal).sum(axis=1)) < STROKE_M
    best, most = None, 0
    for candidate in np.argsort(weight @ inside)[::-1][:20]:
        along = points[inside[:, candidate]] @ direction[candidate]
        metres = len(np.unique(np.floor(along)))
        if metres > most:
            best, most = int(candidate), metres
    if best is None or most < MIN_LANE_METRES:
        return None
    members = np.zeros(len(plan), dtype=bool)
    members[where[inside[:, best]]] = True
    return members


def _stroke_line(
    cloud: PointCloud, index: Indices, plan: Floats, members: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], CloudLine | None]:
    """Refits a stroke and judges it; the points (N,) that it uses up, and the line if it is one."""
    for _ in range(3):
        mean = plan[members].mean(axis=0)
        direction = np.linalg.svd(plan[members] - mean, full_matrices=False)[2][0]
        along = (plan - mean) @ direction
        across = np.abs((plan - mean) @ np.array([-direction[1], direction[0]]))
        inside = _longest_run(along, across < STROKE_M)
        if inside.sum() < MIN_LANE_POINTS:
            return members, None
        members = inside
    span = (along >= along[members].min()) & (along <= along[members].max())
    claimed = span & (across < CLAIM_M)
    flank = span & (across > FLANK_M[0]) & (across < FLANK_M[1])
    # One more than counted: an empty flank does not prove an empty street.
    expected = (flank.sum() + 1) * STROKE_M / (FLANK_M[1] - FLANK_M[0])
    reach = np.hypot(plan[members, 0], plan[members, 1])
    length = float(np.ptp(along[members]))
    is_line = (
        length >= MIN_LANE_M
        and len(np.unique(np.floor(along[members]))) >= MIN_LANE_METRES
        and pdtrc(members.sum() - 1, expected) < CHANCE
        and float(np.ptp(reach)) >= MIN_RADIAL * length
    )
    if not is_line:
        return claimed, None
    points = index[members]
    return claimed, _line("lane", _total_least_squares(cloud.xyz[points].astype(np.float64)), points)


def _longest_run(along: Floats, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of the points inside, those of the longest stretch without a gap wider than two dashes may leave."""
    where = np.flatnonzero(inside)
    if len(where) == 0:
        return inside
    order = where[np.argsort(along[where])]
    runs = np.split(order, np.flatnonzero(np.diff(along[order]) > MAX_GAP_M) + 1)
    longest = max(runs, key=lambda run: float(along[run[-1]] - along[run[0]]))
    kept = np.zeros_like(inside)
    kept[longest] = True
    return kept


def find_poles(cloud: PointCloud, ground: Ground, seen: NDArray[np.bool_]) -> list[CloudLine]:
    """Free-standing, thin, upright objects (CRLF (5), (6), heights above the fitted ground: FORMULAS B).

    The sensor sees only the front of a pole. For returns spread evenly over a round front their mean lies
    pi/4 of the radius before the axis; the radius follows from the returns' spread across the line of sight
    (evenly spread: rms = radius / sqrt 3), and the line is moved back by that. What remains is some 10 % of
    the diameter, and half of it for poles thinner than the azimuth step, whose spread is that of the noise.

    Args:
        cloud: The sweep.
        ground: Its ground plane.
        seen: bool (N,), points that may take part (those in view of the camera).

    Returns:
        Lines from foot to top, in no particular order.
    """
    basis = plane_basis(ground.normal).astype(np.float32)
    height = cloud.xyz @ ground.normal.astype(np.float32) + np.float32(ground.offset)
    index = np.flatnonzero(seen & (height > BOTTOM_M) & (height < CEILING_M))
    plan = (cloud.xyz[index] @ basis.T).astype(np.float64)
    near = np.hypot(plan[:, 0], plan[:, 1]) < POLE_RANGE_M
    index, plan = index[near], plan[near]
    if len(index) < MIN_POLE_POINTS:
        return []
    returns = _Returns(
        index, cloud.xyz[index].astype(np.float64), plan, np.asarray(height[index], dtype=np.float64)
    )
    poles = []
    for members in _pole_candidates(returns, ground.offset, _top_slope(cloud, ground, basis)):
        line = _pole(returns, ground, members)
        if line is not None:
            poles.append(line)
    return poles


@dataclass(frozen=True, slots=True, eq=False)
class _Returns:
    """Points above ground: index in the cloud, (M,3), (M,2) in the plan, height above ground (M,)."""

    index: Indices
    xyz: Floats
    plan: Floats
    up: Floats


def _top_slope(cloud: PointCloud, ground: Ground, basis: np.ndarray) -> float:
    """Tangent of the highest beam against the ground plane, from the cloud itself."""
    thinned = cloud.xyz[:: max(1, len(cloud) // 20_000)]
    reach = np.hypot(*(thinned @ basis.T).T)
    far = reach > LANE_RANGE_M[0]
    if not far.any():
        return 0.0
    slope = (thinned[far] @ ground.normal.astype(np.float32)) / reach[far]
    return float(np.quantile(slope, 0.999))


def _pole_candidates(returns: _Returns, sensor_height: float, top_slope: float) -> list[Indices]:
    """Members of each group of tall cells that is small enough for a pole."""
    plan, up = returns.plan, returns.up
    low = plan.min(axis=0)
    column, row = np.floor((plan - low) / CELL_M).astype(np.int64).T
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    cell = row * shape[1] + column
    highest = np.full(shape[0] * shape[1], -np.inf)
    lowest = np.full(shape[0] * shape[1], np.inf)
    np.maximum.at(highest, cell, up)
    np.minimum.at(lowest, cell, up)
    reach = np.hypot(*(low[:, None] + CELL_M * (np.indices(shape)[::-1].reshape(2, -1) + 0.5)))
    top = np.minimum(TOP_M, sensor_height + reach * top_slope - _TOP_SLACK_M)
    tall = (highest - lowest >= MIN_EXTENT_M) & (highest > top)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        tall.reshape(shape).astype(np.uint8), connectivity=8
    )
    small = np.flatnonzero(
        (stats[:, cv2.CC_STAT_WIDTH] <= _MAX_POLE_CELLS) & (stats[:, cv2.CC_STAT_HEIGHT] <= _MAX_POLE_CELLS)
    )
    wanted = np.zeros(count, dtype=bool)
    wanted[small] = True
    wanted[0] = False
    label = labels.ravel()[cell]
    inside = np.flatnonzero(wanted[label])
    order = inside[np.argsort(label[inside], kind="stable")]
    groups = np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
    return [group for group in groups if len(group) >= MIN_POLE_POINTS]


def _pole(returns: _Returns, ground: Ground, members: Indices) -> CloudLine | None:
    """The axis of one candidate, or None where it is no pole."""
    centre = np.median(returns.plan[members], axis=0)
    # The cells hold neighbours and may cut the pole; the square around the median holds its ring as well.
    near = np.flatnonzero(np.abs(returns.plan - centre).max(axis=1) < RING_M[1])
    xyz, up = returns.xyz[near], returns.up[near]
    pole = np.hypot(*(returns.plan[near] - centre).T) < AXIS_M
    axis, beyond = None, np.zeros(len(near))
    for _ in range(_POLE_REFITS):
        if pole.sum() < MIN_POLE_POINTS:
            return None
        axis = _total_least_squares(xyz[pole])
        beyond = np.linalg.norm(_across(xyz, axis), axis=1)
        pole = beyond < min(AXIS_M, max(3.0 * axis.sigma, _LEVEL_M / 2))
    if axis is None or pole.sum() < MIN_POLE_POINTS:
        return None
    axis = _total_least_squares(xyz[pole])
    low, high = float(up[pole].min()), float(up[pole].max())
    beside = (beyond > RING_M[0]) & (beyond < RING_M[1]) & (up > low) & (up < high)
    stands = (
        abs(float(axis.direction @ ground.normal)) >= math.cos(MAX_TILT)
        and high - low >= MIN_EXTENT_M
        and len(np.unique(np.floor(up[pole] / _LEVEL_M))) >= MIN_LEVELS
        and axis.sigma <= MAX_SPREAD_M
        and beside.sum() <= RING_SHARE * pole.sum()
    )
    if not stands:
        return None
    moved = _behind_the_front(axis, _across(xyz[pole], axis), ground)
    return _line("pole", moved, returns.index[near[pole]])


def _across(xyz: Floats, axis: _Axis) -> Floats:
    """Offsets (M,3) of points (M,3) from an axis."""
    centred = xyz - axis.mean
    return np.asarray(centred - (centred @ axis.direction)[:, None] * axis.direction)


def _behind_the_front(axis: _Axis, across: Floats, ground: Ground) -> _Axis:
    """The axis moved along the line of sight from the mean of the visible front to the pole's middle."""
    sign = 1.0 if axis.direction @ ground.normal > 0 else -1.0
    upwards = sign * axis.direction
    sight = axis.mean - (axis.mean @ upwards) * upwards
    sight /= max(float(np.linalg.norm(sight)), 1e-9)
    sideways = across @ np.cross(upwards, sight)
    depth = across @ sight
    # Range noise scatters the depth and not the width, so it does not enter the radius.
    radius = min(MAX_RADIUS_M, math.sqrt(3.0) * float(sideways.std()))
    sigma = math.sqrt(0.5 * float(sideways.var() + depth.var()))
    return _Axis(axis.mean + math.pi / 4 * radius * sight, upwards, sign * axis.along, sigma)
