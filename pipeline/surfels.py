"""Small planes of a sweep (surfels): what two sweeps of one place have in common.

The sweep is cut into cells whose size grows with the range, so that a cell holds about as many beams near
and far; a cell whose points lie on a plane becomes a surfel. No axis of the frame, no rings and no order of
points is used.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Floats, PointCloud

NEAREST_M = 2.0
"""m; what is nearer is mostly the vehicle itself. The first octave of cells begins here."""

OCTAVES = 6
"""Cells double in size with each doubling of the range: 2 m to 128 m."""

CELL_SHARES = (1.0 / 16.0, 1.0 / 4.0)
"""Side of a cell as a share of the range, finest first: 3.6 deg hold three rings of 1.2 deg on a wall; the
second holds two rings of 2 deg on the road, as far as seven times the sensor's height."""

MIN_POINTS = 6
"""Points of a surfel: twice what a plane needs, so that its thickness means something."""

FLATNESS = 0.2
"""Largest variance across a surfel as a share of the middle one: one ring over rough ground is a line, not
a plane."""

MIN_EXTENT_M = 0.05
"""m, standard deviation along the shorter side: beyond range noise (2-3 cm), or the plane is made of it."""

_NO_SPREAD = 1e-60
"""Where all eigenvalues are equal any direction is right; the cube of this is still a number."""

_MAX_TIME_SPREAD = 0.1
"""Share of the sweep over which the points of a surfel may spread in time: beyond it lies the seam of the
sweep."""


@dataclass(frozen=True, slots=True, eq=False)
class Surfels:
    """Small planes of one sweep.

    Attributes:
        centre: float64 (M,3), metres, LiDAR frame.
        normal: float64 (M,3), unit, of either sign.
        thickness: float64 (M,), standard deviation of the points across the plane, m.
        size: float64 (M,), side of the cell, m.
        time: float64 (M,), mean time of the points, s after the stamp; None where the sweep has no times.
    """

    centre: Floats
    normal: Floats
    thickness: Floats
    size: Floats
    time: Floats | None

    def __len__(self) -> int:
        return len(self.centre)


def surfels(cloud: PointCloud) -> Surfels:
    """The small planes of a sweep; with times where the cloud has them.

    Points that lie on no plane in the finest cells are tried again in coarser ones: the road between the
    rings of a sparse sensor, and of any sensor further away.
    """
    found: list[Surfels] = []
    xyz, time = np.ascontiguousarray(cloud.xyz.T), cloud.time
    for share in CELL_SHARES:
        planes, left = _planes(xyz, time, share)
        found.append(planes)
        xyz, time = np.take(xyz, left, axis=1), None if time is None else time[left]
    return Surfels(
        np.concatenate([f.centre for f in found]),
        np.concatenate([f.normal for f in found]),
        np.concatenate([f.thickness for f in found]),
        np.concatenate([f.size for f in found]),
        None if time is None else np.concatenate([f.time for f in found if f.time is not None]),
    )


def _planes(
    xyz: NDArray[np.float32], time: NDArray[np.float32] | None, share: float
) -> tuple[Surfels, NDArray[np.int64]]:
    """Planes of points (3,N) in cells of ``share`` of the range, and the points that lie on none."""
    _, octave = np.frexp(np.abs(xyz).max(axis=0) / np.float32(NEAREST_M))
    octave -= 1
    inside = (octave >= 0) & (octave < OCTAVES)
    octave[~inside] = 0
    size = np.ldexp(np.float32(NEAREST_M * share), octave)
    half = round(2.0 / share)
    # Outside points get a place like any other and are struck out by their cell's number.
    place = np.clip(xyz / size + np.float32(half), 0.0, 2 * half - 1e-3)
    corner = place.astype(np.int32)
    cell = ((octave * 2 * half + corner[0]) * 2 * half + corner[1]) * 2 * half + corner[2]
    cells = OCTAVES * (2 * half) ** 3
    cell[~inside] = cells
    count = np.bincount(cell, minlength=cells + 1)[:cells]
    occupied = np.flatnonzero(count >= MIN_POINTS)
    surfel = np.full(cells + 1, -1, dtype=np.int32)
    surfel[occupied] = np.arange(occupied.size, dtype=np.int32)
    group = surfel[cell]
    chosen = np.flatnonzero(group >= 0)
    group, n = group[chosen].astype(np.int64), count[occupied].astype(np.float64)
    # Coordinates inside the cell, in units of its side: sums of squares then lose no digits.
    local = np.empty((3, chosen.size))
    for inside_cell, p, c in zip(local, place, corner, strict=True):
        np.subtract(p.take(chosen), c.take(chosen), out=inside_cell)
    local -= 0.5
    mean = np.stack([np.bincount(group, weights=x, minlength=n.size) / n for x in local])
    first = np.zeros(n.size, dtype=np.int64)
    first[group] = chosen
    side = size[first].astype(np.float64)
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    C = np.stack(
        [
            np.bincount(group, weights=local[a] * local[b], minlength=n.size) / n - mean[a] * mean[b]
            for a, b in pairs
        ]
    )
    values, normal = _least_axes(C)
    flat = (values[0] < FLATNESS * values[1]) & (values[1] * side**2 > MIN_EXTENT_M**2)
    cell_time = None
    if time is not None:
        cell_time, together = _cell_times(time[chosen].astype(np.float64), group, n)
        flat &= together
        cell_time = cell_time[flat]
    centre = (mean + corner[:, first] + (0.5 - half)) * side
    thickness = np.sqrt(np.maximum(values[0], 0.0)) * side
    left = inside
    left[chosen[flat[group]]] = False
    planes = Surfels(centre[:, flat].T, normal[:, flat].T, thickness[flat], side[flat], cell_time)
    return planes, np.flatnonzero(left)


def _cell_times(time: Floats, group: NDArray[np.int64], count: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Mean time of each cell, and whether its points were measured together."""
    mean = np.bincount(group, weights=time, minlength=count.size) / count
    variance = np.bincount(group, weights=(time - mean[group]) ** 2, minlength=count.size) / count
    return mean, variance <= (_MAX_TIME_SPREAD * float(np.ptp(time))) ** 2 if time.size else variance <= 0.0


def _least_axes(C: Floats) -> tuple[Floats, Floats]:
    """Least and middle eigenvalue (2,M) and unit eigenvector of the least (3,M), in closed form.

    ``C`` (6,M) holds symmetric matrices as xx, yy, zz, xy, xz, yz. Trigonometric solution of the cubic: ten
    times faster than LAPACK for thousands of matrices, and exact to 1e-8 of the largest eigenvalue.
    """
    mean = C[:3].mean(axis=0)
    xx, yy, zz = C[:3] - mean
    xy, xz, yz = C[3:]
    squares = xx**2 + yy**2 + zz**2 + 2.0 * (xy**2 + xz**2 + yz**2)
    spread = np.maximum(np.sqrt(squares / 6.0), _NO_SPREAD)
    determinant = xx * (yy * zz - yz**2) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    angle = np.arccos(np.clip(determinant / (2.0 * spread**3), -1.0, 1.0)) / 3.0
    least = 2.0 * spread * np.cos(angle + 2.0 * math.pi / 3.0)
    middle = -least - 2.0 * spread * np.cos(angle)
    rows = np.stack(
        [np.stack([xx - least, xy, xz]), np.stack([xy, yy - least, yz]), np.stack([xz, yz, zz - least])]
    )
    # The eigenvector is across all rows; the longest of the three cross products is the surest.
    crosses = np.stack([np.cross(rows[a], rows[b], axis=0) for a, b in ((0, 1), (0, 2), (1, 2))])
    length = np.linalg.norm(crosses, axis=1)
    best = np.argmax(length, axis=0)
    columns = np.arange(C.shape[1])
    normal = crosses[best, :, columns].T / np.maximum(length[best, columns], np.finfo(np.float64).tiny)
    return np.stack([least + mean, middle + mean]), normal
