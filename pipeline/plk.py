"""Extrinsics from matched 3-D and image lines: PLK-Calib methods I and II, corrected (FORMULAS C, D).

Method I minimises the distances of the image lines' ends from the projected cloud lines over all six degrees
of freedom; it is the maximum-likelihood answer. Method II finds the rotation from directions and the
translation linearly after it; it needs no good start and serves as one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from pipeline import se3
from pipeline.records import Floats

HUBER = 2.5
"""Whitened distance of a line beyond which its weight falls: 96 % of good lines (Rayleigh) keep weight 1."""

STEP_SCALE = np.array([0.01] * 3 + [0.1] * 3)
"""rad and m; makes the steps of the solvers comparable: 1 cm of sight at 1 m, 10 cm at 10 m."""

_MAX_STEPS = 60
_CONVERGED = 1e-10
"""Step in units of STEP_SCALE below which the solvers stop."""

_MIN_DAMPING = 1e-10
"""Relative to the largest curvature: keeps null directions where they are, slows no observed one."""

_NULL = 1e-9
"""Curvature over the largest below which a direction is not seen at all (FORMULAS D3)."""

_NO_FREEDOM = 1e-6
"""Degrees of freedom; what is left by rounding."""

_BY_CHANCE = 1e-3
"""Chance that planes with a common ray seem to have none; their answer is then judged by its cost alone."""

_ROUNDING_PX = 1e-6
"""px; no end distance is known better: it makes the weights of noiseless lines finite."""

_MAX_DAMPING = 1e6
"""Times the largest curvature: a step so small that does not lower the cost is rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class LinePairs:
    """Matched lines as arrays, restricted to what image and cloud both see of them.

    Attributes:
        start: float64 (N,3), metres, LiDAR frame: one end of each cloud line.
        end: float64 (N,3), the other end.
        image_start: float64 (N,2), px of the ideal image.
        image_end: float64 (N,2), likewise.
        covariance: float64 (N,2,2), px^2, of the two end distances (S_n of FORMULAS D1).
    """

    start: Floats
    end: Floats
    image_start: Floats
    image_end: Floats
    covariance: Floats

    def __len__(self) -> int:
        return len(self.start)


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """A Gaussian belief about the extrinsic.

    Attributes:
        T_cam_lidar: float64 (4,4), its mean.
        precision: float64 (6,6), inverse covariance of (phi, rho) against the mean.
    """

    T_cam_lidar: Floats
    precision: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Result of method I.

    Attributes:
        T_cam_lidar: float64 (4,4).
        information: float64 (6,6), of (phi, rho) at the solution, from the lines alone (FORMULAS D2).
        gradient: float64 (6,), of the lines alone at the solution, -sum J^T S^-1 r; zero without a prior.
        distances: float64 (N,), whitened distance of each line.
        freedom: Measured distances less the freedoms that they, not the prior, decided.
        chi2: Squared whitened distances, Huber weighted, per degree of freedom; 1 where none is to spare.
    """

    T_cam_lidar: Floats
    information: Floats
    gradient: Floats
    distances: Floats
    freedom: float
    chi2: float


def stack(parts: Sequence[LinePairs]) -> LinePairs:
    """All lines of several frames as one set."""
    return LinePairs(
        np.concatenate([part.start for part in parts]),
        np.concatenate([part.end for part in parts]),
        np.concatenate([part.image_start for part in parts]),
        np.concatenate([part.image_end for part in parts]),
        np.concatenate([part.covariance for part in parts]),
    )


def select(pairs: LinePairs, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> LinePairs:
    """The pairs for which ``chosen`` (N,) holds, or those with these indices."""
    return LinePairs(
        pairs.start[chosen],
        pairs.end[chosen],
        pairs.image_start[chosen],
        pairs.image_end[chosen],
        pairs.covariance[chosen],
    )


def whitening(pairs: LinePairs) -> Floats:
    """Matrices W (N,2,2), 1/px, that give end distances unit covariance: ``W S_n W^T = I``."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(pairs.covariance + _ROUNDING_PX**2 * np.eye(2))))


def line_matrix(K: Floats) -> Floats:
    """K_line = det(K) K^-T, which maps plane normals to image lines (PLK (3))."""
    return np.asarray(np.linalg.det(K) * np.linalg.inv(K).T)


def plucker(start: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Moments and unit directions (N,3) of lines through points (N,3), (N,3) (PLK (1), both normalised)."""
    span = end - start
    length = np.linalg.norm(span, axis=1, keepdims=True)
    return _crossed(start, end, np.empty_like(span)) / length, span / length


def _in_camera(pairs: LinePairs, T_cam_lidar: Floats) -> tuple[Floats, Floats]:
    """Moments and directions (N,3) in the camera frame (PLK (2))."""
    n, v = plucker(pairs.start, pairs.end)
    R, t = T_cam_lidar[:3, :3], T_cam_lidar[:3, 3]
    v_cam = v @ R.T
    return n @ R.T + _crossed(t, v_cam, np.empty_like(v_cam)), v_cam


def residuals(pairs: LinePairs, K: Floats, T_cam_lidar: Floats) -> Floats:
    """Distances (N,2), px, signed, of both image ends from the projected line (PLK (4), corrected)."""
    n_cam, _ = _in_camera(pairs, T_cam_lidar)
    line = n_cam @ line_matrix(K).T
    norm = np.hypot(line[:, 0], line[:, 1])
    return np.asarray(np.einsum("nki,ni->nk", _ends(pairs), line) / norm[:, None])


def jacobians(pairs: LinePairs, K: Floats, T_cam_lidar: Floats) -> Floats:
    """Derivative (N,2,6) of the residuals by (phi, rho): PLK (6), signs of the left perturbation."""
    return _distances(pairs, K, T_cam_lidar)[1]


def _distances(pairs: LinePairs, K: Floats, T_cam_lidar: Floats) -> tuple[Floats, Floats]:
    """The residuals (N,2) and their derivative (N,2,6)."""
    n_cam, v_cam = _in_camera(pairs, T_cam_lidar)
    K_line = line_matrix(K)
    line = n_cam @ K_line.T
    norm = np.hypot(line[:, 0], line[:, 1])
    flat = line * [1.0, 1.0, 0.0]
    ends = _ends(pairs)
    product = np.einsum("nki,ni->nk", ends, line)
    d_line = (ends - (product / norm[:, None] ** 2)[:, :, None] * flat[:, None, :]) / norm[:, None, None]
    d_normal = d_line @ K_line
    slopes = np.empty((len(line), 2, 6))
    # -a^T [n] = (n x a)^T for each row a.
    _crossed(n_cam[:, None, :], d_normal, slopes[:, :, :3])
    _crossed(v_cam[:, None, :], d_normal, slopes[:, :, 3:])
    return product / norm[:, None], slopes


def _crossed(a: Floats, b: Floats, out: Floats) -> Floats:
    """``a x b`` along the last axis into ``out``: for few lines a fraction of what ``np.cross`` takes."""
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[..., k] = a[..., i] * b[..., j] - a[..., j] * b[..., i]
    return out


def _ends(pairs: LinePairs) -> Floats:
    """Both ends of the image lines, homogeneous, (N,2,3)."""
    ends = np.ones((len(pairs), 2, 3))
    ends[:, 0, :2] = pairs.image_start
    ends[:, 1, :2] = pairs.image_end
    return ends


def _homogeneous(uv: Floats) -> Floats:
    return np.column_stack([uv, np.ones(len(uv))])


def plane_normals(pairs: LinePairs, K: Floats) -> Floats:
    """Unit normals (N,3), camera frame, of the planes through camera and image lines: K^T l' (PLK (7))."""
    line = np.cross(_homogeneous(pairs.image_start), _homogeneous(pairs.image_end))
    normal = line @ K
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def method_two(pairs: LinePairs, K: Floats, T_start: Floats) -> Floats | None:
    """PLK-Calib method II: rotation from directions, then translation linearly (FORMULAS C (10)-(14), C7).

    Both stages ask that the line in the camera's axes, PLK (8), lies in the plane of its image, PLK (9): its
    direction for the rotation, its distance from the camera for the translation.

    Stage 1 minimises the weighted sines ``n'^T R v``; stage 2 solves ``n'.t = -n'.(R p_m)``, the scalar form,
    since the printed matrix form is biased.

    Args:
        pairs: At least three lines.
        K: float64 (3,3), px.
        T_start: Where the rotation starts and the weights are taken.

    Returns:
        The extrinsic, or None where directions or planes leave a freedom (parallel or concurrent lines).
    """
    if len(pairs) < 3:
        return None
    R = rotation_from_directions(pairs, K, T_start)
    if R is None:
        return None
    t = translation_from_planes(pairs, K, R, T_start)
    return None if t is None else se3.transform(R, t)


def rotation_from_directions(pairs: LinePairs, K: Floats, T_start: Floats) -> Floats | None:
    """Stage 1 of method II: rotation (3,3) by the weighted sines ``n'^T R v`` (FORMULAS C (10)-(13), C7).

    The sine is PLK (10) and PLK (11), their sum of squares PLK (12), its derivative PLK (13), corrected.
    None where the directions leave a freedom: parallel lines, or fewer than three.
    """
    normal = plane_normals(pairs, K)
    _, v = plucker(pairs.start, pairs.end)
    sigma_sine, _ = _stage_sigmas(pairs, K, T_start)
    R = T_start[:3, :3]
    for _ in range(_MAX_STEPS):
        v_cam = v @ R.T
        J = np.cross(v_cam, normal) / sigma_sine[:, None]
        r = np.einsum("ni,ni->n", normal, v_cam) / sigma_sine
        H = J.T @ J
        spectrum = np.linalg.eigvalsh(H)
        if spectrum[0] < 1e-9 * spectrum[2]:
            return None
        phi = -np.linalg.solve(H, J.T @ r)
        # The sine is not linear over more than half a radian; a longer step overshoots.
        phi *= min(1.0, 0.5 / max(float(np.linalg.norm(phi)), 1e-12))
        R = se3.exp_so3(phi) @ R
        if np.abs(phi).max() < _CONVERGED:
            break
    return se3.orthonormalised(R)


def translation_from_planes(pairs: LinePairs, K: Floats, R: Floats, T_start: Floats) -> Floats | None:
    """Stage 2 of method II: translation (3,) by ``n'.t = -n'.(R p_m)``, PLK (14) in its scalar form.

    The printed matrix form is biased (FORMULAS C (14)).
    The weights are taken at ``T_start``. None where the planes leave a freedom: all share a ray, as far as
    the noise of the image tells.
    """
    normal = plane_normals(pairs, K)
    _, sigma_offset = _stage_sigmas(pairs, K, T_start)
    A = normal / sigma_offset[:, None]
    if _share_a_ray(pairs, K, np.linalg.svd(A)[2][2]):
        return None
    middle = 0.5 * (pairs.start + pairs.end) @ R.T
    b = -np.einsum("ni,ni->n", normal, middle) / sigma_offset
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0])


def _share_a_ray(pairs: LinePairs, K: Floats, ray: Floats) -> bool:
    """Whether the distances of ``ray`` (3,) from all planes may be noise of the image lines.

    Noise gives planes that do share a ray a full rank, and the linear solution then puts the camera on the
    point that all lines have in common, where every residual is small.
    """
    first, last = _homogeneous(pairs.image_start), _homogeneous(pairs.image_end)
    seen = K @ ray
    # The distance is the triple product (first, last, seen) but for a factor that divides out.
    distance = np.cross(first, last) @ seen
    slopes = np.concatenate([np.cross(last, seen)[:, :2], np.cross(seen, first)[:, :2]], axis=1)
    variance = _variance(pairs) * (slopes**2).sum(axis=1)
    statistic = float((distance**2 / np.maximum(variance, 1e-300)).sum())
    return statistic <= float(chdtri(len(pairs) - 2, _BY_CHANCE))


def _stage_sigmas(pairs: LinePairs, K: Floats, T_cam_lidar: Floats) -> tuple[Floats, Floats]:
    """Sigmas (N,) of the two stages' residuals: sine (FORMULAS C7) and offset in metres (C (14))."""
    n_cam, _ = _in_camera(pairs, T_cam_lidar)
    kappa = line_sensitivity(n_cam, K)
    R, t = T_cam_lidar[2, :3], T_cam_lidar[2, 3]
    # Only the weights: a depth that the start puts behind the camera counts as near.
    depth = np.hypot(np.maximum(pairs.start @ R + t, 0.1), np.maximum(pairs.end @ R + t, 0.1))
    length = np.linalg.norm(pairs.end - pairs.start, axis=1)
    sigma_px = np.sqrt(_variance(pairs))
    return sigma_px * depth / (kappa * length), sigma_px * depth / (2 * kappa)


def _variance(pairs: LinePairs) -> Floats:
    """Mean variance (N,) of the two ends of each line, px^2."""
    return np.asarray(np.trace(pairs.covariance, axis1=1, axis2=2) / 2 + _ROUNDING_PX**2)


def line_sensitivity(n_cam: Floats, K: Floats) -> Floats:
    """Sensitivity kappa (N,), px: moving a point at depth z by d moves the line by kappa d / z (D1)."""
    line = n_cam @ line_matrix(K).T
    return np.asarray(
        np.linalg.det(K) * np.linalg.norm(n_cam, axis=1) / np.maximum(np.hypot(line[:, 0], line[:, 1]), 1e-12)
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations of method I at one extrinsic."""

    cost: float
    information: Floats
    gradient: Floats
    distances: Floats


def _linearise(pairs: LinePairs, white: Floats, K: Floats, T_cam_lidar: Floats) -> _Normal:
    """Robust cost (PLK (5), squared and weighted), information and gradient (FORMULAS D2)."""
    distances, slopes = _distances(pairs, K, T_cam_lidar)
    r = np.einsum("nij,nj->ni", white, distances)
    distance = np.hypot(r[:, 0], r[:, 1])
    weight = np.minimum(1.0, HUBER / np.maximum(distance, 1e-12))
    cost = np.where(distance <= HUBER, 0.5 * distance**2, HUBER * (distance - 0.5 * HUBER)).sum()
    root = np.sqrt(weight)[:, None]
    J = ((root[:, :, None] * white) @ slopes).reshape(-1, 6)
    information = J.T @ J
    gradient = -(root * r).reshape(-1) @ J
    return _Normal(float(cost), information, gradient, distance)


def method_one(
    pairs: LinePairs, K: Floats, T_start: Floats, *, prior: Prior | None = None, start_two: bool = True
) -> Solution:
    """PLK-Calib method I: Levenberg-Marquardt with a Huber loss on the end distances (PLK (5), corrected).

    Args:
        pairs: The matched lines; directions that they leave free stay where the start or the prior puts them.
        K: float64 (3,3), px.
        T_start: Where to start.
        prior: Belief that takes part in the cost, but not in the information that is returned.
        start_two: Also try the answer of method II as a start; the cheaper of the two is taken.

    Returns:
        The extrinsic with the information of the lines alone.
    """
    white = whitening(pairs)

    def total(T: Floats) -> tuple[_Normal, float, Floats, Floats]:
        lines = _linearise(pairs, white, K, T)
        if prior is None:
            return lines, lines.cost, lines.information, lines.gradient
        xi = se3.local(prior.T_cam_lidar, T)
        pull = prior.precision @ xi
        return (
            lines,
            lines.cost + 0.5 * float(xi @ pull),
            lines.information + prior.precision,
            (lines.gradient - pull),
        )

    T, at = T_start, total(T_start)
    two = method_two(pairs, K, T_start) if start_two else None
    if two is not None and (candidate := total(two))[1] < at[1]:
        T, at = two, candidate
    damping = 1e-3
    for _ in range(_MAX_STEPS):
        H = at[2] * np.outer(STEP_SCALE, STEP_SCALE)
        top = max(float(np.diag(H).max()), 1e-12)
        step = np.linalg.solve(H + damping * top * np.eye(6), at[3] * STEP_SCALE)
        T_next = se3.retract(T, step * STEP_SCALE)
        candidate = total(T_next)
        if candidate[1] <= at[1]:
            T, at = T_next, candidate
            damping = max(damping / 10, _MIN_DAMPING)
        else:
            damping *= 10
        if np.abs(step).max() < _CONVERGED or damping > _MAX_DAMPING:
            break
    T = se3.transform(se3.orthonormalised(T[:3, :3]), T[:3, 3])
    lines = at[0]
    loss = np.minimum(lines.distances, HUBER) * lines.distances
    scale = np.outer(STEP_SCALE, STEP_SCALE)
    decided = np.trace(
        np.linalg.pinv(at[2] * scale, rcond=_NULL, hermitian=True) @ (lines.information * scale)
    )
    freedom = 2 * len(pairs) - float(decided)
    chi2 = float(loss.sum()) / freedom if freedom > _NO_FREEDOM else 1.0
    return Solution(T, lines.information, lines.gradient, lines.distances, freedom, chi2)
