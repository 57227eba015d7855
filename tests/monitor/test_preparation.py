"""From recording and rig file to a rig in which nothing is missing."""

import dataclasses

import numpy as np
import pytest

from monitor.injection import parse_inject
from monitor.messages import Message, Transform, decode
from monitor.messages.tf import encode_tf
from monitor.preparation import prepare
from pipeline.errors import InputError, RigError
from pipeline.se3 import mount_drift, vehicle_axes
from tests import drives
from tests.drives import INFO_TOPIC, TF_TOPIC

T = [[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, 0.2], [1.0, 0.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]]


@pytest.fixture
def rig_file(tmp_path):
    def write(text):
        path = tmp_path / "rig.toml"
        path.write_text(text)
        return path

    return write


def only(location, rig_file=None, drift=None):
    (pair,) = prepare(str(location), rig_file, drift).rig.pairs
    return pair


def test_a_recording_that_says_all_needs_no_rig(cut):
    pair = only(cut(5))
    assert np.allclose(pair.T_cam_lidar, drives.PARAMETERS.T_stored, atol=1e-9)
    assert np.allclose(pair.T_vehicle_lidar, drives.PARAMETERS.T_vehicle_lidar, atol=1e-9)
    assert np.allclose(pair.camera.model.K, drives.PARAMETERS.camera.K)
    assert (pair.camera.model.width, pair.camera.model.height) == (drives.WIDTH, drives.HEIGHT)


def test_it_is_known_how_many_pairs_there_can_be(cut, rig_file):
    for prepared in (prepare(str(cut(5)), None, None), prepare(str(cut(5)), rig_file(drives.RIG), None)):
        assert prepared.frames == 5


def test_what_a_rig_file_leaves_open_comes_from_the_recording(cut, rig_file):
    pair, own = only(cut(5), rig_file(drives.RIG)), only(cut(5))
    assert pair.name == "front"
    for name in ("T_cam_lidar", "T_vehicle_lidar"):
        assert np.array_equal(getattr(pair, name), getattr(own, name))
    assert np.array_equal(pair.camera.model.K, own.camera.model.K)


def test_what_a_rig_file_states_wins(cut, rig_file):
    text = drives.RIG.replace(f'info = "{INFO_TOPIC}"', drives.INTRINSICS.replace("427.0", "500.0"))
    pair = only(cut(5), rig_file(text + f"[pairs.extrinsic]\nT_cam_lidar = {T}\nsigma_deg = 0.5\n"))
    assert np.array_equal(pair.T_cam_lidar, T)
    assert pair.camera.model.K[0, 0] == 500.0
    assert np.degrees(pair.sigma_rad) == pytest.approx(0.5)


def test_topics_may_be_left_open_where_there_is_one_of_each(cut, rig_file):
    text = f'[[pairs]]\nname = "p"\nlidar = {{}}\ncamera = {{}}\n[pairs.extrinsic]\nT_cam_lidar = {T}\n'
    pair = only(cut(5), rig_file(text))
    assert (pair.lidar.topic, pair.camera.topic) == (drives.CLOUD_TOPIC, drives.IMAGE_TOPIC)


def test_an_injected_drift_is_the_motion_from_the_altered_to_the_true_extrinsic(cut):
    drift = parse_inject("roll=0.3,yaw=-1,up=0.05")
    pair, true = only(cut(5), None, drift), only(cut(5))
    R_vehicle_cam = vehicle_axes(pair.T_cam_lidar, pair.T_vehicle_lidar)
    assert np.allclose(mount_drift(pair.T_cam_lidar, true.T_cam_lidar, R_vehicle_cam), drift, atol=1e-6)


def test_an_extrinsic_that_nothing_states_is_asked_for(messages, rig_file, tmp_path):
    few = [m for m in drives.first_frames(messages, 2) if m.topic != TF_TOPIC]
    path = drives.write(tmp_path / "few.mcap", few)
    with pytest.raises(RigError, match="pair front: no extrinsic, and no chain of transforms from lidar to"):
        only(path, rig_file(drives.RIG))


def test_intrinsics_that_nothing_states_are_asked_for(messages, rig_file, tmp_path):
    few = [m for m in drives.first_frames(messages, 2) if m.topic != INFO_TOPIC]
    path = drives.write(tmp_path / "few.mcap", few)
    text = drives.RIG.replace(f', info = "{INFO_TOPIC}"', "")
    with pytest.raises(RigError, match="pair front: no intrinsics for /camera/image/compressed"):
        only(path, rig_file(text))


def test_without_a_vehicle_frame_the_camera_stands_in(messages, tmp_path):
    def without_vehicle(message):
        given = decode(Message(message.topic, message.type, "cdr", message.data, 0))
        by_child = {one.value.child: one.value.T_parent_child for one in given}
        T_lidar_camera = np.linalg.inv(by_child["lidar"]) @ by_child["camera"]
        return dataclasses.replace(
            message, data=encode_tf([Transform("lidar", "camera", T_lidar_camera, static=True)], 0)
        )

    few = drives.changed(drives.first_frames(messages, 2), TF_TOPIC, without_vehicle)
    pair = only(drives.write(tmp_path / "few.mcap", few))
    assert pair.T_vehicle_lidar is None
    assert np.allclose(pair.T_cam_lidar, drives.PARAMETERS.T_stored, atol=1e-9)


@pytest.mark.parametrize("location", ["tcp/127.0.0.1:7447", "tls/vehicle:7447"])
def test_a_bus_is_no_recording(location):
    with pytest.raises(InputError, match="is a bus, not a recording"):
        prepare(location, None, None)
