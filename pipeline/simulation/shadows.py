"""Shadows: a map of the highest thing on each ray of the sun for what stands still, rays for what moves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Floats, read_only
from pipeline.simulation.raycast import Window
from pipeline.simulation.scene import Light, Scene
from pipeline.simulation.solids import Solids
from pipeline.simulation.surface import F32, Rays

CELL_M = 0.2
"""m; finer than the penumbra of a lamp post (the sun is 0.53 degrees wide: 7 cm at 8 m) is no gain."""
_ASIDE_M = 45.0
"""m; how far from the road shadows are drawn."""
_ABOVE_M = 200.0
"""m; where the rays of the sun start; nothing is higher."""
_BIAS_M = 0.2
"""m; a surface does not shade itself within this."""
_MOVER_REACH_M = 12.0
"""m; length of the shadow of a vehicle, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class ShadowMap:
    """Heights of the highest things towards the sun.

    Attributes:
        corner: x and y of the first cell, m; a point is filed where its ray of the sun meets z = 0.
        slide: float64 (2,), shift in x and y a metre of height, away from the sun.
        top: float32 (nx,ny), z of the highest surface on that ray; -inf: none.
    """

    corner: tuple[float, float]
    slide: Floats
    top: F32

    def __post_init__(self) -> None:
        object.__setattr__(self, "top", read_only(self.top))

    def lit(self, place: F32) -> F32:
        """Share 0..1 of the sun that reaches points (3,N), m, world: float32 (N,), even between cells."""
        x = (place[0] + np.float32(self.slide[0]) * place[2] - np.float32(self.corner[0])) / np.float32(
            CELL_M
        )
        y = (place[1] + np.float32(self.slide[1]) * place[2] - np.float32(self.corner[1])) / np.float32(
            CELL_M
        )
        x = np.clip(x - np.float32(0.5), 0, self.top.shape[0] - 2)
        y = np.clip(y - np.float32(0.5), 0, self.top.shape[1] - 2)
        i, j = x.astype(np.int32), y.astype(np.int32)
        a, b = x - i, y - j
        corner = i * self.top.shape[1] + j
        top, z = self.top.ravel(), place[2] + np.float32(_BIAS_M)
        first, second = (
            (top[corner + row] < z) * (1 - b) + (top[corner + row + 1] < z) * b
            for row in (0, self.top.shape[1])
        )
        return np.asarray(first * (1 - a) + second * a, dtype=np.float32)


def shadow_map(scene: Scene, reach: tuple[float, float]) -> ShadowMap:
    """The map of what stands still, for x between the limits of ``reach``, m."""
    sun = scene.light.sun
    slide = -sun[:2] / sun[2]
    inside = (scene.surface.x >= reach[0]) & (scene.surface.x <= reach[1])
    y = scene.surface.y[inside]
    corner = (reach[0], float(y.min()) - _ASIDE_M)
    shape = (
        int((reach[1] - reach[0]) / CELL_M),
        int((float(y.max()) + _ASIDE_M - corner[1]) / CELL_M),
    )
    x = corner[0] + CELL_M * (np.arange(shape[0]) + 0.5)
    aside = corner[1] + CELL_M * (np.arange(shape[1]) + 0.5)
    up = _ABOVE_M / sun[2] * sun
    rays = Rays(
        (
            (x + up[0]).astype(np.float32)[:, None],
            (aside + up[1]).astype(np.float32)[None, :],
            np.full((1, 1), up[2], dtype=np.float32),
        ),
        np.broadcast_to((-sun).astype(np.float32)[:, None, None], (3, *shape)),
        np.zeros((1, 1), dtype=np.float32),
    )
    t = np.full(shape, np.inf, dtype=np.float32)
    for index, rows, columns, _ in _windows(scene.standing, slide, corner, shape):
        met = scene.standing.meet(index, rays, (rows, columns), scene.textures.grain)
        np.minimum(t[rows, columns], met, out=t[rows, columns])
    top = np.float32(up[2]) - t * np.float32(sun[2])
    return ShadowMap(corner, slide, top)


def _windows(
    solids: Solids, slide: Floats, corner: tuple[float, float], shape: tuple[int, int]
) -> list[Window]:
    corners = solids.corners()
    filed = (corners[:, :, :2] + slide * corners[:, :, 2:] - corner) / CELL_M
    low = np.maximum(np.floor(filed.min(axis=1)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(filed.max(axis=1)).astype(int) + 2, shape)
    seen = np.flatnonzero((high > low).all(axis=1))
    return [(int(k), slice(low[k, 0], high[k, 0]), slice(low[k, 1], high[k, 1]), 0.0) for k in seen]


def shaded_by_movers(place: F32, solids: Solids, first: int, light: Light, grain: F32) -> NDArray[np.bool_]:
    """Whether points (3,N) lie in the shadow of solids from index ``first`` on (those that move)."""
    shaded = np.zeros(place.shape[1], dtype=np.bool_)
    for index in range(first, len(solids)):
        centre = solids.centre[index].astype(np.float32)
        near = np.flatnonzero(np.abs(place[0] - centre[0]) + np.abs(place[1] - centre[1]) < _MOVER_REACH_M)
        if not near.size:
            continue
        x, y, z = (place[k][near][None, :] for k in range(3))
        toward = np.broadcast_to(light.sun.astype(np.float32)[:, None, None], (3, 1, near.size))
        rays = Rays((x, y, z), toward, np.zeros((1, 1), dtype=np.float32))
        met = solids.meet(index, rays, (slice(None), slice(None)), grain)
        shaded[near] |= np.isfinite(met[0])
    return shaded
