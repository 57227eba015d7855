"""A spinning LiDAR: every column of beams is cast from where the sensor is at that moment."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.records import Floats, PointCloud, read_only
from pipeline.simulation.raycast import Hits, Window, cast, places, solid_points
from pipeline.simulation.scene import Scene
from pipeline.simulation.solids import Solids
from pipeline.simulation.surface import F32, KERB, RAISED, ROAD, SKY, Rays

_PAINT_REFLECTANCE = 0.55
"""Fresh road paint with glass beads, as a fraction; asphalt has 0.1 to 0.25."""
_NEAREST_M = 0.9
"""m; spinning LiDARs give nothing nearer."""


@dataclass(frozen=True, slots=True, eq=False)
class LidarModel:
    """A spinning LiDAR in its own frame: spin axis z, azimuth from x towards y.

    Attributes:
        elevations: float64 (rings,), rad, in the order of the ring index.
        columns: Firings a turn.
        period: Duration of a turn, s.
        clockwise: Seen from above (+z).
        start: Azimuth of the first column, rad.
        sigma: Range noise, m.
        reach: Range at which a surface of reflectance 0.1 gives half of its returns, m; it grows with the
            root of the reflectance.
        loss: Share of returns lost at random.
    """

    elevations: Floats
    columns: int
    period: float = 0.1
    clockwise: bool = True
    start: float = math.pi
    sigma: float = 0.02
    reach: float = 60.0
    loss: float = 0.01

    def __post_init__(self) -> None:
        object.__setattr__(self, "elevations", read_only(self.elevations))

    @property
    def azimuths(self) -> Floats:
        """Azimuth of each column, rad, unwrapped, in the order of firing."""
        sign = -1.0 if self.clockwise else 1.0
        return self.start + sign * 2.0 * math.pi * (np.arange(self.columns) + 0.5) / self.columns

    @property
    def times(self) -> Floats:
        """Firing time of each column, s after the start of the turn."""
        return self.period * (np.arange(self.columns) + 0.5) / self.columns


def spinning(rings: int, columns: int = 1800) -> LidarModel:
    """The usual layouts by number of rings: 16 (+-15 deg), 32 (-30.7..10.7), 64 (-24.9..2), 128 (-25..15)."""
    layouts = {
        16: np.linspace(-15.0, 15.0, 16),
        32: np.linspace(-30.67, 10.67, 32),
        64: np.concatenate([np.linspace(-24.9, -8.87, 32), np.linspace(-8.33, 2.0, 32)]),
        128: np.concatenate(
            [np.linspace(-25.0, -6.5, 40), np.linspace(-6.1, 2.0, 64), np.linspace(2.5, 15.0, 24)]
        ),
    }
    return LidarModel(np.radians(layouts[rings]), columns)


def sweep(
    scene: Scene,
    model: LidarModel,
    pose: Callable[[Floats], Floats],
    start_time: float,
    rng: np.random.Generator,
) -> PointCloud:
    """One turn of the sensor.

    Args:
        scene: What is seen.
        model: The sensor.
        pose: ``T_world_lidar`` float64 (n,4,4) at times (n,), s.
        start_time: When the turn begins, s.
        rng: Noise of range, reflectance and losses.

    Returns:
        Points in the LiDAR frame, each of its own moment (not motion compensated), in order of firing;
        ``time`` counts from ``start_time``; ``ring`` is the index of the elevation.
    """
    times = model.times
    middle = start_time + model.period / 2
    T = pose(start_time + times)
    beams = _beams(model)
    direction = np.einsum("cij,jrc->irc", T[:, :3, :3], beams).astype(np.float32)
    origin = (T[:, 0, 3], T[:, 1, 3], T[:, 2, 3])
    moment = (start_time + times - middle).astype(np.float32)
    solids = scene.solids_at(middle)
    rays = Rays(_columns(origin), direction, moment[None, :])
    T_middle = pose(np.array([middle]))[0]
    travel = float(np.linalg.norm(T[-1, :3, 3] - T[0, :3, 3]))
    windows = _windows(model, solids, T_middle, travel)
    hits = cast(scene, solids, rays, windows)
    reflectance, cosine = _surfaces(scene, solids, rays, hits)
    return _returns(model, beams, hits, reflectance, cosine, rng)


def _columns(origin: tuple[Floats, Floats, Floats]) -> tuple[F32, F32, F32]:
    """Origins of columns as rows that broadcast over the rings."""
    x, y, z = (o.astype(np.float32)[None, :] for o in origin)
    return x, y, z


def _beams(model: LidarModel) -> Floats:
    """Unit vectors (3,rings,columns) in the LiDAR frame."""
    e, a = model.elevations[:, None], model.azimuths[None, :]
    return np.stack(
        [np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.broadcast_to(np.sin(e), (e.size, a.size))]
    )


def _windows(model: LidarModel, solids: Solids, T_world_lidar: Floats, travel: float) -> list[Window]:
    """The columns in which each solid may be seen, all rings."""
    corners = solids.corners()
    local = (corners - T_world_lidar[:3, 3]) @ T_world_lidar[:3, :3]
    centre = local.mean(axis=1)
    bearing = np.arctan2(centre[:, 1], centre[:, 0])
    spread = np.angle(np.exp(1j * (np.arctan2(local[:, :, 1], local[:, :, 0]) - bearing[:, None])))
    distance = np.hypot(centre[:, 0], centre[:, 1])
    size = np.linalg.norm(local - centre[:, None, :], axis=2).max(axis=1)
    moved = travel + np.linalg.norm(solids.velocity, axis=1) * model.period
    # Half the travel shifts the bearing from either end of the sweep; 0.02 rad covers a turning vehicle.
    margin = 0.02 + np.arctan2(0.5 * moved, np.maximum(distance - size, 0.3))
    lower, upper = spread.min(axis=1) - margin, spread.max(axis=1) + margin
    nearest = np.linalg.norm(centre, axis=1) - size - moved
    around = (distance < size + moved) | (upper - lower > math.pi)
    step = 2.0 * math.pi / model.columns
    sign = -1.0 if model.clockwise else 1.0
    every = slice(None)
    windows: list[Window] = []
    for k in np.flatnonzero(distance - size < _LIDAR_REACH_M):
        bound = float(max(nearest[k], 0.0))
        if around[k]:
            windows.append((int(k), every, every, bound))
            continue
        ends = [(sign * (bearing[k] + e - model.start)) / step for e in (lower[k], upper[k])]
        first = math.floor(min(ends)) % model.columns
        last = first + math.ceil(max(ends) - min(ends)) + 2
        windows.append((int(k), every, slice(first, min(last, model.columns)), bound))
        if last > model.columns:
            windows.append((int(k), every, slice(0, last - model.columns), bound))
    return windows


_LIDAR_REACH_M = 130.0
"""m; nothing beyond is looked for."""


def _surfaces(scene: Scene, solids: Solids, rays: Rays, hits: Hits) -> tuple[F32, F32]:
    """Reflectance and cosine of the incidence for each beam, float32 (rings,columns)."""
    shape = hits.t.shape
    reflectance = np.zeros(shape, dtype=np.float32)
    cosine = np.abs(rays.direction[2]).copy()
    points = solid_points(solids, rays, hits)
    reflectance.ravel()[points.pixels] = solids.reflectance[points.solid]
    along = np.stack([rays.direction[k].ravel()[points.pixels] for k in range(3)])
    cosine.ravel()[points.pixels] = np.abs((points.normal * along).sum(axis=0))
    reflectance[(hits.what == RAISED) | (hits.what == KERB)] = 0.28
    road = np.flatnonzero(hits.what == ROAD)
    place = places(rays, hits, road)
    s, d = scene.surface.road_coordinates(place[0], place[1])
    paint = scene.paint.covers(s, d)
    fresh = _PAINT_REFLECTANCE * (1.0 - 0.5 * scene.wear)
    reflectance.ravel()[road] = np.where(paint, fresh, 0.08 + 1.2 * scene.asphalt)
    cosine[hits.what == KERB] = 0.7
    grass = hits.what == RAISED
    if grass.any():
        pixels = np.flatnonzero(grass)
        place = places(rays, hits, pixels)
        away = np.abs(scene.surface.lateral(place[0], place[1])) - scene.surface.kerb_left
        reflectance.ravel()[pixels[away > scene.surface.pavement]] = 0.38
    return reflectance, cosine


def _returns(
    model: LidarModel, beams: Floats, hits: Hits, reflectance: F32, cosine: F32, rng: np.random.Generator
) -> PointCloud:
    shape = hits.t.shape
    noise = rng.normal(0.0, 1.0, (2, *shape)).astype(np.float32)
    luck = rng.random(shape, dtype=np.float32)
    sure = np.minimum(
        1.0, 0.5 * (model.reach / np.maximum(hits.t, 1.0)) ** 2 * reflectance / 0.1 + 0.2 * cosine
    )
    kept = (
        (hits.what != SKY)
        & (hits.t > _NEAREST_M)
        & (hits.t < _LIDAR_REACH_M)
        & (luck < sure * (1.0 - model.loss))
    )
    columns, rings = np.nonzero(kept.T)
    flat = rings * shape[1] + columns
    distance = hits.t.ravel()[flat] + model.sigma * noise[0].ravel()[flat]
    xyz = beams.reshape(3, -1)[:, flat].T * distance[:, None]
    # Sensors level out most of the incidence; what is left, and speckle, makes paint and road overlap.
    level = reflectance.ravel()[flat] * (0.75 + 0.25 * cosine.ravel()[flat])
    intensity = level * (1.0 + 0.12 * noise[1].ravel()[flat]) + 0.02 * noise[1].ravel()[flat]
    return PointCloud(
        np.ascontiguousarray(xyz, dtype=np.float32),
        np.clip(intensity, 0.0, 1.0).astype(np.float32),
        rings.astype(np.uint16),
        model.times[columns].astype(np.float32),
    )
