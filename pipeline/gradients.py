"""Oriented, saturated image gradients at several scales: what the edges of the cloud are compared with.

A gradient is divided by its neighbourhood's mean, so that a dark street counts like a sunny one, and
saturated, so that one strong border does not outvote the rest. All widths are angles: they follow the focal
length.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.records import CameraImage, CameraModel, Floats

ORIENTATIONS = 4
"""Steps of 45 degrees: the response is a squared cosine, so linear interpolation between them is close. A
power of two."""

LEVELS = 3
"""Scales per image; each is half of the one before."""

FOCAL_PX = 720.0
"""Focal length that the widths below are stated at."""

_LARGEST_FOCAL_PX = 900.0
"""Above it the image is shrunk to FOCAL_PX: 0.08 deg per pixel is finer than the edges of a LiDAR."""

_SMALLEST_PX = 8
"""Sides of the finest level are at least so long: the coarsest then has neighbours to interpolate between."""

_BLUR_PX = 1.2
"""Blur of the grey image before its gradient."""

_NEIGHBOURHOOD_PX = 61.0
"""Box over which gradients are normalised, 4.9 deg: wider than a lamp post, narrower than a car."""

_NOISE_FLOOR = 1.0
"""Grey levels a pixel, added to the normaliser: flat areas stay flat."""

_LEVEL_BLUR_PX = 1.5
"""Blur of the response at each level: 0.12, 0.24, 0.48 deg at levels 0, 1, 2."""

_SATURATION = 2.0
"""Normalised squared gradient at which the response reaches half of its largest value."""

_FULL_SCALE = 1.5
"""Largest response."""

COUNTS = 40000.0
"""uint16 counts per unit response: 60000 at full scale."""


@dataclass(frozen=True, slots=True, eq=False)
class GradientPyramid:
    """Oriented gradients of one image.

    Attributes:
        levels: For each level uint16 (4,h,w): response to a step along 0, 45, 90, 135 degrees (u right, v
            down), in units of 1/COUNTS.
        scales: For each level (sx, sy): level px = (image px + 0.5) * s - 0.5.
    """

    levels: tuple[NDArray[np.uint16], ...]
    scales: tuple[tuple[float, float], ...]


def gradient_pyramid(image: CameraImage, camera: CameraModel) -> GradientPyramid:
    """Oriented gradients of ``image`` at LEVELS scales (PROBE section 1, image)."""
    focal = 0.5 * (camera.K[0, 0] + camera.K[1, 1])
    grey = cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY)
    height, width = grey.shape
    shrink = FOCAL_PX / focal if focal > _LARGEST_FOCAL_PX else 1.0
    size = (max(_SMALLEST_PX, round(width * shrink)), max(_SMALLEST_PX, round(height * shrink)))
    if size != (width, height):
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    unit = focal * shrink / FOCAL_PX
    free = _free_of_gradients(grey.astype(np.float32), unit)
    levels, scale = [], np.array(size) / (width, height)
    for _ in range(LEVELS):
        levels.append(_blurred(free, _LEVEL_BLUR_PX * unit))
        free = _halved(free)
    scales = tuple((float(scale[0] / 2**k), float(scale[1] / 2**k)) for k in range(LEVELS))
    return GradientPyramid(tuple(levels), scales)


def _blurred(free: NDArray[np.float32], sigma_px: float) -> NDArray[np.uint16]:
    """A level (4,h,w) in counts, of what lacks to the largest response."""
    level = np.empty(free.shape, dtype=np.uint16)
    blurred = np.empty(free.shape[1:], dtype=np.float32)
    for counts, one in zip(level, free, strict=True):
        cv2.GaussianBlur(one, (0, 0), sigma_px, dst=blurred)
        blurred *= np.float32(-_FULL_SCALE * COUNTS)
        np.add(blurred, np.float32(_FULL_SCALE * COUNTS), out=counts, casting="unsafe")
    return level


def _halved(images: NDArray[np.float32]) -> NDArray[np.float32]:
    """Images (4,h,w) at half the size: each pixel the mean of four, an odd last row or column left out."""
    h, w = images.shape[1] // 2, images.shape[2] // 2
    halved = np.empty((len(images), h, w), dtype=np.float32)
    for half, image in zip(halved, images, strict=True):
        cv2.resize(image[: 2 * h, : 2 * w], (w, h), dst=half, interpolation=cv2.INTER_AREA)
    return halved


def _free_of_gradients(grey: NDArray[np.float32], unit: float) -> NDArray[np.float32]:
    """What lacks in the saturated squared directional gradients to the largest response, as a share of it.

    float32 (4,h,w) in 0..1: ``1 / (1 + g^2 / saturation)`` where the response is
    ``full scale g^2 / (saturation + g^2)``. It takes fewer steps over the image than the response does.
    """
    smooth = cv2.GaussianBlur(grey, (0, 0), _BLUR_PX * unit)
    gx = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1.0 / 8.0), dtype=np.float32)
    gy = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1.0 / 8.0), dtype=np.float32)
    box = max(3, round(_NEIGHBOURHOOD_PX * unit))
    free = np.empty((ORIENTATIONS, *grey.shape), dtype=np.float32)
    along, up, across, down = free
    # Not by cv2.magnitude, whose last digit depends on where the arrays lie in memory.
    length = np.square(gx, out=along)
    length += np.square(gy, out=across)
    norm = np.asarray(cv2.blur(np.sqrt(length, out=length), (box, box)), dtype=np.float32)
    norm += np.float32(_NOISE_FLOOR)
    norm *= np.float32(math.sqrt(_SATURATION))
    gx /= norm
    gy /= norm
    np.square(gx, out=along)
    np.square(gy, out=across)
    # Along the diagonals the square is half of (gx +- gy)^2.
    half = np.add(along, across, out=norm)
    half *= np.float32(0.5)
    gx *= gy
    np.add(half, gx, out=up)
    np.subtract(half, gx, out=down)
    free += np.float32(1.0)
    return np.reciprocal(free, out=free)


def sample(
    images: Sequence[NDArray[np.uint16]],
    slot: NDArray[np.int64],
    uv: Floats,
    angle: Floats,
    scale: tuple[float, float],
) -> tuple[Floats, Floats]:
    """Response and its gradient at image pixels, bilinear in place and linear in orientation.

    Args:
        images: uint16 (4,h,w) each, the same level of F images of one size; where they lie, they are read.
        slot: int64 (N,), image of each sample, ascending.
        uv: float64 (N,2), image px.
        angle: float64 (N,), direction of the step in the image, rad (taken modulo pi).
        scale: (sx, sy) of the level.

    Returns:
        Response (N,), and its derivative by image px (N,2), with the orientation held; outside the image the
        border's value and derivative 0.
    """
    h, w = images[0].shape[1:]
    x = (uv[:, 0] + 0.5) * scale[0] - 0.5
    y = (uv[:, 1] + 0.5) * scale[1] - 0.5
    x_in, y_in = np.clip(x, 0.0, w - 1.001), np.clip(y, 0.0, h - 1.001)
    x0, y0 = x_in.astype(np.int64), y_in.astype(np.int64)
    fx, fy = x_in - x0, y_in - y0
    turn = angle * (ORIENTATIONS / math.pi)
    below = np.floor(turn)
    fo = turn - below
    o0 = below.astype(np.int64) & (ORIENTATIONS - 1)
    # The four neighbours in place, of the orientation below and of the one above.
    index = np.empty((8, len(x)), dtype=np.int64)
    index[0] = (o0 * h + y0) * w + x0
    index[4] = index[0] + np.where(o0 == ORIENTATIONS - 1, (1 - ORIENTATIONS) * h * w, h * w)
    for tap, offset in enumerate((1, w, w + 1), 1):
        np.add(index[0], offset, out=index[tap])
        np.add(index[4], offset, out=index[4 + tap])
    read = np.empty((8, len(x)))
    seen = slice(int(slot[0]), int(slot[-1]) + 1) if len(slot) else slice(0, 0)
    bounds = np.searchsorted(slot, np.arange(seen.start, seen.stop + 1)).tolist()
    for image, begin, end in zip(images[seen], bounds[:-1], bounds[1:], strict=True):
        read[:, begin:end] = image.reshape(-1).take(index[:, begin:end])
    taps = read[:4] + fo * (read[4:] - read[:4])
    taps /= COUNTS
    top = taps[0] + fx * (taps[1] - taps[0])
    bottom = taps[2] + fx * (taps[3] - taps[2])
    value = top + fy * (bottom - top)
    du = ((1.0 - fy) * (taps[1] - taps[0]) + fy * (taps[3] - taps[2])) * scale[0]
    dv = (bottom - top) * scale[1]
    slope = np.column_stack([np.where(x == x_in, du, 0.0), np.where(y == y_in, dv, 0.0)])
    return value, slope
