"""Rigid motions: exponential, logarithm, retraction, change from camera to vehicle axes (FORMULAS A)."""

import math

import numpy as np

from pipeline.records import Floats

_SMALL_ANGLE = 1e-6
"""rad; below it the series of sin(x)/x is exact to rounding."""

_NEAR_HALF_TURN = -0.9
"""Cosine of the angle below which the axis is read from the symmetric part of a rotation: the antisymmetric
part vanishes at 180 degrees, and an axis read from it drowns in rounding."""


def skew(a: Floats) -> Floats:
    """The matrix [a] with ``[a] b = a x b``. ``a`` float64 (3,) -> (3,3)."""
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def exp_so3(phi: Floats) -> Floats:
    """Rotation matrix of the axis-angle vector ``phi`` (3,), rad."""
    angle = float(np.linalg.norm(phi))
    W = skew(phi)
    if angle < _SMALL_ANGLE:
        return np.eye(3) + W + 0.5 * W @ W
    return np.eye(3) + math.sin(angle) / angle * W + (1.0 - math.cos(angle)) / angle**2 * W @ W


def log_so3(R: Floats) -> Floats:
    """Axis-angle vector (3,) of a rotation matrix, also at 180 degrees (FORMULAS B (16))."""
    vee = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(np.linalg.norm(vee))
    cosine = 0.5 * (float(np.trace(R)) - 1.0)
    angle = math.atan2(sine, cosine)
    if cosine > _NEAR_HALF_TURN:
        return vee * (angle / sine) if sine > _SMALL_ANGLE else vee
    # (R + R^T) / 2 = cos I + (1 - cos) a a^T; the sign of the axis a is that of the antisymmetric part.
    M = 0.5 * (R + R.T) - cosine * np.eye(3)
    axis = M[:, int(np.argmax(np.diag(M)))]
    sign = -1.0 if float(axis @ vee) < 0.0 else 1.0
    return np.asarray(axis / np.linalg.norm(axis) * (sign * angle), dtype=np.float64)


def rotation_angle(R1: Floats, R2: Floats) -> float:
    """Angle between two rotations, rad, 0..pi (CRLF (16))."""
    chord = float(np.linalg.norm(R1 - R2)) / (2.0 * math.sqrt(2.0))
    return 2.0 * math.asin(min(1.0, chord))


def pose_error(T_a: Floats, T_b: Floats) -> tuple[float, float]:
    """How far two extrinsics (4,4) lie apart, m and rad: CRLF (15) and (16).

    (15) is the distance of the translations, (16) the angle between the rotations, 0..pi.

    The translation is that of ``T_cam_lidar``, so that a turn of the camera in place moves it too;
    :func:`mount_drift` tells the two apart.
    """
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), rotation_angle(T_a[:3, :3], T_b[:3, :3])


def transform(R: Floats, t: Floats) -> Floats:
    """4x4 matrix of rotation (3,3) and translation (3,)."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def inverse(T: Floats) -> Floats:
    """Inverse of a rigid 4x4 matrix."""
    R = T[:3, :3]
    return transform(R.T, -R.T @ T[:3, 3])


def orthonormalised(R: Floats) -> Floats:
    """The nearest rotation to a nearly orthonormal (3,3), by SVD."""
    U, _, Vt = np.linalg.svd(R)
    return np.asarray(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, dtype=np.float64)


def retract(T_cam_lidar: Floats, xi: Floats) -> Floats:
    """``R <- Exp(phi) R, t <- Exp(phi) t + rho`` (FORMULAS A2). ``xi`` = (phi, rho), camera axes."""
    E = exp_so3(xi[:3])
    return transform(E @ T_cam_lidar[:3, :3], E @ T_cam_lidar[:3, 3] + xi[3:])


def local(T_from: Floats, T_to: Floats) -> Floats:
    """The xi with ``retract(T_from, xi) == T_to``."""
    phi = log_so3(T_to[:3, :3] @ T_from[:3, :3].T)
    rho = T_to[:3, 3] - exp_so3(phi) @ T_from[:3, 3]
    return np.concatenate([phi, rho])


def apply(T: Floats, points: np.ndarray) -> Floats:
    """Points (N,3) of any float type mapped by the rigid 4x4 ``T``, float64 (N,3): CRLF (1)."""
    return np.asarray(points @ T[:3, :3].T + T[:3, 3], dtype=np.float64)


AXES_CAM_IN_VEHICLE = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""C0 of FORMULAS A5: columns are the axes of a camera that looks straight ahead, in vehicle axes."""


def vehicle_axes(T_cam_lidar: Floats, T_vehicle_lidar: Floats | None) -> Floats:
    """``R_vehicle_cam`` (3,3): turns camera axes into vehicle axes.

    Without a vehicle frame the stored camera's own axes, renamed (forward z, left -x, up -y), stand in.
    """
    if T_vehicle_lidar is None:
        return AXES_CAM_IN_VEHICLE.copy()
    return np.asarray(T_vehicle_lidar[:3, :3] @ T_cam_lidar[:3, :3].T, dtype=np.float64)


def mount_drift(T_stored: Floats, T_now: Floats, R_vehicle_cam: Floats) -> Floats:
    """Motion of the camera mount since the extrinsic was stored, (6,).

    Roll, pitch, yaw in rad, then forward, left, up in m. Angles are Euler ZYX of ``E_now E_ref^T`` (FORMULAS
    A5); the translation is that of the camera CENTRE. ``R_vehicle_cam`` belongs to the stored extrinsic.
    """
    # The mount's rotation in vehicle axes: dE = R_vc (R_ref R_now^T) R_vc^T.
    dE = R_vehicle_cam @ (T_stored[:3, :3] @ T_now[:3, :3].T) @ R_vehicle_cam.T
    roll = math.atan2(dE[2, 1], dE[2, 2])
    pitch = -math.asin(float(np.clip(dE[2, 0], -1.0, 1.0)))
    yaw = math.atan2(dE[1, 0], dE[0, 0])
    centre_stored = -T_stored[:3, :3].T @ T_stored[:3, 3]
    centre_now = -T_now[:3, :3].T @ T_now[:3, 3]
    shift = R_vehicle_cam @ T_stored[:3, :3] @ (centre_now - centre_stored)
    return np.array([roll, pitch, yaw, *shift])


def displaced(T_cam_lidar: Floats, drift: Floats, R_vehicle_cam: Floats) -> Floats:
    """Extrinsic after the mount moved by ``drift`` (6,) in vehicle axes: inverse of :func:`mount_drift`."""
    R = T_cam_lidar[:3, :3]
    R_now = R_vehicle_cam.T @ _turned(drift).T @ R_vehicle_cam @ R
    centre = -R.T @ T_cam_lidar[:3, 3] + R.T @ R_vehicle_cam.T @ drift[3:]
    return transform(R_now, -R_now @ centre)


def stored_before(T_true: Floats, drift: Floats, R_vehicle_lidar: Floats | None) -> Floats:
    """The stored extrinsic from which the mount moved by ``drift`` to ``T_true``: ``--inject`` (DESIGN 2).

    ``R_vehicle_lidar`` (3,3) turns LiDAR axes into vehicle axes; None lets the axes of the stored camera that
    is sought stand in (:func:`vehicle_axes`).
    """
    R_true, dE = T_true[:3, :3], _turned(drift)
    if R_vehicle_lidar is None:
        R_vc = AXES_CAM_IN_VEHICLE
        R = R_vc.T @ dE @ R_vc @ R_true
    else:
        R = R_true @ R_vehicle_lidar.T @ dE @ R_vehicle_lidar
        R_vc = R_vehicle_lidar @ R.T
    centre = -R_true.T @ T_true[:3, 3] - R.T @ R_vc.T @ drift[3:]
    return transform(R, -R @ centre)


def vehicle_block(R_vehicle_cam: Floats) -> Floats:
    """``B`` (6,6) with ``drift = B xi`` to first order: minus the block rotation (FORMULAS A4)."""
    B = np.zeros((6, 6))
    B[:3, :3] = B[3:, 3:] = -R_vehicle_cam
    return B


def _turned(drift: Floats) -> Floats:
    """Rotation dE of FORMULAS A5, (3,3): Rz(yaw) Ry(pitch) Rx(roll) of the first three of ``drift``."""
    roll, pitch, yaw = drift[:3]
    cr, sr, cp, sp, cy, sy = *_cs(roll), *_cs(pitch), *_cs(yaw)
    Rz = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    Ry = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    Rx = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    return np.asarray(Rz @ Ry @ Rx, dtype=np.float64)


def _cs(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)
