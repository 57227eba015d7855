"""Real clouds and messages: the original files give what was extracted from them elsewhere."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from monitor.messages import Message, decode
from tests.monitor.messages import wire

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[4] / "shared" / "data"))

pytestmark = [
    pytest.mark.recordings,
    pytest.mark.skipif(not DATA.is_dir(), reason="no recordings folder (CALIBWATCH_DATA)"),
]


def cloud(pattern, kind):
    (path,) = DATA.glob(pattern)
    return decode(wire.file(kind, path.read_bytes()))[0].value


@pytest.mark.parametrize(
    ("folder", "pattern", "kind"),
    [
        ("opencalib_crlf", "calib.pcd", "pcd"),
        ("opencalib_st1", "calib.pcd", "pcd"),
        ("opencalib_st2", "calib.pcd", "pcd"),
        ("opencalib_manual", "0.pcd", "pcd"),
        ("rellis_os1", "*.ply", "ply"),
        ("nuscenes_mmdet3d", "*.pcd.bin", "pcd.bin"),
    ],
)
def test_original_clouds_against_their_extracts(folder, pattern, kind):
    found = cloud(f"{folder}/{pattern}", kind)
    with np.load(DATA / folder / "cloud.npz") as extract:
        assert np.array_equal(found.xyz, extract["xyz"])
        scale = max(255.0, float(np.quantile(extract["intensity"], 0.999)))
        assert np.abs(found.intensity - np.minimum(extract["intensity"] / scale, 1)).max() < 2e-3
        for name in ("ring", "time"):
            assert (getattr(found, name) is not None) == (name in extract)
        assert found.ring is None or np.array_equal(found.ring, extract["ring"])
        assert found.time is None or np.abs(found.time - extract["time"]).max() < 2e-6
    from_extract = cloud(f"{folder}/cloud.npz", "npz")
    assert np.array_equal(from_extract.xyz, found.xyz)
    assert np.abs(from_extract.intensity - found.intensity).max() < 1e-6


def test_kitti_keeps_its_reflectance():
    found = cloud("kitti_singles/000001/cloud.bin", "bin")
    raw = np.fromfile(DATA / "kitti_singles/000001/cloud.bin", "<f4").reshape(-1, 4)
    assert np.array_equal(found.xyz, raw[:, :3])
    assert np.array_equal(found.intensity, raw[:, 3])


def test_a_recorded_drive():
    found = {}
    with (DATA / "kitti_raw_0009_mcap" / "kitti_0009.mcap").open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.topic != "/kitti/imu":
                one = Message(channel.topic, schema.name, "cdr", message.data, message.log_time)
                found.setdefault(channel.topic, []).append(decode(one))
    assert {topic: len(messages) for topic, messages in found.items()} == {
        "/kitti/velodyne_points": 12,
        "/kitti/camera_color_left/image_raw": 12,
        "/kitti/camera_color_left/camera_info": 12,
        "/tf": 12,
        "/tf_static": 1,
    }
    for (sweep,) in found["/kitti/velodyne_points"]:
        assert sweep.frame == "velodyne"
        assert 110_000 < len(sweep.value) < 125_000
        assert sweep.value.intensity.max() == pytest.approx(0.99)
    for (image,) in found["/kitti/camera_color_left/image_raw"]:
        assert image.value.size == (1242, 375)
    (info,) = found["/kitti/camera_color_left/camera_info"][0]
    calib = json.loads((DATA / "kitti_raw_0009_a" / "calib.json").read_text())
    assert pytest.approx(np.array(calib["camera"]["K"]).reshape(3, 3), abs=1e-3) == info.value.rectified.K


def test_the_static_transforms_of_a_drive_give_its_extrinsic():
    with (DATA / "kitti_raw_0009_mcap" / "kitti_0009.mcap").open("rb") as stream:
        (schema, channel, message), *_ = make_reader(stream).iter_messages(topics=["/tf_static"])
    decoded = decode(Message(channel.topic, schema.name, "cdr", message.data, message.log_time))
    assert all(one.value.static and one.value.parent == "base_link" for one in decoded)
    T = {one.value.child: one.value.T_parent_child for one in decoded}
    composed = np.linalg.inv(T["camera_color_left"]) @ T["velodyne"]
    calib = json.loads((DATA / "kitti_raw_0009_a" / "calib.json").read_text())
    assert composed == pytest.approx(np.array(calib["T_cam_lidar"]), abs=5e-3)
