"""Masks come back to the pixels of their image, wherever the grid ends."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline import labels
from pipeline.label_image import label_image, on_image
from pipeline.records import Masks
from pipeline.segmentation import grid_scale, grid_size


def masks(lane, pole, scale):
    some = np.zeros(lane.shape, np.float32)
    return Masks(lane, pole, some, some, *scale)


@given(width=st.integers(1, 3000), height=st.integers(1, 60), seed=st.integers(0, 2**32 - 1))
def test_each_pixel_gets_the_cell_whose_centre_is_next(width, height, seed):
    columns, rows = grid_size(width, height)
    scale_x, scale_y = grid_scale(width, height)
    cells = np.arange(rows * columns).reshape(rows, columns)
    back = on_image(cells, (scale_x, scale_y), (width, height))
    assert back.shape == (height, width)
    rng = np.random.default_rng(seed)
    for u, v in zip(rng.integers(width, size=20), rng.integers(height, size=20), strict=True):
        j, i = divmod(int(back[v, u]), columns)
        across = np.abs((np.arange(columns) + 0.5) / scale_x - 0.5 - u)
        down = np.abs((np.arange(rows) + 0.5) / scale_y - 0.5 - v)
        assert across[i] == pytest.approx(across.min(), abs=1e-6)
        assert down[j] == pytest.approx(down.min(), abs=1e-6)


def test_a_cell_of_half_size_covers_four_pixels():
    lane, pole = np.zeros((2, 3), bool), np.zeros((2, 3), bool)
    lane[0, 1] = pole[1, 2] = True
    image = label_image(masks(lane, pole, (0.5, 0.5)), (5, 3))
    assert image.dtype == np.uint8
    assert image.tolist() == [[0, 0, 1, 1, 0], [0, 0, 1, 1, 0], [0, 0, 0, 0, 2]]
    assert (labels.OTHER, labels.LANE, labels.POLE) == (0, 1, 2)


def test_one_pixel_is_one_cell():
    lane = np.ones((1, 1), bool)
    assert label_image(masks(lane, ~lane, (0.5, 0.5)), (1, 1)).tolist() == [[1]]
