"""ROS messages written byte by byte, independently of the library that reads them."""

import struct
from dataclasses import dataclass, field
from typing import Literal

from monitor.messages import Message

Wire = Literal["cdr little", "cdr big", "ros1"]
WIRES: tuple[Wire, ...] = ("cdr little", "cdr big", "ros1")
STAMP_NS = 1_600_000_000_123_456_789


@dataclass
class Writer:
    """Appends primitives: CDR aligns each to its size (behind its four bytes of head), ROS 1 never does."""

    wire: Wire
    body: bytearray = field(default_factory=bytearray)

    @property
    def ros1(self) -> bool:
        return self.wire == "ros1"

    def number(self, code: str, *values: float) -> "Writer":
        for value in values:
            size = struct.calcsize("<" + code)
            if not self.ros1:
                self.body += bytes(-len(self.body) % size)
            self.body += struct.pack((">" if self.wire == "cdr big" else "<") + code, value)
        return self

    def string(self, text: str) -> "Writer":
        data = text.encode() + (b"" if self.ros1 else b"\0")
        return self.number("I", len(data)).raw(data)

    def blob(self, data: bytes) -> "Writer":
        return self.number("I", len(data)).raw(data)

    def raw(self, data: bytes) -> "Writer":
        self.body += data
        return self

    def header(self, frame: str = "lidar", stamp_ns: int = STAMP_NS) -> "Writer":
        if self.ros1:
            self.number("I", 7)
        return self.number("i", stamp_ns // 10**9).number("I", stamp_ns % 10**9).string(frame)

    def message(self, name: str, topic: str = "/topic") -> Message:
        head = {"cdr little": b"\0\1\0\0", "cdr big": b"\0\0\0\0", "ros1": b""}[self.wire]
        return Message(topic, name, "ros1" if self.ros1 else "cdr", head + bytes(self.body), 0)


def point_cloud2(
    fields: list[tuple[str, int, int]],
    data: bytes,
    *,
    width: int,
    point_step: int,
    height: int = 1,
    row_step: int | None = None,
    big: bool = False,
    wire: Wire = "cdr little",
    frame: str = "lidar",
    stamp_ns: int = STAMP_NS,
) -> Message:
    """``fields``: name, offset, type number."""
    writer = Writer(wire).header(frame, stamp_ns).number("I", height, width, len(fields))
    for name, offset, datatype in fields:
        writer.string(name).number("I", offset).number("B", datatype).number("I", 1)
    writer.number("B", big).number("I", point_step, width * point_step if row_step is None else row_step)
    return writer.blob(data).number("B", 1).message("sensor_msgs/msg/PointCloud2")


def image(
    encoding: str,
    data: bytes,
    *,
    width: int,
    height: int,
    step: int,
    big: bool = False,
    wire: Wire = "cdr little",
) -> Message:
    writer = Writer(wire).header("cam").number("I", height, width).string(encoding)
    return writer.number("B", big).number("I", step).blob(data).message("sensor_msgs/msg/Image")


def compressed_image(data: bytes, *, form: str = "jpeg", wire: Wire = "cdr little") -> Message:
    return Writer(wire).header("cam").string(form).blob(data).message("sensor_msgs/msg/CompressedImage")


def camera_info(
    K: list[float],
    D: list[float],
    P: list[float],
    *,
    model: str = "plumb_bob",
    size: tuple[int, int] = (640, 480),
    binning: tuple[int, int] = (0, 0),
    roi: tuple[int, int, int, int] = (0, 0, 0, 0),
    wire: Wire = "cdr little",
) -> Message:
    """``roi``: x, y, height, width."""
    R = [0.0, -1, 0, 1, 0, 0, 0, 0, 1]
    writer = Writer(wire).header("cam").number("I", size[1], size[0]).string(model)
    writer.number("I", len(D)).number("d", *D, *K, *R, *P).number("I", *binning, *roi).number("B", 0)
    return writer.message("sensor_msgs/msg/CameraInfo")


def tf(
    transforms: list[tuple[str, str, tuple[float, float, float], tuple[float, float, float, float]]],
    *,
    topic: str = "/tf",
    name: str = "tf2_msgs/msg/TFMessage",
    wire: Wire = "cdr little",
) -> Message:
    """``transforms``: parent, child, translation, quaternion (x, y, z, w)."""
    writer = Writer(wire).number("I", len(transforms))
    for parent, child, translation, quaternion in transforms:
        writer.header(parent).string(child).number("d", *translation, *quaternion)
    return writer.message(name, topic)


def file(kind: str, data: bytes, stamp_ns: int | None = None) -> Message:
    return Message("folder", f"file/{kind}", "file", data, 0, stamp_ns)
