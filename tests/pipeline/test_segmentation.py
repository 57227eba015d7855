import hashlib
import importlib.util
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import labels, segmentation
from pipeline.errors import InputError, ModelError
from pipeline.segmentation import Segmenter, grid_scale, grid_size, network_input, to_bgr

_SPEC = importlib.util.spec_from_file_location(
    "onnx_bytes", Path(__file__).parents[1] / "oracles" / "onnx_bytes.py"
)
assert _SPEC is not None
assert _SPEC.loader is not None
onnx_bytes = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(onnx_bytes)

CONTRACT = {
    "class_names": ",".join(labels.NAMES),
    "labels_version": labels.VERSION,
    "input_rule": segmentation.INPUT_RULE,
    "normalisation": segmentation.NORMALISATION,
    "model_version": "7.1",
    "training_data_sha256": "ab" * 32,
}


@pytest.fixture(scope="module")
def means():
    return Segmenter(onnx_bytes.block_means(CONTRACT), threads=1)


@pytest.fixture(scope="module")
def shipped():
    return Segmenter((resources.files("models") / "bisenetv2.onnx").read_bytes(), threads=1)


def test_info_names_the_model():
    model = onnx_bytes.block_means(CONTRACT)
    info = Segmenter(model).info
    assert info.hash == hashlib.sha256(model).hexdigest()
    assert (info.version, info.training_data) == ("7.1", "ab" * 32)


@pytest.mark.parametrize("key", ["class_names", "labels_version", "input_rule", "normalisation"])
def test_model_of_another_contract_is_refused(key):
    with pytest.raises(ModelError, match=key):
        Segmenter(onnx_bytes.block_means(CONTRACT | {key: "something else"}))
    with pytest.raises(ModelError, match=key):
        Segmenter(onnx_bytes.block_means({k: v for k, v in CONTRACT.items() if k != key}))


def test_a_session_that_rests_answers_as_before(shipped):
    image = np.random.default_rng(3).integers(0, 256, (96, 160, 3), dtype=np.uint8)
    before = shipped.probabilities(image)
    shipped.rest()
    assert np.array_equal(shipped.probabilities(image), before)


def test_model_with_another_number_of_classes_is_refused():
    with pytest.raises(ModelError, match="inputs and outputs"):
        Segmenter(onnx_bytes.block_means(CONTRACT, classes=6))


def test_model_with_another_grid_is_refused():
    with pytest.raises(ModelError, match="grid"):
        Segmenter(onnx_bytes.block_means(CONTRACT, pool=4)).probabilities(np.zeros((64, 64, 3), np.uint8))


@pytest.mark.parametrize("model", [b"", b"no model", b"\x08\x08" * 100])
def test_bytes_that_are_no_model_are_refused(model):
    with pytest.raises(ModelError, match="no readable ONNX model"):
        Segmenter(model)


def test_every_prefix_of_a_model_ends_in_a_model_error():
    model = onnx_bytes.block_means(CONTRACT)
    for length in range(0, len(model) - 1, 7):
        with pytest.raises(ModelError):
            Segmenter(model[:length])


def test_channels_arrive_as_red_green_blue(means):
    image = np.empty((32, 64, 3), np.uint8)
    image[:] = (10, 20, 30)
    answer = means.probabilities(image)
    assert answer.dtype == np.float32
    assert answer.shape == (9, 16, 32)
    assert np.array_equal(answer[:, 3, 5], [30, 20, 10] * 3)


@settings(max_examples=40, deadline=None)
@given(width=st.integers(1, 3000), height=st.integers(1, 3000), seed=st.integers(0, 2**32 - 1))
def test_a_cell_lies_where_the_grid_scale_says(means, width, height, seed):
    """A ramp of known slope comes back as a ramp over the cells' own places."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    slope_u, slope_v = rng.uniform(0.2, 0.8, 2) * 110 / (width, height)
    image = np.repeat((20 + slope_u * u + slope_v * v).astype(np.uint8)[..., None], 3, axis=2)
    answer = means.probabilities(image)[0]
    columns, rows = grid_size(width, height)
    assert answer.shape == (rows, columns)
    scale_x, scale_y = grid_scale(width, height)
    j, i = np.mgrid[0:rows, 0:columns]
    # Cells on the right and bottom edge may reach over the image, where its last pixel is repeated.
    u_cell, v_cell = (i + 0.5) / scale_x - 0.5, (j + 0.5) / scale_y - 0.5
    inside = (u_cell + 0.5 / scale_x <= width - 0.5) & (v_cell + 0.5 / scale_y <= height - 0.5)
    expected = 20 + slope_u * u_cell + slope_v * v_cell - 0.5  # the mean of what rounding down takes
    tolerance = 1.1 + slope_u / scale_x * 0.3 + slope_v / scale_y * 0.3
    assert np.abs(answer - expected)[inside].max(initial=0.0) < tolerance


def test_input_is_padded_by_its_own_edge_and_not_moved():
    image = np.arange(33 * 40 * 3, dtype=np.uint32).astype(np.uint8).reshape(33, 40, 3)
    pixels = network_input(image)
    assert pixels.shape == (1, 3, 64, 64)
    assert np.array_equal(pixels[0, :, :33, :40], image[..., ::-1].transpose(2, 0, 1))
    assert np.array_equal(pixels[0, :, :33, 63], image[:, -1, ::-1].T)
    assert np.array_equal(pixels[0, :, 63, :40], image[-1, :, ::-1].T)


def test_long_images_are_reduced_and_others_are_not():
    assert segmentation.reduced_size(1242, 375) == (1242, 375)
    assert segmentation.reduced_size(2560, 1440) == (1280, 720)
    assert segmentation.reduced_size(600, 1920) == (400, 1280)
    assert segmentation.reduced_size(16384, 1) == (1280, 1)


def test_grey_alpha_and_sixteen_bit_mean_the_same_picture():
    rng = np.random.default_rng(1)
    grey = rng.integers(0, 256, (20, 30), dtype=np.uint8)
    bgr = np.repeat(grey[..., None], 3, axis=2)
    assert np.array_equal(to_bgr(grey), bgr)
    assert np.array_equal(to_bgr(grey[..., None]), bgr)
    assert np.array_equal(to_bgr(np.dstack((bgr, grey))), bgr)
    assert np.array_equal(to_bgr(bgr.astype(np.uint16) * 257), bgr)
    assert np.array_equal(to_bgr(bgr.astype(">u2") * 257), bgr)
    assert to_bgr(bgr) is bgr or np.shares_memory(to_bgr(bgr), bgr)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 5, 3), np.float32),
        np.zeros((4, 5, 3), np.int16),
        np.zeros((4, 5, 3), np.bool_),
        np.zeros((4, 5, 2), np.uint8),
        np.zeros((4, 5, 5), np.uint8),
        np.zeros((2, 4, 5, 3), np.uint8),
        np.zeros(7, np.uint8),
        np.zeros((0, 5, 3), np.uint8),
        np.zeros((5, 0), np.uint8),
        np.zeros((1, segmentation.LARGEST_SIDE + 1), np.uint8),
    ],
)
def test_what_is_no_image_is_an_input_error(means, image):
    with pytest.raises(InputError, match="can not be segmented"):
        means.probabilities(image)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((96, 200, 3), np.uint8),
        np.full((96, 200, 3), 255, np.uint8),
        np.zeros((1, 1, 3), np.uint8),
        np.full((333, 70), 128, np.uint8),
        np.random.default_rng(2).integers(0, 65536, (64, 97, 4)).astype(np.uint16),
        np.random.default_rng(3).integers(0, 256, (50, 4000, 3)).astype(np.uint8),
    ],
)
def test_shipped_model_gives_probabilities_for_any_image(shipped, image):
    answer = shipped.probabilities(image)
    assert answer.shape == (len(labels.NAMES), *grid_size(image.shape[1], image.shape[0])[::-1])
    assert np.isfinite(answer).all()
    assert answer.min() >= 0.0
    assert np.allclose(answer.sum(axis=0), 1.0, atol=1e-5)


def test_shipped_model_answers_alike_whatever_the_threads(shipped):
    image = np.random.default_rng(4).integers(0, 256, (120, 250, 3)).astype(np.uint8)
    model = (resources.files("models") / "bisenetv2.onnx").read_bytes()
    assert np.array_equal(shipped.probabilities(image), Segmenter(model, threads=2).probabilities(image))
    assert np.array_equal(shipped.probabilities(image), shipped.probabilities(image))


def test_shipped_model_finds_no_paint_in_a_blank_picture(shipped):
    for level in (0, 128, 255):
        answer = shipped.probabilities(np.full((128, 256, 3), level, np.uint8))
        assert answer[labels.LANE].max() < 0.5
        assert answer[labels.POLE].max() < 0.5
