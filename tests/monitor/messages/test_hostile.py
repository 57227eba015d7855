"""Prefixes and flipped bytes of good messages end in a value or an InputError, in little memory."""

import tracemalloc

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import given
from hypothesis import strategies as st

from monitor.messages import Decoded, Message, codecs, decode
from monitor.messages.header import header_stamp_ns
from pipeline.errors import InputError
from tests.monitor.messages import cloud_files, wire

MOST_BYTES = 20_000_000
"""The examples have some 500 bytes: what they may claim to be, once decoded, is small too."""

FIELDS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("t", "<u4")]
POINTS = np.array([(1, 2, 3, 50, 1, 5), (4, 5, 6, 90, 2, 10**7)], FIELDS)
PIXELS = np.random.default_rng(8).integers(0, 256, (6, 8, 3), np.uint8)
STAMP = Timestamp(seconds=1_600_000_000, nanos=5)
MOTION = ("base", "lidar", (1.0, 2, 3), (0.0, 0, 0.6, 0.8))
K = [700.0, 0, 320, 0, 710, 240, 0, 0, 1]
D = [-0.3, 0.1, 0.001, -0.002, 0.01]
P = [650.0, 0, 300, -45, 0, 655, 230, 0, 0, 0, 1, 0]


def picture(suffix):
    return cv2.imencode(suffix, PIXELS)[1].tobytes()


def ros_messages():
    types = {"<f4": 7, "<u2": 4, "<u4": 6}
    fields = [(name, POINTS.dtype.fields[name][1], types[kind]) for name, kind in FIELDS]
    for one in wire.WIRES:
        yield wire.point_cloud2(fields, POINTS.tobytes(), width=2, point_step=22, wire=one)
        yield wire.image("bayer_rggb16", bytes(range(96)), width=8, height=6, step=16, wire=one)
        yield wire.compressed_image(picture(".jpg"), wire=one)
        yield wire.camera_info(K, D, P, binning=(2, 2), roi=(4, 2, 400, 500), wire=one)
        yield wire.tf([MOTION, MOTION], wire=one)
    yield wire.tf([MOTION], wire="ros1", name="tf/msg/tfMessage")


def protobuf_messages():
    numbers = {"<f4": 7, "<u2": 3, "<u4": 5}
    transform = FrameTransform(
        timestamp=STAMP,
        parent_frame_id="base",
        child_frame_id="lidar",
        translation=Vector3(x=1, y=2, z=3),
        rotation=Quaternion(z=0.6, w=0.8),
    )
    fields = [
        PackedElementField(name=name, offset=POINTS.dtype.fields[name][1], type=numbers[kind])
        for name, kind in FIELDS
    ]
    pose = Pose(position=Vector3(x=1), orientation=Quaternion(w=1))
    for message in (
        PointCloud(timestamp=STAMP, pose=pose, point_stride=22, fields=fields, data=POINTS.tobytes()),
        CompressedImage(timestamp=STAMP, format="png", data=picture(".png")),
        RawImage(timestamp=STAMP, width=8, height=6, encoding="mono16", step=16, data=bytes(range(96))),
        CameraCalibration(width=640, height=480, distortion_model="plumb_bob", D=D, K=K, P=P),
        FrameTransforms(transforms=[transform, transform]),
        transform,
    ):
        yield Message("/t", message.DESCRIPTOR.full_name, "protobuf", message.SerializeToString(), 0)


def file_messages():
    for kind in ("ascii", "binary", "binary_compressed"):
        yield wire.file("pcd", cloud_files.pcd(POINTS, kind))
    for form in ("ascii", "binary_little_endian", "binary_big_endian"):
        yield wire.file("ply", cloud_files.ply(POINTS, form))
    yield wire.file("bin", np.arange(8, dtype="<f4").tobytes())
    yield wire.file("pcd.bin", np.arange(10, dtype="<f4").tobytes())
    yield wire.file(
        "npz", cloud_files.npz(xyz=np.ones((2, 3), np.float32), ring=np.arange(2, dtype=np.uint8))
    )
    for suffix in ("png", "jpg", "jpeg", "bmp"):
        yield wire.file(suffix, picture("." + suffix))


GOOD = [*ros_messages(), *protobuf_messages(), *file_messages()]


def name_of(message):
    return f"{message.type} {message.encoding} {message.data[:2].hex()} {len(message.data)}"


def survives(message, data):
    damaged = Message(message.topic, message.type, message.encoding, data, 0)
    header_stamp_ns(damaged)
    try:
        values = decode(damaged)
    except InputError:
        return
    assert all(isinstance(value, Decoded) for value in values)


def test_every_codec_is_attacked():
    assert {message.type for message in GOOD} == set(codecs())


@pytest.mark.parametrize("message", GOOD, ids=name_of)
def test_good_messages_are_read(message):
    assert decode(message)


@pytest.mark.parametrize("message", GOOD, ids=name_of)
def test_every_prefix_ends_in_a_value_or_an_input_error(message):
    for end in range(len(message.data)):
        survives(message, message.data[:end])


@pytest.mark.parametrize("message", GOOD, ids=name_of)
def test_every_flipped_byte_ends_in_a_value_or_an_input_error(message):
    for at in range(len(message.data)):
        for flip in (0x01, 0x80, 0xFF):
            data = bytearray(message.data)
            data[at] ^= flip
            survives(message, bytes(data))


@pytest.mark.parametrize("message", GOOD, ids=name_of)
def test_sizes_are_checked_before_anything_is_allocated(message):
    tracemalloc.start()
    try:
        for at in range(0, len(message.data), 2):
            survives(message, message.data[:at] + b"\x7f\x7f" + message.data[at + 2 :])
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < MOST_BYTES


@pytest.mark.parametrize("message", GOOD, ids=name_of)
def test_bytes_at_the_end_do_no_harm(message):
    for tail in (b"\0", b"\xff" * 9, message.data):
        survives(message, message.data + tail)


@given(st.sampled_from(GOOD), st.binary(max_size=60), st.data())
def test_random_bytes_put_in_anywhere_end_in_a_value_or_an_input_error(message, noise, data):
    at = data.draw(st.integers(0, len(message.data)))
    skipped = data.draw(st.integers(0, 60))
    survives(message, message.data[:at] + noise + message.data[at + skipped :])


def test_an_unknown_type_names_those_that_are_understood():
    with pytest.raises(InputError, match="file/pkl") as error:
        decode(wire.file("pkl", b"\x80\x04."))
    assert "sensor_msgs/msg/PointCloud2" in error.value.hint


@pytest.mark.parametrize("name", [name for name in codecs() if "/msg/" in name])
def test_ros_messages_in_another_encoding_are_refused(name):
    with pytest.raises(InputError, match="protobuf encoding"):
        decode(Message("/t", name, "protobuf", b"", 0))
