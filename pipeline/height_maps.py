"""Inverse distance maps of the masks: how near each pixel is to a lane or a pole (CRLF (8), corrected).

The maximum over all pixels of the other set of ``gamma^distance`` is ``gamma^(distance to the nearest one)``.
Printed like that the map is highest at the contour of a mask and draws points to its edges (FORMULAS B (8)),
so there are three modes:

- ``printed``: ``gamma0^d_in`` inside, ``gamma1^d_out`` outside; to reproduce the paper, biased.
- ``plateau``: 1 inside, ``gamma1^d_out`` outside: a wide basin, its top as wide as the mask.
- ``ridge``: ``1 - gamma0^(d_in - 1/2) / 2`` inside, ``gamma1^(d_out - 1/2) / 2`` outside: highest on the
  middle line of the mask, without a step at its contour.
"""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.records import CameraModel, Masks, read_only

Floats32: TypeAlias = NDArray[np.float32]
Mode: TypeAlias = Literal["printed", "plateau", "ridge"]

GAMMA_OUT = 0.98
"""Per px at the reference focal length: an e-fold of 50 px or 4 deg, so that 6 deg of error still slope."""
GAMMA_IN = 0.8
"""Likewise, inside a mask: strokes are 3 to 30 px wide, and the slope must last to their middle."""
REFERENCE_FOCAL_PX = 720.0
"""px; distances are angles: one px of a longer focal length counts less."""


@dataclass(frozen=True, slots=True, eq=False)
class HeightMaps:
    """The maps H of both classes on one grid; a grid pixel lies where :class:`Masks` says.

    Attributes:
        lane: float32 (h,w), 0..1.
        pole: float32 (h,w), 0..1.
        scale_x: grid px per image px, horizontally.
        scale_y: grid px per image px, vertically.
    """

    lane: Floats32
    pole: Floats32
    scale_x: float
    scale_y: float

    def __post_init__(self) -> None:
        for name in ("lane", "pole"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def height_maps(
    masks: Masks, camera: CameraModel, mode: Mode, *, gamma0: float = GAMMA_IN, gamma1: float = GAMMA_OUT
) -> HeightMaps:
    """Maps of the raw image's masks (CRLF (8)); gammas hold per px at the reference focal length.

    The image stays raw: whoever looks a point up bends it through the lens (FORMULAS E1), so that no part of
    the image is lost to an undistorted frame and no ray beyond the lens comes back in.

    Args:
        masks: Lane and pole masks.
        camera: Intrinsics of the raw image.
        mode: What the map is inside a mask, see the module.
        gamma0: Of the inside, 0..1.
        gamma1: Of the outside, 0..1.
    """
    # One px of a coarser grid is several of the image. Grids are as good as square: one scale does for both.
    px = REFERENCE_FOCAL_PX / float(camera.K[1, 1]) / float(np.sqrt(masks.scale_x * masks.scale_y))
    lane, pole = (
        height_map(mask, mode, gamma0=gamma0**px, gamma1=gamma1**px) for mask in (masks.lane, masks.pole)
    )
    return HeightMaps(lane, pole, masks.scale_x, masks.scale_y)


def height_map(mask: NDArray[np.bool_], mode: Mode, *, gamma0: float, gamma1: float) -> Floats32:
    """Map H, float32 (h,w), of one mask (h,w); an empty mask gives 0, gammas hold per px of its grid.

    Distances are exact city-block ones between pixel centres. A mask without outside is infinitely deep.
    """
    if not mask.any():
        return np.zeros(mask.shape, dtype=np.float32)
    outside = _falloff(~mask, gamma1)
    if mode == "plateau":
        return outside
    inside = np.zeros_like(outside) if mask.all() else _falloff(mask, gamma0)
    if mode == "printed":
        return np.where(mask, inside, outside)
    half = np.float32(0.5)
    return np.where(
        mask, 1 - half * inside * np.float32(gamma0**-0.5), half * outside * np.float32(gamma1**-0.5)
    )


def _falloff(region: NDArray[np.bool_], gamma: float) -> Floats32:
    """``gamma^d``, float32 (h,w), d the city-block distance to the nearest px outside the region.

    1 outside the region.
    """
    distance = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L1, 3)
    return np.asarray(np.exp(distance * np.float32(np.log(gamma))), dtype=np.float32)
