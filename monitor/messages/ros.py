"""The wire of ROS: CDR (both byte orders) and the serialisation of ROS 1, read as messages of ROS 2."""

from functools import cache
from typing import TypeVar

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores.ros2_jazzy import builtin_interfaces__msg__Time as Time
from rosbags.typesys.stores.ros2_jazzy import std_msgs__msg__Header as Header

from monitor.messages import Codec, Message
from monitor.messages.header import NS
from monitor.messages.header import header_stamp_ns as header_stamp_ns  # noqa: PLC0414 - sources import it from here
from pipeline.errors import InputError

CODECS: dict[str, Codec] = {}
"""This module is shared by those of the ROS messages and decodes no type by itself."""

_T = TypeVar("_T")


@cache
def typestore() -> Typestore:
    """Message definitions of ROS 2 Jazzy, built once; the types used here are the same in every release."""
    return get_typestore(Stores.ROS2_JAZZY)


def deserialize(message: Message, kind: type[_T], name: str) -> _T:
    """The ROS message in ``message``; its arrays may be views of the transport's buffer.

    Args:
        message: A message with encoding "cdr" or "ros1".
        kind: Class of the ROS 2 type store.
        name: Its type name (``pkg/msg/Name``).

    Raises:
        InputError: The bytes are not such a message, are cut short or too long.
    """
    try:
        data: memoryview = memoryview(message.data)
        if message.encoding == "ros1":
            data = typestore().ros1_to_cdr(data, name)
        elif message.encoding != "cdr":
            raise InputError(
                f"a {name} in {message.encoding} encoding", hint="ROS messages come in cdr or ros1 encoding"
            )
        value = typestore().deserialize_cdr(data, name)
    except SerdeError as error:
        raise InputError(
            f"the bytes are no {name} ({error})",
            hint="the recording is damaged, or the topic was declared with another type",
        ) from error
    if not isinstance(value, kind):
        raise InputError(f"the bytes are no {name}")
    return value


def serialize(value: object, name: str) -> bytes:
    """A ROS 2 message as CDR, little endian."""
    return bytes(typestore().serialize_cdr(value, name, little_endian=True))


def stamp_ns(stamp: Time) -> int:
    """A ROS stamp in ns."""
    return stamp.sec * NS + stamp.nanosec


def header(stamp: int, frame: str) -> Header:
    """A header for a stamp in ns."""
    return Header(Time(stamp // NS, stamp % NS), frame)


def frame_name(frame: str) -> str:
    """A frame id as tf2 writes it: ROS 1 allowed a leading slash."""
    return frame.lstrip("/")
