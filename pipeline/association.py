"""Which image line shows which cloud line, under what is believed of the extrinsic.

A pair is judged by the distances of the image line's ends from the projected cloud line against their
covariance: noise of both lines (FORMULAS D1) and the uncertainty of the extrinsic. What is ambiguous is
dropped: a missing line widens the answer, a wrong one bends it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline import plk
from pipeline.records import CameraModel, CloudLine, Floats, ImageLine, LineMatch

REFERENCE_FOCAL_PX = 720.0
"""px; the lengths below grow with the focal length."""
MIN_DEPTH_M = 1.0
"""m; the nearer part of a cloud line is cut off: it projects to nearly anywhere."""
MIN_OVERLAP_PX = 20.0
"""px; with less in common the ends of a pair say only where, not which way."""
MIN_OVERLAP_SHARE = 0.3
"""Of the shorter of the two lines, seen along the image line."""
GATE = 13.8
"""Squared whitened distance of two ends; 1e-3 of true pairs lie beyond (chi-square, 2 degrees of freedom)."""
MARGIN = 6.0
"""Twice the log likelihood by which a pair must beat every other of its lines: 20 to 1."""
STRUCTURE_REACH_PX = 6.0
"""px, sigma of a foretold place, 0.5 deg: further off, every other pair of structure lines is a wrong one: an
image has hundreds of edges, and more than half of the cloud's have no partner among them."""
SAME_LINE_PX = 2.0
"""px; an image line this near to the continuation of another is a piece of it and no rival."""
SAME_LINE_SLOPE = 0.05
"""px per px beyond its end: roads bend by some 3 deg over the length of a piece."""
MODEL_M = 0.015
"""m; paint's bright middle and its painted middle differ, poles taper: common to all points of a line."""
OUTERMOST = 1e6
"""m and px; what lies beyond, or is no number, is no line that a sensor saw."""
MOST_CLOUD_LINES, MOST_IMAGE_LINES = 100, 400
"""Lines of one class that are paired, the longest: a street has fewer, a broken mask makes thousands. Bounds
time and memory."""
MOST_TOGETHER = 20_000
"""Pairs of several frames that are compared at once: beyond it memory grows and time is no longer saved."""

FrameLines: TypeAlias = tuple[Sequence[CloudLine], Sequence[ImageLine]]
"""Lines of one frame in cloud and image."""


_NODES = 0.5 + np.array([[1.0, -1.0], [-1.0, 1.0]]) * 0.5 / np.sqrt(3.0)
"""Weights of the ends of the part in common at the two places where lines are compared. There a line of least
squares through an evenly covered stretch of a bend lies on the bend, and straight lines lose nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Association:
    """Accepted pairs of one frame.

    Attributes:
        matches: The pairs.
        pairs: The same as arrays for the solver, restricted to the overlaps.
    """

    matches: tuple[LineMatch, ...]
    pairs: plk.LinePairs


def associate(
    cloud_lines: Sequence[CloudLine],
    image_lines: Sequence[ImageLine],
    camera: CameraModel,
    T_cam_lidar: Floats,
    covariance: Floats,
) -> Association:
    """Mutual best pairs of one frame, unambiguous and inside the gate.

    Args:
        cloud_lines: Lines in the LiDAR frame.
        image_lines: Lines in ideal px.
        camera: Intrinsics.
        T_cam_lidar: float64 (4,4), the extrinsic believed in.
        covariance: float64 (6,6), of (phi, rho) around it, rad and m.

    Returns:
        The pairs; none is an ordinary answer.
    """
    return associate_all([(cloud_lines, image_lines)], camera, T_cam_lidar, covariance)[0]


def associate_all(
    frames: Sequence[FrameLines], camera: CameraModel, T_cam_lidar: Floats, covariance: Floats
) -> list[Association]:
    """:func:`associate` for several frames, which costs little more than for one."""
    found: list[Association] = []
    comparable = [_comparable(*frame) for frame in frames]
    begin = 0
    while begin < len(frames):
        end, pairs = begin + 1, len(comparable[begin])
        while end < len(frames) and pairs + len(comparable[end]) <= MOST_TOGETHER:
            pairs += len(comparable[end])
            end += 1
        together = frames[begin:end], comparable[begin:end]
        found += _associated(*together, camera, T_cam_lidar, covariance)
        begin = end
    return found


def _associated(
    frames: Sequence[FrameLines],
    comparable: Sequence[NDArray[np.int64]],
    camera: CameraModel,
    T_cam_lidar: Floats,
    covariance: Floats,
) -> list[Association]:
    """The pairs of a few frames, of those that are comparable."""
    first = np.cumsum([(0, 0), *((len(cloud), len(image)) for cloud, image in frames)], axis=0)[:-1]
    frame = np.repeat(np.arange(len(frames)), [len(rows) for rows in comparable])
    rows = np.concatenate(comparable)
    enough, candidates = _on_overlap(
        [line for cloud, _ in frames for line in cloud],
        [line for _, image in frames for line in image],
        rows + first[frame],
        camera,
        T_cam_lidar,
    )
    if len(candidates) == 0:
        return [Association((), NO_PAIRS)] * len(frames)
    rows, frame = rows[enough], frame[enough]
    unit = max(1.0, float(camera.K[1, 1]) / REFERENCE_FOCAL_PX)
    r = plk.residuals(candidates, camera.K, T_cam_lidar)
    foretold = _foretold(candidates, camera, T_cam_lidar, covariance)
    cost = _costs(r, candidates.covariance + foretold)
    sharp = np.linalg.eigvalsh(foretold)[:, 1] <= (STRUCTURE_REACH_PX * unit) ** 2
    found = []
    for k, (cloud_lines, image_lines) in enumerate(frames):
        own = np.flatnonzero(frame == k)
        chosen = own[_chosen((cloud_lines, image_lines), rows[own], cost[own], sharp[own], unit)]
        matches = tuple(LineMatch(cloud_lines[i], image_lines[j]) for i, j in rows[chosen].tolist())
        found.append(Association(matches, plk.select(candidates, chosen)))
    return found


def _chosen(
    lines: FrameLines, rows: NDArray[np.int64], costs: Floats, sharp: NDArray[np.bool_], unit: float
) -> NDArray[np.bool_]:
    """Which candidates (M,2) of one frame are accepted, by their costs (M,); ``sharp``: well foretold."""
    cloud_lines, image_lines = lines
    cost = np.full((len(cloud_lines), len(image_lines)), np.inf)
    cost[rows[:, 0], rows[:, 1]] = costs
    # Of each image line only the best pair may win; the rest is asked of these few alone.
    best, second = (np.partition(np.vstack([cost, np.full((2, cost.shape[1]), np.inf)]), 1, axis=0))[:2]
    ahead = (cost <= best) & np.isfinite(cost) & (cost + MARGIN <= second)
    chosen = np.array(
        [bool(ahead[i, j]) and _wins(cost, image_lines, (i, j), unit) for i, j in rows.tolist()],
        dtype=np.bool_,
    )
    structure = np.array([cloud_lines[i].label == "structure" for i in rows[:, 0].tolist()], dtype=np.bool_)
    return np.asarray(chosen & (~structure | sharp))


NO_PAIRS = plk.LinePairs(
    np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2))
)
"""The empty set of pairs."""


def _foretold(pairs: plk.LinePairs, camera: CameraModel, T_cam_lidar: Floats, covariance: Floats) -> Floats:
    """Covariance (N,2,2), px^2, of the distances for what is not known of the extrinsic."""
    J = plk.jacobians(pairs, camera.K, T_cam_lidar)
    return np.asarray(J @ covariance @ J.transpose(0, 2, 1))


def _costs(r: Floats, spread: Floats) -> Floats:
    """Twice the negative log likelihood (N,) of each pair, up to a constant; inf beyond the gate."""
    distance = np.einsum("ni,ni->n", r, np.linalg.solve(spread, r[..., None])[..., 0])
    return np.where(distance <= GATE, distance + np.log(np.linalg.det(spread)), np.inf)


def _wins(cost: Floats, image_lines: Sequence[ImageLine], pair: tuple[int, int], unit: float) -> bool:
    """Whether a pair beats every other pair of its cloud line by the margin.

    Pieces of one image line, one behind the other, are no rivals: each shows its part of the cloud line. Of
    image lines that are one and the same the first stands for all.
    """
    i, j = pair
    for other in np.flatnonzero(cost[i] < cost[i, j] + MARGIN).tolist():
        if other == j:
            continue
        gap = _gap(image_lines[j], image_lines[other], unit)
        if gap is None or (gap < 0 and (cost[i, other], other) < (cost[i, j], j)):
            return False
    return True


def _gap(line: ImageLine, other: ImageLine, unit: float) -> float | None:
    """Distance along a line to a piece that continues it, px, negative where they overlap; None if none."""
    along = line.end - line.start
    length = float(np.linalg.norm(along))
    along = along / length
    offset = np.stack([other.start, other.end]) - line.start
    position = np.sort(offset @ along)
    beyond = np.maximum(np.maximum(-(offset @ along), offset @ along - length), 0.0)
    across = np.abs(offset @ np.array([-along[1], along[0]]))
    if (across > SAME_LINE_PX * unit + SAME_LINE_SLOPE * beyond).any():
        return None
    return float(max(position[0] - length, -position[1]))


def pairs_on_overlap(
    cloud_lines: Sequence[CloudLine],
    image_lines: Sequence[ImageLine],
    camera: CameraModel,
    T_cam_lidar: Floats,
) -> tuple[NDArray[np.int64], plk.LinePairs]:
    """Every pair of one class that has enough in common, cut to it, with its covariance (FORMULAS D1).

    The pairs hold the two Gauss nodes of the part in common, on the image line and on the course of the cloud
    line. Positions on the cloud line follow from the projection: 1/depth is linear along the image line. They
    need no more than the gate's accuracy.

    Returns:
        Indices (M,2) of cloud and image line, and the M pairs.
    """
    rows = _comparable(cloud_lines, image_lines)
    enough, pairs = _on_overlap(cloud_lines, image_lines, rows, camera, T_cam_lidar)
    return rows[enough], pairs


def _comparable(cloud_lines: Sequence[CloudLine], image_lines: Sequence[ImageLine]) -> NDArray[np.int64]:
    """Indices (M,2) of the pairs of one class, of the longest lines of one frame."""
    some_cloud = _longest(
        cloud_lines, [abs(a.sigma_m) + abs(a.mean_m or 0.0) for a in cloud_lines], MOST_CLOUD_LINES
    )
    some_image = _longest(image_lines, [b.sigma_px for b in image_lines], MOST_IMAGE_LINES)
    pairs = [(i, j) for i in some_cloud for j in some_image if cloud_lines[i].label == image_lines[j].label]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _on_overlap(
    cloud_lines: Sequence[CloudLine],
    image_lines: Sequence[ImageLine],
    rows: NDArray[np.int64],
    camera: CameraModel,
    T_cam_lidar: Floats,
) -> tuple[NDArray[np.bool_], plk.LinePairs]:
    """Which of the pairs (M,2) have enough in common, and these, cut to it: see :func:`pairs_on_overlap`."""
    if len(rows) == 0:
        return np.zeros(0, dtype=np.bool_), NO_PAIRS
    some_cloud, of_cloud = np.unique(rows[:, 0], return_inverse=True)
    some_image, of_image = np.unique(rows[:, 1], return_inverse=True)
    cloud = _seen_parts([cloud_lines[i] for i in some_cloud.tolist()], camera, T_cam_lidar).take(of_cloud)
    image = [image_lines[j] for j in some_image.tolist()]
    start = np.stack([line.start for line in image])[of_image]
    along = np.stack([line.end for line in image])[of_image] - start
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = along / length
    tau = np.einsum("nki,ni->nk", cloud.uv - start[:, None], along)
    covered = np.column_stack([np.maximum(0.0, tau.min(axis=1)), np.minimum(length[:, 0], tau.max(axis=1))])
    unit = max(1.0, float(camera.K[1, 1]) / REFERENCE_FOCAL_PX)
    shorter = np.minimum(length[:, 0], np.ptp(tau, axis=1))
    common = covered[:, 1] - covered[:, 0]
    enough = cloud.visible & (common >= np.maximum(MIN_OVERLAP_PX * unit, MIN_OVERLAP_SHARE * shorter))
    place = covered @ _NODES.T
    share = (place - tau[:, :1]) / np.where(enough, tau[:, 1] - tau[:, 0], 1.0)[:, None]
    z = 1.0 / ((1 - share) / cloud.depth[:, :1] + share / cloud.depth[:, 1:])
    arm = cloud.first[:, None] + cloud.length[:, None] * share * z / cloud.depth[:, 1:]
    powers = np.stack([np.ones_like(arm), arm, arm**2], axis=2)
    fit = powers @ cloud.course @ powers.transpose(0, 2, 1)
    sigma_px = np.array([line.sigma_px for line in image])[of_image]
    own = place / length
    weight = np.stack([1.0 - own, own], axis=2)
    noise = sigma_px[:, None, None] ** 2 * (weight @ weight.transpose(0, 2, 1)) + (cloud.kappa**2)[
        :, None, None
    ] * (fit + MODEL_M**2) / (z[:, :, None] * z[:, None, :])
    enough &= np.isfinite(noise).all(axis=(1, 2))
    nodes = cloud.mean[:, None] + arm[:, :, None] * cloud.direction[:, None] + powers @ cloud.offset
    pairs = plk.LinePairs(
        nodes[:, 0],
        nodes[:, 1],
        start + place[:, :1] * along,
        start + place[:, 1:] * along,
        noise,
    )
    return enough, plk.select(pairs, enough)


def _longest(lines: Sequence[CloudLine | ImageLine], figures: Sequence[float], most: int) -> list[int]:
    """Indices, in their order, of lines with two ends and a finite figure; of each class the longest."""
    if not lines:
        return []
    ends = np.stack([np.concatenate([line.start, line.end]) for line in lines])
    sound = (np.abs(ends) < OUTERMOST).all(axis=1) & (np.abs(figures) < OUTERMOST)
    first, last = np.split(np.where(sound[:, None], ends, 0.0), 2, axis=1)
    length = np.linalg.norm(last - first, axis=1)
    label = np.array([line.label for line in lines])
    rank = np.zeros(len(lines), dtype=np.int64)
    order = np.argsort(-length, kind="stable")
    for kind in np.unique(label):
        own = order[label[order] == kind]
        rank[own] = np.arange(len(own))
    return np.flatnonzero((length > 0.0) & (rank < most)).tolist()


@dataclass(frozen=True, slots=True, eq=False)
class _SeenParts:
    """The parts of cloud lines in front of the camera, as arrays over N lines.

    Attributes:
        visible: Whether there is such a part.
        uv: (N,2,2), px of its two ends.
        depth: (N,2), m, of its ends.
        first: (N,), m, its first end along the line, from the mean of the line's points.
        length: (N,), m.
        kappa: (N,), px, sensitivity of FORMULAS D1.
        mean: (N,3), m, LiDAR frame, mean of each line's points.
        direction: (N,3), unit.
        offset: (N,3,3), course against the straight line (LineArc).
        course: (N,3,3), its covariance; a straight line has none in the third place.
    """

    visible: NDArray[np.bool_]
    uv: Floats
    depth: Floats
    first: Floats
    length: Floats
    kappa: Floats
    mean: Floats
    direction: Floats
    offset: Floats
    course: Floats

    def take(self, index: NDArray[np.int64]) -> "_SeenParts":
        return _SeenParts(*(getattr(self, part.name)[index] for part in fields(self)))


def _seen_parts(lines: Sequence[CloudLine], camera: CameraModel, T_cam_lidar: Floats) -> _SeenParts:
    start, end = np.stack([line.start for line in lines]), np.stack([line.end for line in lines])
    direction = (end - start) / np.maximum(np.linalg.norm(end - start, axis=1), 1e-9)[:, None]
    ends = np.stack([start, end], axis=1) @ T_cam_lidar[:3, :3].T + T_cam_lidar[:3, 3]
    span = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(span, axis=1)
    near = ends[:, :, 2] < MIN_DEPTH_M
    visible = ~near.all(axis=1) & (length > MIN_DEPTH_M / 2)
    # Share of the way from start to end where the depth limit cuts the line.
    rise = np.where(near.any(axis=1) & visible, span[:, 2], 1.0)
    limit = (MIN_DEPTH_M - ends[:, 0, 2]) / rise
    cut = np.where(near & visible[:, None], limit[:, None], [0.0, 1.0])
    ends = ends[:, :1] + cut[:, :, None] * span[:, None]
    depth = np.where(visible[:, None], ends[:, :, 2], 1.0)
    uv = (ends @ camera.K.T)[:, :, :2] / depth[:, :, None]
    n_cam = np.cross(ends[:, 0], ends[:, 1])
    mean = np.array(
        [
            0.5 * reach if line.mean_m is None else line.mean_m
            for line, reach in zip(lines, length, strict=True)
        ]
    )
    return _SeenParts(
        visible,
        uv,
        depth,
        cut[:, 0] * length - mean,
        (cut[:, 1] - cut[:, 0]) * length,
        plk.line_sensitivity(n_cam, camera.K),
        start + mean[:, None] * direction,
        direction,
        np.stack([np.zeros((3, 3)) if line.arc is None else line.arc.offset for line in lines]),
        np.stack([_straight(line) if line.arc is None else line.arc.covariance for line in lines]),
    )


def _straight(line: CloudLine) -> Floats:
    """Covariance (3,3) of a straight line's course: 1/m and 1/S of FORMULAS D1."""
    return np.diag([1.0 / max(len(line.points), 1), 1.0 / max(line.spread, 1e-9), 0.0]) * line.sigma_m**2
