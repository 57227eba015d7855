"""Colours stand where the masks are, and nowhere else."""

import numpy as np
import pytest

from monitor.mask_overlay import mask_overlay
from pipeline import labels

LANE, POLE = (np.array(labels.COLOURS_RGB[value][::-1]) for value in (labels.LANE, labels.POLE))


def test_masks_are_tinted_and_lined_and_the_rest_is_as_it_was():
    pixels = np.full((60, 80, 3), 100, np.uint8)
    label = np.zeros((60, 80), np.uint8)
    label[20:40, 10:20] = labels.LANE
    label[5:50, 60:62] = labels.POLE
    shown = mask_overlay(pixels, label).astype(int)
    assert np.abs(shown[25:35, 12:18] - (0.65 * 100 + 0.35 * LANE)).max() <= 1
    assert np.array_equal(shown[30, 9], LANE)
    assert np.array_equal(shown[41 - 1, 15], LANE)
    assert np.abs(shown[30, 60:62] - (0.65 * 100 + 0.35 * POLE)).max() <= 1
    assert np.array_equal(shown[30, [59, 62]], [POLE, POLE])
    changed = (shown != 100).any(axis=2)
    assert changed.sum() == 22 * 12 + 47 * 4


@pytest.mark.parametrize(
    ("size", "shown"), [((900, 3200), (450, 1600)), ((4000, 10), (1600, 4)), ((1, 1), (1, 1))]
)
def test_large_images_are_reduced_to_a_screen(size, shown):
    assert mask_overlay(np.zeros((*size, 3), np.uint8), np.zeros(size, np.uint8)).shape == (*shown, 3)


def test_a_mask_thinner_than_a_reduced_pixel_is_seen():
    label = np.zeros((100, 6400), np.uint8)
    label[:, 3001] = labels.POLE
    shown = mask_overlay(np.zeros((100, 6400, 3), np.uint8), label)
    assert shown[:, 750].any(axis=1).all()


def test_without_masks_the_image_stays():
    pixels = np.random.default_rng(2).integers(0, 256, (20, 30, 3)).astype(np.uint8)
    assert np.array_equal(mask_overlay(pixels, np.zeros((20, 30), np.uint8)), pixels)
