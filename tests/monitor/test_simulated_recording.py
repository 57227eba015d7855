import dataclasses
import json
import math

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from monitor import simulated_recording as recording
from pipeline.errors import InputError
from pipeline.records import CameraModel
from pipeline.se3 import inverse, transform
from pipeline.simulation.drive import START_NS, Drive, DriveParameters
from pipeline.simulation.lidar import spinning
from pipeline.simulation.scene import SceneParameters

PARAMETERS = DriveParameters(
    seed=5,
    duration=1.0,
    scene=SceneParameters(length=150.0),
    lidar=spinning(16, 360),
    camera=CameraModel(
        "plumb_bob",
        np.array([[200.0, 0.0, 119.5], [0.0, 200.0, 39.5], [0.0, 0.0, 1.0]]),
        np.array([-0.1, 0.01, 0.001, 0.0, 0.0]),
        240,
        80,
    ),
    drift_time=0.5,
)


@pytest.fixture(scope="module")
def messages(tmp_path_factory):
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    done = []
    recording.write_drive(PARAMETERS, path, workers=2, progress=lambda n, total: done.append((n, total)))
    assert done == [(10, 10)]
    assert list(path.parent.iterdir()) == [path]
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        found = [(s, c, m) for s, c, m in reader.iter_messages(log_time_order=False)]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    return found, metadata


def decoded(messages, topic):
    store = get_typestore(Stores.ROS2_HUMBLE)
    return [(store.deserialize_cdr(m.data, s.name), m) for s, c, m in messages[0] if c.topic == topic]


def stamp_ns(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def test_clouds_are_those_of_the_drive(messages):
    drive = Drive(PARAMETERS)
    clouds = decoded(messages, recording.CLOUD_TOPIC)
    assert len(clouds) == 10
    for index in (0, 9):
        msg, sent = clouds[index]
        cloud = drive.frame(index).cloud
        kinds = {7: "<f4", 4: "<u2"}
        layout = np.dtype(
            {
                "names": [f.name for f in msg.fields],
                "formats": [kinds[f.datatype] for f in msg.fields],
                "offsets": [f.offset for f in msg.fields],
                "itemsize": msg.point_step,
            }
        )
        points = np.frombuffer(msg.data.tobytes(), layout)
        np.testing.assert_array_equal(np.column_stack([points[k] for k in "xyz"]), cloud.xyz)
        for name in ("intensity", "ring", "time"):
            np.testing.assert_array_equal(points[name], getattr(cloud, name))
        assert stamp_ns(msg.header) == START_NS + index * 100_000_000
        assert msg.header.frame_id == recording.LIDAR_FRAME
        assert sent.log_time > stamp_ns(msg.header) + 100_000_000


def test_images_are_those_of_the_drive(messages):
    drive = Drive(PARAMETERS)
    images, infos = decoded(messages, recording.IMAGE_TOPIC), decoded(messages, recording.INFO_TOPIC)
    assert len(images) == len(infos) == 10
    for index in (3, 8):
        frame = drive.frame(index)
        msg = images[index][0]
        pixels = cv2.imdecode(msg.data, cv2.IMREAD_COLOR)
        assert np.abs(pixels.astype(int) - frame.image.pixels).mean() < 6.0
        assert stamp_ns(msg.header) == stamp_ns(infos[index][0].header) == frame.image_stamp_ns
    info = infos[0][0]
    assert (info.width, info.height, info.distortion_model) == (240, 80, "plumb_bob")
    np.testing.assert_array_equal(info.k.reshape(3, 3), PARAMETERS.camera.K)
    np.testing.assert_array_equal(info.d, PARAMETERS.camera.D)


def test_tf_static_holds_the_stored_extrinsic(messages):
    ((msg, _),) = decoded(messages, recording.TF_TOPIC)
    poses = {}
    for stamped in msg.transforms:
        turn, shift = stamped.transform.rotation, stamped.transform.translation
        R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        assert stamped.header.frame_id == recording.VEHICLE_FRAME
        poses[stamped.child_frame_id] = transform(R, np.array([shift.x, shift.y, shift.z]))
    composed = inverse(poses[recording.CAMERA_FRAME]) @ poses[recording.LIDAR_FRAME]
    np.testing.assert_allclose(composed, PARAMETERS.T_stored, atol=1e-9)


def test_messages_are_in_order_and_carry_their_schemas(messages):
    times = [m.log_time for _, _, m in messages[0]]
    assert times == sorted(times)
    assert {(s.name, s.encoding, c.message_encoding) for s, c, _ in messages[0]} == {
        (f"{package}/msg/{name}", "ros2msg", "cdr")
        for package, name in (
            ("sensor_msgs", "PointCloud2"),
            ("sensor_msgs", "CompressedImage"),
            ("sensor_msgs", "CameraInfo"),
            ("tf2_msgs", "TFMessage"),
        )
    }
    assert all(b"std_msgs/Header" in s.data for s, c, _ in messages[0] if c.topic != recording.TF_TOPIC)


def test_the_truth_stands_in_the_metadata(messages):
    truth = messages[1][recording.METADATA]
    assert json.loads(truth["drift"])[2] == pytest.approx(math.radians(0.5))
    assert int(truth["drift_stamp_ns"]) == START_NS + 500_000_000
    np.testing.assert_allclose(json.loads(truth["T_stored"]), PARAMETERS.T_stored)


def test_a_place_that_can_not_be_written_is_told(tmp_path):
    with pytest.raises(InputError, match="No such file") as caught:
        recording.write_drive(PARAMETERS, tmp_path / "nowhere" / "drive.mcap")
    assert caught.value.hint


def test_a_broken_run_leaves_nothing_behind(tmp_path):
    def broken(_done, _total):
        raise KeyboardInterrupt

    short = dataclasses.replace(PARAMETERS, duration=0.1)
    with pytest.raises(KeyboardInterrupt):
        recording.write_drive(short, tmp_path / "drive.mcap", workers=1, progress=broken)
    assert not list(tmp_path.iterdir())
