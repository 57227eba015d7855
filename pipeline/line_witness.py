"""The line witness: lane lines and poles of a window of frames, matched and solved for the extrinsic."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import plk, se3
from pipeline.association import NO_PAIRS, Association, associate
from pipeline.cameras import undistort
from pipeline.cloud_lanes import find_lanes
from pipeline.cloud_poles import find_poles
from pipeline.ground import Ground, fit_ground
from pipeline.image_lines import find_image_lines
from pipeline.line_arcs import with_arc
from pipeline.records import (
    CameraImage,
    CameraModel,
    CloudLine,
    Floats,
    ImageLine,
    LineMatch,
    Masks,
    PointCloud,
    WitnessEstimate,
)

PRIOR_SIGMA = np.array([np.radians(1.0)] * 3 + [0.15] * 3)
"""rad and m; how far a mount may have moved and its lines still be told apart: twice the alert limits."""
HELD_SIGMAS = 3.0
"""Prior sigmas; a direction that the lines know worse than this is left to the stored extrinsic."""
FLOOR_SIGMA = np.array([np.radians(0.1)] * 3 + [0.03] * 3)
"""rad and m; lines are matched again at least this wide: what the noise model does not know of."""
ROUNDS = 3
"""Matching and solving in turn; the pairs no longer change after the second on simulated streets."""
MIN_FREEDOM = 0.5
"""Distances measured beyond those that the answer needs; without any a wrong pair looks like drift."""
FRAME_CORRELATION = 0.5
"""Correlation of the errors of neighbouring frames (FORMULAS F1): 10 frames of a street are worth some 4."""
VIEW_MARGIN = 0.1
"""Share of the field of view around the image searched for cloud lines: more than the prior moves them."""
MIN_DEPTH_M = 1.0
"""m; nearer points are the vehicle's own."""


@dataclass(frozen=True, slots=True, eq=False)
class LineFrame:
    """Lines of one frame.

    Attributes:
        cloud_lines: In the LiDAR frame; lane lines run along ``forward``, poles from foot to top.
        image_lines: In ideal px.
        reasons: Why a kind of line could not be looked for; empty where all could.
    """

    cloud_lines: tuple[CloudLine, ...]
    image_lines: tuple[ImageLine, ...]
    reasons: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class LineSolution:
    """What the lines of a window say.

    Attributes:
        estimate: Against the stored extrinsic; information zero where nothing was matched.
        matches: Per frame, the pairs that took part.
    """

    estimate: WitnessEstimate
    matches: tuple[tuple[LineMatch, ...], ...]


def find_lines(
    cloud: PointCloud,
    image: CameraImage,
    masks: Masks,
    camera: CameraModel,
    T_cam_lidar: Floats,
    *,
    up: Floats,
    forward: Floats,
    rng: np.random.Generator,
    ground: Ground | None = None,
) -> LineFrame:
    """Finds lane lines and poles in the cloud, around the camera's view, and in the image.

    Args:
        cloud: The sweep.
        image: The image.
        masks: Lane and pole masks of the image.
        camera: Intrinsics.
        T_cam_lidar: float64 (4,4), the stored extrinsic: it only decides which points are looked at.
        up: float64 (3,), unit, LiDAR frame.
        forward: float64 (3,), unit, LiDAR frame.
        rng: For the plane and the lines.
        ground: The ground plane of this very sweep where it was fitted before; else it is fitted here.

    Returns:
        The lines, and the reasons where there can be none.
    """
    reasons = []
    lines: list[CloudLine] = []
    if ground is None:
        ground = fit_ground(cloud, up, rng)
    if ground is None:
        reasons.append("no ground plane in the cloud")
    else:
        seen = in_view(cloud, camera, T_cam_lidar)
        if cloud.intensity is None:
            reasons.append("no lane lines in a cloud without intensity")
        lanes = find_lanes(cloud, ground, seen, rng)
        lines += [with_arc(_along(line, forward), cloud) for line in lanes]
        lines += find_poles(cloud, ground, seen)
    return LineFrame(tuple(lines), tuple(find_image_lines(image, masks, camera)), tuple(reasons))


def _along(line: CloudLine, direction: Floats) -> CloudLine:
    """The same line, its ends ordered along a direction (3,)."""
    if (line.end - line.start) @ direction >= 0:
        return line
    length = float(np.linalg.norm(line.end - line.start))
    mean_m = None if line.mean_m is None else length - line.mean_m
    return CloudLine(line.label, line.end, line.start, line.points, line.sigma_m, line.spread, mean_m)


def in_view(cloud: PointCloud, camera: CameraModel, T_cam_lidar: Floats) -> NDArray[np.bool_]:
    """Points (N,) in front of the camera and inside its field of view with a margin."""
    u, v = np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9)
    border = np.concatenate(
        [np.column_stack([u, np.full(9, e)]) for e in (0, camera.height - 1)]
        + [np.column_stack([np.full(9, e), v]) for e in (0, camera.width - 1)]
    ).astype(np.float64)
    rays = undistort(camera, border)
    rays = rays[np.isfinite(rays).all(axis=1)]
    if len(rays) == 0:
        return np.ones(len(cloud), dtype=bool)
    low, high = rays.min(axis=0), rays.max(axis=0)
    margin = VIEW_MARGIN * (high - low)
    low, high = (low - margin).astype(np.float32), (high + margin).astype(np.float32)
    T = T_cam_lidar.astype(np.float32)
    x, y, z = (T[:3, :3] @ cloud.xyz.T) + T[:3, 3:]
    inside = (z > MIN_DEPTH_M) & (x > low[0] * z) & (x < high[0] * z) & (y > low[1] * z) & (y < high[1] * z)
    return np.asarray(inside)


def solve_lines(frames: Sequence[LineFrame], camera: CameraModel, T_stored: Floats) -> LineSolution:
    """One extrinsic from the lines of all frames of a window.

    Matching and solving take turns, from the prior around the stored extrinsic to the posterior of the
    solution. The prior keeps unobserved directions in place while solving; its pull is taken out of the
    answer again, linearised at the solution. The same pole in 20 frames is not 20 poles: the information is
    that of ``effective_frames`` frames, divided by chi2 where residuals exceed their model, and by
    a little more where chi2 itself rests on few lines.

    Args:
        frames: Lines of each frame.
        camera: Intrinsics.
        T_stored: float64 (4,4), the stored extrinsic.

    Returns:
        The estimate and the pairs; nothing matched, or no pair more than needed to check the others, gives no
        information and no features.
    """
    prior = plk.Prior(T_stored, np.diag(PRIOR_SIGMA**-2.0))
    T, covariance = T_stored, np.diag(PRIOR_SIGMA**2)
    result = LineSolution(_nothing(), tuple(() for _ in frames))
    for _ in range(ROUNDS):
        found = [associate(frame.cloud_lines, frame.image_lines, camera, T, covariance) for frame in frames]
        pairs = plk.stack([part.pairs for part in found] or [NO_PAIRS])
        if len(pairs) == 0:
            return LineSolution(_nothing(), tuple(() for _ in frames))
        solution = plk.method_one(pairs, camera.K, T, prior=prior)
        result = LineSolution(_estimate(solution, found, T_stored), tuple(part.matches for part in found))
        T = solution.T_cam_lidar
        worth = _worth(found, solution)
        covariance = np.linalg.inv(worth * solution.information + prior.precision) + np.diag(FLOOR_SIGMA**2)
    return result


def effective_frames(count: int) -> float:
    """Independent frames that ``count`` correlated ones are worth (FORMULAS F1, exact at any length)."""
    lag = np.arange(1, count)
    return count / (1.0 + 2.0 * float(((1.0 - lag / count) * FRAME_CORRELATION**lag).sum()))


def _worth(found: Sequence[Association], solution: plk.Solution) -> float:
    """Factor on the information: effective over counted frames, over the misfit and the doubt about it.

    A misfit judged by n degrees of freedom is itself known to sqrt(2 / n) only: the answer's tails are those
    of Student's t, whose variance is larger by 1 + 2 / n to first order.
    """
    count = sum(1 for part in found if part.matches)
    doubt = 1.0 + 2.0 / max(solution.freedom, MIN_FREEDOM)
    return effective_frames(count) / count / max(1.0, solution.chi2) / doubt


def _nothing() -> WitnessEstimate:
    return WitnessEstimate("lines", np.zeros(6), np.zeros((6, 6)), 0, 0, 1.0)


def _estimate(solution: plk.Solution, found: Sequence[Association], T_stored: Floats) -> WitnessEstimate:
    """The lines' own answer: prior taken out, directions held that they do not know (FORMULAS D3)."""
    scale = np.outer(PRIOR_SIGMA, PRIOR_SIGMA)
    worth = _worth(found, solution)
    values, V = np.linalg.eigh(worth * solution.information * scale)
    known = values >= HELD_SIGMAS**-2.0
    if solution.freedom < MIN_FREEDOM or not known.any():
        return _nothing()
    values, V = values[known], V[:, known]
    xi_map = se3.local(T_stored, solution.T_cam_lidar)
    pull = worth * (solution.information @ xi_map + solution.gradient) * PRIOR_SIGMA
    xi = PRIOR_SIGMA * (V @ ((V.T @ pull) / values))
    information = (V * values) @ V.T / scale
    return WitnessEstimate(
        "lines",
        xi,
        0.5 * (information + information.T),
        sum(1 for part in found if part.matches),
        sum(len(part.matches) for part in found),
        solution.chi2,
    )
