"""Mask files in place of the network: labels by value, or bright lines told apart by where they lie."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from monitor.line_masks import read_masks
from monitor.rig import load_rig
from pipeline import labels
from pipeline.errors import InputError
from pipeline.masks import horizon_line
from pipeline.records import CameraModel

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[3] / "shared" / "data"))
CAMERA = CameraModel("pinhole", np.array([[200.0, 0, 160], [0, 200.0, 90], [0, 0, 1]]), np.zeros(0), 320, 180)


def written(path, values):
    cv2.imwrite(str(path), values)
    return path


def drawing():
    """Two lanes, and a pole that rises above the horizon at row 90."""
    values = np.zeros((180, 320), np.uint8)
    cv2.line(values, (150, 100), (60, 179), labels.LANE, 5)
    cv2.line(values, (160, 100), (162, 179), labels.LANE, 5)
    cv2.line(values, (250, 20), (252, 130), labels.POLE, 5)
    return values


def test_label_images_are_read_by_value(tmp_path):
    values = drawing()
    values[0, :10], values[1, :10] = labels.IGNORE, labels.SKY
    masks = read_masks(written(tmp_path / "mask.png", values), CAMERA, None)
    np.testing.assert_array_equal(masks.lane, values == labels.LANE)
    np.testing.assert_array_equal(masks.pole, values == labels.POLE)
    assert (masks.scale_x, masks.scale_y) == (1.0, 1.0)


@pytest.mark.parametrize("name", ["mask.png", "mask.jpg"])
def test_bright_lines_are_lanes_below_the_horizon_and_poles_where_they_rise_above_it(tmp_path, name):
    values = drawing()
    cv2.line(values, (20, 30), (60, 30), labels.POLE, 5)
    bright = np.where(values > 0, 255, 0).astype(np.uint8)
    masks = read_masks(written(tmp_path / name, bright), CAMERA, None)
    # A lane straight ahead is upright too, and the arm of a lamp is not.
    assert (masks.lane != (values == labels.LANE)).mean() < 0.005
    assert (masks.pole != (values == labels.POLE)).mean() < 0.005


def test_the_horizon_of_a_prior_moves_the_border(tmp_path):
    bright = np.where(drawing() > 0, 255, 0).astype(np.uint8)
    # The camera looks down by 27 deg: its horizon is above the pole's top.
    low = horizon_line(CAMERA, np.array([0.0, -np.cos(np.radians(27)), -np.sin(np.radians(27))]))
    masks = read_masks(written(tmp_path / "mask.png", bright), CAMERA, low)
    assert not masks.pole.any()
    assert masks.lane[:, 250].any()


def test_a_scaled_mask_keeps_its_place(tmp_path):
    large = cv2.resize(drawing(), (640, 360), interpolation=cv2.INTER_NEAREST)
    masks = read_masks(written(tmp_path / "mask.png", large), CAMERA, None)
    assert (masks.scale_x, masks.scale_y) == (2.0, 2.0)
    assert masks.lane.shape == (360, 640)


def test_what_is_no_mask_is_refused_in_one_line(tmp_path):
    def refused(values):
        with pytest.raises(InputError) as refusal:
            read_masks(written(tmp_path / "mask.png", values), CAMERA, None)
        assert "mask.png" in refusal.value.what
        assert "\n" not in str(refusal.value)
        return refusal.value.what

    assert "320x100 px, its image 320x180" in refused(np.zeros((100, 320), np.uint8))
    assert "no lane and no pole" in refused(np.zeros((180, 320), np.uint8))
    assert "no lane and no pole" in refused(np.full((180, 320), labels.ROAD, np.uint8))
    broken = tmp_path / "mask.png"
    broken.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(40))
    with pytest.raises(InputError, match=r"mask\.png"):
        read_masks(broken, CAMERA, None)
    with pytest.raises(InputError, match="can not be read"):
        read_masks(tmp_path / "missing.png", CAMERA, None)


@pytest.mark.recordings
@pytest.mark.skipif(not DATA.is_dir(), reason="no recordings folder (CALIBWATCH_DATA)")
def test_the_published_line_mask_has_lanes_and_poles_where_they_are():
    camera = load_rig(DATA / "opencalib_crlf" / "calib.json").pairs[0].camera.model
    masks = read_masks(DATA / "opencalib_crlf" / "mask.jpg", camera, None)
    # The lamp post at the left border, the pole in the middle, a lane line and a bar of the crossing.
    assert masks.pole[300, :200].any()
    assert masks.pole[300, 690:770].any()
    assert masks.lane[980, 1000:1900].any()
    assert masks.lane[825, 950:1050].any()
    assert not (masks.lane & masks.pole).any()
    rows = np.nonzero(masks.lane)[0]
    assert rows.min() > camera.K[1, 2] - 30
