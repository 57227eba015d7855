"""Augmentation of crops: what other cameras, lenses, hours and weather do to a picture.

Each function takes and gives a BGR uint8 (H, W, 3) crop; geometry (scale, crop, flip) moves picture and label
together and is done by ``cut``. Randomness comes from the generator that is passed in.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline import labels

Picture = NDArray[np.uint8]


def cut(
    picture: Picture,
    label: Picture,
    centre: tuple[float, float],
    scale: tuple[float, float],
    size: tuple[int, int],
    *,
    flip: bool,
) -> tuple[Picture, Picture]:
    """Cut a crop of a fixed size around a point, at a scale, mirrored where asked.

    Args:
        picture: BGR uint8 (H, W, 3).
        label: uint8 (H, W).
        centre: Point (u, v) of the source that comes to the middle of the crop, px.
        scale: Magnification along x and y.
        size: Crop (height, width), px.
        flip: Mirror left and right.

    Returns:
        Picture and label of the crop; outside the source the picture repeats its edge, the label is ignored.
    """
    height, width = size
    picture, label, centre = _window(picture, label, centre, (height / scale[1], width / scale[0]))
    sign = -1.0 if flip else 1.0
    A = np.array([[sign * scale[0], 0.0, 0.0], [0.0, scale[1], 0.0]])
    A[:, 2] = np.array([(width - 1) / 2, (height - 1) / 2]) - A[:, :2] @ np.array(centre)
    if min(scale) < 1.0:  # what a coarser sensor would have averaged must not alias
        picture = cv2.GaussianBlur(picture, (0, 0), 0.5 * np.sqrt(1.0 / min(scale) ** 2 - 1.0) + 1e-3).astype(
            np.uint8, copy=False
        )
    crop = cv2.warpAffine(
        picture, A, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    moved = cv2.warpAffine(
        label,
        A,
        (width, height),
        flags=cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(labels.IGNORE,),
    )
    return crop.astype(np.uint8, copy=False), moved.astype(np.uint8, copy=False)


def _window(
    picture: Picture, label: Picture, centre: tuple[float, float], size: tuple[float, float]
) -> tuple[Picture, Picture, tuple[float, float]]:
    """Return views of what a crop can see, with a margin, and the centre in them: less to blur."""
    margin = 4
    u, v = centre
    left, top = max(0, int(u - size[1] / 2) - margin), max(0, int(v - size[0] / 2) - margin)
    right, bottom = int(u + size[1] / 2) + margin + 2, int(v + size[0] / 2) + margin + 2
    return picture[top:bottom, left:right], label[top:bottom, left:right], (u - left, v - top)


MONOCHROME = 0.08
"""Share of pictures without colour: many cameras of vehicles have none."""


def colour(picture: Picture, rng: np.random.Generator) -> Picture:
    """White balance, contrast, brightness, saturation and gamma."""
    x = picture.astype(np.float32)
    x *= rng.uniform(0.85, 1.15, 3).astype(np.float32)
    grey = x.mean(axis=2, keepdims=True)
    saturation = 0.0 if rng.random() < MONOCHROME else rng.uniform(0.3, 1.5)
    x = grey + (x - grey) * np.float32(saturation)
    x = (x - 110.0) * np.float32(rng.uniform(0.6, 1.4)) + np.float32(110.0 + rng.uniform(-35.0, 35.0))
    gamma = np.exp(rng.uniform(-0.5, 0.5))
    table = (255.0 * (np.arange(256) / 255.0) ** gamma).astype(np.uint8)
    adapted: Picture = table[np.clip(x, 0.0, 255.0).astype(np.uint8)]
    return adapted


def shadow(picture: Picture, rng: np.random.Generator) -> Picture:
    """Darken one or two random polygons with soft or hard edges, as trees, bridges and buildings do."""
    height, width = picture.shape[:2]
    dark = np.ones((height, width), np.float32)
    for _ in range(int(rng.integers(1, 3))):
        corners = rng.uniform((-0.2, -0.2), (1.2, 1.2), (int(rng.integers(3, 6)), 2)) * (width, height)
        cv2.fillConvexPoly(dark, cv2.convexHull(corners.astype(np.int32)), float(rng.uniform(0.35, 0.8)))
    soft = cv2.GaussianBlur(dark, (0, 0), float(rng.uniform(0.5, 8.0)))
    return (picture * soft[..., None]).astype(np.uint8)


def night(picture: Picture, rng: np.random.Generator) -> Picture:
    """Dim all but a soft spot of head light low in the middle, tint it, and let the sensor's noise grow."""
    height, width = picture.shape[:2]
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    u0, v0 = rng.uniform(0.2, 0.8) * width, rng.uniform(0.6, 1.1) * height
    spot = np.exp(-(((u - u0) / (0.45 * width)) ** 2) - ((v - v0) / (0.45 * height)) ** 2)
    light = np.float32(rng.uniform(0.08, 0.3)) + np.float32(rng.uniform(0.3, 0.7)) * spot
    tint = np.array([rng.uniform(0.7, 1.0), rng.uniform(0.85, 1.0), 1.0], np.float32)
    return noise((picture * light[..., None] * tint).astype(np.uint8), rng, strongest=10.0)


def haze(picture: Picture, rng: np.random.Generator) -> Picture:
    """Lay a light veil over the picture, thicker to one side: fog, spray, a sunlit windscreen."""
    height, width = picture.shape[:2]
    corners = rng.uniform(0.0, 0.65, (2, 2)).astype(np.float32)
    veil = cv2.resize(corners, (width, height), interpolation=cv2.INTER_LINEAR)[..., None]
    light = np.float32(rng.uniform(110.0, 245.0)) * rng.uniform(0.93, 1.07, 3).astype(np.float32)
    veiled: Picture = np.clip(picture * (1.0 - veil) + light * veil, 0.0, 255.0).astype(np.uint8)
    return veiled


def rain(picture: Picture, rng: np.random.Generator) -> Picture:
    """Draw falling streaks, and drops on the glass that smear what lies behind them."""
    height, width = picture.shape[:2]
    streaks = np.zeros((height, width), np.uint8)
    slant, length = rng.normal(0.0, 0.25), rng.uniform(6.0, 25.0)
    for u, v in rng.uniform((0.0, 0.0), (width, height), (int(rng.integers(20, 160)), 2)):
        end = round(u + slant * length), round(v + length * rng.uniform(0.5, 1.0))
        cv2.line(streaks, (round(u), round(v)), end, 255, 1, cv2.LINE_AA)
    share = cv2.GaussianBlur(streaks, (0, 0), 0.7)[..., None] * np.float32(rng.uniform(0.1, 0.35) / 255.0)
    wet = picture + (200.0 - picture.astype(np.float32)) * share
    drops = np.zeros((height, width), np.uint8)
    for u, v in rng.uniform((0.0, 0.0), (width, height), (int(rng.integers(0, 8)), 2)):
        cv2.circle(drops, (round(u), round(v)), int(rng.integers(2, 12)), 255, -1, cv2.LINE_AA)
    behind = cv2.GaussianBlur(drops, (0, 0), 1.0)[..., None].astype(np.float32) / 255.0
    smeared = cv2.GaussianBlur(wet, (0, 0), 5.0)
    return np.clip(wet + (smeared - wet) * behind, 0.0, 255.0).astype(np.uint8)


def blur(picture: Picture, rng: np.random.Generator) -> Picture:
    """Defocus, or the smear of motion along a random direction."""
    if rng.integers(2) == 0:
        return cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.4, 1.5))).astype(np.uint8, copy=False)
    length = int(rng.integers(3, 8))
    kernel = np.zeros((length, length), np.float32)
    middle = (length - 1) / 2
    angle = rng.uniform(0.0, np.pi)
    reach = middle * np.array([np.cos(angle), np.sin(angle)])
    start, end = np.rint(middle - reach).astype(int), np.rint(middle + reach).astype(int)
    cv2.line(kernel, start.tolist(), end.tolist(), 1.0)
    return cv2.filter2D(picture, -1, kernel / kernel.sum()).astype(np.uint8, copy=False)


def noise(picture: Picture, rng: np.random.Generator, *, strongest: float = 8.0) -> Picture:
    """Add grey and colour noise of up to ``strongest`` levels."""
    grain = rng.standard_normal(picture.shape, np.float32) * np.float32(rng.uniform(0.5, strongest))
    return np.clip(picture + grain, 0, 255).astype(np.uint8)


def jpeg(picture: Picture, rng: np.random.Generator) -> Picture:
    """Compress and decode at quality 25 to 90."""
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(25, 91))])
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return picture if decoded is None else decoded.astype(np.uint8, copy=False)


CHANCES = (
    (colour, 0.8),
    (shadow, 0.25),
    (haze, 0.1),
    (night, 0.06),
    (rain, 0.06),
    (blur, 0.2),
    (noise, 0.25),
    (jpeg, 0.2),
)
"""Each step with its chance, in the order in which light, lens, sensor and link act."""


def photometric(picture: Picture, rng: np.random.Generator) -> Picture:
    """Apply each step of ``CHANCES`` with its chance."""
    for step, chance in CHANCES:
        if rng.random() < chance:
            picture = step(picture, rng)
    return picture
