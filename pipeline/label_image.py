"""What lies on the grid of the masks, brought back to the image's own pixels."""

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline import labels
from pipeline.records import Masks

_T = TypeVar("_T", bound=np.generic)


def on_image(grid: NDArray[_T], scale: tuple[float, float], size: tuple[int, int]) -> NDArray[_T]:
    """The value of the cell that each image pixel lies in (nearest cell).

    Args:
        grid: (h,w), values of cells.
        scale: Grid px per image px (x, y), as in ``records.Masks``.
        size: Width and height of the image, px.

    Returns:
        (H,W), of the grid's dtype. Pixels that rounding puts beyond the last cell get its value.
    """
    columns, rows = (
        np.minimum(((np.arange(length) + 0.5) * factor).astype(np.intp), cells - 1)
        for length, factor, cells in zip(size, scale, grid.shape[::-1], strict=True)
    )
    moved: NDArray[Any] = grid[rows[:, None], columns]
    return moved


def label_image(masks: Masks, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Masks as a label image.

    Args:
        masks: Lane and pole.
        size: Width and height of the image they were made of, px.

    Returns:
        uint8 (H,W): ``labels.LANE``, ``labels.POLE``, and ``labels.OTHER`` everywhere else.
    """
    values = np.full(masks.lane.shape, labels.OTHER, dtype=np.uint8)
    values[masks.lane] = labels.LANE
    values[masks.pole] = labels.POLE
    return on_image(values, (masks.scale_x, masks.scale_y), size)
