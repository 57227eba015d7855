"""Roads that show little: a tunnel whose walls repeat, open country, woods, a traffic jam."""

import dataclasses
import math

import numpy as np

from pipeline import labels
from pipeline.simulation import clutter, furniture
from pipeline.simulation.paint import Line, Paint
from pipeline.simulation.roadway import Roadway
from pipeline.simulation.scene import BEHIND_M, Light, Mover, Scene, SceneParameters, draw_scene, ground_at
from pipeline.simulation.solids import Material, Shape, Solid, Solids
from pipeline.simulation.surface import draw_surface
from pipeline.simulation.textures import draw_textures
from pipeline.simulation.weather import Weather

CONCRETE = (0.24, 0.25, 0.26)
EARTH = (0.07, 0.11, 0.15)
UP = np.array([0.0, 0.0, 1.0])


def tunnel(seed, *, length=260.0, half_width=4.6, height=5.2, pitch=12.0, lamps=False, marked=False):
    """A straight tube of bare slabs, ``pitch`` m each; at its far end it is dark.

    Args:
        seed: Of the textures and the slabs' shades.
        length: m, from the start.
        half_width: From the middle to a wall, m.
        height: m.
        pitch: Of the slabs and the lamps along it, m.
        lamps: Light under the ceiling; else head lights alone.
        marked: A dashed line in the middle, with the pitch of the slabs, and lines along both walls.
    """
    rng = np.random.default_rng(seed)
    surface = _ground(rng, length, kerb=half_width + 2.0, curvature=0.0, grade=0.0)
    solids = []
    for s in np.arange(-BEHIND_M, length + 40.0, pitch):
        middle, heading = ground_at(surface, float(s), 0.0)
        for side in (-1.0, 1.0):
            place, _ = ground_at(surface, float(s), side * (half_width + 0.2))
            wall = (pitch, 0.4, height + 0.5)
            solids.append(furniture.panel(place, heading, wall, CONCRETE, labels.CONSTRUCTION))
        slab = np.array([pitch / 2, half_width + 0.5, 0.3])
        solids.append(_box(middle + (height + 0.3) * UP, slab, CONCRETE))
        if lamps:
            lamp = _box(
                middle + (height - 0.06) * UP, np.array([0.75, 0.15, 0.06]), (0.9, 0.9, 0.9), Material.LIGHT
            )
            solids.append(lamp)
    lines = ()
    if marked:
        edge = half_width - 0.4
        lines = (Line(0.0, 0.12, pitch / 3, 2 * pitch / 3, 0.0), Line(-edge, 0.12), Line(edge, 0.12))
    weather = Weather(night=0.85 if lamps else 1.0)
    light = Light(UP, 0.0, 0.35, 1.0)
    return _scene(
        surface, solids, rng, light, weather=weather, paint=Paint(lines, ()), ego_left=-half_width / 2
    )


def open_country(seed, *, length=260.0, bushes=0, woods=False):
    """Rolling ground without a road: grass and earth, and as many bushes; woods along both sides.

    Args:
        seed: Of everything.
        length: m, from the start.
        bushes: How many.
        woods: Trees with and without leaves, as near as 3 m.
    """
    rng = np.random.default_rng(seed)
    surface = _ground(rng, length, kerb=1.2, curvature=0.004, grade=0.06)
    solids = []
    for _ in range(bushes):
        side = float(rng.choice([-1.0, 1.0]))
        place, _ = ground_at(
            surface, float(rng.uniform(-BEHIND_M, length)), side * float(rng.uniform(2.5, 25.0))
        )
        solids += clutter.thicket(place, float(rng.uniform(0.3, 1.4)), rng)
    for s in np.arange(-BEHIND_M, length, 2.5) if woods else ():
        for side in (-1.0, 1.0):
            place, _ = ground_at(surface, float(s), side * (3.0 + float(rng.exponential(6.0))))
            solids += clutter.conifer(place, rng) if rng.random() < 0.3 else clutter.tree(place, rng)
    light = Light(np.array([0.3, 0.5, math.sqrt(0.66)]), 0.4, 0.6, 0.7)
    roadway = Roadway(verge=EARTH if rng.random() < 0.5 else (0.035, 0.12, 0.075))
    return _scene(surface, solids, rng, light, roadway=roadway)


def jam(seed, *, speed=0.4, gap=6.8):
    """A street whose lanes are full: cars and vans before, behind and beside, all as slow as the own one.

    Args:
        seed: Of everything.
        speed: m/s.
        gap: From the middle of one vehicle to the next, m.
    """
    p = SceneParameters(length=260.0)
    scene, rng = draw_scene(p, np.random.default_rng(seed)), np.random.default_rng([seed, 1])
    movers = []
    for lane in range(p.lanes):
        left = (lane + 0.5 - p.lanes / 2) * p.lane_width
        own = abs(left - scene.ego_left) < 0.1
        for s in np.arange(-40.0, 90.0, gap):
            if own and abs(s) < 5.0:
                continue
            parts = furniture.van(rng) if rng.random() < 0.5 else furniture.car(rng)
            arc = float(s + rng.uniform(-0.4, 0.4) + (1.5 if own and s > 0 else 0.0))
            movers.append(Mover(Solids.of(parts), arc, left, speed if left < 0 else -speed))
    return dataclasses.replace(scene, movers=tuple(movers))


def _ground(rng, length, *, kerb, curvature, grade):
    span = (-BEHIND_M - 20.0, length + 60.0)
    return draw_surface(
        rng, span, curvature=curvature, grade=grade, kerbs=(-kerb, kerb), kerb_height=0.0, pavement=0.0
    )


def _box(centre, half, colour, material=Material.PLAIN):
    return Solid(Shape.BOX, centre, np.eye(3), half, labels.CONSTRUCTION, colour, 0.35, material)


def _scene(surface, solids, rng, light, *, roadway=None, weather=None, paint=None, ego_left=0.0):
    return Scene(
        surface,
        Paint((), ()) if paint is None else paint,
        0.2,
        Solids.of(solids),
        (),
        light,
        draw_textures(rng),
        0.1,
        ego_left,
        Roadway() if roadway is None else roadway,
        Weather() if weather is None else weather,
    )
