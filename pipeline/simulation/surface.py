"""The ground: a road of clothoids with grades, kerbs, pavements and verges, and where rays meet it.

The world's x axis runs roughly along the road (heading below 45 degrees), so that centre line, arc length
and height are functions of x and rays meet the ground in closed form. Heights change along x only.
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Floats, read_only

F32: TypeAlias = NDArray[np.float32]

STEP_M = 0.25
"""m; cell of the tables. A curve of 100 m radius leaves its chord by 0.08 mm."""
_FAR_M = 5000.0
"""m; the ground goes on, straight, to the horizon."""
_STEEPEST_HEADING = 0.7
"""rad; the road is scaled to keep below it, so that x stays a good parameter."""

SKY, ROAD, RAISED, KERB = -1, -2, -3, -4
"""What a ray met if it was no solid."""


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """A grid of rays.

    Attributes:
        origin: Three float32 arrays that broadcast to (H,W): x, y, z of the start, m, world.
        direction: float32 (3,H,W), world; its length is the unit of the parameter t along the ray.
        time: float32, broadcasts to (H,W): seconds after the instant at which the solids stand.
    """

    origin: tuple[F32, F32, F32]
    direction: F32
    time: F32


@dataclass(frozen=True, slots=True, eq=False)
class RoadSurface:
    """The ground of a scene.

    Attributes:
        x: float64 (n,), m, uniform steps of ``STEP_M``.
        y: float64 (n,), centre line, m.
        heading: float64 (n,), rad.
        arc: float64 (n,), arc length of the centre line, m.
        height: float64 (n,), m.
        kerb_right: Distance d of the right kerb from the centre line, m, negative.
        kerb_left: As ``kerb_right``, positive.
        kerb_height: m; 0 where the road runs into a verge.
        pavement: Width of the pavement behind each kerb, m; grass behind it.
    """

    x: Floats
    y: Floats
    heading: Floats
    arc: Floats
    height: Floats
    kerb_right: float
    kerb_left: float
    kerb_height: float
    pavement: float

    def __post_init__(self) -> None:
        for name in ("x", "y", "heading", "arc", "height"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def pose(self, arc: Floats | float, left: Floats | float = 0.0) -> tuple[Floats, Floats, Floats]:
        """Place beside the centre line.

        Args:
            arc: Arc length of the centre line, m, any shape.
            left: Distance to the left of it, m.

        Returns:
            Position (...,3) on the road's height, heading (...) and grade dz/dx (...) of the road there.
        """
        x0 = np.interp(arc, self.arc, self.x)
        heading = np.interp(x0, self.x, self.heading)
        x = x0 - left * np.sin(heading)
        y = np.interp(x0, self.x, self.y) + left * np.cos(heading)
        z = np.interp(x, self.x, self.height)
        grade = np.interp(x, self.x, np.gradient(self.height, STEP_M))
        return np.stack([x, y, z], axis=-1), np.asarray(heading), np.asarray(grade)

    def road_coordinates(self, x: F32, y: F32) -> tuple[F32, F32]:
        """Arc length s and distance d to the left of the centre line, m, float32, of points on the ground.

        d is the distance along y times the cosine of the heading: exact for straight roads and by definition
        here, since paint and kerbs are drawn in these coordinates.
        """
        cell, weight = self._cell(x)
        sine, cosine = np.sin(self.heading), np.cos(self.heading)
        aside = y - _lerp(self.y, cell, weight)
        s = _lerp(self.arc, cell, weight) + aside * _lerp(sine, cell, weight)
        return s, aside * _lerp(cosine, cell, weight)

    def lateral(self, x: F32, y: F32) -> F32:
        """The d of :meth:`road_coordinates` alone."""
        cell, weight = self._cell(x)
        return (y - _lerp(self.y, cell, weight)) * _lerp(np.cos(self.heading), cell, weight)

    def _cell(self, x: F32) -> tuple[NDArray[np.int32], F32]:
        place = (x - np.float32(self.x[0])) * np.float32(1.0 / STEP_M)
        cell = np.clip(place, 0, len(self.x) - 2).astype(np.int32)
        return cell, place - cell

    def meet(self, rays: Rays) -> tuple[F32, NDArray[np.int32]]:
        """Parameter t float32 (H,W) at which rays meet the ground (inf: never) and what they meet (int32)."""
        shape = rays.direction.shape[1:]
        t = np.full(shape, np.inf, dtype=np.float32)
        kind = np.full(shape, SKY, dtype=np.int32)
        t_top = self._meet_height(rays, self.kerb_height)
        seen = np.nonzero(np.isfinite(t_top))
        ox, oy, _ = (np.broadcast_to(o, shape)[seen] for o in rays.origin)
        dx, dy = rays.direction[0][seen], rays.direction[1][seen]
        top = t_top[seen]
        d_top = self.lateral(ox + top * dx, oy + top * dy)
        outside = (d_top > self.kerb_left) | (d_top < self.kerb_right)
        if self.kerb_height == 0.0:
            t[seen] = top
            kind[seen] = np.where(outside, RAISED, ROAD)
            return t, kind
        road = self._meet_height(rays, 0.0)[seen]
        # At the very horizon a ray may meet the upper surface and miss the lower one.
        road = np.where(np.isfinite(road), road, top)
        d_road = self.lateral(ox + road * dx, oy + road * dy)
        edge = np.where(d_road > 0, np.float32(self.kerb_left), np.float32(self.kerb_right))
        face = ~outside & ((d_road > self.kerb_left) | (d_road < self.kerb_right))
        with np.errstate(divide="ignore", invalid="ignore"):
            on_face = top + (edge - d_top) / (d_road - d_top) * (road - top)
        t[seen] = np.where(outside, top, np.where(face, on_face, road))
        kind[seen] = np.where(outside, RAISED, np.where(face, KERB, ROAD))
        return t, kind

    def _meet_height(self, rays: Rays, raised: float) -> F32:
        """First t at which each ray comes down to the height of the road plus ``raised``.

        The ground is a cylinder over x: the ray with slope m = dz/|dx| meets it where the running maximum of
        the slopes to the ground's vertices first reaches m, which a binary search finds. Rays that start
        elsewhere than their mean (a moving LiDAR) are put right by repeating the last, linear step from their
        own start.
        """
        x = np.concatenate([[-_FAR_M], self.x, [_FAR_M]])
        h = np.concatenate([self.height[:1], self.height, self.height[-1:]]) + raised
        grade = np.diff(h) / np.diff(x)
        ox, oz = (float(np.mean(o)) for o in (rays.origin[0], rays.origin[2]))
        # Heights relative to the sensor keep float32 exact to micrometres.
        intercept = (h[:-1] - oz + grade * (ox - x[:-1])).astype(np.float32)
        grade32 = grade.astype(np.float32)
        dx, dz = rays.direction[0].ravel(), rays.direction[2].ravel()
        slope = dz / np.maximum(np.abs(dx), np.float32(1e-9))
        t = np.full(dx.shape, np.inf, dtype=np.float32)
        cell = np.zeros(dx.shape, dtype=np.intp)
        ahead = int(np.searchsorted(x, ox, side="right"))
        for forward in (True, False):
            vertices = np.arange(ahead, len(x)) if forward else np.arange(ahead - 1, -1, -1)
            run = np.maximum(np.abs(x[vertices] - ox), 1e-6)
            horizon = np.maximum.accumulate((h[vertices] - oz) / run).astype(np.float32)
            chosen = np.flatnonzero(((dx >= 0) == forward) & (slope < horizon[-1]))
            first = vertices[np.searchsorted(horizon, slope[chosen])]
            cell[chosen] = first - 1 if forward else first
            t[chosen] = intercept[cell[chosen]] / (dz[chosen] - grade32[cell[chosen]] * dx[chosen])
        if rays.origin[0].size > 1:
            self._start_elsewhere(rays, t, (ox, oz), (intercept, grade32))
        return t.reshape(rays.direction.shape[1:])

    def _start_elsewhere(self, rays: Rays, t: F32, mean: tuple[float, float], lines: tuple[F32, F32]) -> None:
        """Puts t right in place for rays that do not start at the mean origin."""
        met = np.flatnonzero(np.isfinite(t))
        shape = rays.direction.shape[1:]
        ox = (np.broadcast_to(rays.origin[0], shape).ravel()[met] - mean[0]).astype(np.float32)
        oz = (np.broadcast_to(rays.origin[2], shape).ravel()[met] - mean[1]).astype(np.float32)
        dx, dz = rays.direction[0].ravel()[met], rays.direction[2].ravel()[met]
        intercept, grade = lines
        first = np.float32(mean[0] - self.x[0])
        for _ in range(3):
            place = (ox + t[met] * dx + first) * np.float32(1.0 / STEP_M) + 1
            cell = np.clip(place, 0, len(grade) - 1).astype(np.intp)
            t[met] = (intercept[cell] + grade[cell] * ox - oz) / (dz - grade[cell] * dx)


def _lerp(table: Floats, cell: NDArray[np.int32], weight: F32) -> F32:
    values = table.astype(np.float32)
    return np.asarray(values[cell] + weight * np.diff(values)[cell], dtype=np.float32)


def draw_surface(
    rng: np.random.Generator,
    span: tuple[float, float],
    *,
    curvature: float,
    grade: float,
    kerbs: tuple[float, float],
    kerb_height: float,
    pavement: float,
) -> RoadSurface:
    """Draws a road.

    Args:
        rng: Source of the draw.
        span: First and last x, m.
        curvature: Standard deviation of the curvature at the nodes of the clothoid chain, 1/m.
        grade: Largest grade, dz/dx.
        kerbs: Right (negative) and left distance of the kerbs from the centre line, m.
        kerb_height: m.
        pavement: m.
    """
    node_m = 45.0
    reach = 1.6 * (span[1] - span[0])
    s = np.arange(0.0, reach, STEP_M)
    nodes = np.arange(0.0, reach + node_m, node_m)
    bend = np.interp(s, nodes, rng.normal(0.0, curvature, len(nodes)))
    heading = np.cumsum(bend) * STEP_M
    heading -= heading[int(-span[0] / STEP_M) if span[0] < 0 < span[1] else 0]
    heading *= min(1.0, _STEEPEST_HEADING / max(float(np.abs(heading).max()), 1e-9))
    along = span[0] + np.concatenate([[0.0], np.cumsum(np.cos(heading[:-1])) * STEP_M])
    aside = np.concatenate([[0.0], np.cumsum(np.sin(heading[:-1])) * STEP_M])
    x = np.arange(span[0], span[1] + STEP_M / 2, STEP_M)
    y = np.interp(x, along, aside)
    phase = rng.uniform(0.0, 2.0 * math.pi, 2)
    waves = (2.0 * math.pi / 420.0, 2.0 * math.pi / 190.0)
    height = sum(
        share * grade / k * np.sin(k * x + p) for share, k, p in zip((0.65, 0.35), waves, phase, strict=True)
    )
    y_ahead = np.interp(0.0, x, y)
    return RoadSurface(
        x,
        y - y_ahead,
        np.interp(x, along, heading),
        np.interp(x, along, s) - np.interp(0.0, along, s),
        np.asarray(height) - np.interp(0.0, x, np.asarray(height)),
        kerbs[0],
        kerbs[1],
        kerb_height,
        pavement,
    )
