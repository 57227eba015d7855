"""Messages: bytes <-> values of ``pipeline.records``. Every module here offers ``CODECS``.

``CODECS`` maps a type name (``sensor_msgs/msg/PointCloud2``, ``foxglove.PointCloud``, ``file/pcd``, ...) to a
function ``(Message) -> tuple[Decoded, ...]``. A message that can not be decoded raises
:class:`~pipeline.errors.InputError`; sizes are checked before anything is allocated.
"""

import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal, TypeAlias

from pipeline.errors import InputError
from pipeline.records import CameraImage, CameraModel, Floats, PointCloud

Encoding: TypeAlias = Literal["cdr", "ros1", "protobuf", "file"]


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """A message as a source gives it, not decoded.

    Attributes:
        topic: Topic, key expression or folder it came from.
        type: Type name, the key of the codec: ROS types as ``pkg/msg/Name`` (ROS 1 too), ``foxglove.Name``,
            or ``file/<suffix>`` (file/bin file/npz file/pcd file/ply file/pcd.bin file/png file/jpg).
        encoding: How ``data`` is written.
        data: The bytes, owned by the message.
        log_ns: When the source recorded or received it, ns.
        stamp_ns: Stamp of the measurement where the source knows it (folders do); None: the message tells.
        sequence: Sequence number of the publisher where the transport gives one.
        sweep_s: Duration of the sweep, s, where the source knows it (KITTI start and end, ``t_cloud_end``).
    """

    topic: str
    type: str
    encoding: Encoding
    data: bytes
    log_ns: int
    stamp_ns: int | None = None
    sequence: int | None = None
    sweep_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CameraInfo:
    """Intrinsics as the message states them: both readings, the rig says which holds.

    Attributes:
        raw: K and D, for images as the sensor gives them.
        rectified: P[:, :3] without distortion, for rectified images; None where P is absent or zero.
    """

    raw: CameraModel
    rectified: CameraModel | None


@dataclass(frozen=True, slots=True, eq=False)
class Transform:
    """``T_parent_child`` float64 (4,4): maps points of ``child`` into ``parent``, as tf states it."""

    parent: str
    child: str
    T_parent_child: Floats
    static: bool


Value: TypeAlias = PointCloud | CameraImage | CameraInfo | Transform


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """A decoded message (a tf message gives one per transform).

    Attributes:
        stamp_ns: Stamp of the measurement, ns.
        frame: Frame id, or empty.
        value: What it carries.
    """

    stamp_ns: int
    frame: str
    value: Value


Codec: TypeAlias = Callable[[Message], tuple[Decoded, ...]]


@cache
def codecs() -> dict[str, Codec]:
    """Every codec in this folder by type name."""
    found: dict[str, Codec] = {}
    for module in pkgutil.iter_modules(__path__):
        found.update(importlib.import_module(f"{__name__}.{module.name}").CODECS)
    return found


def decode(message: Message) -> tuple[Decoded, ...]:
    """The values of a message; InputError names the topic and what is wrong."""
    codec = codecs().get(message.type)
    if codec is None:
        raise InputError(
            f"topic {message.topic}: messages of type {message.type} are not understood",
            hint=f"understood: {', '.join(sorted(codecs()))}",
        )
    try:
        return codec(message)
    except InputError as error:
        raise InputError(f"topic {message.topic}: {error.what}", hint=error.hint) from error
