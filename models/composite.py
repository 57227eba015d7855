"""Synthetic paint and poles drawn into real crops, with exact labels.

Few real cameras come with labelled paint, and poles were drawn in few countries. Paint of every kind is
therefore laid on roads whose outline is labelled, and poles are put up in any picture: light, lens, grain and
surroundings stay those of the real camera. Positions, widths and colours come from the generator that is
passed in; lengths are px of the crop.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline import labels

Picture = NDArray[np.uint8]
Plane = NDArray[np.float32]

_COVERED = 0.5
"""Share of a pixel from which it carries the label of what covers it."""

_HINTED = 0.1
"""Share below which nothing can be seen; between the two nothing is said (``labels.IGNORE``)."""


@dataclass(frozen=True, slots=True)
class Ground:
    """Where a flat road vanishes in a crop, and how it is foreshortened.

    Args:
        u: Column in which straight ahead vanishes, px.
        v: Row of the horizon, px.
        focal: Focal length, px.
    """

    u: float
    v: float
    focal: float


_SEEN = 0.02
"""Share of a row that must be road for the road to be seen there."""


def _chance(rng: np.random.Generator, p: float) -> bool:
    return bool(rng.random() < p)


def highest_road(label: Picture) -> float | None:
    """Return the uppermost row of a picture in which road or paint is seen, or None."""
    share = np.isin(label, (labels.ROAD, labels.LANE)).mean(axis=1)
    rows = np.flatnonzero(share > _SEEN)
    return float(rows[0]) if rows.size else None


def paint(
    picture: Picture, label: Picture, ground: Ground, rng: np.random.Generator
) -> tuple[Picture, Picture]:
    """Lay one to five marks on the road of a crop.

    Args:
        picture: BGR uint8 (H, W, 3).
        label: Label values uint8 (H, W); only pixels of value road are painted.
        ground: Where the road vanishes.
        rng: Source of everything random.

    Returns:
        Picture and label with the marks; unchanged where no road is in sight below the horizon.
    """
    v, u = np.mgrid[0 : label.shape[0], 0 : label.shape[1]].astype(np.float32)
    below = np.maximum(v - np.float32(ground.v), 0.5)
    # In units of the camera's height over the road: to the right, and ahead.
    right, ahead = (u - np.float32(ground.u)) / below, np.float32(ground.focal) / below
    cover = np.zeros(label.shape, np.float32)
    bend = float(rng.normal(0.0, 4e-4))
    for _ in range(int(rng.integers(1, 6))):
        across = right - np.float32(bend) * ahead**2
        cover = np.maximum(cover, _mark(across, ahead, below, np.float32(ground.focal), rng))
    cover *= (label == labels.ROAD) & (v > ground.v + 4.0)
    if not (cover > _COVERED).any():
        return picture, label
    worn = cover * _wear(label.shape, rng)
    moved = label.copy()
    moved[(cover >= _HINTED) & (worn < _COVERED)] = labels.IGNORE
    moved[worn >= _COVERED] = labels.LANE
    around = cv2.GaussianBlur(picture, (0, 0), 3.0).astype(np.float32)
    yellow = [rng.uniform(0.35, 0.8), rng.uniform(0.8, 0.95), 1.0]
    tint = np.array(yellow if _chance(rng, 0.25) else [1.0, 1.0, 1.0])
    colour = np.minimum(around * rng.uniform(1.25, 2.6) + rng.uniform(0.0, 30.0), rng.uniform(200.0, 255.0))
    grain = (picture.astype(np.float32) - around) * np.float32(rng.uniform(0.3, 1.0))
    return _blend(picture, colour * tint.astype(np.float32) + grain, worn), moved


def _mark(across: Plane, ahead: Plane, below: Plane, focal: np.float32, rng: np.random.Generator) -> Plane:
    """Cover (H, W) in 0..1 of one mark: along the road, dashed or not, or a bar or stripes across it."""
    if _chance(rng, 0.85):  # along the road
        middle, half = rng.uniform(-5.0, 5.0), 0.5 * np.exp(rng.uniform(np.log(0.04), np.log(0.18)))
        cover = within(across, middle - half, middle + half, below)
        if _chance(rng, 0.15):  # a second line beside it
            middle += 2.0 * half + rng.uniform(0.06, 0.15)
            cover = np.maximum(cover, within(across, middle - half, middle + half, below))
        if _chance(rng, 0.55):  # dashes
            length, gap = rng.uniform(0.6, 5.0), rng.uniform(0.8, 7.0)
            phase = np.mod(ahead + np.float32(rng.uniform(0.0, length + gap)), np.float32(length + gap))
            cover *= within(phase, 0.0, length, below**2 / focal)
        return cover
    near, depth = rng.uniform(2.0, 15.0), rng.uniform(0.2, 2.0)
    left, wide = rng.uniform(-4.0, 1.0), rng.uniform(0.5, 6.0)
    cover = within(ahead, near, near + depth, below**2 / focal) * within(across, left, left + wide, below)
    if _chance(rng, 0.5):  # zebra
        stripe = rng.uniform(0.2, 0.4)
        phase = np.mod(across, np.float32(2.0 * stripe))
        cover *= within(phase, 0.0, stripe, below)
    return cover


def within(x: Plane, low: float, high: float, px: Plane) -> Plane:
    """Share of each pixel with ``low < x < high`` where x grows by ``1/px`` a pixel."""
    inside: Plane = np.clip(np.minimum(x - np.float32(low), np.float32(high) - x) * px + 0.5, 0.0, 1.0)
    return inside


def _wear(shape: tuple[int, ...], rng: np.random.Generator) -> Plane:
    """Share of the paint (H, W) in 0..1 that traffic has left."""
    if _chance(rng, 0.4):  # new
        return np.full(shape, rng.uniform(0.75, 1.0), np.float32)
    coarse = cv2.resize(rng.standard_normal((9, 15), np.float32), shape[1::-1], interpolation=cv2.INTER_CUBIC)
    fine = cv2.GaussianBlur(rng.standard_normal(shape, np.float32), (0, 0), 0.8) * 2.5
    left: Plane = np.clip(rng.uniform(0.3, 1.3) + 0.35 * coarse + 0.3 * fine, 0.0, 1.0).astype(np.float32)
    return left


def pole(
    picture: Picture, label: Picture, ground: Ground | None, rng: np.random.Generator
) -> tuple[Picture, Picture]:
    """Put up one post, at times with an arm and a sign, partly behind the vehicles of the crop.

    Args:
        picture: BGR uint8 (H, W, 3).
        label: Label values uint8 (H, W).
        ground: Where the road vanishes, or None if that is not known.
        rng: Source of everything random.

    Returns:
        Picture and label with the post.
    """
    height, width = label.shape
    thick = float(np.exp(rng.uniform(np.log(1.6), np.log(16.0))))
    lowest = 0.35 * height if ground is None else max(ground.v, 0.0)
    foot = np.array([rng.uniform(0.0, width), rng.uniform(min(lowest, 0.9 * height), 1.25 * height)])
    at = label[min(int(foot[1]), height - 1), min(int(foot[0]), width - 1)]
    if at in (labels.ROAD, labels.LANE, labels.VEHICLE):  # few posts stand on a road
        foot[1] = min(foot[1], lowest + 0.15 * height)
    lean = rng.normal(0.0, np.radians(1.0))
    top = foot + thick * rng.uniform(12.0, 60.0) * np.array([np.sin(lean), -np.cos(lean)])
    thin = thick * rng.uniform(0.55, 1.0)
    post = stroke(label.shape, foot, top, thick, thin)
    if _chance(rng, 0.3):  # an arm, level or rising
        reach = (1 if _chance(rng, 0.5) else -1) * thick * rng.uniform(5.0, 25.0)
        end = top + np.array([reach, -abs(reach) * rng.uniform(0.0, 0.5)])
        post = np.maximum(post, stroke(label.shape, top, end, thin, 0.7 * thin))
    free = (label != labels.VEHICLE) | (_chance(rng, 0.5))  # before or behind the vehicles
    post = cv2.GaussianBlur(post, (0, 0), float(rng.uniform(0.3, 0.8))) * free
    moved = label.copy()
    moved[(post >= _HINTED) & (post < _COVERED)] = labels.IGNORE
    moved[post >= _COVERED] = labels.POLE
    drawn = _blend(picture, _steel(label.shape, foot, top, thick, rng), post)
    if _chance(rng, 0.35):  # a sign
        drawn, moved = _sign(drawn, moved, foot + rng.uniform(0.5, 1.0) * (top - foot), thick, rng)
    return drawn, moved


def stroke(
    shape: tuple[int, ...], start: NDArray[np.float64], end: NDArray[np.float64], w0: float, w1: float
) -> Plane:
    """Cover (H, W) in 0..1 of a tapering stroke."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float32)
    along = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
    length = float(np.linalg.norm(end - start))
    x, y = u - np.float32(start[0]), v - np.float32(start[1])
    t = x * np.float32(along[0]) + y * np.float32(along[1])
    off = np.abs(x * np.float32(-along[1]) + y * np.float32(along[0]))
    half = 0.5 * (w0 + (w1 - w0) * np.clip(t / max(length, 1e-6), 0.0, 1.0))
    cover: Plane = (
        np.clip(half - off + 0.5, 0.0, 1.0)
        * np.clip(t + 0.5, 0.0, 1.0)
        * np.clip(length - t + 0.5, 0.0, 1.0)
        * np.minimum(2.0 * half, 1.0)
    ).astype(np.float32)
    return cover


def _steel(
    shape: tuple[int, ...],
    foot: NDArray[np.float64],
    top: NDArray[np.float64],
    thick: float,
    rng: np.random.Generator,
) -> Plane:
    """Colour (H, W, 3) of a post: a round body lit from one side, grained, at times ringed or rusty."""
    v, u = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float32)
    axis = (top - foot) / max(float(np.linalg.norm(top - foot)), 1e-6)
    x, y = u - np.float32(foot[0]), v - np.float32(foot[1])
    off = np.clip((x * np.float32(-axis[1]) + y * np.float32(axis[0])) / np.float32(0.5 * thick), -1.0, 1.0)
    light = np.float32(rng.uniform(-1.0, 1.0))
    body = 1.0 - np.float32(rng.uniform(0.0, 0.5)) * (off - light) ** 2 / (1.0 + abs(light)) ** 2
    t = x * np.float32(axis[0]) + y * np.float32(axis[1])
    if _chance(rng, 0.12):  # rings of two colours, as bollards and barriers have
        ring = np.float32(thick * rng.uniform(1.5, 5.0))
        dark = np.float32(rng.uniform(0.3, 0.7))
        body = body * np.where(np.mod(t, 2.0 * ring) < ring, np.float32(1.0), dark)
    grain = 1.0 + np.float32(rng.uniform(0.0, 0.08)) * rng.standard_normal(shape, np.float32)
    level = np.exp(rng.uniform(np.log(18.0), np.log(230.0)))
    hue = np.clip(1.0 + rng.normal(0.0, 0.12, 3), 0.5, 1.5)
    steel: Plane = ((body * grain)[..., None] * (level * hue).astype(np.float32)).astype(np.float32)
    return steel


def _sign(
    picture: Picture, label: Picture, at: NDArray[np.float64], thick: float, rng: np.random.Generator
) -> tuple[Picture, Picture]:
    """Fix a plate of a random outline and colour to a post."""
    size = thick * rng.uniform(3.0, 9.0)
    corners = int(rng.choice([3, 4, 4, 8, 24]))
    turn = np.pi / corners - (np.pi / 2 if corners % 2 else 0.0)  # a side, or a corner, down
    angle = turn + 2.0 * np.pi * np.arange(corners) / corners
    stretch = np.array([rng.uniform(0.6, 1.3), 1.0])
    outline = at + 0.5 * size * stretch * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    fixed = 4  # fractional bits of the corners
    cover = np.zeros(label.shape, np.uint8)
    cv2.fillPoly(cover, [np.rint(outline * 2**fixed).astype(np.int32)], 255, cv2.LINE_AA, fixed)
    inner = np.zeros(label.shape, np.uint8)
    core = at + (outline - at) * rng.uniform(0.4, 0.85)
    cv2.fillPoly(inner, [np.rint(core * 2**fixed).astype(np.int32)], 255, cv2.LINE_AA, fixed)
    share = cover.astype(np.float32) / 255.0
    rim, face = rng.uniform(20.0, 240.0, 3), rng.uniform(20.0, 240.0, 3)
    plate = rim + (inner.astype(np.float32) / 255.0)[..., None] * (face - rim)
    moved = label.copy()
    moved[(share >= _HINTED) & (share < _COVERED)] = labels.IGNORE
    moved[share >= _COVERED] = labels.SIGN
    return _blend(picture, plate.astype(np.float32), share), moved


def _blend(picture: Picture, colour: NDArray[np.floating], share: Plane) -> Picture:
    """Picture with a colour (H, W, 3) laid over it by share (H, W)."""
    below = picture.astype(np.float32)
    return np.clip(below + (colour - below) * share[..., None], 0.0, 255.0).astype(np.uint8)
