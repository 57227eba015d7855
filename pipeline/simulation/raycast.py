"""What each ray of a grid meets first, and the shape of the thing there."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.scene import Scene
from pipeline.simulation.solids import Shape, Solids
from pipeline.simulation.surface import F32, Rays

Window: TypeAlias = tuple[int, slice, slice, float]
"""Index of a solid, rows and columns of the grid that it may cover, and a lower bound of t on it."""


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What a grid of rays met.

    Attributes:
        t: float32 (H,W), parameter along the ray; inf for the sky.
        what: int32 (H,W), index of the solid, or SKY, ROAD, RAISED, KERB of ``surface``.
        tested: Windows of the solids that do not stand wholly behind nearer ones.
    """

    t: F32
    what: NDArray[np.int32]
    tested: tuple[Window, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SolidPoints:
    """The points of a grid that lie on solids.

    Attributes:
        pixels: int64 (N,), flat indices into the grid.
        solid: int32 (N,), index of the solid.
        place: float32 (3,N), world, at the instant of the ray, m.
        unit: float32 (3,N), in the unit shape.
        normal: float32 (3,N), outward, world.
    """

    pixels: NDArray[np.int64]
    solid: NDArray[np.int32]
    place: F32
    unit: F32
    normal: F32


def cast(scene: Scene, solids: Solids, rays: Rays, windows: list[Window]) -> Hits:
    """First hits of a grid of rays.

    Args:
        scene: Its ground and leaf texture.
        solids: ``scene.solids_at`` of the instant to which ``rays.time`` refers.
        rays: The rays.
        windows: For each solid in view the part of the grid that may see it; a solid may come more than once.
    """
    t, what = scene.surface.meet(rays)
    tested: list[Window] = []
    for window in sorted(windows, key=lambda w: w[3]):
        index, rows, columns, bound = window
        nearest = t[rows, columns]
        # From near to far: what stands wholly behind what was met already is not tested.
        if float(nearest.max()) < bound:
            continue
        tested.append(window)
        met = solids.meet(index, rays, (rows, columns), scene.textures.grain)
        closer = met < nearest
        np.copyto(nearest, met, where=closer)
        what[rows, columns][closer] = index
    return Hits(t, what, tuple(tested))


def places(rays: Rays, hits: Hits, pixels: NDArray[np.int64]) -> F32:
    """World coordinates float32 (3,N) of hits, by flat index into the grid."""
    shape = rays.direction.shape[1:]
    t = hits.t.ravel()[pixels]
    return np.stack(
        [
            np.broadcast_to(rays.origin[k], shape).ravel()[pixels] + t * rays.direction[k].ravel()[pixels]
            for k in range(3)
        ]
    )


def solid_points(solids: Solids, rays: Rays, hits: Hits) -> SolidPoints:
    """Place, unit coordinates and normal of every hit on a solid."""
    pixels = np.flatnonzero(hits.what >= 0)
    solid = hits.what.ravel()[pixels]
    place = places(rays, hits, pixels)
    time = np.broadcast_to(rays.time, hits.t.shape).ravel()[pixels]
    moving = solids.velocity.astype(np.float32)[solid]
    offset = place - solids.centre.astype(np.float32)[solid].T - moving.T * time
    A = solids.to_unit.astype(np.float32)[solid]
    unit = np.einsum("nij,jn->in", A, offset)
    gradient = _gradient(solids.shape[solid], unit)
    normal = np.einsum("nij,in->jn", A, gradient)
    normal /= np.sqrt((normal * normal).sum(axis=0)) + np.float32(1e-12)
    return SolidPoints(pixels, solid, place, unit, normal)


def _gradient(shape: NDArray[np.uint8], unit: F32) -> F32:
    """Outward direction at a point on the unit shapes, not normalised."""
    size = np.abs(unit)
    gradient = unit.copy()
    box = shape == Shape.BOX
    face = np.argmax(size, axis=0)
    round_ = shape == Shape.CYLINDER
    radius = np.hypot(unit[0], unit[1])
    cap = round_ & (size[2] > radius)
    gradient[2, round_ & ~cap] = 0.0
    gradient[:2, cap] = 0.0
    for k in range(3):
        gradient[k, box & (face != k)] = 0.0
    return gradient
