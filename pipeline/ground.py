"""The ground plane of a sweep in an arbitrary LiDAR frame, by RANSAC and least squares (FORMULAS B, ground).

The plane is sought among the lowest points of square cells, so that near rings, which hold most points, count
no more than the road further away, and roofs and tree crowns do not count at all.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

_REFITS = 3
"""Least-squares rounds; the second moves the plane by millimetres, the third by less than one."""


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """A fitted ground plane ``normal . p + offset = 0``.

    Attributes:
        normal: float64 (3,), unit, LiDAR frame, pointing up.
        offset: m; height of the LiDAR's origin above the plane.
        inliers: bool (N,), points of the cloud within the band, at any range.
    """

    normal: Floats
    offset: float
    inliers: NDArray[np.bool_]

    def heights(self, xyz: np.ndarray) -> Floats:
        """Heights above the plane, float64 (N,), metres, of points (N,3) in the LiDAR frame."""
        return np.asarray(xyz @ self.normal + self.offset, dtype=np.float64)


def plane_basis(normal: Floats) -> Floats:
    """Rows of (2,3): two unit directions that span the plane of a unit ``normal`` (3,)."""
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
        xyz = xyz[rng.integers(0, len(xyz), SUBSAMPLE)]
    points = xyz.astype(np.float64)
    plan = points @ plane_basis(up).T
    near = np.hypot(plan[:, 0], plan[:, 1]) < RANGE_M
    points, plan = points[near], plan[near]
    cell = _cells(plan)
    lowest = points[_lowest_of_cells(cell, points @ up)]
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
    normal, offset = plane[:3], float(plane[3])
    distance = cloud.xyz @ normal.astype(np.float32) + np.float32(offset)
    return Ground(read_only(normal), offset, read_only(np.abs(distance) <= BAND_M / 2))


def _cells(plan: Floats) -> NDArray[np.int64]:
    """Index (N,) of the cell in which each point (N,2) of the plan lies."""
    side = 2 * math.ceil(RANGE_M / CELL_M)
    column = np.floor((plan + RANGE_M) / CELL_M).astype(np.int64)
    return np.asarray(column[:, 0] * (side + 1) + column[:, 1])


def _lowest_of_cells(cell: NDArray[np.int64], height: Floats) -> NDArray[np.int64]:
    """Index of the lowest point of each occupied cell."""
    lowest = np.full(int(cell.max(initial=0)) + 1, np.inf)
    np.minimum.at(lowest, cell, height)
    return np.flatnonzero(height == lowest[cell])


def _cell_means(points: Floats, cell: NDArray[np.int64], chosen: NDArray[np.bool_]) -> Floats:
    """Mean (M,3) of the chosen points of each cell that has any."""
    where = cell[chosen]
    count = np.bincount(where)
    sums = np.stack([np.bincount(where, weights=points[chosen, axis]) for axis in range(3)], axis=1)
    return np.asarray(sums[count > 0] / count[count > 0, None])


def _best_plane(points: Floats, up: Floats, rng: np.random.Generator) -> Floats | None:
    """The plane (4,) through three of the points (M,3) with most in its band; None if all are steep."""
    triple = points[rng.integers(0, len(points), (HYPOTHESES, 3))]
    normal = np.cross(triple[:, 1] - triple[:, 0], triple[:, 2] - triple[:, 0])
    length = np.linalg.norm(normal, axis=1)
    along_up = normal @ up
    level = np.abs(along_up) >= math.cos(MAX_TILT) * length
    # Triples on one line span no plane; one square metre is a quarter of a cell.
    level &= length > CELL_M * CELL_M / 4
    if not level.any():
        return None
    normal = normal[level] * (np.sign(along_up[level]) / length[level])[:, None]
    offset = -np.einsum("ij,ij->i", normal, triple[level, 0])
    support = (np.abs(points @ normal.T + offset) <= BAND_M / 2).sum(axis=0)
    best = int(np.argmax(support))
    return np.append(normal[best], offset[best])


def _least_squares(points: Floats, up: Floats) -> Floats:
    """Plane (4,) of least squared distances to points (M,3), normal on the side of ``up``."""
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    normal = normal * (1.0 if normal @ up >= 0 else -1.0)
    return np.append(normal, -normal @ centre)
