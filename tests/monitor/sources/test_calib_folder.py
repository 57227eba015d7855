"""Folders with calib.json: which pairs they list, and that pairs are pairs whatever their stamps say."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from monitor.messages import decode
from monitor.rig import bind, parse_rig
from monitor.sources import kinds, open_source
from monitor.sources.calib_folder import SOURCE
from monitor.sync import pairer_for
from pipeline.errors import InputError, RigError

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[4] / "shared" / "data"))
real = [
    pytest.mark.recordings,
    pytest.mark.skipif(not DATA.is_dir(), reason="no recordings folder (CALIBWATCH_DATA)"),
]
CALIB = {
    "camera": {
        "width": 64,
        "height": 48,
        "K": [[50, 0, 32], [0, 50, 24], [0, 0, 1]],
        "distortion_model": "none",
    },
    "T_cam_lidar": np.eye(4).tolist(),
}


def folder_with(path, calib, files, further=None):
    (path / "calib.json").write_text(json.dumps(calib))
    for name, content in (further or {}).items():
        (path / f"calib_{name}.json").write_text(json.dumps(content))
    for name in files:
        (path / name).write_bytes(name.encode())
    return path


def pairs_of(folder):
    """(pair, bytes of the cloud, bytes of the image) of every pair that comes out of the pairing."""
    with SOURCE.open(str(folder)) as source:
        rig = bind(parse_rig(source.rig_document(), where="x"), source.describe(), where="x")
        pairings = {pair.name: pairer_for(pair) for pair in rig.pairs}
        found = []
        for message in source:
            for pair in rig.pairs:
                push = {
                    pair.lidar.topic: pairings[pair.name].push_lidar,
                    pair.camera.topic: pairings[pair.name].push_camera,
                }.get(message.topic)
                if push is not None:
                    found += [
                        (pair.name, p.lidar.data.decode(), p.camera.data.decode())
                        for p in push(message.stamp_ns, message, message.sequence)
                    ]
        assert all(pairing.flush() == [] for pairing in pairings.values())
    return sorted(found)


def test_listed_pairs_stay_together_however_far_their_stamps_are_apart(tmp_path):
    frames = [
        {"image": "b.png", "cloud": "1.pcd", "t_image": 100.0, "t_cloud": 5.0, "t_cloud_end": 5.1},
        {"image": "a.jpg", "cloud": "2.bin", "t_image": 50.0, "t_cloud": 5.5},
        {"image": "c.jpeg", "cloud": "3.pcd.bin"},
    ]
    folder_with(
        tmp_path, {**CALIB, "frames": frames}, ["a.jpg", "b.png", "c.jpeg", "1.pcd", "2.bin", "3.pcd.bin"]
    )
    assert pairs_of(tmp_path) == [
        ("camera", "1.pcd", "b.png"),
        ("camera", "2.bin", "a.jpg"),
        ("camera", "3.pcd.bin", "c.jpeg"),
    ]
    with SOURCE.open(str(tmp_path)) as source:
        of = {message.data.decode(): message for message in source}
    assert of["1.pcd"].stamp_ns == 5_000_000_000
    assert of["1.pcd"].sweep_s == pytest.approx(0.1)
    assert of["b.png"].stamp_ns == 100_000_000_000
    assert of["c.jpeg"].stamp_ns == of["3.pcd.bin"].stamp_ns == 200_000_000
    assert {name: message.type for name, message in of.items()} == {
        "a.jpg": "file/jpg",
        "b.png": "file/png",
        "c.jpeg": "file/jpg",
        "1.pcd": "file/pcd",
        "2.bin": "file/bin",
        "3.pcd.bin": "file/pcd.bin",
    }


def test_an_absent_stamp_is_that_of_the_partner(tmp_path):
    frames = [{"image": "a.png", "cloud": "a.ply", "t_cloud": 1605333546.782736}]
    folder_with(tmp_path, {**CALIB, "frames": frames}, ["a.png", "a.ply"])
    with SOURCE.open(str(tmp_path)) as source:
        assert {message.stamp_ns for message in source} == {1605333546782736000}


def test_without_a_list_there_is_one_pair(tmp_path):
    folder_with(tmp_path, CALIB, ["image.jpg", "cloud.bin", "cloud.npz"])
    assert pairs_of(tmp_path) == [("camera", "cloud.npz", "image.jpg")]


def test_further_cameras_are_further_pairs_and_the_same_frames_are_listed_once(tmp_path):
    front = {**CALIB, "frames": [{"image": "f.jpg", "cloud": "c.pcd"}]}
    back = {**CALIB, "frames": [{"image": "b.jpg", "cloud": "c.pcd"}]}
    folder_with(tmp_path, front, ["f.jpg", "b.jpg", "c.pcd"], {"FRONT": front, "BACK": back})
    assert pairs_of(tmp_path) == [("BACK", "c.pcd", "b.jpg"), ("FRONT", "c.pcd", "f.jpg")]
    (tmp_path / "calib_FRONT.json").unlink()
    assert [pair[0] for pair in pairs_of(tmp_path)] == ["BACK", "camera"]


@pytest.mark.parametrize(
    ("frames", "words"),
    [
        ([{"image": "a.png", "cloud": "absent.bin"}], r"frames\[0\]: cloud absent.bin does not exist"),
        ([{"image": "../../etc/passwd", "cloud": "a.bin"}], r"image ../../etc/passwd lies outside"),
        ([{"image": "/etc/passwd", "cloud": "a.bin"}], "lies outside"),
        ([{"cloud": "a.bin"}], "names no image"),
        ([{"image": 5, "cloud": "a.bin"}], "names no image"),
        ([{"image": "a.txt", "cloud": "a.bin"}], "a.txt is of no known kind"),
        ([{"image": "a.png", "cloud": "a.txt"}], "a.txt is of no known kind"),
        ([{"image": "a.png", "cloud": "a.bin", "t_image": "noon"}], "t_image is 'noon'"),
        ([{"image": "a.png", "cloud": "a.bin", "t_cloud": float("nan")}], "t_cloud is nan"),
        (["a.png"], "is no object"),
        ({}, "is no list of pairs"),
        ([], "is no list of pairs"),
    ],
)
def test_lists_that_are_refused(tmp_path, frames, words):
    folder_with(tmp_path, {**CALIB, "frames": frames}, ["a.png", "a.bin", "a.txt"])
    with pytest.raises(InputError, match=words):
        SOURCE.open(str(tmp_path))


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("{", InputError, "is not JSON"),
        ("[]", InputError, "holds no JSON object"),
        ("{}", InputError, "no frames"),
        ('{"frames": [{"image": "image.png", "cloud": "cloud.bin"}]}', RigError, "has no 'camera' and"),
    ],
)
def test_calib_files_that_are_refused(tmp_path, text, error, words):
    if "frames" in text:
        folder_with(tmp_path, {}, ["image.png", "cloud.bin"])
    (tmp_path / "calib.json").write_text(text)
    with pytest.raises(error, match=words):
        SOURCE.open(str(tmp_path))


def test_every_kind_of_source_has_a_name_of_its_own_and_refuses_what_is_nothing(tmp_path):
    names = [kind.name for kind in kinds()]
    assert names == ["calib_folder", "kitti_raw", "mcap_file", "ros1_bag", "rosbag2_folder", "zenoh_live"]
    assert not any(kind.matches(str(tmp_path)) for kind in kinds())
    with pytest.raises(InputError, match="is not a recording"):
        open_source(str(tmp_path))
    with pytest.raises(InputError, match="absent does not exist"):
        open_source(str(tmp_path / "absent"))


EXPECTED = {
    "kitti_raw_0009_a": 22,
    "kitti_raw_sfnd": 16,
    "nuscenes_mmdet3d": 1,
    "opencalib_crlf": 1,
    "opencalib_manual": 1,
    "rellis_os1": 1,
    "kitti_singles/000006": 1,
}


@pytest.mark.parametrize("folder", [pytest.param(name, marks=real) for name in EXPECTED])
def test_real_folders_are_read_and_their_first_pair_decodes(folder):
    with open_source(str(DATA / folder)) as source:
        rig = bind(parse_rig(source.rig_document(), where=folder), source.describe(), where=folder)
        topics = {topic.name: topic for topic in source.describe()}
        messages = list(source)
    assert len(rig.pairs) == (6 if "nuscenes" in folder else 1)
    pair = rig.pairs[0]
    assert topics[pair.lidar.topic].count == topics[pair.camera.topic].count == EXPECTED[folder]
    assert source.losses.counts == {}
    (cloud,) = decode(next(m for m in messages if m.topic == pair.lidar.topic))
    (image,) = decode(next(m for m in messages if m.topic == pair.camera.topic))
    assert len(cloud.value) > 20_000
    assert image.value.size == (pair.camera.model.width, pair.camera.model.height)
