"""What stands in a street, each thing as a list of solids: poles, signs, trees, buildings, vehicles, people.

Every function takes the place on the ground (3,), the heading there in rad and a generator for the details.
"""
# ruff: noqa: PLR2004 - the figures are odds of a draw, each beside what it decides

import math

import numpy as np

from pipeline import labels
from pipeline.records import Floats
from pipeline.simulation.solids import Material, Shape, Solid, upright

Colour = tuple[float, float, float]

GREY_STEEL: Colour = (0.22, 0.22, 0.21)
CAR_COLOURS: tuple[Colour, ...] = (
    (0.02, 0.02, 0.02),
    (0.10, 0.10, 0.10),
    (0.35, 0.35, 0.34),
    (0.70, 0.70, 0.70),
    (0.25, 0.08, 0.04),
    (0.05, 0.05, 0.30),
    (0.08, 0.16, 0.06),
)
SIGN_COLOURS: tuple[Colour, ...] = ((0.05, 0.05, 0.55), (0.45, 0.15, 0.03), (0.7, 0.7, 0.7), (0.05, 0.5, 0.6))
WALL_COLOURS: tuple[Colour, ...] = (
    (0.30, 0.42, 0.50),
    (0.45, 0.50, 0.55),
    (0.12, 0.17, 0.32),
    (0.35, 0.36, 0.38),
    (0.18, 0.28, 0.40),
)


def pick(rng: np.random.Generator, colours: tuple[Colour, ...], spread: float = 0.25) -> Colour:
    """One of the colours, a little brighter or darker."""
    b, g, r = colours[int(rng.integers(len(colours)))]
    k = float(np.exp(rng.normal(0.0, spread)))
    return (min(b * k, 0.9), min(g * k, 0.9), min(r * k, 0.9))


def _up(height: float) -> Floats:
    return np.array([0.0, 0.0, height])


def bar(
    start: Floats, end: Floats, radius: float, label: int, colour: Colour, *, reflectance: float
) -> Solid:
    """A cylinder between two points."""
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    half = np.array([radius, radius, 0.5 * float(np.linalg.norm(end - start))])
    axes = np.column_stack([side, np.cross(axis, side), axis])
    return Solid(Shape.CYLINDER, 0.5 * (start + end), axes, half, label, colour, reflectance)


def post(
    ground: Floats, height: float, radius: float, lean: tuple[float, float], colour: Colour = GREY_STEEL
) -> Solid:
    """A bare pole; ``lean`` forward and left in rad of the world's axes."""
    axes = upright(0.0, lean)
    foot = ground - 0.2 * axes[:, 2]
    return bar(foot, ground + height * axes[:, 2], radius, labels.POLE, colour, reflectance=0.35)


def lamp_post(
    ground: Floats, heading: float, side: float, lean: tuple[float, float], rng: np.random.Generator
) -> list[Solid]:
    """A lamp post of 5 to 8 m whose arm reaches over the road; ``side`` is +1 left of the road, -1 right."""
    height, radius = float(rng.uniform(5.0, 8.0)), float(rng.uniform(0.06, 0.13))
    colour = pick(rng, (GREY_STEEL, (0.30, 0.30, 0.29), (0.08, 0.10, 0.07)))
    mast = post(ground, height, radius, lean, colour)
    if rng.random() < 0.3:
        return [mast]
    top = mast.centre + mast.axes[:, 2] * mast.half[2]
    inward = -side * np.array([-math.sin(heading), math.cos(heading), 0.0])
    end = top + inward * rng.uniform(0.8, 1.8) + _up(0.15)
    head = Solid(
        Shape.BOX,
        end,
        upright(heading + math.pi / 2),
        np.array([0.35, 0.12, 0.06]),
        labels.POLE,
        colour,
        0.3,
    )
    return [mast, bar(top, end, 0.045, labels.POLE, colour, reflectance=0.35), head]


def sign_post(
    ground: Floats, heading: float, lean: tuple[float, float], rng: np.random.Generator
) -> list[Solid]:
    """A post of 2.6 to 3.6 m with one or two plates that face the traffic."""
    height = float(rng.uniform(2.6, 3.6))
    mast = post(ground, height, float(rng.uniform(0.03, 0.05)), lean, (0.35, 0.35, 0.34))
    facing = heading + (0.0 if rng.random() < 0.75 else math.pi) + rng.normal(0.0, 0.08)
    back = -0.06 * np.array([math.cos(facing), math.sin(facing), 0.0])
    parts, top = [mast], height - 0.05
    for _ in range(1 + int(rng.random() < 0.3)):
        half = float(rng.uniform(0.28, 0.42))
        centre = ground + (mast.axes[:, 2]) * (top - half) + back
        axes = upright(facing)
        round_plate = rng.random() < 0.5
        # The axis of a round plate is the cylinder's z: it points along the road.
        turned = axes[:, [1, 2, 0]] if round_plate else axes
        size = np.array([half, half, 0.015]) if round_plate else np.array([0.015, half, half])
        parts.append(
            Solid(
                Shape.CYLINDER if round_plate else Shape.BOX,
                centre,
                turned,
                size,
                labels.SIGN,
                pick(rng, SIGN_COLOURS, 0.1),
                0.95,
                Material.PLATE,
            )
        )
        top -= 2.0 * half + 0.05
    return parts


def traffic_light(ground: Floats, heading: float, rng: np.random.Generator) -> list[Solid]:
    """A signal on a post of 3 to 3.5 m."""
    height = float(rng.uniform(3.0, 3.5))
    mast = post(ground, height, 0.07, (0.0, 0.0), (0.10, 0.12, 0.10))
    centre = ground + _up(height - 0.5) - 0.2 * np.array([math.cos(heading), math.sin(heading), 0.0])
    axes = upright(heading)
    dark = Solid(Shape.BOX, centre, axes, np.array([0.14, 0.16, 0.45]), labels.SIGN, (0.02, 0.02, 0.02), 0.15)
    lit = int(rng.integers(3))
    colour = ((0.05, 0.05, 0.9), (0.05, 0.6, 0.9), (0.3, 0.9, 0.1))[lit]
    lamp_centre = centre + axes @ np.array([-0.14, 0.0, 0.28 - 0.28 * lit])
    lamp = Solid(
        Shape.CYLINDER,
        lamp_centre,
        axes[:, [1, 2, 0]],
        np.array([0.1, 0.1, 0.02]),
        labels.SIGN,
        colour,
        0.3,
    )
    return [mast, dark, lamp]


def tree(ground: Floats, rng: np.random.Generator) -> list[Solid]:
    """A trunk and a crown of ragged balls."""
    height, radius = float(rng.uniform(2.0, 3.2)), float(rng.uniform(0.1, 0.25))
    lean = tuple(rng.normal(0.0, 0.04, 2))
    up = upright(0.0, (float(lean[0]), float(lean[1])))[:, 2]
    foot, fork = ground - 0.2 * up, ground + (height + 1.0) * up
    trunk = bar(foot, fork, radius, labels.VEGETATION, (0.05, 0.08, 0.11), reflectance=0.3)
    crown = float(rng.uniform(1.4, 2.8))
    middle = ground + (height + 0.8 * crown) * up
    green = pick(rng, ((0.03, 0.12, 0.05), (0.02, 0.09, 0.06), (0.03, 0.14, 0.10)), 0.3)
    return [trunk, *_foliage(middle, np.array([crown, crown, crown]), 5, green, rng)]


def bush(ground: Floats, size: float, rng: np.random.Generator) -> list[Solid]:
    """A bush of two or three balls."""
    green = pick(rng, ((0.03, 0.11, 0.05), (0.03, 0.09, 0.07)), 0.3)
    return _foliage(ground + _up(0.6 * size), np.array([size, size, 0.7 * size]), 2, green, rng)


def _foliage(
    middle: Floats, half: Floats, count: int, green: Colour, rng: np.random.Generator
) -> list[Solid]:
    balls = []
    for k in range(count + 1):
        offset = np.zeros(3) if k == 0 else rng.normal(0.0, 1.0, 3)
        offset *= 0.6 / max(1.0, float(np.linalg.norm(offset)))
        size = half * (0.75 if k == 0 else rng.uniform(0.4, 0.65))
        axes = upright(float(rng.uniform(0.0, math.pi)))
        balls.append(
            Solid(
                Shape.ELLIPSOID,
                middle + half * offset,
                axes,
                size,
                labels.VEGETATION,
                pick(rng, (green,), 0.15),
                0.35,
                Material.LEAVES,
            )
        )
    return balls


def building(
    ground: Floats, heading: float, size: tuple[float, float, float], rng: np.random.Generator
) -> list[Solid]:
    """A block of (length, depth, height) m around ``ground`` with windows and a roof edge."""
    length, depth, height = size
    wall = pick(rng, WALL_COLOURS)
    axes = upright(heading)
    up = axes[:, 2]
    block = Solid(
        Shape.BOX,
        ground + up * (height / 2 - 0.5),
        axes,
        np.array([length / 2, depth / 2, height / 2 + 0.5]),
        labels.CONSTRUCTION,
        wall,
        0.35,
        Material.FACADE,
    )
    roof = Solid(
        Shape.BOX,
        ground + up * (height + 0.15),
        axes,
        np.array([length / 2 + 0.3, depth / 2 + 0.3, 0.15]),
        labels.CONSTRUCTION,
        pick(rng, ((0.08, 0.09, 0.13), (0.06, 0.08, 0.22)), 0.1),
        0.25,
    )
    return [block, roof]


def panel(
    ground: Floats, heading: float, size: tuple[float, float, float], colour: Colour, label: int
) -> Solid:
    """A straight wall, fence or hedge of (length, thickness, height) m."""
    length, thickness, height = size
    hedge = label == labels.VEGETATION
    return Solid(
        Shape.BOX,
        ground + _up(height / 2 - 0.2),
        upright(heading),
        np.array([length / 2, thickness / 2, height / 2 + 0.2]),
        label,
        colour,
        0.35,
        Material.LEAVES if hedge else Material.PLAIN,
    )


def car(rng: np.random.Generator) -> list[Solid]:
    """A passenger car about 4.3 m long in its own frame: x forward, origin on the ground below its middle."""
    length, width = float(rng.uniform(3.8, 4.8)), float(rng.uniform(1.65, 1.85))
    waist, roof = float(rng.uniform(0.85, 1.0)), float(rng.uniform(1.4, 1.75))
    paint = pick(rng, CAR_COLOURS)
    back = float(rng.uniform(0.36, 0.49))
    gloss = float(rng.uniform(0.1, 0.5))
    front_of_cabin = float(rng.uniform(0.16, 0.28))
    cabin_middle = 0.5 * (front_of_cabin - back) * length
    cabin_half = 0.5 * (front_of_cabin + back) * length
    return [
        _part((0.0, 0.0, 0.5 * (0.22 + waist)), (length / 2, width / 2, 0.5 * (waist - 0.22)), paint, gloss),
        _part(
            (cabin_middle, 0.0, 0.5 * (waist + roof)),
            (cabin_half, 0.44 * width, 0.5 * (roof - waist)),
            paint,
            0.3,
            Material.CABIN,
        ),
        *_wheels(length, width, 0.31),
        *_lamps_and_plate(length, width, 0.75 * waist),
    ]


def van(rng: np.random.Generator) -> list[Solid]:
    """A van or lorry of 5 to 8 m in its own frame."""
    length, width, height = (float(rng.uniform(*r)) for r in ((5.0, 8.0), (1.95, 2.4), (2.2, 3.3)))
    paint = pick(rng, (*CAR_COLOURS, (0.75, 0.75, 0.75), (0.75, 0.75, 0.75)))
    cab = 1.7
    return [
        _part(
            (-cab / 2, 0.0, 0.5 * (0.4 + height)),
            ((length - cab) / 2, width / 2, 0.5 * (height - 0.4)),
            paint,
            0.5,
        ),
        _part((length / 2 - cab / 2, 0.0, 0.75), (cab / 2, 0.48 * width, 0.45), paint, 0.4),
        _part(
            (length / 2 - cab / 2 - 0.15, 0.0, 1.65),
            (cab / 2 - 0.2, 0.46 * width, 0.45),
            paint,
            0.3,
            Material.CABIN,
        ),
        *_wheels(length, width, 0.38),
        *_lamps_and_plate(length, width, 0.9),
    ]


def _part(
    centre: tuple[float, float, float],
    half: tuple[float, float, float],
    colour: Colour,
    reflectance: float,
    material: Material = Material.PLAIN,
) -> Solid:
    return Solid(
        Shape.BOX, np.array(centre), np.eye(3), np.array(half), labels.VEHICLE, colour, reflectance, material
    )


def _wheels(length: float, width: float, radius: float) -> list[Solid]:
    axes = np.column_stack([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return [
        Solid(
            Shape.CYLINDER,
            np.array([x * length, y * (width / 2 - 0.08), radius]),
            axes,
            np.array([radius, radius, 0.11]),
            labels.VEHICLE,
            (0.012, 0.012, 0.012),
            0.1,
        )
        for x in (-0.31, 0.31)
        for y in (-1.0, 1.0)
    ]


def _lamps_and_plate(length: float, width: float, height: float) -> list[Solid]:
    red, white = (0.03, 0.03, 0.4), (0.6, 0.6, 0.6)
    half = (0.03, 0.14, 0.08)
    return [
        *(_part((-length / 2, y * 0.4 * width, height), half, red, 0.9, Material.LIGHT) for y in (-1.0, 1.0)),
        *(
            _part((length / 2, y * 0.38 * width, 0.9 * height), half, white, 0.6, Material.LIGHT)
            for y in (-1.0, 1.0)
        ),
        _part((-length / 2, 0.0, 0.8 * height), (0.02, 0.26, 0.06), white, 0.95),
    ]


def person(ground: Floats, rng: np.random.Generator) -> list[Solid]:
    """Somebody standing: two legs, trunk, head."""
    cloth = pick(rng, ((0.03, 0.03, 0.03), (0.2, 0.08, 0.05), (0.05, 0.05, 0.3), (0.3, 0.3, 0.3)))
    axes = upright(float(rng.uniform(0.0, 2.0 * math.pi)))
    height = float(rng.uniform(1.55, 1.9))
    shapes = (
        ((0.0, 0.1, 0.24), (0.08, 0.08, 0.26), (0.04, 0.04, 0.04), Shape.CYLINDER),
        ((0.0, -0.1, 0.24), (0.08, 0.08, 0.26), (0.04, 0.04, 0.04), Shape.CYLINDER),
        ((0.0, 0.0, 0.65), (0.16, 0.25, 0.22), cloth, Shape.ELLIPSOID),
        ((0.0, 0.0, 0.93), (0.1, 0.1, 0.07), (0.2, 0.3, 0.5), Shape.ELLIPSOID),
    )
    scale = np.array([1.0, 1.0, height])
    return [
        Solid(
            shape,
            ground + axes @ (scale * centre),
            axes,
            scale * half,
            labels.OTHER,
            colour,
            reflectance=0.35,
        )
        for centre, half, colour, shape in shapes
    ]
