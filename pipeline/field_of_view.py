"""Which points of a cloud a camera may see, under an extrinsic that is off by some degrees."""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pipeline import cameras
from pipeline.records import CameraModel, Floats, PointCloud


def in_view(cloud: PointCloud, camera: CameraModel, T_cam_lidar: Floats) -> NDArray[np.bool_]:
    """Points inside the camera's field of view plus a margin (3 deg ahead, less aside), bool (N,)."""
    border = _border_rays(camera)
    T = T_cam_lidar.astype(np.float32)
    z = cloud.xyz @ T[2, :3] + T[2, 3]
    x = cloud.xyz @ T[0, :3] + T[0, 3]
    y = cloud.xyz @ T[1, :3] + T[1, 3]
    left, right, top, bottom = border
    return np.asarray(
        (z > cameras.NEAREST_DEPTH_M) & (x > left * z) & (x < right * z) & (y > top * z) & (y < bottom * z)
    )


_VIEW_MARGIN = math.tan(math.radians(3.0))
"""Margin of the view as a slope: what a wrong extrinsic of some degrees would bring in."""

_WIDEST_SLOPE = 5.0
"""Slope of the steepest ray that is looked at (79 deg off axis), for lenses that see more."""


@lru_cache(maxsize=16)
def _border_rays(camera: CameraModel) -> tuple[float, float, float, float]:
    """Slopes x/z and y/z of the border of the image: left, right, top, bottom, with the margin."""
    u = np.linspace(0.0, camera.width - 1.0, 17)
    v = np.linspace(0.0, camera.height - 1.0, 17)
    sides = (
        np.column_stack([np.zeros_like(v), v]),
        np.column_stack([np.full_like(v, camera.width - 1.0), v]),
        np.column_stack([u, np.zeros_like(u)]),
        np.column_stack([u, np.full_like(u, camera.height - 1.0)]),
    )
    slopes = [np.nan_to_num(cameras.undistort(camera, s), nan=np.inf) for s in sides]

    def clipped(value: float) -> float:
        return float(np.clip(value, -_WIDEST_SLOPE, _WIDEST_SLOPE))

    finite = [
        np.where(np.isfinite(s), s, sign * _WIDEST_SLOPE)
        for s, sign in zip(slopes, (-1, 1, -1, 1), strict=True)
    ]
    return (
        clipped(float(finite[0][:, 0].min())) - _VIEW_MARGIN,
        clipped(float(finite[1][:, 0].max())) + _VIEW_MARGIN,
        clipped(float(finite[2][:, 1].min())) - _VIEW_MARGIN,
        clipped(float(finite[3][:, 1].max())) + _VIEW_MARGIN,
    )
