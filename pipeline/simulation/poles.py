"""Poles of every kind along roads: lamp posts, sign posts, signals, gantries, utility poles, bollards.

Every function takes the place on the ground (3,), the heading of the road there and a generator. What
carries is labelled pole, what is carried is sign; wires belong to nothing.
"""
# ruff: noqa: PLR2004 - the figures are odds of a draw, each beside what it decides

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from pipeline import labels
from pipeline.records import Floats
from pipeline.simulation.furniture import SIGN_COLOURS, Colour, bar, pick, post
from pipeline.simulation.solids import Material, Shape, Solid, upright

Lean = tuple[float, float]
STEELS: tuple[Colour, ...] = (
    (0.24, 0.24, 0.23),
    (0.45, 0.45, 0.44),
    (0.12, 0.12, 0.12),
    (0.03, 0.03, 0.03),
    (0.05, 0.09, 0.04),
    (0.62, 0.62, 0.60),
    (0.30, 0.36, 0.40),
    (0.10, 0.05, 0.03),
)
_WOODS: tuple[Colour, ...] = ((0.10, 0.15, 0.20), (0.16, 0.19, 0.21), (0.06, 0.08, 0.11))
_GLOW: Colour = (0.65, 0.85, 1.0)


def _steel(rng: np.random.Generator) -> tuple[Colour, Material]:
    """Colour and finish of a metal post: one in four is rusty, one in seven dirty grey concrete."""
    kind = Material.RUST if rng.random() < 0.25 else Material.PLAIN
    return pick(rng, STEELS, 0.3), kind


def _finished(solid: Solid, material: Material) -> Solid:
    return replace(solid, material=material)


def _aside(heading: float) -> Floats:
    return np.array([-math.sin(heading), math.cos(heading), 0.0])


def _top(mast: Solid) -> Floats:
    return np.asarray(mast.centre + mast.axes[:, 2] * mast.half[2])


def lantern(place: Floats, heading: float, size: float) -> list[Solid]:
    """The head of a street lamp with its pane below."""
    axes = upright(heading)
    body = Solid(
        Shape.BOX, place, axes, size * np.array([0.35, 0.13, 0.06]), labels.POLE, (0.2, 0.2, 0.2), 0.3
    )
    below = place - np.array([0.0, 0.0, 0.075 * size])
    pane = Solid(
        Shape.BOX, below, axes, size * np.array([0.28, 0.1, 0.02]), labels.POLE, _GLOW, 0.3, Material.LAMP
    )
    return [body, pane]


def street_lamp(
    ground: Floats, heading: float, side: float, lean: Lean, rng: np.random.Generator
) -> list[Solid]:
    """A lamp post of 3.5 to 12 m: straight, with one arm or two, bent, or with a ball on top."""
    height, radius = float(rng.uniform(3.5, 12.0)), float(rng.uniform(0.045, 0.13))
    colour, material = _steel(rng)
    mast = _finished(post(ground, height, radius, lean, colour), material)
    parts = [mast]
    if rng.random() < 0.4:
        parts.append(
            _finished(post(ground, float(rng.uniform(0.6, 1.6)), 1.5 * radius, lean, colour), material)
        )
    top, kind = _top(mast), int(rng.integers(5))
    inward = -side * _aside(heading)
    if kind == 0:
        ball = Solid(
            Shape.ELLIPSOID, top, np.eye(3), np.full(3, 0.22), labels.POLE, _GLOW, 0.3, Material.LAMP
        )
        return [*parts, ball]
    reach, rise = float(rng.uniform(0.7, 2.8)), float(rng.uniform(0.0, 0.9))
    for way in (inward, -inward) if kind == 1 else (inward,):
        end = top + reach * way + np.array([0.0, 0.0, rise])
        if kind == 2:
            parts += bent_arm(top, way, (reach, rise + 0.6), 0.7 * radius, colour)
            end = top + reach * way + np.array([0.0, 0.0, rise + 0.6])
        elif kind != 4:
            parts.append(bar(top, end, 0.55 * radius, labels.POLE, colour, reflectance=0.35))
        else:
            end = top + 0.2 * way
        parts += lantern(end, heading + math.pi / 2, float(rng.uniform(0.7, 1.5)))
    return parts


def bent_arm(
    top: Floats, way: Floats, size: tuple[float, float], radius: float, colour: Colour
) -> list[Solid]:
    """A quarter of an ellipse from the top of a mast to a lamp, in four straight pieces."""
    angle = np.linspace(0.0, math.pi / 2, 5)
    places = top + np.outer(size[0] * (1.0 - np.cos(angle)), way)
    places[:, 2] += size[1] * np.sin(angle)
    return [bar(a, b, radius, labels.POLE, colour, reflectance=0.35) for a, b in pairwise(places)]


def plate(place: Floats, facing: float, half: tuple[float, float], rng: np.random.Generator) -> Solid:
    """A sign that faces against ``facing``: round, square, on its tip or oblong, ``half`` wide and high."""
    axes, kind = upright(facing), rng.random()
    size = np.array([0.015, half[0], half[1]])
    if kind < 0.4 and abs(half[0] - half[1]) < 0.02:
        axes, size = axes[:, [1, 2, 0]], np.array([half[0], half[0], 0.015])
        shape = Shape.CYLINDER
    else:
        shape = Shape.BOX
        if kind > 0.85:
            c = math.sqrt(0.5)
            axes = axes @ np.array([[1.0, 0.0, 0.0], [0.0, c, -c], [0.0, c, c]])
    colour = pick(rng, (*SIGN_COLOURS, (0.08, 0.35, 0.06), (0.03, 0.03, 0.5)), 0.15)
    return Solid(shape, place, axes, size, labels.SIGN, colour, 0.95, Material.PLATE)


def signed_post(ground: Floats, heading: float, lean: Lean, rng: np.random.Generator) -> list[Solid]:
    """A post of 1.8 to 4.2 m with up to three signs that face the traffic, or show their backs."""
    height = float(rng.uniform(1.8, 4.2))
    colour, material = _steel(rng)
    material = Material.BANDS if rng.random() < 0.08 else material
    mast = _finished(post(ground, height, float(rng.uniform(0.02, 0.055)), lean, colour), material)
    facing = heading + (0.0 if rng.random() < 0.65 else math.pi) + float(rng.normal(0.0, 0.2))
    back = -0.07 * np.array([math.cos(facing), math.sin(facing), 0.0])
    parts, top = [mast], height
    for _ in range(int(rng.integers(0, 4))):
        half_w = float(rng.uniform(0.2, 0.45))
        half_h = half_w if rng.random() < 0.65 else float(rng.uniform(0.1, 0.5))
        if top - 2.0 * half_h < 0.8:
            break
        parts.append(plate(ground + mast.axes[:, 2] * (top - half_h) + back, facing, (half_w, half_h), rng))
        top -= 2.0 * half_h + float(rng.uniform(0.02, 0.1))
    return parts


def board(ground: Floats, heading: float, rng: np.random.Generator) -> list[Solid]:
    """A large guide sign on two posts."""
    width, height = float(rng.uniform(1.0, 2.6)), float(rng.uniform(0.5, 1.4))
    clear = float(rng.uniform(0.6, 2.4))
    colour, material = _steel(rng)
    way, back = _aside(heading), 0.1 * np.array([math.cos(heading), math.sin(heading), 0.0])
    parts = [
        _finished(
            post(ground + k * 0.6 * width * way, clear + 2.0 * height, 0.05, (0.0, 0.0), colour), material
        )
        for k in (-1.0, 1.0)
    ]
    middle = ground + np.array([0.0, 0.0, clear + height]) - back
    return [*parts, plate(middle, heading, (width, height + 0.05), rng)]


def signal(ground: Floats, heading: float, side: float, lean: Lean, rng: np.random.Generator) -> list[Solid]:
    """Traffic lights on a post, and half of the time on an arm over the road as well."""
    colour, material = _steel(rng)
    arm = rng.random() < 0.5
    height = float(rng.uniform(5.2, 6.5)) if arm else float(rng.uniform(2.8, 4.0))
    radius = float(rng.uniform(0.08, 0.14)) if arm else float(rng.uniform(0.05, 0.08))
    mast = _finished(post(ground, height, radius, lean, colour), material)
    parts, inward = [mast], -side * _aside(heading)
    facing = heading + (0.0 if rng.random() < 0.7 else math.pi)
    front = -0.22 * np.array([math.cos(facing), math.sin(facing), 0.0])
    heads = [ground + front + np.array([0.0, 0.0, min(height, 3.4) - 0.5])]
    if arm:
        reach = float(rng.uniform(3.0, 8.0))
        end = _top(mast) + reach * inward + np.array([0.0, 0.0, float(rng.uniform(0.0, 0.5))])
        parts.append(bar(_top(mast), end, 0.6 * radius, labels.POLE, colour, reflectance=0.35))
        heads += [_top(mast) + k * (end - _top(mast)) + front for k in (0.6, 0.97)]
    for place in heads:
        parts += signal_head(place, facing, rng)
    return parts


def signal_head(place: Floats, facing: float, rng: np.random.Generator) -> list[Solid]:
    """The box of a traffic light with one lamp that is lit."""
    axes = upright(facing)
    colour: Colour = (0.02, 0.02, 0.02) if rng.random() < 0.7 else (0.05, 0.45, 0.55)
    box = Solid(Shape.BOX, place, axes, np.array([0.13, 0.16, 0.45]), labels.SIGN, colour, 0.15)
    lit = int(rng.integers(3))
    glow: Colour = ((0.05, 0.05, 0.9), (0.05, 0.6, 0.9), (0.3, 0.9, 0.1))[lit]
    lamp = Solid(
        Shape.CYLINDER,
        place + axes @ np.array([-0.14, 0.0, 0.28 - 0.28 * lit]),
        axes[:, [1, 2, 0]],
        np.array([0.1, 0.1, 0.02]),
        labels.SIGN,
        glow,
        0.3,
        Material.LAMP,
    )
    return [box, lamp]


def gantry(left: Floats, right: Floats, heading: float, rng: np.random.Generator) -> list[Solid]:
    """Two posts and a beam across the road with signs on it."""
    height, radius = float(rng.uniform(5.2, 6.5)), float(rng.uniform(0.1, 0.22))
    colour, _ = _steel(rng)
    posts = [post(p, height, radius, (0.0, 0.0), colour) for p in (left, right)]
    parts = [*posts, bar(_top(posts[0]), _top(posts[1]), 0.8 * radius, labels.POLE, colour, reflectance=0.35)]
    front = -0.3 * np.array([math.cos(heading), math.sin(heading), 0.0])
    for share in rng.uniform(0.15, 0.85, int(rng.integers(1, 4))):
        place = _top(posts[0]) + share * (_top(posts[1]) - _top(posts[0])) + front
        if rng.random() < 0.3:
            parts += signal_head(place, heading, rng)
        else:
            parts.append(
                plate(place, heading, (float(rng.uniform(0.8, 2.0)), float(rng.uniform(0.6, 1.1))), rng)
            )
    return parts


def utility_poles(grounds: list[Floats], heading: float, rng: np.random.Generator) -> list[Solid]:
    """A row of wooden or concrete poles with cross arms and the wires between them."""
    height, radius = float(rng.uniform(6.5, 11.0)), float(rng.uniform(0.09, 0.17))
    wooden = rng.random() < 0.65
    colour = pick(rng, _WOODS if wooden else ((0.35, 0.37, 0.38),), 0.25)
    material = Material.WOOD if wooden else Material.PLAIN
    way, parts = _aside(heading), []
    arms = int(rng.integers(0, 3))
    tops: list[list[Floats]] = []
    for ground in grounds:
        lean = (float(rng.normal(0.0, 0.02)), float(rng.normal(0.0, 0.02)))
        mast = _finished(post(ground, height, radius, lean, colour), material)
        parts.append(mast)
        ends = [_top(mast)] if arms == 0 else []
        for k in range(arms):
            middle = _top(mast) - mast.axes[:, 2] * (0.3 + 0.7 * k)
            a, b = middle - 0.9 * way, middle + 0.9 * way
            parts.append(bar(a, b, 0.055, labels.POLE, colour, reflectance=0.35))
            ends += [a, b]
        if rng.random() < 0.25:
            place = _top(mast) - mast.axes[:, 2] * 1.8 + 0.35 * way
            parts.append(
                Solid(
                    Shape.CYLINDER,
                    place,
                    np.eye(3),
                    np.array([0.22, 0.22, 0.4]),
                    labels.OTHER,
                    (0.3, 0.3, 0.3),
                    0.3,
                )
            )
        tops.append(ends)
    for first, second in pairwise(tops):
        for a, b in zip(first[:3], second[:3], strict=True):
            parts += _wire(a, b)
    return parts


def _wire(a: Floats, b: Floats) -> list[Solid]:
    """A slack wire in two straight pieces."""
    middle = 0.5 * (a + b) - np.array([0.0, 0.0, 0.02 * float(np.linalg.norm(b - a))])
    dark = (0.02, 0.02, 0.02)
    return [bar(p, q, 0.012, labels.OTHER, dark, reflectance=0.1) for p, q in ((a, middle), (middle, b))]


def bollard(ground: Floats, lean: Lean, rng: np.random.Generator) -> list[Solid]:
    """A bollard, a marker post or a delineator of 0.5 to 1.3 m."""
    height, radius = float(rng.uniform(0.5, 1.3)), float(rng.uniform(0.03, 0.09))
    colour, material = _steel(rng)
    if rng.random() < 0.3:
        material = Material.BANDS
    parts = [_finished(post(ground, height, radius, lean, colour), material)]
    if rng.random() < 0.25:
        band = post(ground + np.array([0.0, 0.0, 0.75 * height]), 0.1, 1.06 * radius, lean, (0.6, 0.6, 0.6))
        parts.append(band)
    return parts
