"""Camera models, one file each: every module here offers ``MODEL``, a :class:`LensModel`.

All work on normalised coordinates ``x = X/Z, y = Y/Z``; :func:`project` and :func:`undistort` add K, the
borders of the image and the fold: beyond the radius where a polynomial lens stops growing nothing projects
(FORMULAS E3).
"""

import importlib
import pkgutil
from functools import cache, lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import CameraModel, Floats

NEAREST_DEPTH_M = 0.1
"""m; a point nearer to the image plane does not project (FORMULAS B (1))."""

_HALF_PX = 0.5
"""Pixel centres lie at integers, so the image ends half a pixel beyond the outermost."""


class LensModel(Protocol):
    """What a camera model offers."""

    names: tuple[str, ...]
    """Names under which messages and rig files know it."""

    def distort(self, xy: Floats, D: Floats) -> Floats:
        """Normalised coordinates (N,2) -> distorted normalised coordinates (N,2)."""

    def jacobian(self, xy: Floats, D: Floats) -> Floats:
        """Derivative of distorted by undistorted coordinates, (N,2,2)."""

    def limit(self, D: Floats) -> float:
        """Largest ``hypot(x, y)`` for which the model is one to one; inf where there is none."""


@cache
def lens_models() -> dict[str, LensModel]:
    """Every model in this folder by each of its names."""
    found: dict[str, LensModel] = {}
    for module in pkgutil.iter_modules(__path__):
        model: LensModel = importlib.import_module(f"{__name__}.{module.name}").MODEL
        found.update(dict.fromkeys(model.names, model))
    return found


_BENT_BY_NATURE = ("equidistant", "fisheye")
"""Lenses that map angles, not slopes, so that coefficients of zero do not make a pinhole."""


def lens_of(camera: CameraModel) -> LensModel:
    """The lens model of a camera; InputError names those that exist."""
    models = lens_models()
    if camera.model in models and not camera.D.any():
        # plumb_bob with zeros is how rectified images are announced; a bare fisheye is none the less bent.
        return models["pinhole"] if camera.model not in _BENT_BY_NATURE else models[camera.model]
    if camera.model not in models:
        raise InputError(
            f"camera model '{camera.model}' is not known", hint=f"known: {', '.join(sorted(models))}"
        )
    return models[camera.model]


def coefficients(D: Floats, count: int) -> tuple[float, ...]:
    """First ``count`` distortion coefficients, 0 where D is shorter; InputError if more of them matter."""
    if D[count:].any():
        raise InputError(
            f"distortion D {D.tolist()} has coefficients beyond the {count} that the camera model knows",
            hint="calibrate without thin prism and tilt, or rectify the images",
        )
    return tuple(np.pad(D[:count], (0, max(0, count - len(D)))).tolist())


def limit_of(camera: CameraModel) -> float:
    """Largest slope ``hypot(x, y)`` for which the lens is one to one; inf where there is none."""
    return _limit(lens_of(camera).names[0], camera.D.tobytes())


@lru_cache(maxsize=64)
def _limit(name: str, coefficients: bytes) -> float:
    """Roots of a polynomial, which a window of frames would otherwise seek a hundred times."""
    return lens_models()[name].limit(np.frombuffer(coefficients, dtype=np.float64))


def project(camera: CameraModel, points_cam: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Pixels of points in the camera frame: CRLF (2), with the lens.

    Args:
        camera: Intrinsics.
        points_cam: float64 (N,3), metres, camera optical frame.

    Returns:
        Pixels float64 (N,2), and bool (N,): in front of the camera, inside the lens model and inside the
        image. Pixels of points behind the camera or beyond the fold are NaN.
    """
    uv, valid = project_unbounded(camera, points_cam)
    inside = (
        (uv[:, 0] >= -_HALF_PX)
        & (uv[:, 0] < camera.width - _HALF_PX)
        & (uv[:, 1] >= -_HALF_PX)
        & (uv[:, 1] < camera.height - _HALF_PX)
    )
    return uv, valid & inside


def project_unbounded(camera: CameraModel, points_cam: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """As :func:`project` without the borders of the image: bool (N,) tells what projects at all."""
    lens = lens_of(camera)
    xy, valid = _slopes(camera, points_cam)
    d = lens.distort(xy, camera.D)
    uv = d @ camera.K[:2, :2].T + camera.K[:2, 2]
    return np.where(valid[:, None], uv, np.nan), valid


def project_with_slopes(
    camera: CameraModel, points_cam: Floats
) -> tuple[Floats, NDArray[np.bool_], Floats, Floats]:
    """As :func:`project_unbounded`, with what the derivative is made of.

    Returns:
        Pixels (N,2), finite even where nothing projects; bool (N,), what projects; ``xy = (X/Z, Y/Z)`` (N,2),
        0 where nothing projects; and the derivative A (N,2,2) of the pixel by ``xy``. The derivative by the
        point is ``[A, -A xy] / Z``.
    """
    lens, K = lens_of(camera), camera.K
    xy, valid = _slopes(camera, points_cam)
    uv = lens.distort(xy, camera.D) @ K[:2, :2].T + K[:2, 2]
    J = lens.jacobian(xy, camera.D)
    A = np.empty((2, 2, len(xy)))
    # Written out: numpy multiplies small matrices one by one, ten times slower.
    for i in range(2):
        for j in range(2):
            A[i, j] = K[i, 0] * J[:, 0, j] + K[i, 1] * J[:, 1, j]
    return uv, valid, xy, A.transpose(2, 0, 1)


def _slopes(camera: CameraModel, points_cam: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """``X/Z, Y/Z`` (N,2) of points (N,3), 0 where they do not project; and which do, bool (N,)."""
    z = points_cam[:, 2]
    valid = z > NEAREST_DEPTH_M
    xy = points_cam[:, :2] / np.where(valid, z, 1.0)[:, None]
    # Squares, for hypot takes thirty times as long.
    valid &= np.square(xy[:, 0]) + np.square(xy[:, 1]) < limit_of(camera) ** 2
    return (xy if valid.all() else np.where(valid[:, None], xy, 0.0)), valid


_NEWTON_STEPS = 12
"""FORMULAS E3: eight steps reach 5e-13 px; four more for strong wide lenses."""

_REACHED = 1e-6
"""Normalised coordinates: a thousandth of a px at 1000 px focal length; what stays above was not reached."""

_WITHIN = 0.999
"""Share of the lens' limit up to which Newton's method may go: at the limit the Jacobian is singular."""


def undistort(camera: CameraModel, uv: Floats) -> Floats:
    """Normalised coordinates (x, y at z = 1) of pixels (N,2), by Newton's method (FORMULAS E3).

    Pixels that no ray inside the lens model reaches give NaN.
    """
    lens = lens_of(camera)
    target = (uv - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    limit = _WITHIN * limit_of(camera)
    xy = _first_guess(lens, camera.D, target, limit)
    for _ in range(_NEWTON_STEPS):
        residual = lens.distort(xy, camera.D) - target
        step = np.linalg.solve(lens.jacobian(xy, camera.D) + 1e-12 * np.eye(2), residual[..., None])[..., 0]
        xy = _pulled_in(xy - step, limit)
    reached = np.hypot(*(lens.distort(xy, camera.D) - target).T) < _REACHED
    return np.where(reached[:, None], xy, np.nan)


_TABLE_SIZE = 512
"""Radii at which the lens is tabulated: a sixth of a degree apart, from which Newton's method converges."""


def _first_guess(lens: LensModel, D: Floats, target: Floats, limit: float) -> Floats:
    """Undistorted coordinates (N,2) by a table of the radius along one direction.

    From the distorted coordinates themselves Newton's method oscillates where a lens first stretches, then
    folds, and creeps where a fisheye nears 90 degrees.
    """
    radii = np.tan(np.linspace(0.0, _WITHIN * np.arctan(limit), _TABLE_SIZE))
    distorted = np.hypot(*lens.distort(np.column_stack([radii, np.zeros(_TABLE_SIZE)]), D).T)
    wanted = np.hypot(target[:, 0], target[:, 1])
    found = np.interp(wanted, np.maximum.accumulate(distorted), radii)
    return target * (found / np.maximum(wanted, np.finfo(np.float64).tiny))[:, None]


def _pulled_in(xy: Floats, limit: float) -> Floats:
    """Coordinates (N,2) held within the radius in which the lens is one to one.

    Beyond it Newton's method converges to folded rays.
    """
    radius = np.hypot(xy[:, 0], xy[:, 1])
    return xy * np.minimum(1.0, limit / np.maximum(radius, np.finfo(np.float64).tiny))[:, None]


def ideal_pixels(camera: CameraModel, uv: Floats) -> Floats:
    """Pixels (N,2) of the raw image as an ideal pinhole with the same K sees them; NaN beyond the lens."""
    return np.asarray(undistort(camera, uv) @ camera.K[:2, :2].T + camera.K[:2, 2], dtype=np.float64)


def raw_pixels(camera: CameraModel, uv_ideal: Floats) -> Floats:
    """Inverse of :func:`ideal_pixels`: pixels (N,2) of the raw image; NaN beyond the lens."""
    xy = (uv_ideal - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    return project_unbounded(camera, np.column_stack([xy, np.ones(len(xy))]))[0]
