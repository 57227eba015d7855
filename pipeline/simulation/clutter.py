"""What stands beside roads and is easily taken for poles: trunks, fronts, fences, pillars, chimneys, people.

None of it is labelled pole. Every function takes the place on the ground (3,), the heading there and a
generator.
"""
# ruff: noqa: PLR2004 - the figures are odds of a draw, each beside what it decides

import math
from dataclasses import replace

import numpy as np

from pipeline import labels
from pipeline.records import Floats
from pipeline.simulation.furniture import WALL_COLOURS, Colour, bar, panel, person, pick, post
from pipeline.simulation.solids import Material, Shape, Solid, upright

_WALLS: tuple[Colour, ...] = (
    *WALL_COLOURS,
    (0.55, 0.60, 0.62),
    (0.08, 0.11, 0.24),
    (0.10, 0.12, 0.14),
    (0.28, 0.40, 0.58),
    (0.62, 0.62, 0.60),
)
_BARKS: tuple[Colour, ...] = ((0.05, 0.07, 0.09), (0.10, 0.12, 0.14), (0.03, 0.04, 0.05), (0.06, 0.11, 0.13))
_GREENS: tuple[Colour, ...] = (
    (0.03, 0.12, 0.05),
    (0.02, 0.09, 0.06),
    (0.03, 0.14, 0.10),
    (0.02, 0.07, 0.03),
    (0.04, 0.16, 0.18),
    (0.03, 0.09, 0.22),
)
_ROOFS: tuple[Colour, ...] = ((0.08, 0.09, 0.13), (0.06, 0.08, 0.22), (0.05, 0.05, 0.05), (0.15, 0.16, 0.17))


def _limb(start: Floats, end: Floats, radius: float, colour: Colour) -> Solid:
    return replace(
        bar(start, end, radius, labels.VEGETATION, colour, reflectance=0.3), material=Material.BARK
    )


def tree(ground: Floats, rng: np.random.Generator) -> list[Solid]:
    """A tree with a straight, leaning or forked trunk, thin or thick, with boughs, in leaf or bare."""
    bark = pick(rng, _BARKS, 0.3)
    radius = float(np.exp(rng.uniform(math.log(0.05), math.log(0.4))))
    bole = float(rng.uniform(1.6, 5.0))
    lean = rng.normal(0.0, 0.12 if rng.random() < 0.4 else 0.03, 2)
    up = np.array([lean[0], lean[1], 1.0])
    foot, fork = ground - 0.3 * up, ground + bole * up
    # A trunk tapers and is never quite straight.
    knee = ground + 0.5 * bole * up + np.append(rng.normal(0.0, 0.4 * radius, 2), 0.0)
    parts = [_limb(foot, knee, radius, bark), _limb(knee, fork, 0.85 * radius, bark)]
    bare = rng.random() < 0.25
    ends = []
    for _ in range(int(rng.integers(2, 5))):
        turn, rise = float(rng.uniform(0.0, 2.0 * math.pi)), float(rng.uniform(0.5, 1.3))
        length = float(rng.uniform(1.0, 2.6))
        way = np.array([math.cos(turn) * math.cos(rise), math.sin(turn) * math.cos(rise), math.sin(rise)])
        start = ground + float(rng.uniform(0.7, 1.0)) * bole * up
        ends.append(start + length * way)
        parts.append(_limb(start, ends[-1], 0.5 * radius, bark))
        for _ in range(4 if bare else 0):
            from_ = start + float(rng.uniform(0.4, 1.0)) * length * way
            twig = way + rng.normal(0.0, 0.5, 3)
            parts.append(_limb(from_, from_ + 0.6 * length * twig, 0.2 * radius, bark))
    if not bare:
        parts += _crown(fork, ends, rng)
    return parts


def _crown(fork: Floats, ends: list[Floats], rng: np.random.Generator) -> list[Solid]:
    green = pick(rng, _GREENS, 0.35)
    size = float(rng.uniform(0.9, 2.4))
    middles = [*ends, fork + np.array([0.0, 0.0, 1.0 + size])]
    return [leaves(m, size * rng.uniform(0.7, 1.2, 3), green, rng) for m in middles]


def leaves(middle: Floats, half: Floats, green: Colour, rng: np.random.Generator) -> Solid:
    """One ragged mass of leaves."""
    return Solid(
        Shape.ELLIPSOID,
        middle,
        upright(float(rng.uniform(0.0, math.pi))),
        np.asarray(half),
        labels.VEGETATION,
        pick(rng, (green,), 0.2),
        0.35,
        Material.CANOPY,
    )


def conifer(ground: Floats, rng: np.random.Generator) -> list[Solid]:
    """A fir: a thin trunk and tiers of drooping boughs."""
    height, green = float(rng.uniform(4.0, 14.0)), pick(rng, ((0.02, 0.06, 0.03), (0.03, 0.08, 0.05)), 0.3)
    trunk = _limb(
        ground - np.array([0.0, 0.0, 0.3]), ground + np.array([0.0, 0.0, 0.9 * height]), 0.1, _BARKS[0]
    )
    tiers = []
    for share in np.arange(0.18, 1.0, 0.2):
        wide = 0.24 * height * (1.08 - share)
        middle = ground + np.array([0.0, 0.0, share * height])
        tiers.append(leaves(middle, np.array([wide, wide, 0.17 * height]), green, rng))
    return [trunk, *tiers]


def thicket(ground: Floats, size: float, rng: np.random.Generator) -> list[Solid]:
    """Bushes."""
    green = pick(rng, _GREENS, 0.3)
    masses = []
    for _ in range(int(rng.integers(1, 4))):
        offset = np.append(rng.normal(0.0, 0.6 * size, 2), rng.uniform(0.2, 0.6) * size)
        masses.append(leaves(ground + offset, size * rng.uniform(0.5, 1.0, 3), green, rng))
    return masses


def house(
    ground: Floats, heading: float, size: tuple[float, float, float], rng: np.random.Generator
) -> list[Solid]:
    """A block of (length, depth, height) m with a front, a flat or steep roof, chimneys and masts on it."""
    length, depth, height = size
    axes, wall = upright(heading), pick(rng, _WALLS, 0.3)
    block = Solid(
        Shape.BOX,
        ground + np.array([0.0, 0.0, height / 2 - 0.5]),
        axes,
        np.array([length / 2, depth / 2, height / 2 + 0.5]),
        labels.CONSTRUCTION,
        wall,
        0.35,
        Material.FRONT,
    )
    roof, parts = pick(rng, _ROOFS, 0.3), [block]
    top = ground + np.array([0.0, 0.0, height])
    if rng.random() < 0.45:
        # A square beam on its edge, half sunk in the block, is a roof of 45 degrees.
        c = math.sqrt(0.5)
        edge = axes @ np.array([[1.0, 0.0, 0.0], [0.0, c, -c], [0.0, c, c]])
        half = np.array([length / 2 + 0.2, 0.36 * depth, 0.36 * depth])
        parts.append(Solid(Shape.BOX, top, edge, half, labels.CONSTRUCTION, roof, 0.25))
    else:
        half = np.array([length / 2 + 0.25, depth / 2 + 0.25, float(rng.uniform(0.08, 0.3))])
        parts.append(Solid(Shape.BOX, top, axes, half, labels.CONSTRUCTION, roof, 0.25))
    for _ in range(int(rng.integers(0, 4))):
        place = top + axes @ np.array([rng.uniform(-0.4, 0.4) * length, rng.uniform(-0.3, 0.3) * depth, 0.0])
        thick, tall = float(rng.uniform(0.04, 0.5)), float(rng.uniform(1.5, 3.5))
        half = np.array([thick, min(thick, 0.35), tall])
        parts.append(Solid(Shape.BOX, place, axes, half, labels.CONSTRUCTION, pick(rng, _WALLS), 0.3))
    return parts


def arcade(ground: Floats, heading: float, length: float, rng: np.random.Generator) -> list[Solid]:
    """Pillars, square or round, under a beam: what holds up a porch, a bridge or a station roof."""
    pitch, height = float(rng.uniform(1.8, 5.0)), float(rng.uniform(2.6, 5.0))
    radius, colour = float(rng.uniform(0.12, 0.4)), pick(rng, _WALLS, 0.3)
    axes = upright(heading)
    parts = []
    for x in np.arange(-length / 2, length / 2 + 0.01, pitch):
        place = ground + x * axes[:, 0]
        if rng.random() < 0.02:
            continue
        half = np.array([radius, radius, height / 2])
        middle = place + np.array([0.0, 0.0, height / 2])
        parts.append(Solid(Shape.BOX, middle, axes, half, labels.CONSTRUCTION, colour, 0.35))
    beam = np.array([length / 2 + radius, 1.3 * radius, 0.25])
    over = ground + np.array([0.0, 0.0, height + 0.25])
    return [*parts, Solid(Shape.BOX, over, axes, beam, labels.CONSTRUCTION, colour, 0.35)]


def fence(ground: Floats, heading: float, length: float, rng: np.random.Generator) -> list[Solid]:
    """A railing, a picket fence or wire mesh between posts that belong to the fence."""
    height = float(rng.uniform(0.8, 2.2))
    colour = pick(
        rng, ((0.03, 0.03, 0.03), (0.35, 0.35, 0.35), (0.6, 0.6, 0.6), (0.1, 0.17, 0.25), (0.05, 0.12, 0.05))
    )
    axes = upright(heading)
    wall = 0.4 if rng.random() < 0.25 else 0.0
    sheet = Solid(
        Shape.BOX,
        ground + np.array([0.0, 0.0, wall + height / 2]),
        axes,
        np.array([length / 2, 0.012, height / 2]),
        labels.CONSTRUCTION,
        colour,
        0.35,
        Material.RAILING,
    )
    parts = [sheet]
    if wall:
        parts.append(panel(ground, heading, (length, 0.3, wall), pick(rng, _WALLS), labels.CONSTRUCTION))
    for x in np.arange(-length / 2, length / 2 + 0.01, float(rng.uniform(2.0, 3.5))):
        stake = post(
            ground + x * axes[:, 0], wall + height + 0.1, float(rng.uniform(0.02, 0.06)), (0.0, 0.0), colour
        )
        parts.append(replace(stake, label=labels.CONSTRUCTION))
    return parts


def guard_rail(ground: Floats, heading: float, length: float, rng: np.random.Generator) -> list[Solid]:
    """A steel beam or two cables on short posts, or a concrete barrier: one stretch of it."""
    steel = pick(rng, ((0.4, 0.4, 0.4), (0.25, 0.28, 0.3)), 0.2)
    axes = upright(heading)
    parts = [panel(ground, heading, (length + 0.1, 0.06, 0.31), steel, labels.CONSTRUCTION)]
    parts[0] = replace(parts[0], centre=parts[0].centre + np.array([0.0, 0.0, 0.45]))
    for x in np.arange(-length / 2 + 0.5, length / 2, 2.0):
        stake = post(ground + x * axes[:, 0], 0.72, 0.05, (0.0, 0.0), steel)
        parts.append(replace(stake, label=labels.CONSTRUCTION))
    return parts


def billboard(ground: Floats, heading: float, rng: np.random.Generator) -> list[Solid]:
    """A hoarding on two stout legs or on the ground, or the lit box of a bus stop."""
    width, height = float(rng.uniform(0.6, 3.0)), float(rng.uniform(0.8, 1.6))
    clear = float(rng.choice([0.0, 0.3, 2.2]))
    axes = upright(heading + float(rng.normal(0.0, 0.4)))
    middle = ground + np.array([0.0, 0.0, clear + height])
    half = np.array([0.08, width, height])
    sheet = Solid(Shape.BOX, middle, axes, half, labels.CONSTRUCTION, (0.4, 0.4, 0.4), 0.4, Material.POSTER)
    if not clear:
        return [sheet]
    legs = [
        replace(
            post(ground + k * 0.7 * width * axes[:, 1], clear, 0.09, (0.0, 0.0)), label=labels.CONSTRUCTION
        )
        for k in (-1.0, 1.0)
    ]
    return [sheet, *legs]


def people(ground: Floats, rng: np.random.Generator) -> list[Solid]:
    """One to three people close together."""
    parts: list[Solid] = []
    for _ in range(int(rng.integers(1, 4))):
        parts += person(ground + np.append(rng.normal(0.0, 0.5, 2), 0.0), rng)
    return parts


def bin_or_box(ground: Floats, heading: float, rng: np.random.Generator) -> list[Solid]:
    """A litter bin, a cabinet or a post box: low, upright and no pole."""
    half = np.array([rng.uniform(0.15, 0.5), rng.uniform(0.15, 0.6), rng.uniform(0.4, 0.75)])
    shape = Shape.CYLINDER if rng.random() < 0.35 else Shape.BOX
    colour = pick(rng, ((0.3, 0.3, 0.3), (0.05, 0.2, 0.05), (0.03, 0.03, 0.4), (0.05, 0.4, 0.5)), 0.3)
    middle = ground + np.array([0.0, 0.0, half[2]])
    return [Solid(shape, middle, upright(heading), half, labels.OTHER, colour, 0.3)]
