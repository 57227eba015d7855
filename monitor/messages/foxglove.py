"""Foxglove's protobuf messages: clouds, images, calibrations, transforms.

The schemas are imported where they are needed: a rig that speaks ROS never loads them.
"""

from typing import TYPE_CHECKING, TypeVar

import numpy as np
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Protobuf

from monitor.messages import CameraInfo, Codec, Decoded, Message, Transform
from monitor.messages.camera_info import camera_model, rectified_model
from monitor.messages.header import NS
from monitor.messages.picture import picture
from monitor.messages.pixels import Raster, bgr_pixels
from monitor.messages.point_fields import KNOWN, Field, Packing, cloud_of, packed_columns
from monitor.messages.ros import frame_name
from monitor.messages.tf import is_static, motion
from pipeline.errors import InputError
from pipeline.records import CameraImage, Floats, PointCloud

if TYPE_CHECKING:
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.Pose_pb2 import Pose
    from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
    from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
    from google.protobuf.timestamp_pb2 import Timestamp

_T = TypeVar("_T", bound=Protobuf)
_NUMBERS = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
_LATEST_S = 2**33
"""s; the year 2242: a stamp beyond it would not fit in 64 bits of ns for long."""


def decode_cloud(message: Message) -> tuple[Decoded, ...]:
    """The points of a foxglove.PointCloud in its frame: ``pose`` is applied.

    Raises:
        InputError: No such message, no x, y, z, or a stride that does not fit.
    """
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud as Cloud  # noqa: PLC0415 - see above

    msg = _parsed(message, Cloud)
    stride, data = msg.point_stride, msg.data  # the property copies each time
    if stride == 0 or len(data) % stride:
        raise InputError(f"{len(data)} bytes are not a whole number of points of {stride} bytes")
    fields = [
        Field(field.name, field.offset, _dtype(field.name, field.type))
        for field in msg.fields
        if field.name.lower() in KNOWN
    ]
    columns = packed_columns(memoryview(data), Packing(len(data) // stride, 1, stride, len(data), fields))
    stamp_ns = _stamp_ns(msg.timestamp)
    cloud = cloud_of(columns, stamp_ns)
    if msg.HasField("pose"):
        cloud = _moved(cloud, _pose(msg.pose))
    return (Decoded(stamp_ns, frame_name(msg.frame_id), cloud),)


def decode_compressed_image(message: Message) -> tuple[Decoded, ...]:
    """The pixels of a foxglove.CompressedImage (jpeg, png).

    Raises:
        InputError: No such message, or no picture that can be read.
    """
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage  # noqa: PLC0415 - see above

    msg = _parsed(message, CompressedImage)
    image = picture(memoryview(msg.data))
    return (Decoded(_stamp_ns(msg.timestamp), frame_name(msg.frame_id), image),)


def decode_raw_image(message: Message) -> tuple[Decoded, ...]:
    """The pixels of a foxglove.RawImage.

    Raises:
        InputError: No such message, an encoding that is not known, or data shorter than declared.
    """
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage  # noqa: PLC0415 - see above

    msg = _parsed(message, RawImage)
    raster = Raster(msg.encoding, msg.width, msg.height, msg.step, big_endian=False)
    image = CameraImage(bgr_pixels(np.frombuffer(msg.data, np.uint8), raster))
    return (Decoded(_stamp_ns(msg.timestamp), frame_name(msg.frame_id), image),)


def decode_calibration(message: Message) -> tuple[Decoded, ...]:
    """K and D of a foxglove.CameraCalibration for raw images, P[:, :3] for rectified ones.

    Raises:
        InputError: No such message, K or P of another length, or a lens that is not known.
    """
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration  # noqa: PLC0415 - see above

    msg = _parsed(message, CameraCalibration)
    if len(msg.K) != 9 or len(msg.P) not in (0, 12):
        raise InputError(f"K has {len(msg.K)} numbers and P {len(msg.P)}, wanted 9 and 12 (or no P)")
    size = (msg.width, msg.height)
    P = np.array(msg.P or np.zeros(12)).reshape(3, 4)
    info = CameraInfo(
        camera_model(msg.distortion_model, np.array(msg.K).reshape(3, 3), list(msg.D), size),
        rectified_model(P, size),
    )
    return (Decoded(_stamp_ns(msg.timestamp), frame_name(msg.frame_id), info),)


def decode_transform(message: Message) -> tuple[Decoded, ...]:
    """A foxglove.FrameTransform; on a topic ending in ``tf_static`` it is static.

    Raises:
        InputError: No such message, or a transform that is not a motion.
    """
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform  # noqa: PLC0415 - see above

    return (_transform(_parsed(message, FrameTransform), static=is_static(message.topic)),)


def decode_transforms(message: Message) -> tuple[Decoded, ...]:
    """The transforms of a foxglove.FrameTransforms.

    Raises:
        InputError: No such message, or a transform that is not a motion.
    """
    from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms  # noqa: PLC0415 - see above

    msg = _parsed(message, FrameTransforms)
    return tuple(_transform(transform, static=is_static(message.topic)) for transform in msg.transforms)


def _parsed(message: Message, kind: type[_T]) -> _T:
    name = kind.DESCRIPTOR.full_name
    if message.encoding != "protobuf":
        raise InputError(f"a {name} in {message.encoding} encoding", hint="it comes in protobuf encoding")
    try:
        return kind.FromString(message.data)
    except DecodeError as error:
        raise InputError(f"the bytes are no {name}", hint="the recording is damaged") from error


def _stamp_ns(stamp: "Timestamp") -> int:
    if not (0 <= stamp.seconds < _LATEST_S and 0 <= stamp.nanos < NS):
        raise InputError(f"the stamp of {stamp.seconds} s and {stamp.nanos} ns is no date")
    return stamp.seconds * NS + stamp.nanos


def _dtype(name: str, number: int) -> np.dtype[np.generic]:
    if number not in _NUMBERS:
        raise InputError(f"field '{name}' has the unknown type number {number}")
    return np.dtype(_NUMBERS[number])


def _motion(translation: "Vector3", rotation: "Quaternion", *, turned: bool) -> Floats:
    """The motion; a rotation that is absent (``turned`` False) is none, one that is all zero is an error."""
    quaternion = (rotation.x, rotation.y, rotation.z, rotation.w) if turned else (0.0, 0.0, 0.0, 1.0)
    return motion((translation.x, translation.y, translation.z), quaternion)


def _pose(pose: "Pose") -> Floats:
    return _motion(pose.position, pose.orientation, turned=pose.HasField("orientation"))


def _moved(cloud: PointCloud, T: Floats) -> PointCloud:
    with np.errstate(over="ignore", invalid="ignore"):
        xyz = (cloud.xyz @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    if not np.isfinite(xyz).all():
        raise InputError(f"the cloud's pose moves points out of reach ({T[:3, 3].tolist()} m)")
    return PointCloud(xyz, cloud.intensity, cloud.ring, cloud.time)


def _transform(msg: "FrameTransform", *, static: bool) -> Decoded:
    parent, child = frame_name(msg.parent_frame_id), frame_name(msg.child_frame_id)
    try:
        T = _motion(msg.translation, msg.rotation, turned=msg.HasField("rotation"))
    except InputError as error:
        raise InputError(f"transform '{parent}' -> '{child}': {error.what}", hint=error.hint) from error
    return Decoded(_stamp_ns(msg.timestamp), parent, Transform(parent, child, T, static))


CODECS: dict[str, Codec] = {
    "foxglove.PointCloud": decode_cloud,
    "foxglove.CompressedImage": decode_compressed_image,
    "foxglove.RawImage": decode_raw_image,
    "foxglove.CameraCalibration": decode_calibration,
    "foxglove.FrameTransform": decode_transform,
    "foxglove.FrameTransforms": decode_transforms,
}
