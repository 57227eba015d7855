"""Surfaces that look like what they are made of: house fronts, bark, rust, striped and wooden posts, posters.

Each function changes the albedo, float32 (3,N) linear BGR, of the chosen points in place. What differs from
house to house comes from ``lots``: numbers of a solid that are the same in every pass.
"""
# ruff: noqa: PLR2004 - the figures are patterns on surfaces, in m or shares of a period, and odds of a draw

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.raycast import SolidPoints
from pipeline.simulation.solids import Material
from pipeline.simulation.surface import F32
from pipeline.simulation.textures import SIZE, Textures, sample

_LOTS = 28


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """Points of one pass that lie on solids, in the coordinates of their solids.

    Attributes:
        points: Where they are.
        local: float32 (3,N), m from the middle of the solid along its axes.
        half: float32 (3,N), half sizes of the solids, m.
        material: uint8 (N,).
        resolved: float32 (N,), px in a metre across the view.
        textures: Noise tables.
        lots: float32 (solids,28), uniform in 0..1.
    """

    points: SolidPoints
    local: F32
    half: F32
    material: NDArray[np.uint8]
    resolved: F32
    textures: Textures
    lots: F32

    def of(self, material: Material) -> NDArray[np.int64]:
        """The points on a material."""
        return np.flatnonzero(self.material == material)


def lots_of(textures: Textures, count: int) -> F32:
    """Numbers 0..1 for each of ``count`` solids, float32 (count,28), that no two neighbours share."""
    rows = (np.arange(count) * 37 + 11)[:, None] % SIZE
    return np.asarray(textures.grain[rows, (np.arange(_LOTS) * 97 + 5)[None, :] % SIZE], dtype=np.float32)


def paint_materials(s: Surfaces, albedo: F32) -> None:
    """Draws the patterns of all materials of this module."""
    _bark(s, albedo)
    _canopy(s, albedo)
    _weathered(s, albedo)
    _poster(s, albedo)
    _front(s, albedo)


def glows(s: Surfaces, night: float) -> F32:
    """Light that points give off, (N,): lamps by day a little, at night much, and lit windows."""
    light = np.zeros(s.material.shape, dtype=np.float32)
    lamps = s.of(Material.LAMP)
    light[lamps] = np.float32(0.3 + 14.0 * night)
    # Lights of vehicles: like any surface by day.
    light[s.of(Material.LIGHT)] = np.float32(9.0 * night)
    front = s.of(Material.FRONT)
    if night > 0.0 and front.size:
        cells = _cells(s, front)
        light[front[cells.glass & (cells.hue > 1.1)]] = np.float32(0.5 * night)
    return light


def _fades(s: Surfaces, chosen: NDArray[np.int64], size: float) -> F32:
    """Share 0..1 of a pattern of ``size`` m that the picture resolves."""
    return np.asarray(np.clip(size * s.resolved[chosen] - 0.5, 0.0, 1.0), dtype=np.float32)


def _bark(s: Surfaces, albedo: F32) -> None:
    """Furrows along the trunk, patches of moss; birches are white with dark bands."""
    k = s.of(Material.BARK)
    if not k.size:
        return
    around = np.arctan2(s.points.unit[1, k], s.points.unit[0, k])
    up = s.local[2, k]
    lot = s.lots[s.points.solid[k]]
    furrows = sample(s.textures.fine, around * 3.0, up * 0.35, 9.0) * _fades(s, k, 0.03)
    moss = sample(s.textures.rough, around, up, 6.0)
    albedo[:, k] *= np.exp(0.45 * furrows + 0.3 * moss)
    birch = lot[:, 3] < 0.12
    bands = sample(s.textures.fine, around * 0.6, up * 2.5, 5.0) > 0.9
    albedo[:, k[birch]] = np.where(bands[birch], np.float32(0.05), np.float32(0.5))


def _canopy(s: Surfaces, albedo: F32) -> None:
    """Leaves in light and shade, boughs darker towards the inside."""
    k = s.of(Material.CANOPY)
    x, y, z = (s.local[i, k] for i in range(3))
    fine = sample(s.textures.fine, x + y, z + 0.4 * (x - y), 21.0) * _fades(s, k, 0.05)
    twig = sample(s.textures.fine, x - y, z + 0.5 * x, 5.0) * _fades(s, k, 0.2)
    bough = sample(s.textures.rough, x + 0.5 * y, z, 3.0)
    albedo[:, k] *= np.exp(0.4 * fine + 0.4 * twig + 0.35 * bough - 0.15)


def _weathered(s: Surfaces, albedo: F32) -> None:
    """Rust and dirt in blotches, red-white or black-white bands, grain of wood."""
    for material in (Material.RUST, Material.BANDS, Material.WOOD):
        k = s.of(material)
        if not k.size:
            continue
        around = np.arctan2(s.points.unit[1, k], s.points.unit[0, k])
        up = s.local[2, k] + s.half[2, k]
        lot = s.lots[s.points.solid[k]]
        if material == Material.RUST:
            blotch = sample(s.textures.rough, around * 0.4, up, 5.0) + 1.2 * np.exp(-2.5 * up) - 0.5
            share = np.clip(1.5 * blotch, 0.0, 1.0)
            albedo[:, k] += share * (np.array([[0.03], [0.06], [0.16]], dtype=np.float32) - albedo[:, k])
        elif material == Material.BANDS:
            dark = np.where(lot[:, 0] < 0.5, np.array([[0.05], [0.04], [0.45]]), np.float32(0.03))
            period = 0.25 + 0.5 * lot[:, 1]
            albedo[:, k] = np.where(np.mod(up / period, 1.0) < 0.5, dark, np.float32(0.65))
        else:
            grain = sample(s.textures.fine, around * 2.0, up * 0.2, 12.0) * _fades(s, k, 0.02)
            albedo[:, k] *= np.exp(0.25 * grain + 0.2 * sample(s.textures.rough, around, up, 2.0))


def _poster(s: Surfaces, albedo: F32) -> None:
    """Blocks of colour, lines of writing and a frame."""
    k = s.of(Material.POSTER)
    if not k.size:
        return
    thin = np.argmin(s.half[:, k], axis=0)
    across = np.where(thin == 1, s.local[0, k], s.local[1, k])
    lot = s.lots[s.points.solid[k]]
    up = s.local[2, k]
    column, row = np.floor(across * (0.4 + lot[:, 0])), np.floor(up * (0.6 + lot[:, 1]))
    for c in range(3):
        hue = sample(s.textures.fine, column + 3.3 * c, row + 0.7 * c, 1.0)
        albedo[c, k] = np.clip(0.22 * np.exp(0.6 * hue), 0.02, 0.8)
    line = (np.mod(up, 0.34) < 0.14) & (np.mod(row + column, 2.0) < 1.0)
    letter = sample(s.textures.fine, np.floor(across * 9.0), np.floor(up / 0.34), 1.0) > -0.2
    albedo[:, k[line & letter]] = np.float32(0.7)
    edge = (s.half[2, k] - np.abs(up) < 0.08) | (
        np.where(thin == 1, s.half[0, k], s.half[1, k]) - np.abs(across) < 0.08
    )
    albedo[:, k[edge]] = np.float32(0.3)


@dataclass(frozen=True, slots=True, eq=False)
class _Cells:
    """The grid of windows at points on house fronts; all arrays (N,)."""

    along: F32
    up: F32
    a: F32
    b: F32
    pitch: F32
    storey: F32
    lot: F32
    hue: F32
    window: NDArray[np.bool_]
    glass: NDArray[np.bool_]
    ground: NDArray[np.bool_]
    shop: NDArray[np.bool_]


def _cells(s: Surfaces, k: NDArray[np.int64]) -> _Cells:
    unit = s.points.unit[:, k]
    gable = np.abs(unit[0]) > np.abs(unit[1])
    along = np.where(gable, s.local[1, k], s.local[0, k])
    up = s.local[2, k] + s.half[2, k] - np.float32(0.5)
    lot = s.lots[s.points.solid[k]]
    wall = np.abs(unit[2]) < 0.999
    curtain = lot[:, 0] < 0.08
    pitch = np.where(curtain, 1.2 + lot[:, 1], 1.3 + 2.8 * lot[:, 1] ** 2)
    storey = 2.6 + 1.1 * lot[:, 2]
    ground = up < 3.0 + 1.2 * lot[:, 9]
    shop = ground & (lot[:, 8] < 0.45) & wall
    a = np.where(shop, along / (1.2 + 2.5 * lot[:, 10]), along / pitch + lot[:, 25])
    b = np.where(ground, up / (3.0 + 1.2 * lot[:, 9]), (up - 3.0 - 1.2 * lot[:, 9]) / storey)
    hue = sample(s.textures.fine, np.floor(a) + 0.5, np.floor(b) + 7.0 * s.points.solid[k] + 0.5, 1.0)
    width = np.where(curtain, 0.47, 0.13 + 0.25 * lot[:, 3])
    width = np.where(shop, 0.47, width)
    height = np.where(curtain, 0.48, 0.20 + 0.2 * lot[:, 4])
    height = np.where(shop, 0.36, height)
    in_a, in_b = np.abs(np.mod(a, 1.0) - 0.5), np.abs(np.mod(b, 1.0) - np.where(shop, 0.42, 0.52))
    # A blind cell now and then, and whole gables without windows.
    open_ = wall & (hue > -1.6) & ~(gable & (lot[:, 5] < 0.5))
    window = (in_a < width) & (in_b < height) & open_
    rim = 0.03 + 0.08 * lot[:, 6]
    size = np.where(shop, 1.2 + 2.5 * lot[:, 10], pitch)
    tall = np.where(ground, 3.0 + 1.2 * lot[:, 9], storey)
    glass = window & (in_a < width - rim / size) & (in_b < height - rim / tall)
    bars = (0.5 + 1.5 * np.floor(3.0 * lot[:, 7])) / np.maximum(width * size, 0.2)
    mullion = (
        np.mod((np.mod(a, 1.0) - 0.5) * size * bars + 0.5 * np.floor(2.0 * lot[:, 11]), 1.0) < 0.05 * bars
    )
    transom = np.abs((np.mod(b, 1.0) - 0.6) * tall) < np.where(lot[:, 12] < 0.5, 0.025, 0.0)
    glass &= ~(mullion | transom)
    along, up, a, b, size, tall, hue = (
        np.asarray(x, dtype=np.float32) for x in (along, up, a, b, size, tall, hue)
    )
    return _Cells(along, up, a, b, size, tall, lot, hue, window, glass, ground & wall, shop)


def _front(s: Surfaces, albedo: F32) -> None:
    """Brick or plaster, cornices, pilasters, downpipes, windows with frames and bars, shops, doors."""
    k = s.of(Material.FRONT)
    if not k.size:
        return
    c = _cells(s, k)
    lot = c.lot
    wall = albedo[:, k]
    rough = sample(s.textures.rough, c.along, c.up, 2.0)
    course = np.floor(c.up / 0.075)
    shift = np.mod(course, 2.0) * 0.5
    brick = sample(s.textures.fine, np.floor(c.along / 0.24 + shift), course, 1.0)
    mortar = (np.mod(c.up, 0.075) < 0.012) | (np.mod(c.along / 0.24 + shift, 1.0) < 0.05)
    fade = _fades(s, k, 0.075)
    masonry = np.exp(fade * (0.2 * brick + np.where(mortar, np.float32(0.35), np.float32(0.0))))
    wall *= np.where(lot[:, 13] < 0.4, masonry, 1.0) * (1.0 + 0.08 * rough)
    streaks = sample(s.textures.rough, c.along * 2.0, c.up * 0.1, 3.0)
    wall *= np.exp(0.25 * lot[:, 26] * np.minimum(streaks, 0.0))
    cornice = (np.mod(c.b, 1.0) * c.storey < 0.22) & (lot[:, 14] < 0.35)
    wall[:, cornice] *= np.where(lot[cornice, 15] < 0.6, np.float32(1.45), np.float32(0.65))
    pilaster = (lot[:, 16] < 0.3) & (np.mod(c.along + 0.3, c.pitch * 2.0) < 0.3 + 0.3 * lot[:, 17])
    wall[:, pilaster] *= np.where(lot[pilaster, 18] < 0.6, np.float32(1.35), np.float32(0.7))
    _openings(c, wall)
    # Down the wall in front of everything: round, so bright on one side and dark on the other.
    spacing = c.pitch * (2.0 + np.floor(4.0 * lot[:, 19]))
    radius = 0.04 + 0.035 * lot[:, 20]
    off = (np.mod(c.along + spacing * lot[:, 21], spacing) - 0.2) / radius
    pipe = (np.abs(off) < 1.0) & (lot[:, 22] < 0.6) & ~c.shop
    tones = np.array([0.6, 0.25, 0.06, 0.4], dtype=np.float32)[(3.99 * lot[:, 23]).astype(int)]
    round_ = tones * (0.75 + 0.4 * off * np.sign(lot[:, 24] - 0.5))
    wall[:, pipe] = np.where(lot[pipe, 23] > 0.75, wall[:, pipe] * (0.75 + 0.4 * off[pipe]), round_[pipe])
    albedo[:, k] = wall


def _openings(c: _Cells, wall: F32) -> None:
    """Windows with frames and sills, shop fronts with a fascia, doors."""
    lot = c.lot
    frames = np.array([0.7, 0.55, 0.04, 0.15, 0.3], dtype=np.float32)[(4.99 * lot[:, 6]).astype(int)]
    sill = ~c.window & ~c.shop & (np.abs(np.mod(c.a, 1.0) - 0.5) < 0.2 + 0.25 * lot[:, 3])
    below = np.mod(c.b, 1.0) - (0.32 - 0.2 * lot[:, 4])
    sill &= (np.abs(below + 0.02) < 0.02) & (lot[:, 5] > 0.3)
    wall[:, sill] *= np.float32(1.4)
    frame = c.window & ~c.glass
    wall[:, frame] = frames[frame]
    up = np.mod(c.b, 1.0)
    pane = 0.03 + 0.09 * np.exp(0.8 * c.hue) * (0.5 + up)
    blind = c.glass & (c.hue > 0.6) & (up > 0.5 + 0.2 * lot[:, 12])
    glass = c.glass & ~blind
    wall[:, glass] = np.array([[1.15], [1.0], [0.9]], dtype=np.float32) * pane[glass]
    wall[:, blind] = np.float32(0.45)
    fascia = c.shop & (up > 0.8) & (up < 0.97)
    wall[:, fascia] = np.clip(np.stack([0.3 * lot[fascia, j] ** 2 for j in (24, 25, 26)]) * 1.5, 0.02, 0.6)
    door = c.ground & ~c.shop & (np.mod(np.floor(c.a) + 3.0 * np.floor(9.0 * lot[:, 27]), 4.0) == 0.0)
    beside = np.abs(np.mod(c.a, 1.0) - 0.5) * c.pitch
    door &= (beside < 0.62) & (c.up < 2.35) & (c.up > 0.0)
    wall[:, door] = frames[door]
    leaf = door & (beside < 0.5) & (c.up < 2.2)
    wall[:, leaf] = np.stack([0.02 + 0.25 * lot[leaf, j] ** 2 for j in (17, 20, 21)])
