"""What lies between street and lens: bonnet, mirrored dashboard, drops and streaks of rain, snow."""
# ruff: noqa: PLR2004 - the figures are odds of a draw and shares of the image

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline import labels
from pipeline.simulation.surface import F32

Pixels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Windscreen:
    """What is in the way; nothing by default.

    Attributes:
        bonnet: Share of the image's height that the bonnet hides in the middle, 0: out of sight.
        reflection: Brightness of the dashboard's mirror image, 0..1.
        drops: Drops in an image, on average.
        falling: Streaks of rain or flakes of snow in an image, on average.
        flakes: Whether it snows.
    """

    bonnet: float = 0.0
    reflection: float = 0.0
    drops: float = 0.0
    falling: float = 0.0
    flakes: bool = False


def draw_windscreen(rng: np.random.Generator, *, rain: bool, snow: bool) -> Windscreen:
    """Draws what is in the way."""
    return Windscreen(
        bonnet=float(rng.uniform(0.03, 0.2)) if rng.random() < 0.25 else 0.0,
        reflection=float(rng.uniform(0.03, 0.25)) if rng.random() < 0.12 else 0.0,
        drops=float(rng.uniform(0.0, 60.0)) if rain and rng.random() < 0.5 else 0.0,
        falling=float(rng.uniform(50.0, 500.0)) if (rain or snow) and rng.random() < 0.6 else 0.0,
        flakes=snow,
    )


def seen_through(
    screen: Windscreen, pixels: Pixels, classes: Pixels, rng: np.random.Generator
) -> tuple[Pixels, Pixels]:
    """An image BGR (H,W,3) and its classes (H,W) as they look through a windscreen."""
    shown = pixels.astype(np.float32)
    if screen.falling > 0.0:
        shown = _falling(shown, screen, rng)
    if screen.drops > 0.0:
        shown = _drops(shown, int(rng.poisson(screen.drops)), rng)
    if screen.reflection > 0.0:
        shown += 255.0 * screen.reflection * _clutter(shown.shape[:2], rng)[:, :, None]
    if screen.bonnet > 0.0:
        shown, classes = _bonnet(shown, classes, screen.bonnet, rng)
    return np.asarray(np.clip(np.rint(shown), 0, 255), dtype=np.uint8), classes


def _falling(shown: F32, screen: Windscreen, rng: np.random.Generator) -> F32:
    """Bright streaks of rain, or flakes, near ones large and blurred."""
    height, width = shown.shape[:2]
    veil = np.zeros((height, width), dtype=np.float32)
    slant = float(rng.normal(0.0, 0.15))
    for _ in range(int(rng.poisson(screen.falling))):
        u, v = (int(k) for k in rng.uniform(0.0, 1.0, 2) * (width, height))
        size = float(np.exp(rng.uniform(-7.0, -4.2))) * width
        strength = float(rng.uniform(0.05, 0.3))
        if screen.flakes:
            cv2.circle(veil, (u, v), max(1, int(0.4 * size)), 2.0 * strength, -1)
        else:
            end = (u + int(6.0 * slant * size), v + int(6.0 * size))
            cv2.line(veil, (u, v), end, strength, max(1, int(0.12 * size)))
    veil = np.asarray(cv2.GaussianBlur(veil, (0, 0), max(0.7, 0.0008 * width)), dtype=np.float32)
    return shown + veil[:, :, None] * (np.float32(225.0) - shown)


def _drops(shown: F32, count: int, rng: np.random.Generator) -> F32:
    """Drops on the glass: each shows the street small, upside down and out of focus."""
    height, width = shown.shape[:2]
    blurred = np.asarray(cv2.GaussianBlur(shown, (0, 0), 0.004 * width), dtype=np.float32)
    for _ in range(count):
        r = max(2, int(width * float(np.exp(rng.uniform(-6.2, -3.9)))))
        u, v = (int(k) for k in rng.uniform(0.0, 1.0, 2) * (width, height))
        top, left = max(v - r, 0), max(u - r, 0)
        bottom, right = min(v + r + 1, height), min(u + r + 1, width)
        y, x = np.mgrid[top:bottom, left:right].astype(np.float32)
        dx, dy = (x - u) / r, (y - v) / r
        square = dx * dx + dy * dy
        cover = np.clip(2.5 * (1.0 - square), 0.0, 0.85)[:, :, None]
        far_u = np.clip(u - 6.0 * r * dx, 0, width - 1).astype(int)
        far_v = np.clip(v - 5.0 * r * dy, 0, height - 1).astype(int)
        inside = blurred[far_v, far_u] * (1.0 - 0.35 * np.clip(square - 0.5, 0.0, 1.0)[:, :, None])
        shown[top:bottom, left:right] += cover * (inside - shown[top:bottom, left:right])
    return shown


def _clutter(shape: tuple[int, int], rng: np.random.Generator) -> F32:
    """Soft bright shapes, as a dashboard and papers on it look in the glass; 0..1, (H,W)."""
    height, width = shape
    veil = np.zeros(shape, dtype=np.float32)
    for _ in range(int(rng.integers(2, 7))):
        middle = rng.uniform((0.0, 0.4), (1.0, 1.05)) * (width, height)
        corners = middle + rng.normal(0.0, 0.16, (5, 2)) * (width, 0.6 * height)
        cv2.fillConvexPoly(veil, cv2.convexHull(corners.astype(np.int32)), float(rng.uniform(0.2, 1.0)))
    return np.asarray(
        cv2.GaussianBlur(veil, (0, 0), float(rng.uniform(0.002, 0.02)) * width), dtype=np.float32
    )


def _bonnet(shown: F32, classes: Pixels, share: float, rng: np.random.Generator) -> tuple[F32, Pixels]:
    """The own bonnet: painted, mirroring what is above it, with a fold or two; it is not labelled."""
    height, width = shown.shape[:2]
    u = np.linspace(-1.0, 1.0, width, dtype=np.float32)
    round_, tilt = float(rng.uniform(0.2, 0.9)), float(rng.normal(0.0, 0.1))
    rim = height * (1.0 - share * (1.0 - round_ * u**2 + tilt * u))
    v = np.arange(height, dtype=np.float32)[:, None]
    inside = v > rim[None, :]
    away = np.maximum(v - rim[None, :], 0.0)
    source = np.clip(rim[None, :] - 1.0 - 3.0 * away, 0, height - 1).astype(int)
    mirrored = np.take_along_axis(shown, source[:, :, None], axis=0)
    mirrored = np.asarray(cv2.GaussianBlur(mirrored, (0, 0), 0.003 * width), dtype=np.float32)
    tone = float(rng.choice([5.0, 20.0, 60.0, 130.0])) * np.exp(rng.normal(0.0, 0.1, 3))
    mirror = float(rng.uniform(0.05, 0.6))
    paint = tone.astype(np.float32) * (1.0 + 0.2 * np.abs(u))[None, :, None]
    drawn = paint * (1.0 - mirror) + mirror * mirrored
    for place in rng.uniform(-0.8, 0.8, int(rng.integers(0, 3))):
        drawn *= (1.0 - 0.3 * np.exp(-((((u - place) * width / 2) / 2.0) ** 2)))[None, :, None]
    hidden = classes.copy()
    hidden[inside] = labels.IGNORE
    return np.where(inside[:, :, None], drawn, shown), hidden
