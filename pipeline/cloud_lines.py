"""Straight lines fitted to points of a cloud, with what a solver must know of their noise (FORMULAS D1)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.records import CloudLine, Floats, LineLabel


@dataclass(frozen=True, slots=True, eq=False)
class FittedAxis:
    """A fitted 3-D line.

    Attributes:
        mean: float64 (3,), mean of its points, metres, LiDAR frame.
        direction: float64 (3,), unit.
        along: float64 (M,), positions of its points from the mean, metres.
        sigma: rms of its points across it, metres per axis.
    """

    mean: Floats
    direction: Floats
    along: Floats
    sigma: float


def total_least_squares(points: Floats) -> FittedAxis:
    """The line of least squared distances to points (M,3); its direction has no preferred sign."""
    mean = points.mean(axis=0)
    centred = points - mean
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    along = centred @ direction
    across = centred - along[:, None] * direction
    # Two axes across, four parameters taken from 2 m coordinates.
    sigma = math.sqrt(float((across**2).sum()) / max(2 * len(points) - 4, 1))
    return FittedAxis(mean, direction, along, sigma)


def cloud_line(label: LineLabel, axis: FittedAxis, points: NDArray[np.int64]) -> CloudLine:
    """The fitted line as a record, from its first point to its last; ``points`` (M,) index the cloud."""
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


def unrepeated(xyz: NDArray[np.float32], index: NDArray[np.int64]) -> NDArray[np.int64]:
    """``index`` (M,) into points (N,3), of points that stand there twice only the first.

    Both echoes of a beam may be one and the same; what is counted twice would seem known twice as well.
    """
    bits = np.ascontiguousarray(xyz[index]).view(np.uint32).astype(np.uint64)
    # Points of one key are one point: 64 bits tell millions apart.
    key = bits @ _ODD
    in_order = np.sort(key)
    if (in_order[1:] != in_order[:-1]).all():
        return index
    return np.asarray(index[np.sort(np.unique(key, return_index=True)[1])])


_ODD = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)
"""Odd numbers without a pattern, whose multiples scatter over 64 bits."""
