"""KITTI drives: stamps, sweeps and the composed extrinsic, on folders made here and on real ones."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monitor.messages import decode
from monitor.rig import bind, parse_rig
from monitor.sources.kitti_raw import CAMERA_TOPIC, LIDAR_TOPIC, SOURCE, kitti_document
from pipeline.errors import InputError, RigError

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[4] / "shared" / "data"))
real = [
    pytest.mark.recordings,
    pytest.mark.skipif(not DATA.is_dir(), reason="no recordings folder (CALIBWATCH_DATA)"),
]
FIRST = 1_317_042_507_000_000_000
"""2011-09-26 13:08:27 UTC, ns."""


def stamp(ms):
    return f"2011-09-26 13:08:{27 + ms // 1000}.{ms % 1000:03d}000000"


def drive(folder, frames=3, *, start_end=True, stamps=True, name="2011_09_26_drive_0001_sync"):
    at = folder / name
    for sensor, suffix in (("velodyne_points", "bin"), ("image_02", "png")):
        (at / sensor / "data").mkdir(parents=True)
        for i in range(frames):
            (at / sensor / "data" / f"{i:010d}.{suffix}").write_bytes(bytes([i]))
    if stamps:
        lines(at / "velodyne_points" / "timestamps.txt", [50 + 100 * i for i in range(frames)])
        lines(at / "image_02" / "timestamps.txt", [60 + 100 * i for i in range(frames)])
    if start_end:
        lines(at / "velodyne_points" / "timestamps_start.txt", [100 * i for i in range(frames)])
        lines(at / "velodyne_points" / "timestamps_end.txt", [100 * i + 99 for i in range(frames)])
    return at


def lines(path, milliseconds):
    path.write_text("".join(stamp(ms) + "\n" for ms in milliseconds))


def opened(folder):
    with SOURCE.open(str(folder)) as source:
        return source, list(source)


def test_a_cloud_carries_its_first_point_and_the_duration_of_its_sweep(tmp_path):
    source, messages = opened(drive(tmp_path))
    clouds = [m for m in messages if m.topic == LIDAR_TOPIC]
    images = [m for m in messages if m.topic == CAMERA_TOPIC]
    assert [m.stamp_ns - FIRST for m in clouds] == [0, 100_000_000, 200_000_000]
    assert [m.sweep_s for m in clouds] == pytest.approx([0.099] * 3)
    assert [m.stamp_ns - FIRST for m in images] == [60_000_000, 160_000_000, 260_000_000]
    assert [m.type for m in (clouds[0], images[0])] == ["file/bin", "file/png"]
    assert [m.log_ns for m in messages] == sorted(m.log_ns for m in messages)
    assert [m.data for m in clouds] == [b"\0", b"\1", b"\2"]
    assert [(t.name, t.count) for t in source.describe()] == [(CAMERA_TOPIC, 3), (LIDAR_TOPIC, 3)]


def test_without_start_and_end_the_stamp_is_the_moment_ahead_and_the_sweep_unknown(tmp_path):
    _, messages = opened(drive(tmp_path, start_end=False))
    clouds = [m for m in messages if m.topic == LIDAR_TOPIC]
    assert [m.stamp_ns - FIRST for m in clouds] == [50_000_000, 150_000_000, 250_000_000]
    assert {m.sweep_s for m in clouds} == {None}


def test_without_stamps_the_nominal_rate_stands_in_and_is_told(tmp_path):
    source, messages = opened(drive(tmp_path, start_end=False, stamps=False))
    assert [m.stamp_ns for m in messages if m.topic == CAMERA_TOPIC] == [0, 100_000_000, 200_000_000]
    assert any("nominal 10 Hz" in note for note in source.losses.notes)


def test_a_missing_frame_takes_its_stamp_with_it(tmp_path):
    at = drive(tmp_path)
    (at / "velodyne_points" / "data" / "0000000001.bin").unlink()
    _, messages = opened(at)
    assert [m.stamp_ns - FIRST for m in messages if m.topic == LIDAR_TOPIC] == [0, 200_000_000]


def test_a_slice_with_its_original_numbers_has_a_stamp_per_file(tmp_path):
    at = drive(tmp_path)
    for path in sorted(at.glob("*/data/*"), reverse=True):
        path.rename(path.with_stem(f"{int(path.stem) + 26:010d}"))
    _, messages = opened(at)
    assert [m.stamp_ns - FIRST for m in messages if m.topic == LIDAR_TOPIC] == [0, 100_000_000, 200_000_000]


def test_the_folder_above_is_enough_when_it_contains_one_drive(tmp_path):
    drive(tmp_path / "2011_09_26")
    assert SOURCE.matches(str(tmp_path))
    assert len(opened(tmp_path)[1]) == 6


def test_two_drives_are_listed(tmp_path):
    drive(tmp_path, name="a_sync")
    drive(tmp_path, name="b_sync")
    with pytest.raises(InputError, match=r"contains 2 KITTI drives: a_sync, b_sync.*name one"):
        SOURCE.open(str(tmp_path))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("image_02/timestamps.txt", "yesterday\n" * 3, r"timestamps.txt:1: 'yesterday' is no time stamp"),
        ("image_02/timestamps.txt", "2011-13-26 13:08:27.1\n" * 3, "is no time stamp"),
        ("image_02/timestamps.txt", stamp(0), "is frame 1, but its folder has stamps for 1 frames"),
    ],
)
def test_stamps_that_are_no_stamps(tmp_path, name, content, words):
    at = drive(tmp_path)
    (at / name).write_text(content)
    with pytest.raises(InputError, match=words):
        SOURCE.open(str(at))


def test_a_file_that_can_not_be_read_is_counted(tmp_path):
    at = drive(tmp_path)
    source = SOURCE.open(str(at))
    (at / "velodyne_points" / "data" / "0000000001.bin").unlink()
    assert len(list(source)) == 5
    assert source.losses.counts == {"unreadable": 1}
    assert "0000000001.bin can not be read" in source.losses.notes[-1]


def test_a_folder_that_is_no_drive(tmp_path):
    assert not SOURCE.matches(str(tmp_path))
    assert not SOURCE.matches(str(tmp_path / "absent"))


def test_the_extrinsic_projects_like_kittis_own_matrices():
    rng = np.random.default_rng(2)
    P = np.array([[700, 0, 600, 45], [0, 710, 170, 0.2], [0, 0, 1, 0.003]])
    R_rect, R = Rotation.random(2, random_state=rng).as_matrix()
    t = rng.normal(size=3)
    document = kitti_document(
        {"P_rect_02": P.ravel(), "R_rect_00": R_rect.ravel(), "S_rect_02": np.array([1242.0, 375.0])},
        {"R": R.ravel(), "T": t},
        where="x",
    )
    pair = parse_rig(document, where="x").pairs[0]
    points = rng.normal(size=(50, 3))
    # The devkit's own chain: P_rect R_rect (R p + T), homogeneous.
    expected = P @ np.vstack([R_rect @ (R @ points.T + t[:, None]), np.ones(50)])
    found = pair.camera.model.K @ (pair.T_cam_lidar[:3, :3] @ points.T + pair.T_cam_lidar[:3, 3:])
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert (pair.camera.model.width, pair.camera.model.height) == (1242, 375)


def test_calib_files_without_a_row(tmp_path):
    at = drive(tmp_path)
    (tmp_path / "calib_cam_to_cam.txt").write_text("calib_time: today\nP_rect_02: 1 2 3\n")
    (tmp_path / "calib_velo_to_cam.txt").write_text("R: 1\n")
    with pytest.raises(InputError, match="no P_rect_02 of 12 numbers"):
        SOURCE.open(str(at))


def test_calib_json_in_the_folder_is_the_rig(tmp_path):
    at = drive(tmp_path)
    (at / "calib.json").write_text("{}")
    with pytest.raises(RigError, match=r"calib\.json has no 'camera' and 'T_cam_lidar'"):
        SOURCE.open(str(at))


def test_no_calibration_is_told(tmp_path):
    source, _ = opened(drive(tmp_path))
    assert source.rig_document() is None
    assert "a rig file is needed" in source.losses.notes[-1]


@pytest.mark.parametrize(
    "folder",
    [pytest.param(name, marks=real) for name in ("kitti_raw_0009_a", "kitti_raw_0005_a", "kitti_odom_03_a")],
)
def test_the_files_of_a_real_drive_give_the_published_extrinsic(folder):
    with SOURCE.open(str(DATA / folder / "2011_09_26")) as source:
        rig = bind(parse_rig(source.rig_document(), where=folder), source.describe(), where=folder)
        first = next(iter(source))
    assert rig.pairs[0].lidar.spin == "cw"
    calib = json.loads((DATA / folder / "calib.json").read_text())
    np.testing.assert_allclose(rig.pairs[0].T_cam_lidar, calib["T_cam_lidar"], atol=1e-6)
    np.testing.assert_allclose(rig.pairs[0].camera.model.K, calib["camera"]["K"])
    (decoded,) = decode(first)
    assert len(decoded.value) > 100_000
    assert decoded.stamp_ns == first.stamp_ns
