from importlib import resources

import numpy as np
import onnxruntime
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import evaluate
from models.evaluate import Tally
from pipeline import labels, segmentation


@settings(max_examples=30, deadline=None)
@given(width=st.integers(1, 2000), height=st.integers(1, 2000))
def test_what_is_measured_is_fed_as_the_run_time_feeds_it(width, height):
    image = np.random.default_rng(width).integers(0, 256, (height, width, 3)).astype(np.uint8)
    pixels, reduced = evaluate.network_input(image)
    assert np.array_equal(pixels, segmentation.network_input(image))
    assert reduced == segmentation.reduced_size(width, height)[::-1]


def test_figures_of_a_mask_two_pixels_beside_its_label():
    label = np.zeros((200, 1280), np.uint8)
    label[:, 600:604] = labels.LANE
    p = np.zeros((200, 1280), np.float32)
    p[:, 602:606] = 0.72
    tally = Tally()
    tally.add(p, label, labels.LANE)
    assert tally.at(0.7) == {"iou": round(2 / 6, 3), "precision": 1.0, "recall": 1.0}
    assert tally.at(0.75) == {"iou": 0.0, "precision": None, "recall": 0.0}
    assert tally.reliability()[7] == 0.5
    far = np.zeros_like(p)
    far[:, 700:704] = 0.9
    tally.add(far, label, labels.LANE)
    assert tally.at(0.7)["precision"] == 0.5
    assert tally.at(0.7)["recall"] == 0.5


def test_ignored_pixels_count_for_nothing():
    label = np.full((50, 60), labels.IGNORE, np.uint8)
    label[:, :30] = labels.POLE
    p = np.ones((50, 60), np.float32)
    tally = Tally()
    tally.add(p, label, labels.POLE)
    assert tally.at(0.5) == {"iou": 1.0, "precision": 1.0, "recall": 1.0}
    assert tally.said.sum() == 50 * 30


def test_a_class_that_is_absent_gives_no_figure_but_counts_false_alarms():
    tally = Tally()
    tally.add(np.zeros((40, 40), np.float32), np.zeros((40, 40), np.uint8), labels.POLE)
    assert tally.at(0.5) == {"iou": None, "precision": None, "recall": None}
    tally.add(np.ones((40, 40), np.float32), np.zeros((40, 40), np.uint8), labels.POLE)
    assert tally.at(0.5) == {"iou": 0.0, "precision": 0.0, "recall": None}


@pytest.mark.parametrize("size", [(375, 1242), (1000, 1600), (97, 33)])
def test_probabilities_stand_on_the_pictures_own_pixels(size):
    model = (resources.files("models") / "bisenetv2.onnx").read_bytes()
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    image = np.random.default_rng(1).integers(0, 256, (*size, 3)).astype(np.uint8)
    full = evaluate.probabilities(session, image)
    assert full.shape == (len(labels.NAMES), *size)
    cells = segmentation.Segmenter(model).probabilities(image)
    scale_x, scale_y = segmentation.grid_scale(size[1], size[0])
    j, i = cells.shape[1] // 2, cells.shape[2] // 2
    v, u = round((j + 0.5) / scale_y - 0.5), round((i + 0.5) / scale_x - 0.5)
    assert np.abs(full[:, v, u] - cells[:, j, i]).max() < 0.35
