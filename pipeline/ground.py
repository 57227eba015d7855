"""The ground of a sweep in an arbitrary LiDAR frame, by RANSAC and least squares (FORMULAS B, ground).

The plane is sought among the lowest points of square cells, so that near rings, which hold most points, count
no more than the road further away, and roofs and tree crowns do not count at all. Where one plane is not
enough, on crests, ramps, cambers and pavements, further planes join it (CRLF III-B), each for its own cells.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from pipeline.records import Floats, PointCloud, read_only

BAND_M = 0.20
"""m; thickness of the ground in all (CRLF III-B): an inlier lies at most half of it from the plane."""

MAX_TILT = math.radians(15.0)
"""rad; a plane tilted further from the hint is a bank or a wall (FORMULAS B): roads stay below 12 deg."""

RANGE_M = 40.0
"""m; horizontal range within which the plane is fitted: roads are planes to 10 cm only over such lengths."""

CELL_M = 2.0
"""m; side of a cell: wider than a person or a pole, so that its lowest point is ground where any is seen."""

SUBSAMPLE = 30_000
"""Points looked at: two to three per cell where it matters, at a quarter of the cost of a full sweep."""

HYPOTHESES = 400
"""Planes tried: with 25 % ground cells a good triple is missed with probability (1 - 0.25^3)^400 = 0.2 %."""

MIN_CELLS = 20
"""Cells of support below which no plane is claimed: 80 m^2 of road."""

MIN_SHARE = 0.2
"""Share of the cells that must support the plane: below it any cloud of clutter has one by chance."""

MOST_PLANES = 5
"""Planes in all: the road, what it goes over into ahead and behind, and a pavement on both sides."""

STEP_M = 0.15
"""m; a usual kerb. Two planes of one ground meet between cells side by side or differ by less there."""

BARE_SHARE = 0.5
"""Share of a cell's points within the band above its lowest one, at least, where it may be bare ground:
hedges, walls and vehicles go on upwards."""

NEIGHBOUR_M = 6.0
"""m between cells side by side: beyond 30 m rings of a 64-beam sensor lie 4 m apart and more."""

MIN_FURTHER_CELLS = 12
"""Cells of a further plane, at least: 48 m^2."""

DENSE_SHARE = 0.5
"""Share of the cells beside one of a further plane that are on it too: of clutter a tenth is by chance."""

_FURTHER_TRIES = 6
"""Further planes with most cells that are asked whether they go on from the ground."""

_PLANES_AT_A_TIME = 64
"""Planes whose bands are counted together: their heights stay in the cache, six times quicker than all."""

_REFITS = 3
"""Least-squares rounds; the second moves the plane by millimetres, the third by less than one."""


@dataclass(frozen=True, slots=True, eq=False)
class Relief:
    """The planes of a ground that one plane does not do for, in the LiDAR frame.

    Attributes:
        planes: float64 (K,4), normals and offsets, the main plane first.
        basis: float64 (2,3), directions of the plan over which the parts are told.
        part: int64 (S,S), row of ``planes`` for each cell of the plan, ``CELL_M`` wide, the sensor in its
            middle; beyond ``RANGE_M`` the outermost cells go on.
    """

    planes: Floats
    basis: Floats
    part: NDArray[np.int64]

    def __post_init__(self) -> None:
        for name in self.__slots__:
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def near_further(self, xyz: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Points (N,3) that lie about a plane other than the main one, in whatever part they are."""
        near = np.zeros(len(xyz), dtype=bool)
        for plane in self.planes[1:].astype(np.float32):
            height = xyz @ plane[:3]
            height += plane[3]
            # Half the band and as much again for the rounding of single precision.
            near |= np.abs(height, out=height) <= BAND_M
        return near

    def heights(self, xyz: np.ndarray) -> Floats:
        """Heights above the plane of each one's place, float64 (N,), metres, of points (N,3)."""
        first, second = self.basis.astype(xyz.dtype)
        part = np.take(self.part, _row(xyz @ second) * _side() + _row(xyz @ first))
        heights = np.asarray(xyz @ self.planes[0, :3].astype(xyz.dtype) + xyz.dtype.type(self.planes[0, 3]))
        for k in range(1, len(self.planes)):
            on = np.flatnonzero(part == k)
            heights[on] = xyz[on] @ self.planes[k, :3] + self.planes[k, 3]
        return np.asarray(heights, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """A fitted ground: its main plane ``normal . p + offset = 0``, and its relief where that does not do.

    Attributes:
        normal: float64 (3,), unit, LiDAR frame, pointing up.
        offset: m; height of the LiDAR's origin above the main plane.
        inliers: bool (N,), points of the cloud within the band about the main plane or that of their place.
        relief: Planes of its parts, of the frame in which it was fitted; None where the main plane does.
    """

    normal: Floats
    offset: float
    inliers: NDArray[np.bool_]
    relief: Relief | None = None

    def heights(self, xyz: np.ndarray) -> Floats:
        """Heights above the main plane, float64 (N,), metres, of points (N,3) in the LiDAR frame."""
        return np.asarray(xyz @ self.normal + self.offset, dtype=np.float64)

    def local_heights(self, xyz: np.ndarray) -> Floats:
        """Heights above the ground of each one's place, float64 (N,), metres, of points (N,3).

        The points are of the frame in which the ground was fitted.
        """
        return self.heights(xyz) if self.relief is None else self.relief.heights(xyz)


def plane_basis(normal: Floats) -> Floats:
    """Rows of (2,3): unit directions spanning the plane of a unit ``normal`` (3,): CRLF (4), heading open."""
    helper = np.zeros(3)
    helper[int(np.argmin(np.abs(normal)))] = 1.0
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def fit_ground(cloud: PointCloud, up: Floats, rng: np.random.Generator) -> Ground | None:
    """Fits the plane of the road (FORMULAS B: RANSAC, inlier band, least squares on the inliers).

    Args:
        cloud: The sweep, LiDAR frame.
        up: float64 (3,), unit, LiDAR frame: where up is, to some degrees.
        rng: Draws the subsample and the triples.

    Returns:
        The plane, or None where no plane within 15 degrees of the hint has enough support.
    """
    xyz = cloud.xyz
    if len(xyz) > SUBSAMPLE:
        xyz = xyz.take(rng.integers(0, len(xyz), SUBSAMPLE), axis=0)
    points = xyz.astype(np.float64)
    plan = points @ plane_basis(up).T
    near = np.flatnonzero(np.hypot(plan[:, 0], plan[:, 1]) < RANGE_M)
    points, plan = points.take(near, axis=0), plan.take(near, axis=0)
    cell = _cells(plan)
    height = points @ up
    first = _lowest_of_cells(cell, height)
    lowest = points[first]
    if len(lowest) < MIN_CELLS:
        return None
    plane = _best_plane(lowest, up, rng)
    if plane is None:
        return None
    for _ in range(_REFITS):
        means = _cell_means(points, cell, np.abs(points @ plane[:3] + plane[3]) <= BAND_M / 2)
        if len(means) < max(MIN_CELLS, MIN_SHARE * len(lowest)):
            return None
        plane = _least_squares(means, up)
    bare = lowest[_bare(height, cell)[cell[first]]]
    planes = _further_planes(points, cell, bare, plane, up, rng)
    relief = _relief(planes, bare, plane_basis(up))
    normal, offset = plane[:3], float(plane[3])
    inliers = np.abs(cloud.xyz @ normal.astype(np.float32) + np.float32(offset)) <= BAND_M / 2
    if relief is not None:
        # In the part of the main plane nothing is new, and few others lie about the plane of any part.
        asked = np.flatnonzero(relief.near_further(cloud.xyz) & ~inliers)
        inliers[asked] = np.abs(relief.heights(cloud.xyz.take(asked, axis=0))) <= BAND_M / 2
    return Ground(read_only(normal), offset, read_only(inliers), relief)


def _bare(height: Floats, cell: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether most points of each cell are as low as its lowest one, of points (N,)."""
    lowest = np.full(int(cell.max(initial=0)) + 1, np.inf)
    np.minimum.at(lowest, cell, height)
    low = np.bincount(cell[height <= lowest[cell] + BAND_M], minlength=len(lowest))
    share = low / np.maximum(np.bincount(cell, minlength=len(lowest)), 1)
    return np.asarray(share >= BARE_SHARE)


def _further_planes(
    points: Floats,
    cell: NDArray[np.int64],
    lowest: Floats,
    plane: Floats,
    up: Floats,
    rng: np.random.Generator,
) -> Floats:
    """The main plane and those that go on from it (K,4), of bare cells with lowest points (M,3)."""
    planes = plane[None]
    while len(planes) < MOST_PLANES:
        heights = lowest @ planes[:, :3].T + planes[:, 3]
        ground = np.abs(heights).min(axis=1) <= BAND_M / 2
        rest = lowest[~ground]
        if len(rest) < MIN_FURTHER_CELLS:
            break
        known = _Known(lowest[ground], planes[np.abs(heights[ground]).argmin(axis=1)])
        found = _further_plane(rest, known, up, rng)
        if found is None:
            break
        free = np.flatnonzero((np.abs(points @ planes[:, :3].T + planes[:, 3]) > BAND_M / 2).all(axis=1))
        refined = _refined(points.take(free, axis=0), cell[free], found, up)
        if refined is None:
            break
        on = np.flatnonzero(np.abs(rest @ refined[:3] + refined[3]) <= BAND_M / 2)
        if refined[:3] @ up < math.cos(MAX_TILT) or not _goes_on(rest[on], refined, known):
            break
        planes = np.vstack([planes, refined])
    return planes


def _refined(points: Floats, cell: NDArray[np.int64], plane: Floats, up: Floats) -> Floats | None:
    """The plane (4,) of least squares on the points (N,3) in its band; None where it is of too few cells."""
    for _ in range(_REFITS):
        means = _cell_means(points, cell, np.abs(points @ plane[:3] + plane[3]) <= BAND_M / 2)
        if len(means) < MIN_FURTHER_CELLS:
            return None
        plane = _least_squares(means, up)
    return plane


@dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """Lowest points (G,3) of cells of the ground, and their planes (G,4)."""

    points: Floats
    planes: Floats


def _further_plane(rest: Floats, known: _Known, up: Floats, rng: np.random.Generator) -> Floats | None:
    """The plane (4,) with most cells (M,3) side by side that goes on from the ground."""
    planes = _hypotheses(rest, up, rng)
    count = _counts(rest, planes)
    order = np.argsort(count, kind="stable")[::-1][:_FURTHER_TRIES]
    if len(order) == 0 or count[order[0]] < MIN_FURTHER_CELLS:
        return None
    beside = (cdist(rest, rest) <= NEIGHBOUR_M).astype(np.float32)
    crowd = beside.sum(axis=1)
    best, most = None, MIN_FURTHER_CELLS - 1
    for k in order.tolist():
        on = np.abs(rest @ planes[k, :3] + planes[k, 3]) <= BAND_M / 2
        dense = on & (beside @ on.astype(np.float32) >= DENSE_SHARE * crowd)
        if int(dense.sum()) <= most:
            continue
        dense = _largest(dense, beside)
        if int(dense.sum()) > most and _goes_on(rest[dense], planes[k], known):
            best, most = planes[k], int(dense.sum())
    return best


def _largest(chosen: NDArray[np.bool_], beside: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Of the chosen cells (M,) those of the largest group side by side (M,M): a crest falls off both ways."""
    index = np.flatnonzero(chosen)
    linked = beside[np.ix_(index, index)]
    left, best = np.ones(len(index), dtype=bool), index[:0]
    while int(left.sum()) > len(best):
        reached = np.zeros(len(index), dtype=np.float32)
        reached[int(np.argmax(left))] = 1.0
        size = 0
        while size < (size := int(np.count_nonzero(reached))):
            reached = (linked @ reached > 0.0).astype(np.float32)
        group = np.flatnonzero(reached)
        left[group] = False
        if len(group) > len(best):
            best = group
    largest = np.zeros_like(chosen)
    largest[index[best]] = True
    return largest


def _goes_on(points: Floats, plane: Floats, known: _Known) -> bool:
    """Whether a plane (4,) meets the ground between its own cells (M,3) and those of the ground beside."""
    rows, columns = np.nonzero(cdist(points, known.points) <= NEIGHBOUR_M)
    if len(rows) == 0:
        return False
    # Heights of the new plane over the old one at both cells of each pair: it crosses, or is a low step.
    at_known = -(known.points[columns] @ plane[:3] + plane[3])
    old = known.planes[columns]
    at_new = np.einsum("ni,ni->n", points[rows], old[:, :3]) + old[:, 3]
    meets = (at_known * at_new <= 0) | (np.minimum(np.abs(at_known), np.abs(at_new)) <= STEP_M)
    return bool(meets.mean() >= DENSE_SHARE)


def _relief(planes: Floats, lowest: Floats, basis: Floats) -> Relief | None:
    """The plane of each cell of the plan: of ground cells the nearest one, elsewhere as beside it."""
    side = _side()
    if len(planes) == 1:
        return None
    away = np.abs(lowest @ planes[:, :3].T + planes[:, 3])
    ground = away.min(axis=1) <= BAND_M / 2
    column, row = (_row(lowest[ground] @ direction) for direction in basis)
    empty = np.ones((side, side), dtype=np.uint8)
    empty[row, column] = 0
    plane = np.zeros((side, side), dtype=np.int64)
    plane[row, column] = away[ground].argmin(axis=1)
    _, label = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    of_label = np.zeros(int(label.max()) + 1, dtype=np.int64)
    of_label[label[row, column]] = plane[row, column]
    return Relief(planes, basis, of_label[label])


def _side() -> int:
    """Cells along a side of the plan."""
    return 2 * math.ceil(RANGE_M / CELL_M) + 1


def _row(place: np.ndarray) -> NDArray[np.int64]:
    """Row or column (N,) of the plan's grid for coordinates (N,) of it, m; those beyond get the outermost."""
    return np.asarray(np.clip((place + RANGE_M) / CELL_M, 0, _side() - 1).astype(np.int64))


def _cells(plan: Floats) -> NDArray[np.int64]:
    """Index (N,) of the cell in which each point (N,2) of the plan lies."""
    return _row(plan[:, 0]) * _side() + _row(plan[:, 1])


def _lowest_of_cells(cell: NDArray[np.int64], height: Floats) -> NDArray[np.int64]:
    """Index of the lowest point of each occupied cell."""
    lowest = np.full(int(cell.max(initial=0)) + 1, np.inf)
    np.minimum.at(lowest, cell, height)
    tied = np.flatnonzero(height == lowest[cell])
    return tied[np.unique(cell[tied], return_index=True)[1]]


def _cell_means(points: Floats, cell: NDArray[np.int64], chosen: NDArray[np.bool_]) -> Floats:
    """Mean (M,3) of the chosen points of each cell that has any."""
    index = np.flatnonzero(chosen)
    where, taken = cell.take(index), points.take(index, axis=0)
    count = np.bincount(where)
    sums = np.stack([np.bincount(where, weights=column) for column in taken.T], axis=1)
    return np.asarray(sums[count > 0] / count[count > 0, None])


def _best_plane(points: Floats, up: Floats, rng: np.random.Generator) -> Floats | None:
    """The plane (4,) through three of the points (M,3) with most in its band; None if all are steep."""
    planes = _hypotheses(points, up, rng)
    if len(planes) == 0:
        return None
    return np.asarray(planes[int(np.argmax(_counts(points, planes)))])


def _counts(points: Floats, planes: Floats) -> NDArray[np.float32]:
    """Number (H,) of the points (M,3) in the band of each plane (H,4)."""
    counts = np.empty(len(planes), dtype=np.float32)
    one = np.ones(len(points), dtype=np.float32)
    for first in range(0, len(planes), _PLANES_AT_A_TIME):
        block = planes[first : first + _PLANES_AT_A_TIME]
        height = block[:, :3] @ points.T
        height += block[:, 3:]
        # A product is quicker than a sum of truth values.
        counts[first : first + len(block)] = (np.abs(height, out=height) <= BAND_M / 2).astype(
            np.float32
        ) @ one
    return counts


def _hypotheses(points: Floats, up: Floats, rng: np.random.Generator) -> Floats:
    """Level planes (H,4) through three of the points (M,3)."""
    triple = points[rng.integers(0, len(points), (HYPOTHESES, 3))]
    normal = np.cross(triple[:, 1] - triple[:, 0], triple[:, 2] - triple[:, 0])
    length = np.linalg.norm(normal, axis=1)
    along_up = normal @ up
    level = np.abs(along_up) >= math.cos(MAX_TILT) * length
    # Triples on one line span no plane; one square metre is a quarter of a cell.
    level &= length > CELL_M * CELL_M / 4
    normal = normal[level] * (np.sign(along_up[level]) / length[level])[:, None]
    offset = -np.einsum("ij,ij->i", normal, triple[level, 0])
    return np.column_stack([normal, offset])


def _least_squares(points: Floats, up: Floats) -> Floats:
    """Plane (4,) of least squared distances to points (M,3), normal on the side of ``up``."""
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    normal = normal * (1.0 if normal @ up >= 0 else -1.0)
    return np.append(normal, -normal @ centre)
