"""Frames with known extrinsics: which ones are taken, what they are called, what is refused."""

import json

import numpy as np
import pytest

from monitor.evaluated_frames import SIMULATED, chained, recorded_frames, simulated_frames
from pipeline import se3
from pipeline.cameras import project
from pipeline.errors import CalibwatchError
from pipeline.se3 import mount_drift
from tests.drives import PARAMETERS
from tests.monitor.frame_folders import calib, frame, write_frames

SIGMA = np.array([0.003] * 3 + [0.05] * 3)


def listed(*places, most=3, tell=lambda _: None):
    found = recorded_frames(places, most, SIGMA, tell)
    taken = list(found)
    assert len(taken) == len(found)
    return taken


def test_a_frame_is_what_its_folder_holds(tmp_path):
    (found,) = listed(write_frames(tmp_path / "a"))
    assert (found.name, found.group) == ("a", "a")
    assert np.array_equal(found.pair.cloud.xyz, frame().cloud.xyz)
    assert np.array_equal(found.pair.image.pixels, frame().image.pixels)
    assert np.allclose(found.mount.T_cam_lidar, PARAMETERS.T_stored, atol=1e-9)
    assert np.array_equal(found.reference_sigma, SIGMA)


def test_a_folder_of_frames_is_one_set_and_a_folder_of_sets_is_several(tmp_path):
    for name in ("x/1", "x/2", "y"):
        write_frames(tmp_path / "top" / name)
    names = {(one.group, one.name) for one in listed(tmp_path / "top")}
    assert names == {("x", "1"), ("x", "2"), ("y", "y")}
    assert {one.group for one in listed(tmp_path / "top" / "x")} == {"x"}
    assert [one.group for one in listed(tmp_path / "top" / "x" / "2", tmp_path / "top" / "y")] == [
        "2",
        "y",
    ]


@pytest.mark.parametrize(
    ("most", "numbers"), [(1, [2]), (2, [0, 3]), (3, [0, 2, 3]), (4, [0, 1, 2, 3]), (9, [0, 1, 2, 3])]
)
def test_frames_of_a_drive_are_spread_over_it(tmp_path, most, numbers):
    taken = listed(write_frames(tmp_path / "drive", 4), most=most)
    assert [found.name for found in taken] == [f"drive #{number}" for number in numbers]
    for found, number in zip(taken, numbers, strict=True):
        assert np.array_equal(found.pair.cloud.xyz, frame(number).cloud.xyz)


def test_each_camera_of_a_folder_is_a_frame(tmp_path):
    folder = write_frames(tmp_path / "rig")
    document = calib(frames=[{"image": "image.png", "cloud": "cloud.npz"}])
    for name in ("LEFT", "RIGHT"):
        (folder / f"calib_{name}.json").write_text(json.dumps(document))
    (folder / "calib.json").write_text(json.dumps(document))
    assert [one.name for one in listed(folder)] == ["rig LEFT", "rig RIGHT"]


def test_a_recording_among_folders_is_found(tmp_path, cut):
    write_frames(tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "c.mcap").write_bytes(cut(5).read_bytes())
    (tmp_path / "notes.txt").write_text("no recording")
    assert [one.name for one in listed(tmp_path, most=1)] == ["a", "b #2"]


def test_a_start_is_off_by_what_was_asked(tmp_path):
    (found,) = listed(write_frames(tmp_path / "a"))
    drift = np.array([0.02, -0.03, 0.04, 0.3, -0.2, 0.1])
    off = found.off_by(drift)
    moved = mount_drift(off.T_cam_lidar, found.mount.T_cam_lidar, off.R_vehicle_cam)
    assert np.allclose(moved, drift, atol=1e-12)


def test_simulated_frames_are_the_same_each_time():
    (one,), (again,) = list(simulated_frames(1, 7)), list(simulated_frames(1, 7))
    assert (one.group, one.name) == (SIMULATED, again.name)
    assert np.array_equal(one.pair.cloud.xyz, again.pair.cloud.xyz)
    assert np.array_equal(one.pair.image.pixels, again.pair.image.pixels)
    assert not one.reference_sigma.any()
    # Thousands of points are seen: the camera looks where the truth says.
    assert project(one.camera, se3.apply(one.mount.T_cam_lidar, one.pair.cloud.xyz))[1].sum() > 1000


def test_parts_follow_each_other(tmp_path):
    a, b = (recorded_frames([write_frames(tmp_path / name)], 3, SIGMA) for name in "ab")
    both = chained([b, a])
    assert [one.name for one in both] == ["b", "a"]
    assert len(both) == 2


def test_a_set_may_be_known_better_or_worse_than_the_others(tmp_path):
    for name in "ab":
        write_frames(tmp_path / name)
    places = [tmp_path / name for name in "ab"]
    found = recorded_frames(places, 3, SIGMA, of_sets={"b": 7 * SIGMA})
    assert [one.reference_sigma.tolist() for one in found] == [SIGMA.tolist(), (7 * SIGMA).tolist()]
    with pytest.raises(CalibwatchError, match=r"no set 'c' \(there are: a, b\)"):
        recorded_frames(places, 3, SIGMA, of_sets={"c": SIGMA})


def refusal(*places):
    with pytest.raises(CalibwatchError) as refused:
        recorded_frames(places, 3, SIGMA)
    text = str(refused.value)
    assert "\n" not in text
    assert refused.value.hint or "does not exist" in text
    return text


def test_a_folder_without_frames_is_refused(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    assert f"{tmp_path} holds no frames" in refusal(tmp_path)
    assert "gone does not exist" in refusal(tmp_path / "gone")
    (tmp_path / "a" / "notes.txt").write_text("no recording")
    assert "holds no frames" in refusal(tmp_path / "a" / "notes.txt")


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"T_cam_lidar": None}, "T_cam_lidar"),
        ({"camera": None}, "camera"),
        ({"camera": calib()["camera"] | {"width": 320}}, "640x203 px, the intrinsics are for 320x203"),
        ({"T_cam_lidar": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()}, "T_cam_lidar"),
    ],
)
def test_a_folder_that_does_not_fit_is_refused_before_any_frame_is_given(tmp_path, changed, says):
    write_frames(tmp_path / "good")
    bad = write_frames(tmp_path / "wrong", **changed)
    text = refusal(tmp_path)
    assert str(bad) in text
    assert says in text


def test_an_image_that_can_not_be_read_is_named(tmp_path):
    folder = write_frames(tmp_path / "a")
    (folder / "image.png").write_bytes((folder / "image.png").read_bytes()[:400])
    assert str(folder) in refusal(folder)
    drive = write_frames(tmp_path / "drive", 2)
    (drive / "cloud_1.npz").write_bytes(b"no archive")
    told = []
    assert [one.name for one in listed(drive, tell=told.append)] == ["drive"]
    assert len(told) == 1
    assert str(drive) in told[0]
