"""Colour and class of what rays of the camera met: materials, light, shadow, haze, sky; linear BGR."""
# ruff: noqa: PLR2004 - the figures are patterns on surfaces, in the units of the coordinate beside them

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import labels
from pipeline.records import Floats
from pipeline.simulation.materials import Surfaces, glows, lots_of, paint_materials
from pipeline.simulation.paint import YELLOW
from pipeline.simulation.raycast import Hits, SolidPoints, places, solid_points
from pipeline.simulation.scene import Scene
from pipeline.simulation.shadows import ShadowMap, shaded_by_movers
from pipeline.simulation.solids import Material, Solids
from pipeline.simulation.surface import F32, KERB, RAISED, SKY, Rays
from pipeline.simulation.textures import sample
from pipeline.simulation.weather import dusk, head_light, lamp_light, sky

_SKY_COLOUR = np.array([[1.12], [1.0], [0.92]], dtype=np.float32)
_PAINT_TINT = np.array([[0.2], [0.72], [0.95]], dtype=np.float32)
"""Of yellow paint, relative to white."""
_AIR_M = 60.0
"""m; height of the haze over the ground."""
_SNOW = np.array([[0.86], [0.84], [0.82]], dtype=np.float32)
_GONE, _LEFT = 0.15, 0.35
"""Share of paint that is left below which it is road, and above which it is a mark; between, who knows."""
_BODY_M = 1.2
"""m; half length from which a part of a vehicle keeps the sky from the ground."""
_CONTACT_M = 0.22
"""m; how far beside a vehicle the ground is darker: about its clearance."""
_PAVING = np.array([[0.24], [0.26], [0.27]], dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What shading needs to know of one pass.

    Attributes:
        scene: The street.
        solids: As they stand at the exposure.
        rays: Rays with direction z_cam = 1, so that t is the depth.
        hits: What they met.
        shadows: Of what stands still.
        focal: px.
        R_world_cam: float64 (3,3), how the camera is turned.
    """

    scene: Scene
    solids: Solids
    rays: Rays
    hits: Hits
    shadows: ShadowMap
    focal: float
    R_world_cam: Floats


def shade(view: View) -> tuple[F32, NDArray[np.uint8]]:
    """Radiance float32 (3,H,W) and class uint8 (H,W) of one pass."""
    shape = view.hits.t.shape
    colour = np.empty((3, shape[0] * shape[1]), dtype=np.float32)
    classes = np.full(shape[0] * shape[1], labels.SKY, dtype=np.uint8)
    what = view.hits.what.ravel()
    above = np.flatnonzero(what == SKY)
    colour[:, above] = _sky(view, above)
    ground = np.flatnonzero(what < SKY)
    colour[:, ground], classes[ground] = _ground(view, ground)
    points = solid_points(view.solids, view.rays, view.hits)
    colour[:, points.pixels] = _solids(view, points)
    classes[points.pixels] = view.solids.label[points.solid]
    return colour.reshape(3, *shape), classes.reshape(shape)


def _horizon(view: View) -> F32:
    glow = np.array(view.scene.weather.glow, dtype=np.float32)[:, None]
    return glow * np.float32(0.9 + 0.3 * view.scene.light.overcast) * dusk(view.scene.weather)


def _sky(view: View, pixels: NDArray[np.int64]) -> F32:
    """Blue that pales towards the horizon, with clouds on a far plane."""
    d = np.stack([view.rays.direction[k].ravel()[pixels] for k in range(3)])
    if view.scene.weather.glossy:
        light = view.scene.light
        shown = sky(view.scene.weather, view.scene.textures, d, light.sun, light.overcast)
        # Fog hides the sky too, most of it near the horizon.
        way = _AIR_M / (np.maximum(d[2], 0.0) / np.sqrt((d * d).sum(axis=0)) + np.float32(0.05))
        clear = np.exp(-way / np.float32(view.scene.weather.sight))
        return np.asarray(clear * shown + (1.0 - clear) * 0.6 * _horizon(view), dtype=np.float32)
    rise = np.maximum(d[2] / np.sqrt((d * d).sum(axis=0)), np.float32(0.01))
    pale = np.exp(-4.0 * rise)
    zenith = np.array([[0.75], [0.42], [0.22]], dtype=np.float32)
    blue = pale * _horizon(view) + (1.0 - pale) * zenith
    stretch = np.float32(60.0) / (d[2] + np.float32(0.08))
    clouds = sample(view.scene.textures.rough, d[0] * stretch, d[1] * stretch, 1.0)
    cover = np.clip(0.45 * clouds + 1.6 * view.scene.light.overcast - 0.3, 0.0, 1.0)
    white = np.float32(0.95) + 0.06 * clouds
    return np.asarray(blue + cover * (white - blue), dtype=np.float32)


def _detail(view: View, pixels: NDArray[np.int64], cell: float) -> F32:
    """Share 0..1 of a texture of so large cells (m) that a pixel on the ground resolves."""
    t = view.hits.t.ravel()[pixels]
    resolved = np.float32(2.0 * cell * view.focal * 1.5) / (t * t + 1e-6)
    return np.asarray(np.minimum(resolved, 1.0), dtype=np.float32)


def _ground(view: View, pixels: NDArray[np.int64]) -> tuple[F32, NDArray[np.uint8]]:
    scene, noise, roadway = view.scene, view.scene.textures, view.scene.roadway
    what = view.hits.what.ravel()[pixels]
    place = places(view.rays, view.hits, pixels)
    x, y = place[0], place[1]
    s, d = scene.surface.road_coordinates(x, y)
    fine = sample(noise.fine, x, y, 40.0) * _detail(view, pixels, 0.025)
    middle = sample(noise.fine, x, y, 7.0) * _detail(view, pixels, 0.15)
    soft = sample(noise.rough, x, y, 1.3)
    mottle = 1.0 + 0.13 * fine + 0.07 * middle + 0.06 * soft
    repaired = sample(noise.rough, s, d, 0.35) > 1.35
    asphalt = scene.asphalt * mottle * np.where(repaired, np.float32(0.72), np.float32(1.0))
    albedo = np.repeat(asphalt[None, :], 3, axis=0)
    roadway.mark(albedo, s, d, _detail(view, pixels, 0.025), noise)
    classes = np.full(pixels.size, labels.ROAD, dtype=np.uint8)
    raised, kerb = what == RAISED, what == KERB
    verge = raised & (np.abs(d) - np.float32(scene.surface.kerb_left) > scene.surface.pavement)
    slabs = raised & ~verge
    joints = ((np.mod(s, 0.6) < 0.02) | (np.mod(d, 0.6) < 0.02)) & (_detail(view, pixels, 0.02) > 0.4)
    paving = _PAVING * np.float32(roadway.paving)
    albedo[:, slabs] = paving * (mottle * np.where(joints, np.float32(0.6), np.float32(1.0)))[slabs]
    grass = np.array(roadway.verge, dtype=np.float32)[:, None]
    albedo[:, verge] = grass * np.exp(0.35 * fine + 0.3 * middle + 0.25 * soft)[verge]
    albedo[:, kerb] = np.float32(roadway.kerb) * mottle[kerb]
    classes[raised | kerb] = labels.OTHER
    if roadway.grassy:
        classes[verge] = labels.VEGETATION
    on_road = ~(raised | kerb)
    paint = np.where(on_road, scene.paint.colours(s, d), np.uint8(0))
    _paint(view, (s, d), paint, (fine, middle, soft), (albedo, classes))
    if roadway.snow > 0.0:
        _snow(view, (s, d), on_road, middle, (albedo, classes))
    lit = view.shadows.lit(place)
    lit *= ~shaded_by_movers(place, view.solids, len(scene.standing), scene.light, noise.grain)
    facing = np.full(pixels.size, scene.light.sun[2], dtype=np.float32)
    facing[kerb] *= np.float32(0.6)
    light = _light(view, facing, lit, _open_sky(view, place))
    if scene.weather.night > 0.0:
        up = np.array([[0.0], [0.0], [1.0]], dtype=np.float32)
        light += _lamps(view, pixels, place, up)
    # Water fills the pores: what is wet is darker.
    light[:, on_road] *= np.float32(1.0 - 0.45 * scene.weather.wet)
    radiance = albedo * light
    if scene.weather.glossy:
        radiance += _glare(view, pixels, lit)
    return _hazed(view, pixels, radiance), classes


def _glare(view: View, pixels: NDArray[np.int64], lit: F32) -> F32:
    """Radiance (3,N) of the sun that the ground throws back at a flat angle."""
    d = np.stack([view.rays.direction[k].ravel()[pixels] for k in range(3)])
    d /= np.sqrt((d * d).sum(axis=0))
    sun, weather = view.scene.light.sun.astype(np.float32), view.scene.weather
    toward = np.maximum(d[0] * sun[0] + d[1] * sun[1] - d[2] * sun[2], np.float32(0.0))
    flat = (1.0 - np.clip(-d[2], 0.0, 1.0)) ** 5
    lobe = (toward ** np.float32(12.0 + 60.0 * weather.wet)) * flat * lit
    strength = np.float32(view.scene.light.direct * (0.35 + 4.0 * weather.wet))
    return np.asarray(strength * lobe * np.array(weather.sun, dtype=np.float32)[:, None], dtype=np.float32)


def _paint(
    view: View,
    place: tuple[F32, F32],
    paint: NDArray[np.uint8],
    grain: tuple[F32, F32, F32],
    drawn: tuple[F32, NDArray[np.uint8]],
) -> None:
    """Puts paint on the ground: road coordinates, its colours, grain; albedo and classes in place."""
    albedo, classes = drawn
    painted = np.flatnonzero(paint)
    roadway = view.scene.roadway
    fine, middle, soft = (g[painted] for g in grain)
    worn = view.scene.wear * (1.0 + 0.7 * fine + 0.9 * middle + 0.5 * soft)
    left = roadway.worn(place[0][painted], place[1][painted], view.scene.textures)
    fresh = np.clip(1.0 - worn, 0.25, 1.0) * left
    tint = np.where(paint[painted] == YELLOW, _PAINT_TINT, np.float32(1.0))
    albedo[:, painted] = fresh * np.float32(roadway.paint_albedo) * tint + (1.0 - fresh) * albedo[:, painted]
    classes[painted] = np.where(
        left >= _LEFT, labels.LANE, np.where(left > _GONE, labels.IGNORE, labels.ROAD)
    )


def _snow(
    view: View,
    place: tuple[F32, F32],
    on_road: NDArray[np.bool_],
    grain: F32,
    drawn: tuple[F32, NDArray[np.uint8]],
) -> None:
    """Covers verges, pavements and what the wheels left; paint below it is road."""
    albedo, classes = drawn
    edge = view.scene.surface.kerb_left
    covered = ~on_road | view.scene.roadway.snowed(place[1], place[0], view.scene.textures, edge=edge)
    if view.scene.roadway.snow < 0.35:
        covered &= on_road | (np.abs(grain) < 1.0)
    albedo[:, covered] = _SNOW * (1.0 + 0.08 * grain[covered])
    classes[covered & on_road] = labels.ROAD
    classes[covered & ~on_road] = labels.OTHER


def _lamps(view: View, pixels: NDArray[np.int64], place: F32, normal: F32) -> F32:
    """Irradiance (3,N) of street lamps and of the own head lights."""
    d = np.stack([view.rays.direction[k].ravel()[pixels] for k in range(3)])
    seen = view.R_world_cam.T.astype(np.float32) @ d
    facing = -(d * normal).sum(axis=0) / np.sqrt((d * d).sum(axis=0))
    own = head_light(view.scene.weather, seen, view.hits.t.ravel()[pixels], facing)
    return np.asarray(own + lamp_light(view.scene.weather, place, normal), dtype=np.float32)


def _open_sky(view: View, place: F32) -> F32:
    """Share of the sky that points on the ground see (N,): little under and beside vehicles."""
    sky = np.ones(place.shape[1], dtype=np.float32)
    solids = view.solids
    for index in {window[0] for window in view.hits.tested}:
        half = solids.half[index]
        if solids.label[index] != labels.VEHICLE or half[0] < _BODY_M:
            continue
        offset = place - solids.centre[index].astype(np.float32)[:, None]
        near = np.flatnonzero(np.abs(offset[0]) + np.abs(offset[1]) < 1.5 * half[0] + 2.0)
        local = solids.to_unit[index].astype(np.float32)[:2] @ offset[:, near]
        outside = np.maximum(np.abs(local) - 1.0, 0.0) * half[:2, None].astype(np.float32)
        sky[near] *= 1.0 - 0.85 * np.exp(-np.hypot(outside[0], outside[1]) / np.float32(_CONTACT_M))
    return sky


def _light(view: View, facing: F32, lit: F32, open_sky: F32) -> F32:
    """Irradiance (3,N) from sun and sky; ``open_sky`` is the share of the sky that the surface sees."""
    light = view.scene.light
    direct = np.float32(light.direct) * np.maximum(facing, np.float32(0.0)) * lit
    return np.asarray(
        direct * np.array(view.scene.weather.sun, dtype=np.float32)[:, None]
        + np.float32(light.ambient) * open_sky * _SKY_COLOUR,
        dtype=np.float32,
    )


def _hazed(view: View, pixels: NDArray[np.int64], radiance: F32) -> F32:
    clear = np.exp(-view.hits.t.ravel()[pixels] / np.float32(view.scene.weather.sight))
    return np.asarray(clear * radiance + (1.0 - clear) * 0.6 * _horizon(view), dtype=np.float32)


def _solids(view: View, points: SolidPoints) -> F32:
    scene, noise = view.scene, view.scene.textures
    material = view.solids.material[points.solid]
    local = points.unit * view.solids.half.astype(np.float32)[points.solid].T
    albedo = np.ascontiguousarray(view.solids.colour[points.solid].T)
    leaves = material == Material.LEAVES
    # Two planes across each other: no direction of a round surface is drawn out.
    swing = sample(noise.fine, local[0], local[2], 9.0) + sample(noise.fine, local[1], local[2] + 7.3, 9.0)
    soft = sample(noise.rough, local[0] - local[2], local[1] + local[2], 20.0)
    near = np.minimum(np.float32(0.2 * view.focal) / view.hits.t.ravel()[points.pixels], np.float32(1.0))
    albedo *= np.where(leaves, np.exp(near * (0.4 * swing + 0.35 * soft)), 1.0 + 0.03 * swing + 0.03 * soft)
    _facade(view, points, local, albedo, np.flatnonzero(material == Material.FACADE))
    _cabin(points, albedo, np.flatnonzero(material == Material.CABIN))
    _plate(points, albedo, np.flatnonzero(material == Material.PLATE))
    half = np.ascontiguousarray(view.solids.half.astype(np.float32)[points.solid].T)
    resolved = np.float32(view.focal) / view.hits.t.ravel()[points.pixels]
    surfaces = Surfaces(points, local, half, material, resolved, noise, lots_of(noise, len(view.solids)))
    paint_materials(surfaces, albedo)
    facing = np.einsum("i,in->n", scene.light.sun.astype(np.float32), points.normal)
    leaves |= material == Material.CANOPY
    facing = np.where(leaves, 0.35 + 0.65 * facing, facing)
    lit = view.shadows.lit(points.place + np.float32(0.25) * points.normal)
    open_sky = 0.6 + 0.4 * points.normal[2]
    light = _light(view, facing, lit, open_sky.astype(np.float32))
    if scene.weather.night > 0.0:
        light += _lamps(view, points.pixels, points.place, points.normal)
        # Signs and plates send head light back where it came from.
        light *= np.where(view.solids.reflectance[points.solid] > 0.8, np.float32(3.0), np.float32(1.0))
    return _hazed(view, points.pixels, albedo * (light + glows(surfaces, scene.weather.night)))


def _facade(view: View, points: SolidPoints, local: F32, albedo: F32, chosen: NDArray[np.int64]) -> None:
    """Rows of windows with frames; each building has its own pitch."""
    if not chosen.size:
        return
    solid = points.solid[chosen]
    unit = points.unit[:, chosen]
    gable = np.abs(unit[0]) > np.abs(unit[1])
    along = np.where(gable, local[1, chosen], local[0, chosen])
    up = local[2, chosen] + view.solids.half.astype(np.float32)[solid, 2] - 0.5
    pitch = np.float32(1.9) + 0.25 * (solid % 7).astype(np.float32)
    storey = np.float32(2.7) + 0.1 * (solid % 5).astype(np.float32)
    a, b = along / pitch, up / storey
    in_a, in_b = a - np.floor(a), b - np.floor(b)
    frame = (np.abs(in_a - 0.5) < 0.3) & (np.abs(in_b - 0.55) < 0.32) & (np.abs(unit[2]) < 0.999)
    glass = (np.abs(in_a - 0.5) < 0.26) & (np.abs(in_b - 0.55) < 0.29) & frame
    hue = sample(view.scene.textures.fine, np.floor(a) + 0.5, np.floor(b) + 7.0 * solid + 0.5, 1.0)
    albedo[:, chosen[frame]] = np.float32(0.5)
    albedo[:, chosen[glass]] = np.array([[0.09], [0.08], [0.07]]) * np.exp(0.6 * hue[glass])
    plinth = up < 0.6
    albedo[:, chosen[plinth]] *= np.float32(0.6)


def _cabin(points: SolidPoints, albedo: F32, chosen: NDArray[np.int64]) -> None:
    """Panes between pillars; they mirror a little of the sky."""
    unit = np.abs(points.unit[:, chosen])
    side = unit[1] > unit[0]
    across = np.where(side, unit[0], unit[1])
    pane = (
        (unit[2] < 0.85) & (across < 0.92) & ~(side & (across < 0.05)) & (np.maximum(unit[0], unit[1]) > 0.98)
    )
    mirror = 0.04 + 0.1 * np.maximum(points.unit[2, chosen], 0.0)
    albedo[:, chosen[pane]] = mirror[pane] * np.array([[1.1], [1.0], [0.95]])


def _plate(points: SolidPoints, albedo: F32, chosen: NDArray[np.int64]) -> None:
    """A light inner field or a light rim with a dark mark, by the index of the solid."""
    unit = points.unit[:, chosen]
    ordered = np.sort(np.abs(unit), axis=0)
    # The thin axis is the one whose coordinate lies on the face: what remains spans the plate.
    rim = ordered[1] > 0.78
    mark = (ordered[0] < 0.22) & (ordered[1] < 0.6)
    odd = points.solid[chosen] % 2 == 1
    light = np.where(odd, ~rim & ~mark, rim)
    albedo[:, chosen[light]] = np.float32(0.72)
    dark = odd & mark
    albedo[:, chosen[dark]] = np.float32(0.04)
