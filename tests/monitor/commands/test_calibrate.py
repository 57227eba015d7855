"""``calibwatch calibrate``: known errors are found back, and what can not be used is refused."""

import json

import numpy as np
import pytest

from monitor.injection import parse_inject
from monitor.preparation import prepare
from pipeline.se3 import mount_drift, vehicle_axes
from tests import drives
from tests.drives import IMAGE_TOPIC, INFO_TOPIC


@pytest.fixture
def reference(cut, tmp_path):
    """A rig file with the true extrinsic under the name that the recording gives its pair."""
    pair = prepare(str(cut(5)), None, None).rig.pairs[0]
    path = tmp_path / "truth.toml"
    path.write_text(
        drives.RIG.replace('"front"', f'"{pair.name}"')
        + f"[pairs.extrinsic]\nT_cam_lidar = {pair.T_cam_lidar.tolist()}\n"
    )
    return path


def test_a_known_error_is_found_back_and_held_against_the_reference(calibwatch, cut, reference):
    options = ("--inject", "yaw=1,pitch=-0.5", "--reference", reference, "--json")
    code, out, err = calibwatch("calibrate", cut(20), *options)
    assert (code, err) == (0, "")
    (result,) = json.loads(out)
    assert (result["pair"], result["frames"]) == ("camera", 20)
    yaw, pitch = result["axes"]["yaw"], result["axes"]["pitch"]
    assert yaw["value"] == pytest.approx(1.0, abs=3 * yaw["sigma"])
    assert pitch["value"] == pytest.approx(-0.5, abs=3 * pitch["sigma"])
    # Error against the truth is what remains of the injected drift, axis by axis, up to second order.
    assert yaw["error"] == pytest.approx(yaw["value"] - 1.0, abs=0.02)
    assert pitch["error"] == pytest.approx(pitch["value"] + 0.5, abs=0.02)
    assert {name for name, axis in result["axes"].items() if axis["observable"]} == set(result["observable"])
    stored = prepare(str(cut(5)), None, parse_inject("yaw=1,pitch=-0.5")).rig.pairs[0]
    R_vehicle_cam = vehicle_axes(stored.T_cam_lidar, stored.T_vehicle_lidar)
    moved = mount_drift(stored.T_cam_lidar, np.array(result["T_cam_lidar"]), R_vehicle_cam)
    assert np.degrees(moved[2]) == pytest.approx(yaw["value"], abs=1e-6)


def test_the_text_says_per_axis_what_is_known(calibwatch, cut):
    code, out, err = calibwatch("calibrate", cut(5))
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].startswith("camera: 5 frames: ")
    assert [line.split()[0] for line in lines[1:7]] == ["roll", "pitch", "yaw", "forward", "left", "up"]
    assert all("sigma" in line for line in lines[1:7])


def test_what_is_lost_is_told_and_the_rest_is_used(calibwatch, messages, tmp_path):
    bad = drives.changed(
        drives.first_frames(messages, 5),
        IMAGE_TOPIC,
        lambda m: m if m.sequence != 1 else drives.with_data(m.data[:300])(m),
    )
    code, out, err = calibwatch("calibrate", drives.write(tmp_path / "bad.mcap", bad))
    assert code in (0, 4)
    assert out.startswith("camera: 4 frames: ")
    undecodable, dropped = err.splitlines()
    assert undecodable.startswith(f"warning: topic {IMAGE_TOPIC}: ")
    assert "2 of 10 frames dropped" in dropped


def test_images_of_another_size_are_refused(calibwatch, cut, tmp_path):
    rig = tmp_path / "rig.toml"
    intrinsics = "width = 1280, height = 406, K = [[854,0,639],[0,854,193],[0,0,1]]"
    rig.write_text(drives.RIG.replace(f'info = "{INFO_TOPIC}"', intrinsics))
    code, out, err = calibwatch("calibrate", cut(5), "--rig", rig)
    assert (code, out) == (1, "")
    assert err == (
        "calibwatch: pair front: images are 640x203 px, the rig says 1280x406 "
        "(give the intrinsics for this size)\n"
    )


def test_clocks_that_are_an_hour_apart_are_refused(calibwatch, messages, tmp_path):
    late = drives.changed(
        drives.first_frames(messages, 3),
        IMAGE_TOPIC,
        lambda m: drives.stamped(m, drives.stamp_of(m) + 3600 * 10**9),
    )
    code, _, err = calibwatch("calibrate", drives.write(tmp_path / "late.mcap", late))
    assert code == 1
    assert "camera stamps are +3600.0" in err
    assert len(err.splitlines()) == 1


def test_a_reference_that_says_nothing_of_the_pair_is_refused(calibwatch, cut, tmp_path):
    reference = tmp_path / "reference.toml"
    reference.write_text(drives.RIG)
    code, _, err = calibwatch("calibrate", cut(5), "--reference", reference)
    assert code == 1
    assert "has no T_cam_lidar for pair camera" in err
