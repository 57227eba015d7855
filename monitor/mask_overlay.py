"""An image with its masks laid over it, for the eye."""

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline import labels

_LONGEST_PX = 1600
"""px; fits a screen, and a pole of 2 px is still seen."""

_TINT = 0.35
"""Share of the class's colour inside the mask: what lies below must be seen to be judged."""

_OUTLINE_PX = 1
"""px around the mask; outside of it, or thin masks would be nothing but outline."""


def mask_overlay(pixels: NDArray[np.uint8], label: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Tint lane and pole in the colours of the label contract and draw a line around them.

    Args:
        pixels: uint8 (H,W,3), BGR.
        label: uint8 (H,W), values of ``pipeline.labels``.

    Returns:
        uint8 (h,w,3), BGR, reduced so that the longer side has at most 1600 px.
    """
    height, width = label.shape
    scale = min(1.0, _LONGEST_PX / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    shown = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    around = np.ones((2 * _OUTLINE_PX + 1, 2 * _OUTLINE_PX + 1), dtype=np.uint8)
    for value in (labels.LANE, labels.POLE):
        colour = np.array(labels.COLOURS_RGB[value][::-1], dtype=np.float32)
        # Any covered pixel shows: what is thinner than a reduced pixel would else come and go.
        share = cv2.resize((label == value).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        mask = (share > 0.0).astype(np.uint8)
        outline = np.asarray(cv2.dilate(mask, around) > mask)
        inside = mask.astype(np.bool_)
        tinted = (1.0 - _TINT) * shown[inside] + _TINT * colour
        shown[inside] = np.round(tinted).astype(np.uint8)
        shown[outline] = colour.astype(np.uint8)
    return shown
