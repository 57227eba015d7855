"""Which side of a cloud is up, with no hint: the largest plane below the sensor that has all else above it.

For a LiDAR in any attitude: on its side, upside down, on a mast that leans.
"""

import math
from dataclasses import dataclass

import numpy as np

from pipeline.ground import BAND_M, Ground, fit_ground
from pipeline.records import Floats, PointCloud

VOXEL_M = 1.0
"""m; one point of each cube takes part, or the nearest rings would be the largest plane."""
RANGE_M = 30.0
"""m; roads are planes to a quarter of a metre only over such lengths."""
SUBSAMPLE = 30_000
"""Points looked at."""
HYPOTHESES = 800
"""Planes tried: with a quarter of the cubes on the road all miss it with (1 - 1/64)^800 = 3e-6."""
NEAREST_M, FARTHEST_M = 0.2, 6.0
"""m; height of a LiDAR above the road: on a bumper, or on a mast on a truck's roof."""
BELOW_M = 0.5
"""m; what lies deeper is below the ground, and there is nothing but noise and mirrors."""
RIVAL = 0.5
"""A plane with so large a share of the best one's support may be the road too: a wall beside the vehicle."""
APART = math.radians(30.0)
"""rad; planes that enclose less are one ground and its camber, slopes or pavements."""
MOST = 2
"""Sides that are told: each is followed to the end, and costs as much as the other."""


@dataclass(frozen=True, slots=True, eq=False)
class _Planes:
    """Unit normals (H,3) on the side of the sensor, heights of the sensor (H,), and support (H,)."""

    normals: Floats
    heights: Floats
    support: Floats


def find_grounds(cloud: PointCloud, rng: np.random.Generator) -> tuple[Ground, ...]:
    """Planes that may be the road, the likeliest first, each with its normal on the side of up.

    Args:
        cloud: The sweep, in any frame with the sensor at its origin to a few metres.
        rng: Draws the planes.
    """
    xyz = cloud.xyz
    if len(xyz) > SUBSAMPLE:
        xyz = xyz[rng.integers(0, len(xyz), SUBSAMPLE)]
    points = _thinned(xyz[np.linalg.norm(xyz, axis=1) < RANGE_M].astype(np.float64))
    grounds: list[Ground] = []
    for normal in _sides(_planes(points, rng)):
        ground = fit_ground(cloud, normal, rng)
        if ground is not None:
            grounds.append(ground)
    return tuple(grounds)


def _thinned(points: Floats) -> Floats:
    """One of the points (N,3) of each cube."""
    cube = np.floor(points / VOXEL_M).astype(np.int64)
    return points[np.unique(cube, axis=0, return_index=True)[1]]


def _planes(points: Floats, rng: np.random.Generator) -> _Planes:
    """Planes through three of the points (N,3), what lies below them taken off their support."""
    if len(points) < _LEAST_POINTS:
        return _Planes(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    triple = points[rng.integers(0, len(points), (HYPOTHESES, 3))]
    normal = np.cross(triple[:, 1] - triple[:, 0], triple[:, 2] - triple[:, 0])
    length = np.linalg.norm(normal, axis=1)
    # Thin triangles span no plane; a square metre is what one cube shows of the road.
    normal, first = normal[length > VOXEL_M**2], triple[length > VOXEL_M**2, 0]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = -np.einsum("hi,hi->h", normal, first)
    side = np.where(height < 0, -1.0, 1.0)
    normal, height = side[:, None] * normal, side * height
    good = (height >= NEAREST_M) & (height <= FARTHEST_M)
    normal, height = normal[good], height[good]
    above = points @ normal.T + height
    support = (np.abs(above) <= BAND_M / 2).sum(axis=0) - (above < -BELOW_M).sum(axis=0)
    return _Planes(normal, height, np.asarray(support, dtype=np.float64))


_LEAST_POINTS = 100
"""Cubes; fewer are no street."""


def _sides(planes: _Planes) -> list[Floats]:
    """Unit normals (3,) of the planes with most support that differ from each other."""
    kept: list[Floats] = []
    order = np.argsort(-planes.support, kind="stable")
    for k in order.tolist():
        if planes.support[k] < max(1.0, RIVAL * planes.support[order[0]]) or len(kept) == MOST:
            break
        if all(planes.normals[k] @ other < math.cos(APART) for other in kept):
            kept.append(planes.normals[k])
    return kept
