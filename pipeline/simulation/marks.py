"""Road marks as towns and countries paint them, and what lies on the road and is no paint."""
# ruff: noqa: PLR2004 - the figures are odds of a draw, each beside what it decides

import math

import numpy as np

from pipeline.simulation.paint import WHITE, YELLOW, Line, Paint, Patch, Stroke
from pipeline.simulation.roadway import GRASS, Bgr, Blot, Ribbon, Roadway
from pipeline.simulation.scene import SceneParameters

_GLYPHS = {
    "B": (
        (0, 0, 0, 7),
        (0, 7, 2.6, 6),
        (2.6, 6, 2.6, 4.4),
        (2.6, 4.4, 0, 3.6),
        (2.6, 3, 2.6, 1),
        (2.6, 1, 0, 0),
    ),
    "U": ((0, 7, 0, 0.4), (0, 0.3, 3, 0.3), (3, 0.4, 3, 7)),
    "S": ((3, 6.6, 0, 6.6), (0, 6.6, 0, 3.6), (0, 3.6, 3, 3.6), (3, 3.6, 3, 0.4), (3, 0.4, 0, 0.4)),
    "T": ((0, 6.7, 3, 6.7), (1.5, 6.7, 1.5, 0)),
    "O": ((0, 0.3, 0, 6.7), (0, 6.7, 3, 6.7), (3, 6.7, 3, 0.3), (3, 0.3, 0, 0.3)),
    "P": ((0, 0, 0, 6.7), (0, 6.7, 3, 6.7), (3, 6.7, 3, 3.4), (3, 3.4, 0, 3.4)),
    "L": ((0, 7, 0, 0.3), (0, 0.3, 3, 0.3)),
    "W": ((0, 7, 0.8, 0), (0.8, 0, 1.5, 5), (1.5, 5, 2.2, 0), (2.2, 0, 3, 7)),
    "X": ((0, 0, 3, 7), (0, 7, 3, 0)),
    "3": ((0, 6.7, 3, 6.7), (3, 6.7, 3, 0.3), (0, 0.3, 3, 0.3), (0.6, 3.5, 3, 3.5)),
    "0": ((0, 0.3, 0, 6.7), (0, 6.7, 3, 6.7), (3, 6.7, 3, 0.3), (3, 0.3, 0, 0.3)),
    "5": ((3, 6.7, 0, 6.7), (0, 6.7, 0, 3.8), (0, 3.8, 3, 3.8), (3, 3.8, 3, 0.3), (3, 0.3, 0, 0.3)),
}
"""Strokes (x0, y0, x1, y1) on a field of 3 by 7, x to the right and y ahead as the driver reads."""
_VERGES: tuple[tuple[Bgr, bool], ...] = (
    (GRASS, True),
    (GRASS, True),
    ((0.05, 0.13, 0.12), True),
    ((0.10, 0.20, 0.24), True),
    ((0.10, 0.14, 0.18), False),
    ((0.22, 0.25, 0.27), False),
)
"""Colour of the ground beside roads, and whether it is grass: green, dry, straw, earth, gravel."""
_WORDS = ("BUS", "STOP", "SLOW", "50", "30", "TO", "X")


def draw_paint(p: SceneParameters, crossings: list[float], rng: np.random.Generator) -> Paint:
    """Draws the marks of a road; ``crossings`` are arc lengths, m."""
    edge, forward = p.lanes * p.lane_width / 2, (p.lanes + 1) // 2
    centre = YELLOW if rng.random() < 0.25 else WHITE
    works = YELLOW if rng.random() < 0.1 else WHITE
    phase, lines = float(rng.uniform(0.0, sum(p.dash))), []
    for k in range(1, p.lanes):
        d = -edge + k * p.lane_width
        if k != forward:
            lines.append(Line(d, p.paint_width, *p.dash, phase, works))
        else:
            lines += _middle(d, p, phase, centre, rng)
    if p.edge_lines:
        inset = float(rng.choice([0.0, 0.15, 0.35]))
        dash = (1.0, 1.0) if rng.random() < 0.1 else (0.0, 0.0)
        colour = YELLOW if rng.random() < 0.1 else WHITE
        lines += [Line(k * (edge - inset), p.paint_width, *dash, phase, colour) for k in (-1.0, 1.0)]
    patches: list[Patch] = []
    strokes: list[Stroke] = []
    for s in crossings:
        some, more = _junction(p, s, rng)
        patches += some
        strokes += more
    for s in np.arange(float(rng.uniform(4.0, 30.0)), p.length, float(rng.uniform(18.0, 60.0))):
        some, more = _in_lane(p, float(s), rng)
        patches += some
        strokes += more
    if p.town and rng.random() < 0.35:
        strokes += _bays(edge, p.length, rng)
    return Paint(tuple(lines), tuple(patches), tuple(strokes))


def _middle(d: float, p: SceneParameters, phase: float, colour: int, rng: np.random.Generator) -> list[Line]:
    """The line between the directions: single or double, broken, whole or one of each."""
    kind, w = rng.random(), p.paint_width
    if kind < 0.45:
        return [Line(d, w, *p.dash, phase, colour)]
    if kind < 0.6:
        return [Line(d, w, colour=colour)]
    second = Line(d + 0.5 * w + 0.09, w, colour=colour)
    dash = p.dash if kind < 0.75 else (0.0, 0.0)
    return [Line(d - 0.5 * w - 0.09, w, *dash, phase, colour), second]


def _junction(p: SceneParameters, s: float, rng: np.random.Generator) -> tuple[list[Patch], list[Stroke]]:
    """A stop line, a crossing of bars, of two lines or none, arrows in the lanes before it."""
    edge, forward = p.lanes * p.lane_width / 2, (p.lanes + 1) // 2
    patches: list[Patch] = []
    strokes: list[Stroke] = []
    kind = rng.random()
    if kind < 0.5:
        bar, long = float(rng.uniform(0.3, 0.6)), float(rng.uniform(2.2, 4.5))
        patches += [
            Patch((s, s + long), float(d), (bar / 2, bar / 2))
            for d in np.arange(-edge + bar, edge, 2.0 * bar)
        ]
    elif kind < 0.75:
        wide = float(rng.uniform(0.12, 0.4))
        strokes += [Stroke((s + k, -edge), (s + k, edge), wide) for k in (0.2, 3.2)]
    middle = 0.5 * (forward * p.lane_width - 2.0 * edge)
    if rng.random() < 0.8:
        wide = float(rng.uniform(0.2, 0.6))
        half = forward * p.lane_width / 2 - 0.1
        patches.append(Patch((s - 1.5 - wide, s - 1.5), middle, (half, half)))
    for k in range(p.lanes):
        if rng.random() < 0.6:
            d, ahead = -edge + (k + 0.5) * p.lane_width, k < forward
            place = s - 12.0 if ahead else s + 16.0
            patches_, strokes_ = lane_arrow(place, d, 1.0 if ahead else -1.0, rng)
            patches += patches_
            strokes += strokes_
    return patches, strokes


def lane_arrow(s: float, d: float, way: float, rng: np.random.Generator) -> tuple[list[Patch], list[Stroke]]:
    """An arrow of 3 to 6 m ahead, to a side or both; ``way`` is +1 along the road, -1 against it."""
    long, shaft = float(rng.uniform(3.0, 6.0)), float(rng.uniform(0.1, 0.2))
    side = float(rng.choice([-1.0, 1.0]))
    patches: list[Patch] = []
    strokes: list[Stroke] = []
    kind = int(rng.integers(3))
    neck = s + way * 0.62 * long
    strokes.append(Stroke((s, d), (neck, d), shaft))
    if kind != 1:
        tip = s + way * long
        half = (0.4, 0.0) if way > 0 else (0.0, 0.4)
        patches.append(Patch((min(neck, tip), max(neck, tip)), d, half))
    if kind != 0:
        bend = s + way * 0.4 * long
        tip_s, tip_d = bend + way * 0.2 * long, d + side * 0.75
        strokes.append(Stroke((bend, d), (tip_s, tip_d), shaft))
        strokes += [
            Stroke((tip_s - way * 0.75, tip_d - side * 0.05), (tip_s + way * 0.1, tip_d), 1.4 * shaft),
            Stroke((tip_s, tip_d - side * 0.6), (tip_s, tip_d), 1.6 * shaft),
        ]
    return patches, strokes


def _in_lane(p: SceneParameters, s: float, rng: np.random.Generator) -> tuple[list[Patch], list[Stroke]]:
    """Words, arrows, hatched areas, lines that part or join, a give-way line."""
    edge, forward = p.lanes * p.lane_width / 2, (p.lanes + 1) // 2
    lane = int(rng.integers(p.lanes))
    d, way = -edge + (lane + 0.5) * p.lane_width, 1.0 if lane < forward else -1.0
    kind = rng.random()
    if kind < 0.22:
        return lane_arrow(s, d, way, rng)
    if kind < 0.42:
        word = _WORDS[int(rng.integers(len(_WORDS)))]
        colour = YELLOW if rng.random() < 0.2 else WHITE
        return [], lettering(word, (s, d), way, colour, rng)
    if kind < 0.6:
        return [], _hatched(p, s, rng)
    if kind < 0.75:
        # The border of a lane that begins or ends: it leaves one line and joins the next.
        long = float(rng.uniform(12.0, 40.0))
        first = -edge + int(rng.integers(p.lanes + 1)) * p.lane_width
        return [], [
            Stroke(
                (s, first), (s + long, first + float(rng.choice([-1.0, 1.0])) * p.lane_width), p.paint_width
            )
        ]
    if kind < 0.85:
        teeth = np.arange(d - 0.5 * p.lane_width + 0.3, d + 0.5 * p.lane_width - 0.2, 0.6)
        return [Patch((s, s + 0.6), float(x), (0.2, 0.0)) for x in teeth], []
    return [], []


def lettering(
    word: str, place: tuple[float, float], way: float, colour: int, rng: np.random.Generator
) -> list[Stroke]:
    """Letters stretched along the road, as wide as the lane allows."""
    tall, wide = float(rng.uniform(1.6, 4.0)), float(rng.uniform(0.35, 0.55))
    thick = float(rng.uniform(0.09, 0.16))
    strokes = []
    for k, letter in enumerate(word):
        left = (k - (len(word) - 1) / 2) * 1.4 * wide - wide / 2
        for x0, y0, x1, y1 in _GLYPHS[letter]:
            (a, b), (c, e) = ((left + x * wide / 3.0, y * tall / 7.0) for x, y in ((x0, y0), (x1, y1)))
            start = (place[0] + way * b, place[1] - way * a)
            strokes.append(Stroke(start, (place[0] + way * e, place[1] - way * c), thick, colour))
    return strokes


def _hatched(p: SceneParameters, s: float, rng: np.random.Generator) -> list[Stroke]:
    """A closed area with slanting bars, between two lines that meet in a point."""
    edge = p.lanes * p.lane_width / 2
    long, half = float(rng.uniform(10.0, 30.0)), float(rng.uniform(0.5, 1.4))
    d = float(rng.choice([-edge + half, 0.0, edge - half]))
    colour = YELLOW if rng.random() < 0.15 else WHITE
    bars = []
    for x in np.arange(1.0, long, float(rng.uniform(1.2, 3.0))):
        reach = half * x / long
        bars.append(Stroke((s + x - reach, d - reach), (s + x + reach, d + reach), 0.3, colour))
    rims = [Stroke((s, d), (s + long, d + k * half), 0.15, colour) for k in (-1.0, 1.0)]
    return bars + rims


def _bays(edge: float, length: float, rng: np.random.Generator) -> list[Stroke]:
    """Bars between parking bays along one side."""
    side, pitch = float(rng.choice([-1.0, 1.0])), float(rng.choice([2.5, 5.5]))
    slant = float(rng.choice([0.0, 1.5])) if pitch < 3.0 else 0.0
    return [
        Stroke((float(s), side * edge), (float(s) + slant, side * (edge + 2.2)), 0.1)
        for s in np.arange(0.0, min(length, 90.0), pitch)
    ]


def draw_flaws(p: SceneParameters, kerb: float, snow: float, rng: np.random.Generator) -> Roadway:
    """Draws the make of a road: seams, cracks, tracks, repairs, manholes, gutters, rails, kerbs and verges.

    Args:
        p: Of the street.
        kerb: Distance of the kerbs from the centre line, m.
        snow: 0..1, how much lies on the ground.
        rng: Source of the draw.
    """
    edge = p.lanes * p.lane_width / 2
    wide = edge + 2.0
    ribbons: list[Ribbon] = []
    for _ in range(int(rng.poisson(2.5))):
        # Joints between two runs of the paver lie near lane borders: dark with tar, shiny where it is new.
        d = float(rng.choice(-edge + np.arange(p.lanes + 1) * p.lane_width) + rng.normal(0.0, 0.5))
        gain = float(rng.choice([0.35, 0.55, 1.5, 2.2], p=[0.4, 0.3, 0.2, 0.1]))
        first = float(rng.uniform(-20.0, 60.0))
        ribbons.append(
            Ribbon(
                d, float(rng.uniform(0.02, 0.13)), gain, float(rng.uniform(0.0, 0.2)), (first, first + 90.0)
            )
        )
    ribbons += [
        Ribbon(
            float(rng.uniform(-wide, wide)),
            float(rng.uniform(0.02, 0.1)),
            float(rng.choice([0.4, 1.4])),
            float(rng.uniform(0.3, 1.2)),
            (-20.0, 120.0),
        )
        for _ in range(int(rng.poisson(1.5)))
    ]
    for k in range(p.lanes):
        if rng.random() < 0.5:
            d, gain = -edge + (k + 0.5) * p.lane_width, float(np.exp(rng.normal(0.0, 0.18)))
            ribbons += [Ribbon(d + off, 0.45, gain, 0.1, (-60.0, 400.0), soft=True) for off in (-0.8, 0.8)]
    for _ in range(int(rng.poisson(1.2))):
        # Black rubber of braking wheels.
        d, first = float(rng.uniform(-edge, edge)), float(rng.uniform(2.0, 50.0))
        span = (first, first + float(rng.uniform(4.0, 25.0)))
        ribbons += [Ribbon(d + off, 0.18, 0.6, 0.15, span, soft=True) for off in (0.0, 1.5)]
    if p.town and rng.random() < 0.35:
        # A gutter of light stone along the kerb.
        gain, wide_ = float(rng.uniform(1.3, 3.2)), float(rng.uniform(0.15, 0.45))
        ribbons += [Ribbon(k * (kerb - wide_ / 2), wide_, gain, 0.0, (-90.0, 400.0)) for k in (-1.0, 1.0)]
    if p.town and rng.random() < 0.08:
        d = float(rng.choice([-1.0, 1.0])) * 0.5 * p.lane_width
        for off in (-0.72, 0.72):
            ribbons += [
                Ribbon(d + off, 0.16, 0.5, 0.0, (-90.0, 400.0)),
                Ribbon(d + off, 0.055, float(rng.uniform(2.0, 5.0)), 0.0, (-90.0, 400.0)),
            ]
    verge, grassy = _VERGES[int(rng.integers(len(_VERGES)))]
    return Roadway(
        tuple(ribbons),
        tuple(_blots(p, wide, rng)),
        joint=float(rng.uniform(4.0, 8.0)) if rng.random() < 0.12 else math.inf,
        cracks=float(rng.uniform(0.0, 1.0)) ** 2,
        cobbles=p.town and rng.random() < 0.06,
        kerb=float(np.exp(rng.uniform(math.log(0.12), math.log(0.65)))),
        paving=float(np.exp(rng.uniform(math.log(0.3), math.log(1.7)))),
        verge=verge,
        grassy=grassy,
        snow=snow,
        wear=float(rng.uniform(0.15, 0.75)) if rng.random() < 0.35 else 0.0,
        paint_albedo=float(rng.uniform(0.4, 0.75)),
    )


def _blots(p: SceneParameters, wide: float, rng: np.random.Generator) -> list[Blot]:
    """Repairs with hard edges, trenches across, manholes, spots of oil."""
    blots = []
    for _ in range(int(rng.poisson(3.0))):
        half = (float(rng.uniform(0.3, 6.0)), float(rng.uniform(0.2, 1.5)))
        place = (float(rng.uniform(0.0, 70.0)), float(rng.uniform(-wide, wide)))
        blots.append(Blot(place, half, float(np.exp(rng.normal(-0.1, 0.4))), sealed=rng.random() < 0.4))
    for _ in range(int(rng.poisson(0.6))):
        place = (float(rng.uniform(0.0, 60.0)), 0.0)
        gain = float(rng.choice([0.5, 1.4]))
        blots.append(Blot(place, (float(rng.uniform(0.04, 0.5)), 3.0 * wide), gain, sealed=False))
    for _ in range(int(rng.poisson(2.0 if p.town else 0.4))):
        place = (float(rng.uniform(2.0, 40.0)), float(rng.uniform(-wide, wide)))
        blots.append(Blot(place, (0.35, 0.35), float(rng.choice([0.4, 0.6, 1.6])), sealed=False, round=True))
    for _ in range(int(rng.poisson(2.0))):
        size = float(rng.uniform(0.1, 0.5))
        place = (float(rng.uniform(2.0, 30.0)), float(rng.uniform(-wide, wide)))
        blots.append(Blot(place, (2.0 * size, size), 0.55, sealed=False, round=True))
    return blots
