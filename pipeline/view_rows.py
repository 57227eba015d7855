"""Neighbours in a cloud without rings: rows and columns of points as the camera sees them.

Clouds of several LiDARs in one, of solid-state sensors, or thinned by voxels have no rings to go along. What
an image shows as a border is still a border in them: points at one range end, and those beside them as the
camera sees it lie behind. Rows are as wide as points are far apart, which the cloud itself tells.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.medians import median
from pipeline.records import Floats

_PATCH_RAD = math.radians(2.0)
"""Patches of the view in which points are counted; the closest LiDARs on sale put some hundred in each."""

_FEWEST_IN_PATCH = 4
"""Points of the usual patch: with fewer, neighbours are a degree apart and borders lie anywhere between."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewRows:
    """Points ordered by row, and inside each row along it.

    Attributes:
        index: int64 (M,), index of each ordered point among those given.
        row: int64 (M,), its row.
        along: float64 (M,), its place along the row, rad, growing.
        distance: float64 (M,), range from the camera, m.
        width: Of the rows, rad: with so many points as there are, neighbours of a row are as far apart.
    """

    index: NDArray[np.int64]
    row: NDArray[np.int64]
    along: Floats
    distance: Floats
    width: float


def view_angles(xyz_cam: Floats) -> tuple[Floats, Floats, Floats]:
    """Angle to the right (N,) and upwards (N,), rad, and range (N,), m, of points (N,3) in camera axes."""
    x, y, z = xyz_cam.T
    flat = np.hypot(x, z)
    return np.arctan2(x, z), np.arctan2(-y, flat), np.hypot(flat, y)


def point_spacing(right: Floats, upwards: Floats) -> float | None:
    """How far points are apart where the usual one lies, rad; None where they are too few to be neighbours.

    Args:
        right: float64 (N,), rad.
        upwards: float64 (N,), rad.
    """
    if right.size == 0:
        return None
    columns = int(2.0 * math.pi / _PATCH_RAD) + 2
    patch = np.floor(upwards / _PATCH_RAD).astype(np.int64) * columns + np.floor(right / _PATCH_RAD).astype(
        np.int64
    )
    _, which, counts = np.unique(patch, return_inverse=True, return_counts=True)
    usual = median(counts[which].astype(np.float64))
    return _PATCH_RAD / math.sqrt(usual) if usual >= _FEWEST_IN_PATCH else None


def view_rows(along: Floats, across: Floats, distance: Floats, width: float) -> ViewRows:
    """Orders points by rows.

    Args:
        along: float64 (N,), angle along the rows, rad.
        across: float64 (N,), angle across them, rad.
        distance: float64 (N,), m.
        width: Of a row, rad.
    """
    row = np.floor(across / width).astype(np.int64)
    # One key for both is sorted three times as fast as two.
    least = float(along.min(initial=0.0))
    reach = 1.0 + float(along.max(initial=0.0)) - least
    order = np.argsort(row + (along - least) / reach, kind="stable")
    row, along = row[order], along[order]
    return ViewRows(order, row, along, distance[order], width)


def joined(rows: ViewRows, widest: float) -> NDArray[np.bool_]:
    """Whether each ordered point and the next (M-1,) share a row without a gap of ``widest`` rad."""
    return np.asarray((np.diff(rows.row) == 0) & (np.diff(rows.along) < widest))


def lasting_jumps(
    rows: ViewRows, least: Floats, lasting: int, widest: float
) -> tuple[NDArray[np.int64], Floats]:
    """Points of a row beside which the next ones lie farther: place in the order (K,), and the way (K,).

    The way is the angle along the row to the first of the farther ones, rad, negative against the order.

    Args:
        rows: Ordered points.
        least: float64 (M,), m, by how much the others lie farther, for each ordered point.
        lasting: So many in a row do: where near and far points alternate, a sensor looks past the border from
            another place than the camera.
        widest: A wider gap was not seen, rad.
    """
    places, ways = [], []
    linked = joined(rows, widest)
    count = len(rows.row)
    for sense in (1, -1):
        near = np.arange(count)
        for k in range(1, lasting + 1):
            # Few are left after the first step.
            near = near[(near + sense * k >= 0) & (near + sense * k < count)]
            other = near + sense * k
            farther = rows.distance[other] - rows.distance[near] > least[near]
            near = near[farther & linked[np.minimum(other, other - sense)]]
        places.append(near)
        ways.append(rows.along[near + sense] - rows.along[near])
    return np.concatenate(places), np.concatenate(ways)
