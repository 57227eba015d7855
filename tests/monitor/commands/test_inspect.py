"""``calibwatch inspect`` on recordings whose content is known, and on the recordings of others."""

import dataclasses
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from mcap.writer import CompressionType, Writer

from monitor.cli import calibwatch, main
from monitor.commands.inspect import _lines
from monitor.inspection import inspect
from monitor.messages import Transform
from monitor.messages.camera_info import TYPE as INFO
from monitor.messages.camera_info import encode_camera_info
from monitor.messages.image import COMPRESSED as IMAGE
from monitor.messages.image import encode_compressed_image
from monitor.messages.point_cloud2 import TYPE as CLOUD
from monitor.messages.point_cloud2 import encode_point_cloud2
from monitor.messages.tf import TYPE as TF
from monitor.messages.tf import encode_tf
from pipeline.errors import CalibwatchError
from pipeline.records import CameraImage, CameraModel, PointCloud
from pipeline.se3 import inverse, transform
from tests import drives

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[4] / "shared/data"))
recordings = pytest.mark.skipif(not DATA.is_dir(), reason="no recordings folder (CALIBWATCH_DATA)")

START, PERIOD = 1_700_000_000_000_000_000, 100_000_000
RINGS, COLUMNS, SWEEP_S, FRAMES = 8, 200, 0.1, 12
R_CAM_LIDAR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
T_CAM_LIDAR = transform(R_CAM_LIDAR, np.array([0.1, 0.2, -0.3]))
CAMERA = CameraModel("pinhole", np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]), np.empty(0), 160, 120)


def sweep(*, ring=True, time=True):
    """A cylinder seen by eight rings."""
    azimuth = np.tile(np.linspace(-np.pi, np.pi, COLUMNS, endpoint=False), RINGS)
    elevation = np.repeat(np.radians(np.linspace(-20, 5, RINGS)), COLUMNS)
    xyz = 10 * np.column_stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    return PointCloud(
        xyz.astype(np.float32),
        ring=np.repeat(np.arange(RINGS), COLUMNS).astype(np.uint16) if ring else None,
        time=np.tile(np.linspace(0, SWEEP_S, COLUMNS), RINGS).astype(np.float32) if time else None,
    )


def recorded(
    path,
    *,
    T=T_CAM_LIDAR,
    camera_clock_ns=0,
    delay_ns=60_000_000,
    cloud=None,
    camera=CAMERA,
    tf=True,
    info=True,
):
    """A recording: sweeps every 100 ms, each image exposed ``delay_ns`` after the sweep's start."""
    image = CameraImage(np.zeros((120, 160, 3), np.uint8))
    cloud = sweep() if cloud is None else cloud
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=4000, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        channels = {
            topic: writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b""))
            for topic, kind in (
                ("/lidar", CLOUD),
                ("/cam/image/compressed", IMAGE),
                ("/cam/camera_info", INFO),
                ("/tf_static", TF),
                ("/imu", "sensor_msgs/msg/Imu"),
            )
        }

        def add(topic, log_ns, data):
            writer.add_message(channels[topic], log_time=log_ns, data=data, publish_time=log_ns)

        if tf:
            link = Transform("base_link", "cam", inverse(T), static=True)
            add("/tf_static", START, encode_tf([link], START))
            link = Transform("base_link", "lidar", np.eye(4), static=True)
            add("/tf_static", START, encode_tf([link], START))
        for i in range(FRAMES):
            begun = START + i * PERIOD
            exposed = begun + delay_ns
            add("/lidar", begun + 110_000_000, encode_point_cloud2(cloud, begun, "lidar"))
            stamp = exposed + camera_clock_ns
            if info:
                add("/cam/camera_info", exposed + 10_000_000, encode_camera_info(camera, stamp, "cam"))
            add(
                "/cam/image/compressed",
                exposed + 10_000_000,
                encode_compressed_image(image, stamp, "cam", "png"),
            )
            add("/imu", begun, b"\0\1\0\0")
        writer.finish()
    return str(path)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "drive.mcap"


def topic(found, name):
    return next(topic for topic in found.topics if topic.name == name)


def test_what_a_recording_holds_is_told(path):
    found = inspect(recorded(path), None)
    lidar, camera = topic(found, "/lidar"), topic(found, "/cam/image/compressed")
    assert (lidar.count, camera.count, lidar.backwards) == (FRAMES, FRAMES, 0)
    assert lidar.rate_hz == pytest.approx(10.0)
    assert (lidar.stamps.first_ns, lidar.stamps.last_ns) == (START, START + (FRAMES - 1) * PERIOD)
    assert lidar.delay_ms == pytest.approx(110.0)
    assert camera.delay_ms == pytest.approx(10.0)
    cloud = lidar.cloud
    assert (cloud.frame, cloud.points, cloud.rings) == ("lidar", (1600, 1600, 1600), RINGS)
    assert (cloud.intensity, cloud.ring, cloud.time) == (False, True, True)
    assert cloud.sweep_s == pytest.approx(SWEEP_S, rel=1e-5)
    assert cloud.middle_ms == pytest.approx(50.0, rel=1e-5)
    assert camera.image.size == (160, 120)
    assert camera.image.reading.startswith("K without distortion")
    assert not topic(found, "/imu").understood
    assert topic(found, "/imu").stamps is None
    assert {(link.parent, link.child) for link in found.transforms} == {
        ("base_link", "cam"),
        ("base_link", "lidar"),
    }
    assert found.losses == {}


def test_how_a_pair_comes_about_is_told(path):
    found = inspect(recorded(path), None)
    (pair,) = found.pairs
    assert found.missing == ()
    np.testing.assert_allclose(pair.T_cam_lidar, T_CAM_LIDAR, atol=1e-12)
    np.testing.assert_allclose(pair.camera_at_m, [0.3, 0.1, 0.2], atol=1e-12)
    np.testing.assert_allclose(pair.looks_along, [1, 0, 0], atol=1e-12)
    assert "tf base_link -> cam, base_link -> lidar" in pair.how
    assert pair.vehicle_frame
    assert (pair.pairs, pair.sweeps, pair.images) == (FRAMES, FRAMES, FRAMES)
    assert pair.gap_ms == pytest.approx(10.0, abs=1e-3)
    # Sweeps are logged 10 ms after they end, images 10 ms after they are exposed.
    assert pair.clock_offset_ms == pytest.approx(0.0, abs=1e-3)
    assert pair.problems == ()
    view = sweep().xyz.astype(float) @ T_CAM_LIDAR[:3, :3].T + T_CAM_LIDAR[:3, 3]
    u, v = (100 * view[:, i] / view[:, 2] + c for i, c in ((0, 80), (1, 60)))
    seen = (view[:, 2] > 0) & (u >= -0.5) & (u < 159.5) & (v >= -0.5) & (v < 119.5)
    assert pair.in_view == (int(seen.sum()), 1600)


def test_rings_are_found_where_no_field_tells_them(path):
    found = inspect(recorded(path, cloud=sweep(ring=False, time=False)), None)
    cloud = topic(found, "/lidar").cloud
    assert (cloud.ring, cloud.rings, cloud.sweep_s, cloud.middle_ms) == (False, RINGS, None, None)
    # Compared by its stamp, the image is 40 ms before the next sweep, nearer than 60 ms after its own.
    assert found.pairs[0].gap_ms == pytest.approx(-40.0)


def test_a_cloud_without_rings_is_told_and_no_problem(path):
    rng = np.random.default_rng(3)
    cloud = PointCloud(rng.normal(size=(3000, 3)).astype(np.float32) * 10)
    found = inspect(recorded(path, cloud=cloud), None)
    assert topic(found, "/lidar").cloud.rings is None
    assert not any("ring" in problem for problem in found.pairs[0].problems)
    assert any("no rings found" in line for line in _lines(found))


def test_clocks_apart_are_told_with_their_distance(path):
    found = inspect(recorded(path, camera_clock_ns=3_000_000_000), None)
    (pair,) = found.pairs
    assert pair.pairs == 0
    assert pair.gap_ms is None
    assert pair.clock_offset_ms == pytest.approx(3000.0, abs=1e-3)
    assert any("no sweep and image belong together" in problem for problem in pair.problems)


def test_an_inverted_extrinsic_shows_nothing_in_the_image(path):
    behind = transform(np.diag([-1.0, 1, -1]) @ R_CAM_LIDAR, np.zeros(3))
    cloud = sweep()
    ahead = PointCloud(cloud.xyz[cloud.xyz[:, 0] > 5], ring=cloud.ring[cloud.xyz[:, 0] > 5])
    found = inspect(recorded(path, T=behind, cloud=ahead), None)
    assert found.pairs[0].in_view[0] == 0
    assert any("inverted" in problem for problem in found.pairs[0].problems)


@pytest.mark.parametrize(
    ("missing", "told"), [({"tf": False}, "no transforms"), ({"info": False}, "no CameraInfo")]
)
def test_what_is_missing_is_told_in_words(path, missing, told):
    found = inspect(recorded(path, **missing), None)
    assert found.pairs == ()
    assert any(told in sentence for sentence in found.missing)
    result = CliRunner().invoke(calibwatch, ["inspect", str(path)])
    assert result.exit_code == 0
    assert "no pair can be watched" in result.output
    assert told in result.output


def test_intrinsics_of_another_size_are_told(path):
    other = CameraModel("pinhole", CAMERA.K, np.empty(0), 320, 240)
    found = inspect(recorded(path, camera=other), None)
    assert any("320x240 px" in sentence and "160x120" in sentence for sentence in found.missing)


def test_a_rig_file_is_obeyed_and_completed(path, tmp_path):
    recording, rig = recorded(path), tmp_path / "rig.toml"
    rig.write_text(
        '[[pairs]]\nname = "front"\nmax_gap_ms = 5\n[pairs.lidar]\nstamp = "middle"\n'
        '[pairs.camera]\nrectified = true\ninfo = "/cam/camera_info"\n'
    )
    (pair,) = inspect(recording, rig).pairs
    assert pair.name == "front"
    assert "extrinsic from tf" in pair.how
    assert pair.pairs == 0
    assert topic(inspect(recording, rig), "/cam/image/compressed").image.reading.startswith("P:")


@pytest.mark.parametrize(("spin", "times", "warned"), [("ccw", 0, 1), ("cw", 0, 0), ("ccw", 1, 0)])
def test_a_wrong_sense_of_rotation_is_told(messages, tmp_path, spin, times, warned):
    def without_times(message):
        assert b"time\0" in message.data
        return dataclasses.replace(message, data=message.data.replace(b"time\0", b"tame\0"))

    stream = drives.first_frames(messages, 5)
    if not times:
        stream = drives.changed(stream, drives.CLOUD_TOPIC, without_times)
    recording, rig = str(drives.write(tmp_path / "turning.mcap", stream)), tmp_path / "rig.toml"
    rig.write_text(f'[[pairs]]\nname = "front"\n[pairs.lidar]\nspin = "{spin}"\n')
    found = inspect(recording, rig)
    assert len(found.pairs[0].warnings) == warned
    told = [line for line in _lines(found) if "warning:" in line]
    assert len(told) == warned
    assert all("set lidar.spin to 'cw'" in line for line in told)


def test_a_cut_recording_tells_how_much_was_read(path):
    recorded(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    result = CliRunner().invoke(calibwatch, ["inspect", str(path)])
    assert result.exit_code == 0
    assert "messages read; the rest is missing or damaged after byte" in result.output
    found = inspect(str(path), None)
    assert 0 < sum(topic.count for topic in found.topics) < 4 * FRAMES
    assert found.losses == {"rest_of_file": 1}


def test_json_is_what_people_read(path):
    recorded(path)
    result = CliRunner().invoke(calibwatch, ["inspect", str(path), "--json"])
    document = json.loads(result.output)
    assert document["schema"] == "calibwatch.inspection/1"
    assert document["pairs"][0]["pairs"] == FRAMES


def test_a_folder_without_stamps_claims_none(tmp_path):
    calib = {
        "camera": {"K": CAMERA.K.tolist(), "D": [], "width": 160, "height": 120},
        "T_cam_lidar": T_CAM_LIDAR.tolist(),
    }
    (tmp_path / "calib.json").write_text(json.dumps(calib))
    cv2.imwrite(str(tmp_path / "image.png"), np.zeros((120, 160, 3), np.uint8))
    np.column_stack([sweep().xyz, np.zeros(1600, np.float32)]).tofile(tmp_path / "cloud.bin")
    found = inspect(str(tmp_path), None)
    (pair,) = found.pairs
    assert topic(found, "cloud").nominal
    assert pair.same_stamps
    assert pair.gap_ms is None
    assert pair.clock_offset_ms is None
    output = CliRunner().invoke(calibwatch, ["inspect", str(tmp_path)]).output
    assert "no stamps" in output
    assert "no gap can be told" in output


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.mcap", b"", "is empty"),
        ("a.mcap", b"nothing of the kind", "no MCAP"),
        ("a.bag", b"nothing", "no ROS 1 bag"),
        ("a.txt", b"nothing", "not a recording"),
        ("tcp/127.0.0.1:1", None, "live"),
    ],
)
def test_what_can_not_be_read_costs_one_line_and_exit_1(tmp_path, monkeypatch, capsys, name, content, told):
    monkeypatch.chdir(tmp_path)
    if content is not None:
        Path(name).write_bytes(content)
    with pytest.raises(SystemExit) as ended:
        main(["inspect", name])
    assert ended.value.code == 1
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1


@recordings
@pytest.mark.recordings
@pytest.mark.parametrize(
    ("folder", "pairs", "rings", "gap_ms", "points"),
    [
        ("kitti_raw_0005_a", 9, 64, 10.5, 123_000),
        ("kitti_odom_03_a", 10, 64, None, 125_000),
        ("kitti_singles/000006", 1, 64, None, 110_089),
        ("nuscenes_mmdet3d", 1, 32, -35.491, 34_688),
        ("opencalib_st2", 1, 64, None, 98_805),
        ("opencalib_manual", 1, 64, None, 78_238),
        ("rellis_os1", 1, 64, -70.9, 77_708),
        ("kitti_raw_0009_mcap/kitti_0009.mcap", 12, 64, 10.5, 119_000),
    ],
)
def test_recordings_are_as_they_were_published(folder, pairs, rings, gap_ms, points):
    found = inspect(str(DATA / folder), None)
    pair = next(p for p in found.pairs if p.name in ("CAM_FRONT", "camera", "camera_color_left"))
    cloud = topic(found, pair.lidar).cloud
    assert (pair.pairs, cloud.rings) == (pairs, rings)
    assert pair.gap_ms == (None if gap_ms is None else pytest.approx(gap_ms, abs=0.3))
    assert cloud.points[1] == pytest.approx(points, rel=0.01)
    assert pair.problems == ()
    assert pair.in_view[0] > 2000


def test_flipped_bytes_end_in_an_inspection_or_one_line(path):
    """Damage anywhere: what can be read is told, and nothing escapes as another kind of error."""
    recorded(path, cloud=PointCloud(sweep().xyz[:50]))
    good, rng = path.read_bytes(), np.random.default_rng(7)
    for _ in range(150):
        data = bytearray(good)
        for at in rng.integers(8, len(good), 3):
            data[at] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        try:
            found = inspect(str(path), None)
        except CalibwatchError:
            continue
        assert "\n".join(_lines(found))
