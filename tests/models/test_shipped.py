"""What the networks that ship see in simulated streets of seeds that no training had."""

from importlib import resources

import cv2
import numpy as np
import pytest

from pipeline import labels
from pipeline.label_image import label_image
from pipeline.masks import MaskParameters, masks_from_probabilities
from pipeline.segmentation import Segmenter, grid_scale
from pipeline.simulation.variety import draw_variety, picture

STREETS = 5


@pytest.fixture(scope="module")
def streets():
    def draw(index):
        rng = np.random.default_rng([556, index])
        shown, _ = picture(draw_variety(rng), rng)
        return shown.image.pixels, shown.labels

    return [draw(index) for index in range(STREETS)]


def crossings(label, unit):
    """Rows of posts 3 to 5 px wide at a width of 1280 px: (row, from, to)."""
    for row, pole in enumerate(label == labels.POLE):
        ends = np.flatnonzero(np.diff(np.concatenate([[0], pole.astype(int), [0]])))
        for start, end in zip(ends[::2], ends[1::2], strict=True):
            if 2.5 * unit < end - start <= 5.0 * unit:
                yield row, start, end


# Measured here: 0.60 and 0.47 (0.76 and 0.66 on twelve streets of seed 555); network 1.0 had 0.41.
@pytest.mark.parametrize(("name", "least"), [("bisenetv2.onnx", 0.5), ("bisenetv2_free.onnx", 0.4)])
def test_posts_of_four_pixels_survive(streets, name, least):
    segmenter = Segmenter((resources.files("models") / name).read_bytes(), threads=1)
    found = []
    for pixels, label in streets:
        size = pixels.shape[1::-1]
        scale = grid_scale(*size)
        masks = masks_from_probabilities(
            segmenter.probabilities(pixels), pixels, MaskParameters(), scale=scale
        )
        pole = (label_image(masks, size) == labels.POLE).astype(np.uint8)
        near = cv2.dilate(pole, np.ones((5, 5), np.uint8)).astype(bool)
        unit = max(1.0, size[0] / 1280.0)
        found += [near[row, start:end].any() for row, start, end in crossings(label, unit)]
    assert len(found) > 500
    assert np.mean(found) > least
