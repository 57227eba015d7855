"""Poles of one sweep: free-standing, thin, upright (CRLF (5), (6); FORMULAS B).

Works on unorganised clouds in any LiDAR frame: heights and the plan view come from the fitted ground.
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.cloud_lines import FittedAxis, cloud_line, total_least_squares, unrepeated
from pipeline.ground import Ground, plane_basis
from pipeline.records import CloudLine, Floats, PointCloud

Indices: TypeAlias = NDArray[np.int64]

CELL_M = 0.5
"""m; cell of the plan (CRLF III-B)."""
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
MOST_CANDIDATES = 300
"""Candidates looked at, those of most returns: a street has some dozens, a forest thousands."""
_LEVEL_M = 0.15
_POLE_REFITS = 3
"""Rounds of fit and trim; the third changes no point in practice."""
_MAX_POLE_CELLS = 2
"""Cells across: a pole on a corner of the grid fills 2 x 2."""
_TOP_SLACK_M = 0.3
"""m; FORMULAS B: the highest beam may pass just above a return."""
_SLIM_SHARE, _SLIM_FACTOR, _SLIM_M = 0.25, 2.0, 0.06
"""Levels as wide as this many times a slim one, the quarter that is slimmest, are the pole; and levels of so
many m, rms, always: range noise and the beam's width."""
MAX_RADIUS_M = 0.3
"""m; thicker than any street pole: a limit to the shift from the front surface to the axis."""
MIN_SLOPE_REACH_M = 2.0
"""m, horizontal; nearer returns come from the vehicle itself and say nothing of the highest beam."""


def find_poles(
    cloud: PointCloud, ground: Ground, seen: NDArray[np.bool_], *, origin: Floats | None = None
) -> list[CloudLine]:
    """Free-standing, thin, upright objects (CRLF (5), (6), heights above the fitted ground: FORMULAS B).

    The sensor sees only the front of a pole. For returns spread evenly over a round front their mean lies
    pi/4 of the radius before the axis; the radius follows from the returns' spread across the line of sight
    (evenly spread: rms = radius / sqrt 3), and the line is moved back by that. What remains is some 10 % of
    the diameter, and half of it for poles thinner than the azimuth step, whose spread is that of the noise.

    Args:
        cloud: The sweep.
        ground: Its ground plane.
        seen: bool (N,), points that may take part (those in view of the camera).
        origin: float64 (3,), where the sensor stands in the cloud's frame (``sensor_seat``); None: at
            its origin.

    Returns:
        Lines from foot to top, in no particular order.
    """
    sensor = np.zeros(3) if origin is None else origin
    basis = plane_basis(ground.normal)
    index = unrepeated(cloud.xyz, np.flatnonzero(seen))
    height = ground.local_heights(cloud.xyz[index])
    tall = (height > BOTTOM_M) & (height < CEILING_M)
    index, height = index[tall], height[tall]
    xyz = cloud.xyz[index].astype(np.float64)
    plan = (xyz - sensor) @ basis.T
    near = np.hypot(plan[:, 0], plan[:, 1]) < POLE_RANGE_M
    index, xyz, plan, height = index[near], xyz[near], plan[near], height[near]
    if len(index) < MIN_POLE_POINTS:
        return []
    returns = _Returns(index, xyz, plan, height, ground.heights(xyz) - height, sensor)
    top_slope = _top_slope(cloud, ground.normal, basis, sensor)
    candidates = _pole_candidates(returns, float(ground.heights(sensor)), top_slope)
    poles = []
    for members in sorted(candidates, key=len, reverse=True)[:MOST_CANDIDATES]:
        line = _pole(returns, ground, members)
        if line is not None:
            poles.append(line)
    return poles


@dataclass(frozen=True, slots=True, eq=False)
class _Returns:
    """Points above ground: index in the cloud, (M,3), (M,2) in the plan, height above the ground below (M,).

    ``rise`` (M,) is that ground above the main plane; the sensor stands at ``sensor`` (3,) of the
    cloud's frame and above the origin of the plan.
    """

    index: Indices
    xyz: Floats
    plan: Floats
    up: Floats
    rise: Floats
    sensor: Floats


def _top_slope(cloud: PointCloud, normal: Floats, basis: Floats, sensor: Floats) -> float:
    """Tangent of the highest beam against the ground plane, from the cloud itself."""
    thinned = cloud.xyz[:: max(1, len(cloud) // 20_000)] - sensor
    reach = np.hypot(*(thinned @ basis.T).T)
    far = reach > MIN_SLOPE_REACH_M
    if not far.any():
        return 0.0
    slope = (thinned[far] @ normal) / reach[far]
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
    rise = np.zeros(shape[0] * shape[1])
    rise[cell] = returns.rise
    reach = np.hypot(*(low[:, None] + CELL_M * (np.indices(shape)[::-1].reshape(2, -1) + 0.5)))
    top = np.minimum(TOP_M, sensor_height - rise + reach * top_slope - _TOP_SLACK_M)
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
    beside = (np.abs(returns.plan[:, axis] - centre[axis]) < RING_M[1] for axis in (0, 1))
    near = np.flatnonzero(np.logical_and(*beside))
    inside = np.hypot(*(returns.plan[near] - centre).T) < AXIS_M
    # A plate or a lamp is wider than its pole and stands beside it: it would bend the axis.
    slim = inside.copy()
    slim[inside] = _slim_levels(returns.plan[near[inside]], returns.up[near[inside]])
    for shaft in (slim, inside):
        axis = _axis(returns, ground, near, shaft)
        if axis is not None:
            return axis
    return None


def _axis(returns: _Returns, ground: Ground, near: Indices, shaft: NDArray[np.bool_]) -> CloudLine | None:
    """The axis of those of the returns nearby (M,) that may be a shaft, or None where they are no pole."""
    xyz, up = returns.xyz[near], returns.up[near]
    pole = shaft
    axis, beyond = None, np.zeros(len(near))
    for _ in range(_POLE_REFITS):
        if pole.sum() < MIN_POLE_POINTS:
            return None
        axis = total_least_squares(xyz[pole])
        beyond = np.linalg.norm(_across(xyz, axis), axis=1)
        before, pole = pole, shaft & (beyond < min(AXIS_M, max(3.0 * axis.sigma, _LEVEL_M / 2)))
        if np.array_equal(before, pole):
            break
    if axis is None or pole.sum() < MIN_POLE_POINTS:
        return None
    axis = total_least_squares(xyz[pole])
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
    moved = _behind_the_front(axis, _across(xyz[pole], axis), ground, returns.sensor)
    return cloud_line("pole", moved, returns.index[near[pole]])


def _slim_levels(plan: Floats, up: Floats) -> NDArray[np.bool_]:
    """Whether points (M,2) of the plan at heights (M,) are of levels as slim as the slimmest of the thing."""
    if len(up) == 0:
        return np.zeros(0, dtype=bool)
    _, level = np.unique(np.floor(up / _LEVEL_M), return_inverse=True)
    count = np.bincount(level)
    mean = np.column_stack([np.bincount(level, weights=x) / count for x in plan.T])
    spread = np.sqrt(np.bincount(level, weights=((plan - mean[level]) ** 2).sum(axis=1)) / count)
    usual = float(np.quantile(spread, _SLIM_SHARE))
    return np.asarray((spread <= max(_SLIM_FACTOR * usual, _SLIM_M))[level])


def _across(xyz: Floats, axis: FittedAxis) -> Floats:
    """Offsets (M,3) of points (M,3) from an axis."""
    centred = xyz - axis.mean
    return np.asarray(centred - (centred @ axis.direction)[:, None] * axis.direction)


def _behind_the_front(axis: FittedAxis, across: Floats, ground: Ground, sensor: Floats) -> FittedAxis:
    """The axis moved along the line of sight from the mean of the visible front to the pole's middle."""
    sign = 1.0 if axis.direction @ ground.normal > 0 else -1.0
    upwards = sign * axis.direction
    sight = axis.mean - sensor
    sight -= (sight @ upwards) * upwards
    sight /= max(float(np.linalg.norm(sight)), 1e-9)
    sideways = across @ np.cross(upwards, sight)
    depth = across @ sight
    # Range noise scatters the depth and not the width, so it does not enter the radius.
    radius = min(MAX_RADIUS_M, math.sqrt(3.0) * float(sideways.std()))
    sigma = math.sqrt(0.5 * float(sideways.var() + depth.var()))
    return FittedAxis(axis.mean + math.pi / 4 * radius * sight, upwards, sign * axis.along, sigma)
