"""What a wet road mirrors: the street as a camera sees it that is itself mirrored at the road's plane."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline import labels
from pipeline.records import Floats
from pipeline.simulation.raycast import Hits, Window
from pipeline.simulation.scene import Scene
from pipeline.simulation.shading import View, shade
from pipeline.simulation.surface import F32, ROAD, SKY, STEP_M, Rays
from pipeline.simulation.textures import smooth

_HEAD_ON = 0.02
"""Share of light that water mirrors at a right angle (index 1.33)."""
_MOST = 0.8
"""Share of the mirror image that a film of water on rough asphalt gives at most."""
_STEP = 2
"""px; every so manieth ray is mirrored: what is blurred afterwards needs no more."""


@dataclass(frozen=True, slots=True, eq=False)
class Mirror:
    """The plane of the road below a camera.

    Attributes:
        normal: float64 (3,), unit, upward.
        T_world_cam: float64 (4,4), the camera mirrored at it; a left-handed frame.
    """

    normal: Floats
    T_world_cam: Floats


def mirror_below(scene: Scene, T_world_cam: Floats) -> Mirror:
    """The mirror below a camera."""
    eye, surface = T_world_cam[:3, 3], scene.surface
    grade = float(np.interp(eye[0], surface.x, np.gradient(surface.height, STEP_M)))
    normal = np.array([-grade, 0.0, 1.0]) / np.hypot(grade, 1.0)
    foot = np.array([eye[0], eye[1], np.interp(eye[0], surface.x, surface.height)])
    flip = np.eye(3) - 2.0 * np.outer(normal, normal)
    T = np.eye(4)
    T[:3, :3] = flip @ T_world_cam[:3, :3]
    T[:3, 3] = eye - 2.0 * ((eye - foot) @ normal) * normal
    return Mirror(normal, T)


def add_reflections(
    view: View, mirror: Mirror, windows: list[Window], radiance: F32, classes: NDArray[np.uint8]
) -> None:
    """Blends the mirrored street over the road, in place.

    Args:
        view: The first pass.
        mirror: Below its camera.
        windows: Of the solids in the mirrored image.
        radiance: float32 (3,H,W), linear BGR.
        classes: uint8 (H,W).
    """
    road = (view.hits.what == ROAD) & np.isin(classes, (labels.ROAD, labels.LANE, labels.IGNORE))
    v, u = np.nonzero(road)
    if not v.size:
        return
    first, last = int(v.min()), int(v.max()) + 1
    shown, _ = shade(_mirrored(view, mirror, windows, (first, last)))
    picture = np.ascontiguousarray(np.moveaxis(shown, 0, -1))
    wet, width = view.scene.weather.wet, radiance.shape[2]
    # Water on asphalt is not flat: what it mirrors is drawn out downwards.
    drawn_out = 1.0 + (3.0 - 2.0 * wet) * width / 640.0
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8, sigmaY=drawn_out).astype(np.float32, copy=False)
    picture = cv2.resize(picture, (width, last - first)).astype(np.float32, copy=False)
    direction = view.rays.direction[:, v, u]
    cosine = -(mirror.normal.astype(np.float32) @ direction) / np.sqrt((direction * direction).sum(axis=0))
    share = _HEAD_ON + (1.0 - _HEAD_ON) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5
    x, y = (view.rays.origin[k].ravel()[0] + view.hits.t[v, u] * direction[k] for k in range(2))
    puddles = 0.5 * smooth(view.scene.textures.rough, x, y, 1.2)
    share = (share * np.clip(1.3 * wet - 0.3 + puddles, 0.0, _MOST)).astype(np.float32)
    radiance[:, v, u] += share * (picture[v - first, u].T - radiance[:, v, u])


def _mirrored(view: View, mirror: Mirror, windows: list[Window], rows: tuple[int, int]) -> View:
    """The mirrored camera's pass over some rows: solids above the road and the sky, no ground."""
    flip = np.eye(3) - 2.0 * np.outer(mirror.normal, mirror.normal)
    seen = view.rays.direction[:, rows[0] : rows[1] : _STEP, ::_STEP]
    direction = np.tensordot(flip.astype(np.float32), seen, axes=1)
    x, y, z = (np.full((1, 1), mirror.T_world_cam[k, 3], dtype=np.float32) for k in range(3))
    rays = Rays((x, y, z), direction, np.zeros((1, 1), dtype=np.float32))
    # A ray comes out of the road where the first pass met it: what it meets before lies underneath.
    floor = view.hits.t[rows[0] : rows[1] : _STEP, ::_STEP]
    t = np.full(floor.shape, np.inf, dtype=np.float32)
    what = np.full(floor.shape, SKY, dtype=np.int32)
    for index, high, wide, bound in sorted(windows, key=lambda w: w[3]):
        first, last = max(high.start - rows[0], 0) // _STEP, (min(high.stop, rows[1]) - rows[0] + 1) // _STEP
        place = (slice(first, last), slice(wide.start // _STEP, (wide.stop + 1) // _STEP))
        nearest = t[place]
        if not nearest.size or float(nearest.max()) < bound:
            continue
        met = view.solids.meet(index, rays, place, view.scene.textures.grain)
        closer = (met < nearest) & (met > floor[place])
        np.copyto(nearest, met, where=closer)
        what[place][closer] = index
    return replace(view, rays=rays, hits=Hits(t, what, ()), R_world_cam=mirror.T_world_cam[:3, :3])
