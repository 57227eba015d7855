"""Painted lines follow the road: a course of second order through the points of a fitted line.

A straight line through the points of a bend lies off the paint by more than its noise: with a radius of 500 m
by 4 cm in the middle of 12 m, and the further beyond. The course is a regression with a belief about bends:
points decide where there are many over a great length, and what they leave open is uncertainty.
"""

import dataclasses

import numpy as np

from pipeline.records import CloudLine, Floats, LineArc, PointCloud

BEND_SIGMA = 0.005
"""1/m; of half the curvature: a bend with a radius of 100 m is ordinary, one of 30 m a turning."""
LEAST_SIGMA_M = 0.005
"""m; of one point across: no cloud is that even."""


def with_arc(line: CloudLine, cloud: PointCloud) -> CloudLine:
    """The line with the course of its points; as it is where they are too few to show their noise."""
    xyz = cloud.xyz[line.points].astype(np.float64)
    span = line.end - line.start
    length = float(np.linalg.norm(span))
    middle = 0.5 * length if line.mean_m is None else line.mean_m
    if length == 0.0 or len(xyz) < _LEAST_POINTS:
        return line
    direction = span / length
    offset = xyz - (line.start + middle * direction)
    along = offset @ direction
    across = offset - along[:, None] * direction
    return dataclasses.replace(line, arc=fit_arc(along, across))


_LEAST_POINTS = 4
"""One more than a course of second order has unknowns."""


def fit_arc(along: Floats, across: Floats) -> LineArc:
    """The course through points at ``along`` (M,), m, that lie ``across`` (M,3), m, off the straight line.

    FORMULAS D1 with a third column: the covariance of the course at s, s' is
    ``(1, s, s^2) C (1, s', s'^2)^T``. The belief about bends enters as one more observation.
    """
    columns = np.column_stack([np.ones_like(along), along, along**2])
    free = np.linalg.lstsq(columns, across, rcond=None)[0]
    freedom = max(2 * len(along) - 6, 1)
    sigma = max(LEAST_SIGMA_M, float(np.sqrt(((across - columns @ free) ** 2).sum() / freedom)))
    normal = columns.T @ columns
    normal[2, 2] += (sigma / BEND_SIGMA) ** 2
    inverse = np.linalg.inv(normal)
    return LineArc(inverse @ (columns.T @ across), sigma**2 * inverse)
