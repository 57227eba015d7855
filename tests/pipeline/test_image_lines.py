import importlib.util
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.cameras import raw_pixels
from pipeline.image_lines import find_image_lines
from pipeline.records import CameraImage, CameraModel, Masks

_spec = importlib.util.spec_from_file_location(
    "line_scenes", Path(__file__).parents[1] / "oracles" / "line_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)

K = np.array([[721.5, 0.0, 240.0], [0.0, 721.5, 160.0], [0.0, 0.0, 1.0]])
CAMERA = CameraModel("pinhole", K, np.zeros(0), 480, 320)


def distances(line, start, end):
    """Signed distances of the found ends from the drawn centre line."""
    along = (np.asarray(end) - start) / np.linalg.norm(np.asarray(end) - start)
    normal = np.array([-along[1], along[0]])
    return np.array([(line.start - start) @ normal, (line.end - start) @ normal])


@settings(max_examples=20, deadline=None)
@given(
    st.sampled_from(["lane", "pole"]),
    st.floats(0.15, math.pi - 0.15),
    st.floats(4.0, 14.0),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_centre_line_of_a_stroke_is_found_to_a_tenth_of_a_pixel(label, angle, width, du, dv):
    middle = np.array([240.0 + du, 160.0 + dv])
    arm = 80.0 * np.array([math.cos(angle), math.sin(angle)])
    image, masks = scenes.draw([(label, middle - arm, middle + arm, width)], rng=np.random.default_rng(1))
    (line,) = find_image_lines(image, masks, CAMERA)
    assert line.label == label
    assert np.abs(distances(line, middle - arm, middle + arm)).max() < 0.15
    assert np.linalg.norm(line.end - line.start) == pytest.approx(160.0, abs=12.0)
    assert 0.3 <= line.sigma_px < 0.5


def test_dark_pole_is_found_and_dark_lane_is_not():
    strokes = [
        (label, (100.0 + x, 40.0), (102.0 + x, 260.0), 6.0) for label, x in (("pole", 0), ("lane", 200))
    ]
    image, masks = scenes.draw(strokes, grey=(180, 60), rng=np.random.default_rng(1))
    (line,) = find_image_lines(image, masks, CAMERA)
    assert line.label == "pole"
    assert np.abs(distances(line, (100.0, 40.0), (102.0, 260.0))).max() < 0.15


def test_pole_before_a_background_of_two_shades_is_found_by_both_edges():
    image, masks = scenes.draw([("pole", (200.0, 20.0), (200.0, 280.0), 8.0)], grey=(120, 120))
    pixels = image.pixels.copy()
    pixels[:, :196] = 60
    pixels[:, 204:] = 220
    pixels[:, 196:204] = 140
    (line,) = find_image_lines(CameraImage(pixels), masks, CAMERA)
    assert np.abs(distances(line, (199.5, 20.0), (199.5, 280.0))).max() < 0.2


def test_pole_whose_background_changes_along_it_is_found_in_one():
    image, masks = scenes.draw([("pole", (200.0, 20.0), (203.0, 280.0), 8.0)], grey=(90, 140))
    pixels = image.pixels.astype(int)
    # Sky above, darker than the pole below.
    pixels[:140][pixels[:140] < 100] = 230
    (line,) = find_image_lines(CameraImage(pixels.astype(np.uint8)), masks, CAMERA)
    assert np.abs(distances(line, (200.0, 20.0), (203.0, 280.0))).max() < 0.3
    assert np.linalg.norm(line.end - line.start) > 230


def test_dashes_of_one_line_become_one_line():
    start, end = np.array([100.0, 310.0]), np.array([400.0, 140.0])
    parts = [(0.0, 0.3), (0.5, 0.7), (0.85, 1.0)]
    strokes = [("lane", start + a * (end - start), start + b * (end - start), 6.0) for a, b in parts]
    image, masks = scenes.draw(strokes, rng=np.random.default_rng(2))
    (line,) = find_image_lines(image, masks, CAMERA)
    assert np.abs(distances(line, start, end)).max() < 0.15
    assert np.linalg.norm(line.end - line.start) > 330


def test_a_fine_mask_of_a_long_lens_gives_the_same_line_as_a_coarse_one():
    long_lens = CameraModel("pinhole", np.diag([4.0, 4.0, 1.0]) @ K, np.zeros(0), 1920, 1280)
    strokes = [("pole", (900.0, 150.0), (930.0, 1150.0), 60.0)]
    for scale in (1.0, 0.5, 0.25):
        image, masks = scenes.draw(strokes, size=(1920, 1280), rng=np.random.default_rng(6), scale=scale)
        (line,) = find_image_lines(image, masks, long_lens)
        assert np.abs(distances(line, (900.0, 150.0), (930.0, 1150.0))).max() < 0.3
        assert np.linalg.norm(line.end - line.start) > 900


def test_lines_side_by_side_stay_apart():
    strokes = [("lane", (30.0 + x, 310.0), (180.0 + x, 150.0), 6.0) for x in (0.0, 40.0, 250.0)]
    image, masks = scenes.draw(strokes, rng=np.random.default_rng(3))
    assert len(find_image_lines(image, masks, CAMERA)) == 3


def painted(curve, width, size=(480, 320)):
    """A bright curve (N,2) px and its masks."""
    fine = 4
    canvas = np.zeros((size[1] * fine, size[0] * fine), dtype=np.uint8)
    points = np.rint(((curve + 0.5) * fine - 0.5) * 16).astype(np.int32)
    cv2.polylines(canvas, [points], isClosed=False, color=255, thickness=width * fine, shift=4)
    cover = canvas.reshape(size[1], fine, size[0], fine).mean(axis=(1, 3)) / 255
    pixels = np.repeat((90 + 110 * cover)[..., None], 3, axis=2).astype(np.uint8)
    return CameraImage(pixels), scenes.masks_of(cover > 0.5, np.zeros(cover.shape, dtype=bool))


def test_a_bent_stroke_is_split_into_straight_pieces_that_lie_on_it():
    u = np.linspace(0, 240, 61)
    image, masks = painted(np.column_stack([100 + u, 280 - 0.5 * u - 0.0008 * u**2]), 6)
    lines = find_image_lines(image, masks, CAMERA)
    assert len(lines) >= 2
    for line in lines:
        for end in (line.start, line.end):
            x = end[0] - 100
            assert abs(280 - 0.5 * x - 0.0008 * x**2 - end[1]) < 1.5


def test_a_line_that_the_lens_bends_is_straight_after_undistortion():
    wide = np.array([[300.0, 0.0, 240.0], [0.0, 300.0, 160.0], [0.0, 0.0, 1.0]])
    bent = CameraModel("plumb_bob", wide, np.array([-0.30, 0.08, 0.0005, -0.0002, 0.0]), 480, 320)
    start, end = np.array([40.0, 300.0]), np.array([330.0, 10.0])
    raw = raw_pixels(bent, start + np.linspace(0, 1, 200)[:, None] * (end - start))
    # The oracle itself: what is drawn is bent by pixels.
    assert np.abs(raw[100] - 0.5 * (raw[0] + raw[-1])).max() > 3
    lines = find_image_lines(*painted(raw, 6), bent)
    assert sum(np.linalg.norm(line.end - line.start) for line in lines) > 330
    for line in lines:
        assert np.abs(distances(line, start, end)).max() < 0.4


def test_cropping_the_image_with_its_intrinsics_moves_the_line_along():
    image, masks = scenes.draw([("pole", (300.0, 40.0), (304.0, 280.0), 7.0)], rng=np.random.default_rng(4))
    (whole,) = find_image_lines(image, masks, CAMERA)
    shifted = CAMERA.K.copy()
    shifted[:2, 2] -= [100, 20]
    crop = CameraModel("pinhole", shifted, CAMERA.D, 380, 300)
    cut = Masks(
        masks.lane[10:, 50:],
        masks.pole[10:, 50:],
        masks.lane_probability[10:, 50:],
        masks.pole_probability[10:, 50:],
        0.5,
        0.5,
    )
    (line,) = find_image_lines(CameraImage(image.pixels[20:, 100:].copy()), cut, crop)
    assert np.abs(distances(line, whole.start - [100, 20], whole.end - [100, 20])).max() < 0.05


@pytest.mark.parametrize("case", ["empty", "full", "noise", "blob", "no edges"])
def test_masks_without_strokes_give_no_lines(case):
    rng = np.random.default_rng(5)
    pixels = np.clip(rng.normal(100, 3, (320, 480, 1)), 0, 255).astype(np.uint8).repeat(3, axis=2)
    lane = np.zeros((320, 480), dtype=bool)
    if case == "full":
        lane[:] = True
    elif case == "noise":
        lane = rng.random(lane.shape) < 0.02
    elif case == "blob":
        lane[200:215, 300:315] = True
    elif case == "no edges":
        lane[100:300, 200:206] = True
    masks = scenes.masks_of(lane, np.zeros_like(lane))
    assert find_image_lines(CameraImage(pixels), masks, CAMERA) == []
