"""Straight edges of buildings, vehicles and furniture in a sweep: lines of class ``structure`` (PLK V-C).

Three sources: planes that meet, borders of planes, and jumps of range where the cloud shows rings. What they
find twice is told once; pieces of one line are joined where their covariances allow it.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipeline.cloud_lines import unrepeated
from pipeline.jump_lines import jump_lines
from pipeline.plane_edges import borders, creases
from pipeline.planes import DEFAULT_SPACING_RAD, find_planes, thinned
from pipeline.records import CloudLine, Floats, PointCloud
from pipeline.rings import ScanPattern, scan_pattern, spin_turns
from pipeline.uncertain_lines import UncertainLine, structure_line

MOST_POINTS = 200_000
"""Points of a sweep that take part; more are thinned evenly first. A sweep of 128 rings in a wide view."""
OUTERMOST_M = 1e4
"""m; coordinates beyond are no measurement, and neither is what is not a number."""
MOST_LINES = 80
"""Lines given, those longest for their uncertainty: matching costs the product with the image's lines."""
SAME_ANGLE = math.radians(3.0)
"""rad between two lines that may be one."""
SAME_M = 0.15
"""m across between two finds of one edge: half a beam's gap at 20 m and the noise of a plane's border."""
JOIN_GAP_M = 1.0
"""m between pieces of one line: a lost return or two, or a thin thing before it."""
JOIN_CHI2 = 13.3
"""Squared whitened misfit of two pieces; 1 % of true pairs lie beyond (chi-square, 4 degrees of freedom)."""
MAX_SIGMA_PER_RANGE = 0.008
"""Sigma sideways at an end over the range, at most: 6 px at a focal length of 720 px tell nothing."""


def find_structure_lines(
    cloud: PointCloud, seen: NDArray[np.bool_], rng: np.random.Generator, origin: Floats | None = None
) -> list[UncertainLine]:
    """Straight edges in a sweep, with the covariance of their ends.

    Args:
        cloud: The sweep, in any LiDAR frame, with or without rings.
        seen: bool (N,), points that may take part (those in view of the camera).
        rng: Draws the borders of planes.
        origin: float64 (3,), where the sensor stands in the cloud's frame (``sensor_seat``); None: at
            its origin.

    Returns:
        At most ``MOST_LINES``, the surest first; none is an ordinary answer.
    """
    shift = np.zeros(3) if origin is None else origin
    with np.errstate(invalid="ignore"):
        sound = (np.abs(cloud.xyz) < OUTERMOST_M).all(axis=1)
    index = unrepeated(cloud.xyz, np.flatnonzero(seen & sound))
    # Nothing is asked of what is out of view: most of a sweep.
    cloud = PointCloud(cloud.xyz[index], None, None if cloud.ring is None else cloud.ring[index])
    xyz = cloud.xyz.astype(np.float64) - shift
    keep = np.zeros(len(index), dtype=bool)
    keep[:: max(1, math.ceil(len(index) / MOST_POINTS))] = True
    turn, pattern = _pattern(cloud, xyz, keep)
    spacing = DEFAULT_SPACING_RAD if pattern is None else max(pattern.ring_spacing, pattern.azimuth_step)
    cells = thinned(xyz, keep, spacing)
    planes = find_planes(cells, xyz)
    lines = creases(planes, cells, xyz)
    if pattern is not None:
        found = jump_lines(xyz @ turn.T, pattern)
        lines += [line.moved(turn.T, np.zeros(3)) for line in found]
    else:
        # With rings the same borders are known better from their jumps.
        lines += borders(planes, cells, xyz, spacing, rng)
    best = distinct(joined([line for line in lines if _sure(line)]))[:MOST_LINES]
    return [dataclasses.replace(line.moved(np.eye(3), shift), points=index[line.points]) for line in best]


def cloud_lines(lines: Sequence[UncertainLine], eye: Floats) -> list[CloudLine]:
    """The lines as records of class ``structure``, for a camera at ``eye`` (3,), m, LiDAR frame."""
    return [structure_line(line, eye) for line in lines]


def _pattern(cloud: PointCloud, xyz: Floats, keep: NDArray[np.bool_]) -> tuple[Floats, ScanPattern | None]:
    """The turn (3,3) that brings the spin axis to z, and the scan pattern there, or None."""
    kept = np.flatnonzero(keep)
    if len(kept) == 0:
        return np.eye(3), None
    for turn in spin_turns(cloud):
        turned = dataclasses.replace(cloud, xyz=(xyz @ turn.T).astype(np.float32))
        pattern = scan_pattern(turned, keep)
        if pattern is not None:
            return turn, pattern
    return np.eye(3), None


def _sure(line: UncertainLine) -> bool:
    """Whether both ends are known well enough to say anything in an image."""
    reach = np.array([np.linalg.norm(line.start), np.linalg.norm(line.end)])
    return bool((np.sqrt(np.diag(line.sideways)) <= MAX_SIGMA_PER_RANGE * reach).all())


def _quality(line: UncertainLine) -> float:
    """Length over sigma."""
    return line.length / math.sqrt(max(float(np.trace(line.sideways)), 1e-12))


def joined(lines: list[UncertainLine]) -> list[UncertainLine]:
    """Pieces of one line of one kind, one behind the other, as one (3D merging of PLK V-C)."""
    lines = sorted(lines, key=_quality, reverse=True)
    start, end = _ends(lines)
    kind = np.array([line.kind for line in lines])
    free = np.ones(len(lines), dtype=bool)
    done: list[UncertainLine] = []
    for first in range(len(lines)):
        if not free[first]:
            continue
        free[first] = False
        whole, grown = lines[first], True
        while grown:
            grown = False
            for k in np.flatnonzero(free & (kind == whole.kind) & _continuing(whole, start, end)).tolist():
                joint = _joint(whole, lines[k])
                if joint is not None:
                    whole, grown, free[k] = joint, True, False
                    break
        done.append(whole)
    return done


def _ends(lines: Sequence[UncertainLine]) -> tuple[Floats, Floats]:
    """Starts and ends (N,3)."""
    return np.array([a.start for a in lines]).reshape(-1, 3), np.array([a.end for a in lines]).reshape(-1, 3)


def _continuing(line: UncertainLine, start: Floats, end: Floats) -> NDArray[np.bool_]:
    """Which others (N,), by their ends (N,3), may be a piece of the line beyond its ends."""
    along = (np.stack([start, end]) - line.start) @ line.direction
    low, high = along.min(axis=0), along.max(axis=0)
    gap = np.maximum(low - line.length, -high)
    span = end - start
    cosine = np.abs(span @ line.direction) / np.linalg.norm(span, axis=1)
    fits = (cosine >= math.cos(SAME_ANGLE)) & (gap <= JOIN_GAP_M) & (gap >= -0.5 * (high - low))
    return np.asarray(fits)


def _joint(line: UncertainLine, other: UncertainLine) -> UncertainLine | None:
    """Both pieces as one line of least squares, or None where they are not one within their covariances.

    The errors of both may be common (one column of beams, one plane), so the information of each counts half
    (covariance intersection, FORMULAS F6).
    """
    axes, direction = line.axes, line.direction
    if (other.end - other.start) @ direction < 0:
        swap = np.array([2, 3, 0, 1])
        other = UncertainLine(
            other.kind, other.end, other.start, other.points, other.covariance[np.ix_(swap, swap)]
        )
    pieces = (line, other)
    along = np.array([[(p.start - line.start) @ direction, (p.end - line.start) @ direction] for p in pieces])
    low, high = float(along.min()), float(along.max())
    share = (along - low) / (high - low)
    H = [np.kron(np.column_stack([1.0 - s, s]), np.eye(2)) for s in share]
    y = [np.concatenate([axes @ (p.start - line.start), axes @ (p.end - line.start)]) for p in pieces]
    weight = [np.linalg.inv(p.covariance + _REGULAR_M**2 * np.eye(4)) for p in pieces]
    information = sum((h.T @ w @ h for h, w in zip(H, weight, strict=True)), np.zeros((4, 4)))
    right = sum((h.T @ w @ v for h, w, v in zip(H, weight, y, strict=True)), np.zeros(4))
    x = np.linalg.solve(information, right)
    misfit = sum(float((v - h @ x) @ w @ (v - h @ x)) for h, w, v in zip(H, weight, y, strict=True))
    if misfit > JOIN_CHI2:
        return None
    ends = line.start + np.array([[low], [high]]) * direction + x.reshape(2, 2) @ axes
    points = np.union1d(line.points, other.points)
    return UncertainLine(line.kind, ends[0], ends[1], points, 2.0 * np.linalg.inv(information))


_REGULAR_M = 1e-4
"""m; noiseless lines have covariances without an inverse."""


def distinct(lines: list[UncertainLine]) -> list[UncertainLine]:
    """Lines without those that a surer one covers, the surest first."""
    lines = sorted(lines, key=_quality, reverse=True)
    start, end = _ends(lines)
    kept: list[int] = []
    covered = np.zeros(len(lines), dtype=bool)
    for k, line in enumerate(lines):
        if not covered[k]:
            kept.append(k)
            covered |= _covers(line, start, end)
    return [lines[k] for k in kept]


def _covers(line: UncertainLine, start: Floats, end: Floats) -> NDArray[np.bool_]:
    """Of which lines (N,) half lies along the line, so near that both are one edge, by their ends (N,3)."""
    length = np.linalg.norm(end - start, axis=1)
    along = np.sort(np.stack([start - line.start, end - line.start]) @ line.direction, axis=0)
    common = np.minimum(along[1], line.length) - np.maximum(along[0], 0.0)
    # The nearness of the part in common; ends beyond may have turned away.
    off = np.abs((0.5 * (start + end) - line.start) @ line.axes.T)
    near = (off[:, 0] <= SAME_M) & (off[:, 1] <= _SAME_DEPTH_M)
    same = along[1] - along[0] >= math.cos(SAME_ANGLE) * length
    return np.asarray(same & near & (common >= 0.5 * length))


_SAME_DEPTH_M = 0.5
"""m in depth between two finds of one edge: less than the least jump."""
