"""What a drift does to perception: how far points land from their pixels, and things from their places."""

from dataclasses import dataclass

import numpy as np

from pipeline import se3
from pipeline.cameras import project_unbounded, undistort
from pipeline.records import CameraModel, Floats

RANGES_M = (10.0, 30.0, 80.0)
"""m; a pedestrian ahead in town, the next car, and the braking distance on a fast road."""

_COLUMNS, _ROWS = 9, 5
"""Places of the image over which the worst is sought: smooth fields are largest at the border."""

_DIFFERENCE = 1e-6
"""rad and m; step of the differences that carry the covariance over."""


@dataclass(frozen=True, slots=True)
class AtRange:
    """Consequence of a drift at one distance from the camera. NaN where nothing projects.

    Attributes:
        range_m: The distance, m.
        shift_px: How far a point on the optical axis moves in the image, px.
        sigma_px: Standard deviation of that place, in the direction in which it is largest, px.
        worst_px: The largest move of a point at this distance anywhere in the image, px: a roll shows only
            away from the axis.
        left_m: How far left of where the stored extrinsic puts it a thing seen on the optical axis stands, as
            the camera looks, m: ``left + range * yaw`` for a camera that looks ahead.
        sigma_left_m: Its standard deviation.
        up_m: How far above, likewise, m: ``up - range * pitch``.
        sigma_up_m: Its standard deviation.
    """

    range_m: float
    shift_px: float
    sigma_px: float
    worst_px: float
    left_m: float
    sigma_left_m: float
    up_m: float
    sigma_up_m: float


def consequences(
    camera: CameraModel, R_vehicle_cam: Floats, drift: Floats, covariance: Floats
) -> tuple[AtRange, ...]:
    """Consequence of a drift at each of ``RANGES_M``.

    Args:
        camera: Intrinsics.
        R_vehicle_cam: float64 (3,3), turns camera axes into vehicle axes.
        drift: float64 (6,), motion of the mount in vehicle axes, rad and m (FORMULAS A4).
        covariance: float64 (6,6), of the drift.
    """
    rays = _rays(camera)
    return tuple(_at(camera, R_vehicle_cam, (drift, covariance), rays, range_m) for range_m in RANGES_M)


def _at(
    camera: CameraModel, R_vehicle_cam: Floats, belief: tuple[Floats, Floats], rays: Floats, range_m: float
) -> AtRange:
    drift, covariance = belief
    T = _moved(drift, R_vehicle_cam)
    steps = _DIFFERENCE * np.eye(6)
    slopes = [
        (
            _told(camera, _moved(drift + step, R_vehicle_cam), range_m)
            - _told(camera, _moved(drift - step, R_vehicle_cam), range_m)
        )
        / (2.0 * _DIFFERENCE)
        for step in steps
    ]
    J = np.array(slopes).T
    C = J @ covariance @ J.T
    du, dv, left, up = _told(camera, T, range_m)
    # A symmetric 2x2 matrix by hand: LAPACK refuses NaN.
    mean, half = 0.5 * (C[0, 0] + C[1, 1]), 0.5 * (C[0, 0] - C[1, 1])
    return AtRange(
        range_m=range_m,
        shift_px=float(np.hypot(du, dv)),
        sigma_px=float(np.sqrt(mean + np.hypot(half, C[0, 1]))),
        worst_px=_worst(camera, T, rays * range_m),
        left_m=float(left),
        sigma_left_m=float(np.sqrt(C[2, 2])),
        up_m=float(up),
        sigma_up_m=float(np.sqrt(C[3, 3])),
    )


def _moved(drift: Floats, R_vehicle_cam: Floats) -> Floats:
    """``T_now T_reference^-1`` (4,4): points as the camera saw them to where it sees them after the drift."""
    return se3.displaced(np.eye(4), drift, R_vehicle_cam)


def _told(camera: CameraModel, T: Floats, range_m: float) -> Floats:
    """Move of the point on the optical axis in the image (2,), px; misplacement left and up (2,), m."""
    point = np.array([[0.0, 0.0, range_m]])
    before, _ = project_unbounded(camera, point)
    after, _ = project_unbounded(camera, se3.apply(T, point))
    misplaced = se3.apply(se3.inverse(T), point)[0] - point[0]
    return np.array([*(after - before)[0], -misplaced[0], -misplaced[1]])


def _rays(camera: CameraModel) -> Floats:
    """Unit vectors (N,3) of places spread over the image, those that the lens reaches; camera frame."""
    u = np.linspace(0.0, camera.width - 1.0, _COLUMNS)
    v = np.linspace(0.0, camera.height - 1.0, _ROWS)
    xy = undistort(camera, np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    xy = xy[np.isfinite(xy).all(axis=1)]
    rays = np.column_stack([xy, np.ones(len(xy))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True), dtype=np.float64)


def _worst(camera: CameraModel, T: Floats, points: Floats) -> float:
    before, seen = project_unbounded(camera, points)
    after, seen_after = project_unbounded(camera, se3.apply(T, points))
    both = seen & seen_after
    if not both.any():
        return float("nan")
    return float(np.linalg.norm(after[both] - before[both], axis=1).max())
