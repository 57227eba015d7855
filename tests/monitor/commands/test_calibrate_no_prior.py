"""``calibwatch calibrate`` from nothing, from far off, and with masks of one's own."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline import labels
from tests.monitor.frame_folders import calib, frame, write_frames

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[4] / "shared" / "data"))


@pytest.fixture(scope="module")
def bare(tmp_path_factory):
    """A folder of one frame with intrinsics alone, a mask, and the truth beside it."""
    folder = write_frames(tmp_path_factory.mktemp("bare") / "frame", T_cam_lidar=None)
    cv2.imwrite(str(folder.parent / "mask.png"), frame().labels)
    (folder.parent / "truth.json").write_text(json.dumps(calib()))
    return folder


def options(bare, *further):
    return (
        "calibrate",
        bare,
        "--mask",
        bare.parent / "mask.png",
        "--reference",
        bare.parent / "truth.json",
        "--json",
        *further,
    )


def assert_right(out):
    (result,) = json.loads(out)
    assert result["relative_to"] == "found"
    for axis, found in result["axes"].items():
        most = 1.0 if axis in ("roll", "pitch", "yaw") else 0.2
        assert abs(found["error"]) < max(most, 4.0 * found["sigma"]), axis
    assert {"yaw", "pitch"} <= set(result["observable"])


def test_a_frame_without_extrinsic_is_calibrated(calibwatch, bare):
    code, out, err = calibwatch(*options(bare, "--no-prior"))
    assert code == 0
    assert "standard errors ahead of any other" in err
    assert_right(out)


def test_without_asking_for_it_the_missing_extrinsic_is_an_error(calibwatch, bare):
    code, out, err = calibwatch("calibrate", bare)
    assert (code, out) == (1, "")
    assert "no extrinsic" in err
    assert "--no-prior" in err
    assert len(err.splitlines()) == 1


def test_a_start_far_off_is_found_back_with_a_wide_prior(calibwatch, bare, tmp_path):
    start = tmp_path / "start.json"
    start.write_text(json.dumps(calib()))
    off = ("--rig", start, "--inject", "yaw=5,pitch=-4,left=0.6", "--prior-sigma", "4", "0.6")
    code, out, err = calibwatch(*options(bare, *off))
    assert code == 0
    assert len(err.splitlines()) == 1
    assert_right(out)


def test_a_scene_that_can_not_give_it_says_why(calibwatch, bare):
    values = frame().labels.copy()
    values[values == labels.LANE] = labels.ROAD
    mask = bare.parent / "poles.png"
    cv2.imwrite(str(mask), values)
    code, out, err = calibwatch("calibrate", bare, "--no-prior", "--mask", mask)
    assert (code, out) == (4, "")
    assert err == "pair camera, frame 0: fewer than two lanes in the image\n"
    code, out, _ = calibwatch("calibrate", bare, "--no-prior", "--mask", mask, "--json")
    assert (code, out) == (4, "[]\n")


@pytest.mark.parametrize(
    ("mask", "what"),
    [
        (np.zeros((10, 10), np.uint8), "is 10x10 px, its image 640x203"),
        (np.zeros((203, 640), np.uint8), "shows no lane and no pole"),
        (None, "can not be read"),
    ],
)
def test_a_bad_mask_is_refused_in_one_line(calibwatch, bare, tmp_path, mask, what):
    path = tmp_path / "mask.png"
    if mask is not None:
        cv2.imwrite(str(path), mask)
    code, out, err = calibwatch("calibrate", bare, "--no-prior", "--mask", path)
    assert (code, out) == (1, "")
    assert what in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        (("--no-prior", "--inject", "yaw=1"), "--inject has no meaning"),
        (("--no-prior", "--prior-sigma", "3", "1"), "--prior-sigma has no meaning"),
        (("--prior-sigma", "0", "1"), "is not in the range"),
    ],
)
def test_options_that_contradict_are_wrong_usage(calibwatch, bare, wrong, what):
    code, out, err = calibwatch("calibrate", bare, *wrong)
    assert (code, out) == (2, "")
    assert what in err


def test_a_width_that_is_no_number_is_refused(calibwatch, bare):
    code, out, err = calibwatch(
        "calibrate", bare, "--rig", bare.parent / "truth.json", "--prior-sigma", "nan", "1"
    )
    # Wrong usage, as a word in place of the number would be.
    assert (code, out) == (2, "")
    assert "Invalid value for '--prior-sigma': nan" in err.splitlines()[-1]


@pytest.mark.recordings
@pytest.mark.skipif(not DATA.is_dir(), reason="no recordings folder (CALIBWATCH_DATA)")
@pytest.mark.parametrize("mask", [(), ("--mask", DATA / "opencalib_crlf" / "mask.jpg")])
def test_the_published_frame_is_found_from_nothing(calibwatch, mask):
    folder = DATA / "opencalib_crlf"
    code, out, _ = calibwatch(
        "calibrate", folder, "--no-prior", *mask, "--reference", folder / "calib.json", "--json"
    )
    assert code == 0
    (result,) = json.loads(out)
    errors = [abs(axis["error"]) for axis in result["axes"].values()]
    assert max(errors[:3]) < 0.3
    assert max(errors[3:]) < 0.12
