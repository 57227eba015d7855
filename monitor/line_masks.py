"""Mask files of lanes and poles, in place of the network: ``calibrate --mask``.

Two kinds are told apart by their values. A label image has the classes of ``pipeline.labels`` (1 lane, 2
pole, up to 8, 255 ignored). A line mask has bright lines on black, whatever they show, JPEG noise included:
CRLF's authors give theirs so, and what a line is follows from where it lies.
"""

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from monitor.image_files import read_image
from pipeline import labels
from pipeline.cameras import ideal_pixels
from pipeline.errors import InputError
from pipeline.records import CameraModel, Floats, Masks

BRIGHT = 128
"""Grey level from which a pixel of a line mask belongs to a line: half of full white."""
UPRIGHT = math.radians(20.0)
"""rad; poles lean less in the image of an upright camera, also beside the middle of a wide lens."""
SLENDER = 3.0
"""Length over width of an upright piece, at least."""
MOSTLY = 0.5
"""Share of a piece below the horizon under which it is a pole, with arms and lamps of whatever shape."""
LEAST_PX = 8
"""px; smaller pieces are noise of the compression."""
SAME_SHAPE = 0.01
"""Relative difference of width over height up to which a mask is its image, scaled."""
HINT = "a mask is an image of its frame's shape: classes 1 lane, 2 pole, or bright lines on black"


def read_masks(path: Path, camera: CameraModel, horizon: Floats | None) -> Masks:
    """Masks of one frame from a file.

    Args:
        path: PNG, JPEG or BMP of the image's size, or the same picture scaled.
        camera: Intrinsics of the image.
        horizon: float64 (3,), line in px, positive on the ground's side (``masks.horizon_line``), which parts
            lanes from poles in a line mask; None: that of a level camera.

    Raises:
        InputError: It can not be read, is of another shape, or shows no lines. The text names the file.
    """
    grey = read_image(path).pixels.max(axis=2)
    height, width = grey.shape
    scale_x, scale_y = width / camera.width, height / camera.height
    if abs(scale_x / scale_y - 1.0) > SAME_SHAPE:
        raise InputError(
            f"mask {path} is {width}x{height} px, its image {camera.width}x{camera.height}", hint=HINT
        )
    if not (set(np.unique(grey).tolist()) - {*range(len(labels.NAMES)), labels.IGNORE}) and _named(grey):
        lane, pole = grey == labels.LANE, grey == labels.POLE
    else:
        lane, pole = _told_apart(grey >= BRIGHT, camera, (scale_x, scale_y), horizon)
    if not (lane.any() or pole.any()):
        raise InputError(f"mask {path} shows no lane and no pole", hint=HINT)
    return Masks(lane, pole, lane.astype(np.float32), pole.astype(np.float32), scale_x, scale_y)


def _named(values: NDArray[np.uint8]) -> bool:
    """Whether lane or pole occurs by its label: 0 and 255 alone may be a line mask as well."""
    return bool(((values == labels.LANE) | (values == labels.POLE)).any())


def _told_apart(
    lines: NDArray[np.bool_], camera: CameraModel, scale: tuple[float, float], horizon: Floats | None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Lanes and poles (h,w): pieces above the horizon and upright ones across it are poles."""
    line = np.array([0.0, 1.0, -camera.K[1, 2]]) if horizon is None else horizon
    count, pieces = cv2.connectedComponents(lines.astype(np.uint8), connectivity=8)
    rows, columns = np.nonzero(pieces)
    owner = pieces[rows, columns]
    raw = (np.column_stack([columns, rows]) + 0.5) / np.array(scale) - 0.5
    ground_side = raw @ line[:2] + line[2] > 0
    kind = np.zeros(count, dtype=np.uint8)
    order = np.argsort(owner, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(owner[order])) + 1):
        if len(part) < LEAST_PX:
            continue
        below = float(ground_side[part].mean())
        # A lane straight ahead stands upright as well, and with a camera that looks down it seems to rise.
        rises = below < MOSTLY or (below < 1.0 and _stands(ideal_pixels(camera, raw[part])))
        kind[owner[part[0]]] = labels.POLE if rises else labels.LANE
    found = kind[pieces]
    return found == labels.LANE, found == labels.POLE


def _stands(ideal: Floats) -> bool:
    """Whether a piece, ideal px (N,2), is slender and upright."""
    ideal = ideal[np.isfinite(ideal).all(axis=1)]
    if len(ideal) < LEAST_PX:
        return False
    values, axes = np.linalg.eigh(np.cov(ideal.T))
    upright = abs(float(axes[1, 1])) >= math.cos(UPRIGHT)
    return upright and float(values[1]) >= SLENDER**2 * max(float(values[0]), 1e-9)
