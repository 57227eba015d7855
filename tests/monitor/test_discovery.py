"""Rigs out of CameraInfo and tf: chains against products of matrices, and a recording of others."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from monitor.discovery import Survey, compose, discover, path, survey_in
from monitor.messages import CameraInfo, Transform
from monitor.sources import mcap_file
from pipeline.records import CameraModel
from pipeline.se3 import inverse, transform

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[3] / "shared" / "data"))


def motion(seed):
    rng = np.random.default_rng(seed)
    return transform(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3))


def link(parent, child, T, *, static=True):
    return Transform(parent, child, T, static)


def info(size=(64, 48)):
    K = np.array([[50, 0, 32], [0, 50, 24], [0, 0, 1.0]])
    camera = CameraModel("pinhole", K, np.empty(0), *size)
    return CameraInfo(camera, camera)


def survey(*transforms, frames=("cam", "lidar")):
    seen = Survey()
    seen.clouds["/points"] = frames[1]
    seen.images["/cam/image_raw"] = (frames[0], (64, 48))
    seen.infos["/cam/camera_info"] = (frames[0], info())
    for one in transforms:
        seen.transforms[one.parent, one.child] = one
    return seen


@given(st.integers(0, 1000), st.integers(2, 7))
def test_a_chain_through_any_tree_is_the_product_of_its_links(seed, size):
    rng = np.random.default_rng(seed)
    T_root = {0: np.eye(4)}
    links = []
    for node in range(1, size):
        parent = int(rng.integers(node))
        T = motion(1000 * seed + node)
        T_root[node] = T_root[parent] @ T
        links.append(link(str(parent), str(node), T))
    a, b = (int(n) for n in rng.integers(size, size=2))
    rng.shuffle(links)
    chain = path(links, str(a), str(b))
    np.testing.assert_allclose(compose(chain), inverse(T_root[a]) @ T_root[b], atol=1e-12)


def test_the_extrinsic_and_the_vehicle_frame_come_from_a_common_ancestor():
    T_base_lidar, T_base_cam = motion(1), motion(2)
    found = discover(survey(link("base_link", "lidar", T_base_lidar), link("base_link", "cam", T_base_cam)))
    (pair,) = found.rig.pairs
    np.testing.assert_allclose(pair.T_cam_lidar, inverse(T_base_cam) @ T_base_lidar, atol=1e-12)
    np.testing.assert_allclose(pair.T_vehicle_lidar, T_base_lidar, atol=1e-12)
    assert pair.name == "cam"
    assert pair.camera.model.K[0, 0] == 50
    assert found.missing == ()
    assert "base_link -> cam" in found.notes[0]


def test_a_changing_transform_is_the_second_choice_and_told():
    direct = link("cam", "lidar", motion(1), static=False)
    chain = (link("base", "lidar", motion(2)), link("base", "cam", motion(3)))
    np.testing.assert_allclose(
        discover(survey(direct, *chain)).rig.pairs[0].T_cam_lidar, inverse(motion(3)) @ motion(2), atol=1e-12
    )
    alone = discover(survey(direct))
    np.testing.assert_allclose(alone.rig.pairs[0].T_cam_lidar, motion(1), atol=1e-12)
    assert "not all of them static" in alone.notes[0]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s.transforms.clear(), "no transforms"),
        (
            lambda s: s.transforms.pop(("base_link", "cam")),
            "no chain of transforms from lidar of /points to cam",
        ),
        (lambda s: s.infos.clear(), "no CameraInfo for /cam/image_raw"),
        (lambda s: s.clouds.clear(), "no topic with point clouds"),
        (lambda s: s.images.clear(), "no topic with images"),
        (lambda s: s.infos.update({"/cam/camera_info": ("cam", info((32, 24)))}), "is for 32x24 px"),
        (lambda s: s.undecodable.update({"/depth": "16UC1 is no picture"}), "topic /depth: 16UC1"),
    ],
)
def test_what_is_missing_is_told_in_words(change, words):
    seen = survey(link("base_link", "lidar", motion(1)), link("base_link", "cam", motion(2)))
    change(seen)
    found = discover(seen)
    assert any(words in sentence for sentence in found.missing), found.missing
    if "depth" not in words:
        assert found.rig is None


def test_raw_and_compressed_streams_of_one_camera_are_one_pair():
    seen = survey(link("cam", "lidar", motion(1)))
    seen.images["/cam/image_raw/compressed"] = ("cam", (64, 48))
    (pair,) = discover(seen).rig.pairs
    assert pair.camera.topic == "/cam/image_raw"


def test_several_sensors_get_names_of_their_own():
    seen = survey(link("cam", "lidar", motion(1)), link("cam", "left/cam", motion(2)))
    seen.clouds["/rear/points"] = "lidar"
    seen.images["/left/cam/image_raw"] = ("left/cam", (64, 48))
    seen.infos["/left/cam/camera_info"] = ("left/cam", info())
    names = [pair.name for pair in discover(seen).rig.pairs]
    assert len(set(names)) == 4
    assert "cam-rear_points" in names


@pytest.mark.recordings
@pytest.mark.skipif(not DATA.is_dir(), reason="no recordings folder (CALIBWATCH_DATA)")
def test_a_recording_that_this_project_did_not_write():
    with mcap_file.SOURCE.open(str(DATA / "kitti_raw_0009_mcap" / "kitti_0009.mcap")) as source:
        found = discover(survey_in(source, source.describe()))
    (pair,) = found.rig.pairs
    calib = json.loads((DATA / "kitti_raw_0009_a" / "calib.json").read_text())
    T = np.array(calib["T_cam_lidar"])
    np.testing.assert_allclose(pair.T_cam_lidar[:3, :3], T[:3, :3], atol=1e-6)
    # Its converter moved camera 02 by P[0,3]/fx alone: 2.3 mm in x and 2.7 mm in z (the recording's notes).
    np.testing.assert_allclose(pair.T_cam_lidar[:3, 3] - T[:3, 3], [0.0023, 0.0004, -0.0027], atol=1e-4)
    np.testing.assert_allclose(pair.camera.model.K, calib["camera"]["K"])
    assert not pair.camera.model.D.any()
    assert found.missing == ()
