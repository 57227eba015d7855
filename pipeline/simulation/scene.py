"""A street drawn from a seed: ground, paint, furniture, buildings, trees, vehicles that park or move."""
# ruff: noqa: PLR2004 - the figures are odds of a draw, each beside what it decides

import math
from dataclasses import dataclass, field

import numpy as np

from pipeline import labels
from pipeline.records import Floats, read_only
from pipeline.simulation import furniture
from pipeline.simulation.paint import Line, Paint, Patch, arrow, crossing
from pipeline.simulation.roadway import Roadway
from pipeline.simulation.solids import Solid, Solids, upright
from pipeline.simulation.surface import RoadSurface, draw_surface
from pipeline.simulation.textures import Textures, draw_textures
from pipeline.simulation.weather import Weather

PARKING_M = 2.2
"""m; strip for parked vehicles at each side of a street in town."""
SHOULDER_M = 0.6
"""m; asphalt outside the edge line."""
BEHIND_M = 60.0
"""m; how far the street reaches behind the start: a spinning LiDAR sees it."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneParameters:
    """What is drawn; lengths in m, angles in rad.

    Attributes:
        length: Street ahead of the start; a drive needs its own length and 120 m to look at.
        lanes: Lanes in all, the right half forward (the larger half if odd).
        lane_width: 2.75 (town) to 3.75 (motorway).
        town: Kerbs, pavement, buildings, parked cars; else verges, guard rails, trees.
        curvature: Standard deviation at the nodes of the clothoid chain, 1/m.
        grade: Largest dz/dx.
        paint_width: 0.10 to 0.20 by most rules for road marks.
        dash: Dash and gap of lane lines.
        edge_lines: Solid lines along both edges.
        wear: Share of its brightness that paint loses on average.
        lamp_spacing: Between lamp posts on one side.
        sign_spacing: Between sign posts on one side.
        tree_spacing: Between trees on one side.
        lean: Standard deviation of the lean of poles; real ones stand within 1 to 2 degrees.
        parked_share: Share of the parking places that are taken.
        traffic: Moving vehicles.
        crossings: Zebra crossings, stop lines and arrows are painted.
        sun_elevation: Of the sun.
        overcast: 0 clear sky with hard shadows, 1 grey sky without.
    """

    length: float = 320.0
    lanes: int = 4
    lane_width: float = 3.4
    town: bool = True
    curvature: float = 0.0022
    grade: float = 0.03
    paint_width: float = 0.15
    dash: tuple[float, float] = (3.0, 6.0)
    edge_lines: bool = True
    wear: float = 0.15
    lamp_spacing: float = 24.0
    sign_spacing: float = 30.0
    tree_spacing: float = 22.0
    lean: float = math.radians(0.7)
    parked_share: float = 0.45
    traffic: int = 6
    crossings: bool = True
    sun_elevation: float = math.radians(40.0)
    overcast: float = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """Sun and sky.

    Attributes:
        sun: float64 (3,), unit vector towards the sun, world.
        direct: Irradiance from the sun on a surface that faces it; the sky gives ``ambient``.
        ambient: Irradiance from the whole sky.
        overcast: 0 clear, 1 grey.
    """

    sun: Floats
    direct: float
    ambient: float
    overcast: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "sun", read_only(self.sun))


@dataclass(frozen=True, slots=True, eq=False)
class Mover:
    """A vehicle that keeps to its lane.

    Attributes:
        parts: Its solids in its own frame: x forward, origin on the ground.
        arc: Arc length of the road at time 0, m.
        left: Distance from the centre line, m.
        speed: Along the road, m/s; negative against it.
    """

    parts: Solids
    arc: float
    left: float
    speed: float


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A street and what moves on it.

    Attributes:
        surface: The ground.
        paint: On the road.
        wear: Share of its brightness that paint lost.
        standing: Everything that does not move.
        movers: Everything that does.
        light: Sun and sky.
        textures: Noise tables.
        asphalt: Albedo of the road, 0..1.
        ego_left: Middle of the lane of the own vehicle, m to the left of the centre line.
        roadway: What the road is made of and bears besides paint.
        weather: Hour and weather.
    """

    surface: RoadSurface
    paint: Paint
    wear: float
    standing: Solids
    movers: tuple[Mover, ...]
    light: Light
    textures: Textures
    asphalt: float
    ego_left: float
    roadway: Roadway = field(default_factory=Roadway)
    weather: Weather = field(default_factory=Weather)

    def solids_at(self, time: float) -> Solids:
        """All solids as they stand at ``time`` s, the standing ones first."""
        solids = self.standing
        for mover in self.movers:
            arc = mover.arc + mover.speed * time
            if not self.surface.arc[0] < arc < self.surface.arc[-1]:
                continue
            place, heading, grade = self.surface.pose(arc, mover.left)
            turn = float(heading) + (math.pi if mover.speed < 0 else 0.0)
            T = np.eye(4)
            T[:3, :3] = upright(turn, (-math.atan(float(grade) * math.cos(turn)), 0.0))
            T[:3, 3] = place
            direction = np.array([math.cos(float(heading)), math.sin(float(heading)), float(grade)])
            solids = solids.joined(mover.parts.moved(T, mover.speed * direction))
        return solids


def draw_scene(parameters: SceneParameters, rng: np.random.Generator) -> Scene:
    """Draws a street; the same parameters and seed give the same street."""
    p = parameters
    edge = p.lanes * p.lane_width / 2
    kerb = edge + SHOULDER_M + (PARKING_M if p.town else 0.0)
    surface = draw_surface(
        rng,
        (-BEHIND_M - 20.0, p.length + 60.0),
        curvature=p.curvature,
        grade=p.grade,
        kerbs=(-kerb, kerb),
        kerb_height=float(rng.uniform(0.10, 0.15)) if p.town else 0.0,
        pavement=float(rng.uniform(2.2, 4.0)) if p.town else 0.0,
    )
    crossings = _junctions(p, rng)
    solids: list[Solid] = []
    for side in (-1.0, 1.0):
        solids += _roadside(surface, p, side, crossings, rng)
        solids += _background(surface, p, side, rng)
        if p.town:
            solids += parked(surface, p, side, crossings, rng)
    solids += _horizon(surface, p, rng)
    azimuth = rng.uniform(0.0, 2.0 * math.pi)
    sun = np.array([math.cos(azimuth), math.sin(azimuth), math.tan(p.sun_elevation)])
    direct = (1.0 - p.overcast) * 0.9
    light = Light(sun / np.linalg.norm(sun), direct, 0.35 + 0.35 * p.overcast, p.overcast)
    forward = (p.lanes + 1) // 2
    return Scene(
        surface,
        _paint(p, crossings, rng),
        p.wear,
        Solids.of(solids),
        traffic(p, forward, rng),
        light,
        draw_textures(rng),
        float(rng.uniform(0.07, 0.13)),
        -edge + 0.5 * p.lane_width,
    )


def _junctions(p: SceneParameters, rng: np.random.Generator) -> list[float]:
    """Arc lengths of crossings, about one in 90 m."""
    if not (p.crossings and p.town):
        return []
    return list(np.arange(rng.uniform(18.0, 70.0), p.length, 90.0) + rng.uniform(0.0, 15.0))


def _paint(p: SceneParameters, crossings: list[float], rng: np.random.Generator) -> Paint:
    edge = p.lanes * p.lane_width / 2
    forward = (p.lanes + 1) // 2
    phase = float(rng.uniform(0.0, sum(p.dash)))
    lines = []
    for k in range(1, p.lanes):
        d = -edge + k * p.lane_width
        if k == forward and p.lanes > 2:
            lines += [Line(d - 0.12, p.paint_width), Line(d + 0.12, p.paint_width)]
        else:
            lines.append(Line(d, p.paint_width, *p.dash, phase))
    if p.edge_lines:
        lines += [Line(-edge, p.paint_width), Line(edge, p.paint_width)]
    patches: list[Patch] = []
    for s in crossings:
        if rng.random() < 0.5:
            patches += crossing(s, -edge, edge)
        stop = (s - 1.9, s - 1.5)
        middle = 0.5 * (-edge + (forward * p.lane_width - edge))
        patches.append(Patch(stop, middle, (forward * p.lane_width / 2 - 0.1,) * 2))
        for k in range(p.lanes):
            d = -edge + (k + 0.5) * p.lane_width
            patches += arrow(s - 15.0 if k < forward else s + 15.0, d, forward=k < forward)
    return Paint(tuple(lines), tuple(patches))


def _lean(p: SceneParameters, rng: np.random.Generator) -> tuple[float, float]:
    a, b = rng.normal(0.0, p.lean, 2)
    return float(a), float(b)


def places_along(
    p: SceneParameters, spacing: float, rng: np.random.Generator, jitter: float = 0.2
) -> list[float]:
    """Arc lengths of things that stand at about regular distances."""
    s = np.arange(-BEHIND_M + rng.uniform(0.0, spacing), p.length, spacing)
    return list(s + rng.uniform(-jitter, jitter, len(s)) * spacing)


def ground_at(surface: RoadSurface, s: float, left: float) -> tuple[Floats, float]:
    """Place on the ground beside the road, kerb height included, and heading."""
    place, heading, _ = surface.pose(s, left)
    place[2] += surface.kerb_height if not surface.kerb_right < left < surface.kerb_left else 0.0
    return place, float(heading)


def _roadside(
    surface: RoadSurface, p: SceneParameters, side: float, crossings: list[float], rng: np.random.Generator
) -> list[Solid]:
    """Lamp posts, signs, signals, bollards, trees and people along one side."""
    kerb = surface.kerb_left
    solids: list[Solid] = []
    for s in places_along(p, p.lamp_spacing, rng, 0.05):
        place, heading = ground_at(surface, s, side * (kerb + 0.5))
        solids += furniture.lamp_post(place, heading, side, _lean(p, rng), rng)
    for s in places_along(p, p.sign_spacing, rng):
        place, heading = ground_at(surface, s, side * (kerb + rng.uniform(0.4, 1.0)))
        solids += furniture.sign_post(place, heading, _lean(p, rng), rng)
    for s in crossings:
        place, heading = ground_at(surface, s - 1.5, side * (kerb + 0.4))
        if rng.random() < 0.6:
            solids += furniture.traffic_light(place, heading, rng)
    for s in places_along(p, p.tree_spacing, rng):
        beyond = surface.pavement - 0.8 if p.town else rng.uniform(2.0, 9.0)
        solids += furniture.tree(ground_at(surface, s, side * (kerb + beyond))[0], rng)
    if p.town:
        for s in places_along(p, 25.0, rng, 0.5):
            place, _ = ground_at(surface, s, side * (kerb + rng.uniform(0.6, surface.pavement)))
            solids += furniture.person(place, rng)
        start = float(rng.uniform(0.0, p.length))
        for s in np.arange(start, start + 20.0, 2.2):
            place, _ = ground_at(surface, float(s), side * (kerb + 0.35))
            solids.append(furniture.post(place, 0.95, 0.05, _lean(p, rng), (0.3, 0.3, 0.3)))
    return solids


def _background(
    surface: RoadSurface, p: SceneParameters, side: float, rng: np.random.Generator
) -> list[Solid]:
    """Buildings, walls and hedges behind the pavement; guard rails and bushes along a country road."""
    solids: list[Solid] = []
    front = surface.kerb_left + surface.pavement
    s = -BEHIND_M
    while p.town and s < p.length:
        length, height = float(rng.uniform(9.0, 24.0)), float(rng.uniform(6.0, 18.0))
        depth = float(rng.uniform(8.0, 12.0))
        setback = float(rng.choice([0.3, 2.5, 5.0]))
        place, heading = ground_at(surface, s + length / 2, side * (front + setback + depth / 2))
        solids += furniture.building(place, heading, (length, depth, height), rng)
        if setback > 1.0:
            place, heading = ground_at(surface, s + length / 2, side * (front + 0.25))
            hedge = bool(rng.random() < 0.5)
            label = labels.VEGETATION if hedge else labels.CONSTRUCTION
            colour = (0.03, 0.09, 0.05) if hedge else (0.3, 0.33, 0.36)
            size = (0.9 * length, 0.4 if hedge else 0.15, float(rng.uniform(0.9, 1.6)))
            solids.append(furniture.panel(place, heading, size, colour, label))
        s += length + float(rng.choice([0.2, 3.0, 8.0]))
    if p.town:
        return solids
    railed = rng.random() < 0.5
    for s in np.arange(-BEHIND_M, p.length, 4.0):
        if railed:
            place, heading = ground_at(surface, float(s), side * (surface.kerb_left + 0.6))
            rail = furniture.panel(place, heading, (4.1, 0.06, 0.31), (0.4, 0.4, 0.4), labels.CONSTRUCTION)
            solids.append(_raised(rail, 0.45))
            solids.append(furniture.post(place, 0.7, 0.05, (0.0, 0.0)))
        if rng.random() < 0.35:
            place, _ = ground_at(surface, float(s), side * (surface.kerb_left + rng.uniform(2.5, 14.0)))
            solids += furniture.bush(place, float(rng.uniform(0.6, 2.0)), rng)
    return solids


def _raised(solid: Solid, height: float) -> Solid:
    return Solid(
        solid.shape,
        solid.centre + np.array([0.0, 0.0, height]),
        solid.axes,
        solid.half,
        solid.label,
        solid.colour,
        solid.reflectance,
        solid.material,
    )


def _horizon(surface: RoadSurface, p: SceneParameters, rng: np.random.Generator) -> list[Solid]:
    """A far belt of trees, so that the street does not end in the sky."""
    solids: list[Solid] = []
    for left in np.arange(-150.0, 151.0, 12.0):
        place, _ = ground_at(surface, p.length + 20.0 + float(rng.uniform(0.0, 15.0)), float(left))
        solids += furniture.bush(place, float(rng.uniform(5.0, 9.0)), rng)
    return solids


def parked(
    surface: RoadSurface, p: SceneParameters, side: float, crossings: list[float], rng: np.random.Generator
) -> list[Solid]:
    """Parked vehicles beside the kerb, none near a crossing."""
    solids: list[Solid] = []
    left = side * (surface.kerb_left - 1.15)
    for s in np.arange(-BEHIND_M, p.length, 6.5):
        near = any(-8.0 < s - c < 11.0 for c in crossings)
        if near or rng.random() > p.parked_share:
            continue
        parts = furniture.van(rng) if rng.random() < 0.12 else furniture.car(rng)
        place, heading, grade = surface.pose(float(s), left + float(rng.normal(0.0, 0.08)))
        turn = float(heading) + (math.pi if side > 0 else 0.0) + float(rng.normal(0.0, 0.02))
        R = upright(turn, (-math.atan(float(grade) * math.cos(turn)), 0.0))
        solids += [
            Solid(
                q.shape,
                place + R @ q.centre,
                R @ q.axes,
                q.half,
                q.label,
                q.colour,
                q.reflectance,
                q.material,
            )
            for q in parts
        ]
    return solids


def traffic(p: SceneParameters, forward: int, rng: np.random.Generator) -> tuple[Mover, ...]:
    """Vehicles in every lane but the own one: those that come towards us, and those beside us."""
    edge = p.lanes * p.lane_width / 2
    lanes = [k for k in range(p.lanes) if k > 0]
    taken: list[tuple[int, float]] = []
    movers = []
    for _ in range(p.traffic):
        if not lanes:
            break
        lane = int(rng.choice(lanes))
        arc = float(rng.uniform(-30.0, 1.2 * p.length if lane >= forward else 90.0))
        if any(lane == other and abs(arc - place) < 16.0 for other, place in taken):
            continue
        taken.append((lane, arc))
        parts = furniture.van(rng) if rng.random() < 0.2 else furniture.car(rng)
        # One speed a lane: vehicles do not run into each other.
        speed = -10.5 if lane >= forward else 11.5 + lane
        movers.append(Mover(Solids.of(parts), arc, -edge + (lane + 0.5) * p.lane_width, speed))
    return tuple(movers)
