"""Connected pieces of a mask, and which of them stay."""

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.records import Floats

Floats32: TypeAlias = NDArray[np.float32]
Bools: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """The connected pieces (8 neighbours) of a mask.

    Attributes:
        image: int32 (h,w), number of each pixel's piece, 1..n; 0 outside the mask.
        boxes: int64 (n+1,2), width and height of each piece's bounding box, px.
        sizes: int64 (n+1,), px; entry 0 of both stands for what is no piece.
    """

    image: NDArray[np.int32]
    boxes: NDArray[np.int64]
    sizes: NDArray[np.int64]

    def where(self, chosen: Bools) -> Bools:
        """Pixels (h,w) of the chosen pieces, bool (n+1,)."""
        chosen = chosen.copy()
        chosen[0] = False
        return np.asarray(chosen[self.image], dtype=np.bool_)

    def share(self, mask: Bools) -> Floats:
        """Share of each piece that lies in another mask, (n+1,)."""
        inside = np.bincount(self.image[mask], minlength=len(self.sizes))
        return np.asarray(inside / self.sizes, dtype=np.float64)

    def peaks(self, values: Floats32) -> Floats32:
        """Largest of the values (h,w) in each piece, (n+1,)."""
        found = np.full(len(self.sizes), -np.inf, dtype=np.float32)
        inside = self.image > 0
        np.maximum.at(found, self.image[inside], values[inside])
        return found

    def around(self, values: Floats32, reach: tuple[int, int]) -> Floats:
        """Mean of the values (h,w) outside all pieces, at most ``reach`` px (x, y) from each, (n+1,).

        NaN for a piece without such pixels. A pixel near several pieces counts for one of them.
        """
        window = np.ones((2 * reach[1] + 1, 2 * reach[0] + 1), dtype=np.uint8)
        nearest = cv2.dilate(self.image.astype(np.float32), window).astype(np.int32)
        nearest[self.image > 0] = 0
        ring = np.flatnonzero(nearest)
        owner = nearest.ravel()[ring]
        count = np.bincount(owner, minlength=len(self.sizes))
        total = np.bincount(owner, weights=values.ravel()[ring], minlength=len(self.sizes))
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def pieces_of(mask: Bools) -> Pieces:
    """The pieces of a mask (h,w)."""
    _, image, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    boxes = np.asarray(stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]], dtype=np.int64)
    sizes = np.asarray(stats[:, cv2.CC_STAT_AREA], dtype=np.int64)
    return Pieces(np.asarray(image, dtype=np.int32), boxes, np.maximum(sizes, 1))
