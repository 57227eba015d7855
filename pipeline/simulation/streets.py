"""Streets of many kinds for training: towns and country roads with all that is taken for a pole."""
# ruff: noqa: PLR2004 - the figures are odds of a draw, each beside what it decides

import math
from typing import TYPE_CHECKING

import numpy as np

from pipeline import labels
from pipeline.simulation import clutter, poles
from pipeline.simulation.furniture import panel
from pipeline.simulation.marks import draw_flaws, draw_paint
from pipeline.simulation.scene import (
    BEHIND_M,
    PARKING_M,
    Light,
    Scene,
    SceneParameters,
    ground_at,
    parked,
    places_along,
    traffic,
)
from pipeline.simulation.solids import Solid, Solids
from pipeline.simulation.surface import RoadSurface, draw_surface
from pipeline.simulation.textures import draw_textures
from pipeline.simulation.weather import Weather

if TYPE_CHECKING:
    from collections.abc import Callable

    from pipeline.records import Floats


def draw_street(
    p: SceneParameters, light: Light, weather: Weather, rng: np.random.Generator, *, snow: float
) -> Scene:
    """Draws a street; the same arguments and seed give the same street.

    Args:
        p: Its size and what stands how often.
        light: Sun and sky.
        weather: Hour and weather.
        rng: Source of the draw.
        snow: 0..1, how much lies on the ground.
    """
    edge = p.lanes * p.lane_width / 2
    bays = p.town and rng.random() < 0.7
    kerb = edge + float(rng.uniform(0.2, 1.2)) + (PARKING_M if bays else 0.0)
    surface = draw_surface(
        rng,
        (-BEHIND_M - 20.0, p.length + 60.0),
        curvature=p.curvature,
        grade=p.grade,
        kerbs=(-kerb, kerb),
        kerb_height=float(rng.uniform(0.03, 0.18)) if p.town else 0.0,
        pavement=float(rng.uniform(1.2, 4.5)) if p.town else 0.0,
    )
    crossings = []
    if p.crossings and p.town:
        crossings = list(np.arange(rng.uniform(10.0, 60.0), p.length, 90.0))
    solids: list[Solid] = []
    for side in (-1.0, 1.0):
        solids += _posts(surface, p, side, crossings, rng)
        solids += _town_side(surface, p, side, rng) if p.town else _country_side(surface, p, side, rng)
        solids += _strewn(surface, p, side, rng)
        if bays:
            solids += parked(surface, p, side, crossings, rng)
    if rng.random() < (0.1 if p.town else 0.3):
        s = float(rng.uniform(15.0, 80.0))
        (left, heading), (right, _) = (ground_at(surface, s, k * (kerb + 0.8)) for k in (1.0, -1.0))
        solids += poles.gantry(left, right, heading, rng)
    solids += _skyline(surface, p, rng)
    return Scene(
        surface,
        draw_paint(p, crossings, rng),
        p.wear,
        Solids.of(solids),
        traffic(p, (p.lanes + 1) // 2, rng),
        light,
        draw_textures(rng),
        float(np.exp(rng.uniform(math.log(0.04), math.log(0.3)))),
        -edge + 0.5 * p.lane_width,
        draw_flaws(p, kerb, snow, rng),
        weather,
    )


def _lean(p: SceneParameters, rng: np.random.Generator) -> tuple[float, float]:
    a, b = rng.normal(0.0, p.lean, 2)
    return float(a), float(b)


def _posts(
    surface: RoadSurface, p: SceneParameters, side: float, crossings: list[float], rng: np.random.Generator
) -> list[Solid]:
    """Everything that is labelled pole along one side."""
    kerb, solids = surface.kerb_left, list[Solid]()
    aside = kerb + float(rng.uniform(0.2, 1.5))
    if rng.random() < (0.85 if p.town else 0.45):
        for s in places_along(p, p.lamp_spacing, rng, 0.1):
            place, heading = ground_at(surface, s, side * aside)
            solids += poles.street_lamp(place, heading, side, _lean(p, rng), rng)
    for s in places_along(p, p.sign_spacing, rng):
        place, heading = ground_at(surface, s, side * (kerb + rng.uniform(0.15, 2.0)))
        if rng.random() < 0.12:
            solids += poles.board(place, heading, rng)
        else:
            solids += poles.signed_post(place, heading, _lean(p, rng), rng)
    if rng.random() < (0.2 if p.town else 0.4):
        left = side * (kerb + float(rng.uniform(0.8, 6.0)))
        row = [ground_at(surface, s, left) for s in places_along(p, float(rng.uniform(25.0, 45.0)), rng, 0.1)]
        solids += poles.utility_poles([place for place, _ in row], row[0][1], rng)
    return solids + _signals(surface, p, side, crossings, rng) + _bollards(surface, p, side, rng)


def _signals(
    surface: RoadSurface, p: SceneParameters, side: float, crossings: list[float], rng: np.random.Generator
) -> list[Solid]:
    """Traffic lights before and behind crossings along one side."""
    kerb, solids = surface.kerb_left, list[Solid]()
    for s in crossings:
        for off in (-1.5, float(rng.uniform(4.0, 12.0))):
            if rng.random() < 0.55:
                place, heading = ground_at(surface, s + off, side * (kerb + rng.uniform(0.3, 1.0)))
                solids += poles.signal(place, heading, side, _lean(p, rng), rng)
    return solids


def _bollards(surface: RoadSurface, p: SceneParameters, side: float, rng: np.random.Generator) -> list[Solid]:
    """Rows of bollards or marker posts along one side."""
    kerb, solids = surface.kerb_left, list[Solid]()
    for _ in range(int(rng.poisson(1.2))):
        start, pitch = float(rng.uniform(-10.0, 80.0)), float(rng.uniform(1.2, 8.0))
        left = side * (kerb + float(rng.uniform(0.2, 0.8)))
        for s in start + pitch * np.arange(int(rng.integers(2, 10))):
            solids += poles.bollard(ground_at(surface, float(s), left)[0], _lean(p, rng), rng)
    return solids


def _town_side(
    surface: RoadSurface, p: SceneParameters, side: float, rng: np.random.Generator
) -> list[Solid]:
    """Fronts of houses, arcades, walls, railings and gardens behind the pavement; trees before them."""
    solids: list[Solid] = []
    front = surface.kerb_left + surface.pavement
    dense, tall = rng.random() < 0.6, float(np.exp(rng.uniform(math.log(5.0), math.log(22.0))))
    s = -30.0
    while s < p.length:
        length, depth = float(rng.uniform(6.0, 28.0)), float(rng.uniform(7.0, 13.0))
        setback = float(rng.uniform(0.1, 0.6) if dense else rng.uniform(1.5, 12.0))
        place, heading = ground_at(surface, s + length / 2, side * (front + setback + depth / 2))
        kind = rng.random()
        if kind < 0.82:
            height = tall * float(np.exp(rng.normal(0.0, 0.25)))
            solids += clutter.house(place, heading, (length, depth, height), rng)
            if rng.random() < 0.12:
                place, heading = ground_at(surface, s + length / 2, side * (front + 0.15))
                solids += clutter.arcade(place, heading, 0.9 * length, rng)
        elif kind < 0.93:
            for x in np.arange(0.0, length, 5.0):
                place, _ = ground_at(surface, s + float(x), side * (front + rng.uniform(1.0, 8.0)))
                solids += clutter.tree(place, rng)
        if setback > 1.2 or kind > 0.82:
            solids += _border(surface, s, length, side * (front + 0.2), rng)
        s += length + float(rng.choice([0.0, 0.1, 3.0, 9.0]))
    if rng.random() < 0.7:
        for s_tree in places_along(p, p.tree_spacing, rng):
            place, _ = ground_at(
                surface, s_tree, side * (surface.kerb_left + rng.uniform(0.5, surface.pavement))
            )
            solids += clutter.tree(place, rng)
    return solids


def _border(
    surface: RoadSurface, s: float, length: float, left: float, rng: np.random.Generator
) -> list[Solid]:
    """What parts a garden from the pavement: a fence, a wall or a hedge."""
    place, heading = ground_at(surface, s + length / 2, left)
    kind, height = rng.random(), float(rng.uniform(0.6, 2.0))
    if kind < 0.45:
        return clutter.fence(place, heading, 0.95 * length, rng)
    if kind < 0.7:
        grey = float(rng.uniform(0.1, 0.5))
        size = (0.95 * length, 0.2, height)
        return [panel(place, heading, size, (0.8 * grey, 0.9 * grey, grey), labels.CONSTRUCTION)]
    return [
        mass
        for x in np.arange(0.0, length, 1.6)
        for mass in clutter.thicket(ground_at(surface, s + float(x), left)[0], 0.5 * height, rng)[:1]
    ]


def _country_side(
    surface: RoadSurface, p: SceneParameters, side: float, rng: np.random.Generator
) -> list[Solid]:
    """Guard rails, noise barriers, fences, single trees, woods and farms beside a road out of town."""
    kerb, solids = surface.kerb_left, list[Solid]()
    stretches = np.arange(-30.0, min(p.length, 130.0), 8.0)
    if rng.random() < 0.45:
        first = float(rng.uniform(-30.0, 40.0))
        for s in stretches[stretches > first]:
            place, heading = ground_at(surface, float(s), side * (kerb + 0.5))
            solids += clutter.guard_rail(place, heading, 8.0, rng)
    solids += _edge_of_fields(surface, p, side, rng)
    for s in places_along(p, max(p.tree_spacing, 12.0), rng):
        place, heading = ground_at(surface, s, side * (kerb + rng.uniform(2.0, 20.0)))
        draw = rng.random()
        if draw < 0.5:
            solids += clutter.tree(place, rng)
        elif draw < 0.9:
            solids += clutter.thicket(place, float(rng.uniform(0.5, 2.0)), rng)
        else:
            far = ground_at(surface, s, side * (kerb + 22.0))[0]
            solids += clutter.house(far, heading, (14.0, 9.0, 6.0), rng)
    return solids


def _edge_of_fields(
    surface: RoadSurface, p: SceneParameters, side: float, rng: np.random.Generator
) -> list[Solid]:
    """A wood, a noise barrier, a fence or nothing along a road out of town."""
    kerb, solids = surface.kerb_left, list[Solid]()
    stretches = np.arange(-30.0, min(p.length, 130.0), 8.0)
    kind = rng.random()
    if kind < 0.35:
        depth = float(rng.uniform(2.0, 9.0))
        for s in places_along(p, float(rng.uniform(2.5, 6.0)), rng):
            place, _ = ground_at(surface, s, side * (kerb + depth + float(rng.exponential(5.0))))
            solids += clutter.conifer(place, rng) if rng.random() < 0.3 else clutter.tree(place, rng)
    elif kind < 0.5:
        for s in stretches:
            place, heading = ground_at(surface, float(s), side * (kerb + 3.0))
            grey = float(rng.uniform(0.2, 0.4))
            size = (8.05, 0.2, 3.2)
            solids.append(panel(place, heading, size, (grey, grey, grey), labels.CONSTRUCTION))
    elif kind < 0.65:
        left = side * (kerb + float(rng.uniform(1.5, 6.0)))
        for s in stretches:
            solids += clutter.fence(*ground_at(surface, float(s), left), 8.0, rng)
    return solids


def _strewn(surface: RoadSurface, p: SceneParameters, side: float, rng: np.random.Generator) -> list[Solid]:
    """People, boxes, hoardings and bushes here and there."""
    wide = max(surface.pavement, 2.0)
    things: list[tuple[float, Callable[[Floats, float], list[Solid]]]] = [
        (6.0 if p.town else 0.2, lambda place, _: clutter.people(place, rng)),
        (3.0 if p.town else 0.5, lambda place, heading: clutter.bin_or_box(place, heading, rng)),
        (0.5, lambda place, heading: clutter.billboard(place, heading, rng)),
        (1.5, lambda place, _: clutter.thicket(place, float(rng.uniform(0.3, 0.9)), rng)),
    ]
    solids: list[Solid] = []
    for often, make in things:
        for _ in range(int(rng.poisson(often))):
            left = side * (surface.kerb_left + float(rng.uniform(0.5, wide)))
            solids += make(*ground_at(surface, float(rng.uniform(2.0, 70.0)), left))
    return solids


def _skyline(surface: RoadSurface, p: SceneParameters, rng: np.random.Generator) -> list[Solid]:
    """What closes the view at the end, unless it is left open: woods, houses or hills."""
    solids: list[Solid] = []
    kind = rng.random()
    if kind < 0.25:
        return solids
    for left in np.arange(-150.0, 151.0, 14.0):
        place, heading = ground_at(surface, p.length + float(rng.uniform(0.0, 30.0)), float(left))
        if kind < 0.65:
            size = float(rng.uniform(3.0, 9.0))
            solids += clutter.thicket(place, size, rng)[:1]
        else:
            size = float(rng.uniform(5.0, 25.0))
            solids += clutter.house(place, heading + math.pi / 2, (13.0, 10.0, size), rng)
    return solids
