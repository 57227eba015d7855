"""Stamps of messages without decoding what they carry: for rates, gaps and order of a whole recording."""

import struct

from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp

from monitor.messages import Codec, Message

CODECS: dict[str, Codec] = {}
"""This module reads the head of messages and decodes no type."""

NS = 1_000_000_000
_STAMPED = (
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CameraInfo",
)
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_STAMP_FIRST = (
    "foxglove.PointCloud",
    "foxglove.CompressedImage",
    "foxglove.RawImage",
    "foxglove.CameraCalibration",
    "foxglove.FrameTransform",
)
_FIELD_1 = b"\x0a"
"""Tag of field 1, a message in the message: Foxglove's stamps are field 1, and serialisers keep the order."""


def header_stamp_ns(message: Message) -> int | None:
    """Stamp of a message, ns, read without decoding what it carries (tf: of the first transform).

    None where the message states none that can be read so: too short, without transforms, or of a type whose
    stamp does not stand at its beginning. A folder's messages answer with the stamp that the source knows.
    """
    match message.encoding:
        case "file":
            return message.stamp_ns
        case "protobuf":
            return _protobuf_stamp_ns(message) if message.type in _STAMP_FIRST else None
        case "cdr" | "ros1" if message.type in _STAMPED + _TRANSFORMS:
            return _ros_stamp_ns(message)
    return None


def _ros_stamp_ns(message: Message) -> int | None:
    order = "<" if message.encoding == "ros1" or message.data[1:2] == b"\x01" else ">"
    try:
        start = 4  # behind the CDR encapsulation, or behind the sequence number of ROS 1
        if message.type in _TRANSFORMS:
            first = 0 if message.encoding == "ros1" else 4
            (count,) = struct.unpack_from(f"{order}I", message.data, first)
            if count == 0:
                return None
            start += 4
        sec, nanosec = struct.unpack_from(f"{order}iI", message.data, start)
    except struct.error:
        return None
    return int(sec) * NS + int(nanosec)


def _protobuf_stamp_ns(message: Message) -> int | None:
    length = message.data[1:2]
    if message.data[:1] != _FIELD_1 or not length:
        return None
    try:
        stamp = Timestamp.FromString(message.data[2 : 2 + length[0]])
    except DecodeError:
        return None
    return stamp.seconds * NS + stamp.nanos
