import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp

from monitor.messages import Message, codecs, decode
from monitor.messages.header import header_stamp_ns
from tests.monitor.messages import wire

MOTION = ("a", "b", (0, 0, 0), (0, 0, 0, 1))


@pytest.mark.parametrize("transport", wire.WIRES)
def test_the_stamp_without_decoding_is_the_stamp_of_decoding(transport):
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]
    for message in (
        wire.point_cloud2(fields, bytes(24), width=2, point_step=12, wire=transport),
        wire.image("mono8", bytes(4), width=2, height=2, step=2, wire=transport),
        wire.camera_info([1.0, 0, 0, 0, 1, 0, 0, 0, 1], [], [0.0] * 12, wire=transport),
        wire.tf([MOTION], wire=transport),
    ):
        assert header_stamp_ns(message) == decode(message)[0].stamp_ns == wire.STAMP_NS


@pytest.mark.parametrize("transport", wire.WIRES)
def test_transforms_without_any_have_no_stamp(transport):
    assert header_stamp_ns(wire.tf([], wire=transport)) is None


@pytest.mark.parametrize("name", [name for name in codecs() if "/msg/" in name])
@pytest.mark.parametrize("encoding", ["cdr", "ros1", "protobuf"])
def test_messages_cut_short_have_no_stamp(name, encoding):
    assert header_stamp_ns(Message("/t", name, encoding, b"\0\1\0\0\1\0\0\0", 5)) is None


def test_foxglove_messages_begin_with_their_stamp():
    for kind in (PointCloud, CompressedImage, RawImage, CameraCalibration, FrameTransform):
        message = kind(timestamp=Timestamp(seconds=1_600_000_000, nanos=5))
        name = message.DESCRIPTOR.full_name
        data = message.SerializeToString()
        assert header_stamp_ns(Message("/t", name, "protobuf", data, 0)) == 1_600_000_000_000_000_005
        assert header_stamp_ns(Message("/t", name, "protobuf", data[:5], 0)) is None
    nested = FrameTransforms(transforms=[FrameTransform(timestamp=Timestamp(seconds=1))])
    message = Message("/t", "foxglove.FrameTransforms", "protobuf", nested.SerializeToString(), 0)
    assert header_stamp_ns(message) is None


def test_other_types_have_no_stamp_and_files_that_of_their_folder():
    assert header_stamp_ns(Message("/t", "std_msgs/msg/String", "cdr", bytes(40), 5)) is None
    assert header_stamp_ns(wire.file("bin", b"", stamp_ns=9)) == 9
    assert header_stamp_ns(wire.file("bin", b"")) is None
