"""Which image line shows which cloud line, under what is believed of the extrinsic.

A pair is judged by the distances of the image line's ends from the projected cloud line against their
covariance: noise of both lines (FORMULAS D1) and the uncertainty of the extrinsic. What is ambiguous is
dropped: a missing line widens the answer, a wrong one bends it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import plk, se3
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
SAME_LINE_PX = 2.0
"""px; an image line this near to the continuation of another is a piece of it and no rival."""
SAME_LINE_SLOPE = 0.05
"""px per px beyond its end: roads bend by some 3 deg over the length of a piece."""
MODEL_M = 0.015
"""m; paint's bright middle and its painted middle differ, poles taper: common to all points of a line."""


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
    rows: list[tuple[int, int]] = []
    candidates: list[plk.LinePairs] = []
    for i, cloud in enumerate(cloud_lines):
        for j, image in enumerate(image_lines):
            pair = pair_on_overlap(cloud, image, camera, T_cam_lidar) if cloud.label == image.label else None
            if pair is not None:
                rows.append((i, j))
                candidates.append(pair)
    cost = np.full((len(cloud_lines), len(image_lines)), np.inf)
    if candidates:
        for (i, j), value in zip(
            rows, _costs(plk.stack(candidates), camera, T_cam_lidar, covariance), strict=True
        ):
            cost[i, j] = value
    unit = max(1.0, float(camera.K[1, 1]) / REFERENCE_FOCAL_PX)
    chosen = [
        k
        for k, (i, j) in enumerate(rows)
        if np.isfinite(cost[i, j]) and _wins(cost, image_lines, (i, j), unit)
    ]
    matches = tuple(LineMatch(cloud_lines[rows[k][0]], image_lines[rows[k][1]]) for k in chosen)
    return Association(matches, plk.stack([candidates[k] for k in chosen]) if chosen else NO_PAIRS)


NO_PAIRS = plk.LinePairs(
    np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2, 2))
)
"""The empty set of pairs."""


def _costs(pairs: plk.LinePairs, camera: CameraModel, T_cam_lidar: Floats, covariance: Floats) -> Floats:
    """Twice the negative log likelihood (N,) of each pair, up to a constant; inf beyond the gate."""
    r = plk.residuals(pairs, camera.K, T_cam_lidar)
    J = plk.jacobians(pairs, camera.K, T_cam_lidar)
    spread = pairs.covariance + J @ covariance @ J.transpose(0, 2, 1)
    distance = np.einsum("ni,ni->n", r, np.linalg.solve(spread, r[..., None])[..., 0])
    return np.where(distance <= GATE, distance + np.log(np.linalg.det(spread)), np.inf)


def _wins(cost: Floats, image_lines: Sequence[ImageLine], pair: tuple[int, int], unit: float) -> bool:
    """Whether a pair beats every other pair of its cloud line and of its image line by the margin.

    Pieces of one image line, one behind the other, are no rivals: each shows its part of the cloud line.
    """
    i, j = pair
    beaten = cost[i, j] + MARGIN
    if (np.delete(cost[:, j], i) < beaten).any():
        return False
    for other in np.flatnonzero(cost[i] < beaten).tolist():
        if other == j:
            continue
        gap = _gap(image_lines[j], image_lines[other], unit)
        if gap is None or (gap < 0 and cost[i, other] < cost[i, j]):
            return False
    return True


def _gap(line: ImageLine, other: ImageLine, unit: float) -> float | None:
    """Distance along a line to a piece that continues it, px, negative where they overlap; None if it is none."""
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


def pair_on_overlap(
    cloud: CloudLine, image: ImageLine, camera: CameraModel, T_cam_lidar: Floats
) -> plk.LinePairs | None:
    """One pair, cut to the part of the image line that the cloud line covers, with its covariance (D1).

    Positions of the image ends on the cloud line follow from the projection: 1/depth is linear along the
    image line. They need no more than the gate's accuracy.

    Returns:
        The pair, or None where the two have too little in common.
    """
    ends = se3.apply(T_cam_lidar, np.stack([cloud.start, cloud.end]))
    length = float(np.linalg.norm(ends[1] - ends[0]))
    depth = ends[:, 2]
    if depth.max() <= MIN_DEPTH_M or length < MIN_DEPTH_M / 2:
        return None
    # Share of the way from start to end where the depth limit cuts the line.
    cut = np.array([0.0, 1.0])
    for k in np.flatnonzero(depth < MIN_DEPTH_M):
        cut[k] = (MIN_DEPTH_M - depth[0]) / (depth[1] - depth[0])
    ends = ends[0] + cut[:, None] * (ends[1] - ends[0])
    uv = ends @ camera.K.T
    uv = uv[:, :2] / uv[:, 2:]
    along = image.end - image.start
    image_length = float(np.linalg.norm(along))
    along = along / image_length
    tau = (uv - image.start) @ along
    covered = np.array([max(0.0, float(tau.min())), min(image_length, float(tau.max()))])
    unit = max(1.0, float(camera.K[1, 1]) / REFERENCE_FOCAL_PX)
    common = float(covered[1] - covered[0])
    if common < max(MIN_OVERLAP_PX * unit, MIN_OVERLAP_SHARE * min(image_length, float(np.ptp(tau)))):
        return None
    share = (covered - tau[0]) / (tau[1] - tau[0])
    z = 1.0 / ((1 - share) / ends[0, 2] + share / ends[1, 2])
    position = length * (cut[0] + (cut[1] - cut[0]) * share * z / ends[1, 2])
    middle = 0.5 * length if cloud.mean_m is None else cloud.mean_m
    arm = position - middle
    n_cam, _ = plk.plucker(ends[:1], ends[1:])
    kappa = float(plk.line_sensitivity(n_cam, camera.K)[0])
    fit = cloud.sigma_m**2 * (1.0 / len(cloud.points) + np.outer(arm, arm) / max(cloud.spread, 1e-9))
    noise = image.sigma_px**2 * np.eye(2) + kappa**2 * (fit + MODEL_M**2) / np.outer(z, z)
    seen = image.start + covered[:, None] * along
    if not math.isfinite(float(noise.sum())):
        return None
    return plk.LinePairs(cloud.start[None], cloud.end[None], seen[:1], seen[1:], noise[None])
