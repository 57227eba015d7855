"""Where in an image two extrinsics can be told apart by eye.

A place is good where the points of the cloud lie far apart under the two, where they are many, and where they
run along clear edges of the image under one of the two: a pole against the sky, not the leaves of a tree.
Which of the two it is does not matter: places are not chosen to flatter the estimate.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.records import Floats

Pixels = NDArray[np.uint8]

_ACROSS = 6
"""A place is this part of the image's width: a drift of half a degree moves a point by a tenth of it."""
_SHAPE = 1.4
"""width / height of a place."""
_STEPS = 3
"""places tried per width and height of one."""
_MOVES = 3
"""A place is moved this often towards the middle of its points."""
_ENOUGH_POINTS = 30
"""points beyond which more do not make a place better to judge."""
_FEWEST_POINTS = 6
"""points below which nothing can be judged."""
_SURROUNDINGS = 24
"""Edges are held against the texture within this part of the image's width."""
_NOISE = 4.0
"""grey levels per px; gradients of this size are noise of a camera at dusk."""
_ALIKE_PX = 1.0
"""px; extrinsics that lie closer differ by less than an eye can tell, then clear edges alone decide."""


@dataclass(frozen=True, slots=True)
class Place:
    """A part of the image, px, and how far the extrinsics lie apart in it.

    Attributes:
        left: First column.
        top: First row.
        width: Columns.
        height: Rows.
        apart_px: Median displacement of the points between the two extrinsics.
        points: Number of points.
    """

    left: int
    top: int
    width: int
    height: int
    apart_px: float
    points: int


def best_places(image: Pixels, stored: Floats, estimated: Floats, most: int) -> tuple[Place, ...]:
    """The best places that do not overlap, best first.

    Args:
        image: uint8 (H,W,3).
        stored: Pixels (M,2) of points under one extrinsic, inside the image.
        estimated: Pixels (M,2) of the same points under the other.
        most: Number of places at most.
    """
    height, width = image.shape[:2]
    w = max(1, width // _ACROSS)
    h = max(1, min(height, round(w / _SHAPE)))
    clear = _clearness(image, stored, estimated)
    scored: list[tuple[float, Place]] = []
    for top in range(0, height - h + 1, max(1, h // _STEPS)):
        for left in range(0, width - w + 1, max(1, w // _STEPS)):
            x, y, inside = _centred(stored, estimated, (left, top, w, h), (width, height))
            number = int(inside.sum())
            if number < _FEWEST_POINTS:
                continue
            apart = float(np.median(np.linalg.norm(stored[inside] - estimated[inside], axis=1)))
            edges = float(clear[inside].mean(axis=0).max())
            score = max(apart, _ALIKE_PX) * min(number, _ENOUGH_POINTS) * edges
            scored.append((score, Place(x, y, w, h, apart, number)))
    chosen: list[Place] = []
    for _, place in sorted(scored, key=lambda item: item[0], reverse=True):
        if len(chosen) < most and not any(_overlap(place, other) for other in chosen):
            chosen.append(place)
    return tuple(chosen)


def _centred(
    stored: Floats, estimated: Floats, window: tuple[int, int, int, int], size: tuple[int, int]
) -> tuple[int, int, NDArray[np.bool_]]:
    """Moves a window until its points stand in its middle: left, top, and which points it holds then."""
    x, y, w, h = window
    middle = 0.5 * (stored + estimated)
    inside = _inside(stored, estimated, x, y, w, h)
    for _ in range(_MOVES):
        if not inside.any():
            break
        corner = np.round(np.median(middle[inside], axis=0) - (0.5 * w, 0.5 * h))
        x, y = (int(c) for c in np.clip(corner, 0, (size[0] - w, size[1] - h)))
        inside = _inside(stored, estimated, x, y, w, h)
    return x, y, inside


def within(uv: Floats, left: int, top: int, width: int, height: int) -> NDArray[np.bool_]:
    """Which of the pixels (M,2) lie in a place, bool (M,)."""
    u, v = uv[:, 0], uv[:, 1]
    return (u >= left) & (u < left + width) & (v >= top) & (v < top + height)


def _inside(stored: Floats, estimated: Floats, *window: int) -> NDArray[np.bool_]:
    """Both ends of a displacement must be in the picture, or one of the two shows nothing."""
    return within(stored, *window) & within(estimated, *window)


def _overlap(a: Place, b: Place) -> bool:
    return abs(a.left - b.left) < a.width and abs(a.top - b.top) < a.height


def _clearness(image: Pixels, stored: Floats, estimated: Floats) -> Floats:
    """Per point and extrinsic, (M,2): gradient along the displacement over that of the surroundings."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    gradients = np.abs(np.stack([cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)])) / 8.0
    side = 2 * (image.shape[1] // _SURROUNDINGS // 2) + 1
    texture = cv2.blur(np.hypot(gradients[0], gradients[1]), (side, side)) + _NOISE
    # A point may lie a pixel beside its edge and still be on it.
    near = np.ones((3, 3), dtype=np.uint8)
    across = np.stack([cv2.dilate(gradient, near) / texture for gradient in gradients], axis=-1)
    shift = np.abs(estimated - stored) + 1e-9
    direction = shift / np.linalg.norm(shift, axis=1, keepdims=True)
    height, width = grey.shape
    columns = []
    for uv in (stored, estimated):
        u = np.clip(np.round(uv[:, 0]).astype(int), 0, width - 1)
        v = np.clip(np.round(uv[:, 1]).astype(int), 0, height - 1)
        columns.append((across[v, u] * direction).sum(axis=1))
    return np.stack(columns, axis=1)
