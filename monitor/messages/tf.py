"""tf2_msgs/TFMessage (and the older tf/tfMessage of ROS 1): transforms between frames."""

import math
from collections.abc import Sequence

import numpy as np
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Quaternion as Quaternion
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Transform as RosTransform
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__TransformStamped as TransformStamped
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Vector3 as Vector3
from rosbags.typesys.stores.ros2_jazzy import tf2_msgs__msg__TFMessage as TFMessage

from monitor.messages import Codec, Decoded, Message, Transform, ros
from pipeline.errors import InputError
from pipeline.records import Floats

TYPE = "tf2_msgs/msg/TFMessage"

_SMALLEST_NORM = 1e-6
"""Below this a quaternion is an unset field, not a rotation badly rounded."""


def decode(message: Message) -> tuple[Decoded, ...]:
    """One :class:`~monitor.messages.Transform` each; on a topic ending in ``tf_static`` they are static.

    Raises:
        InputError: No TFMessage, or a transform that is not a motion.
    """
    msg = ros.deserialize(message, TFMessage, TYPE)
    static = is_static(message.topic)
    return tuple(_decoded(transform, static=static) for transform in msg.transforms)


def is_static(topic: str) -> bool:
    """Whether the transforms of a topic hold for good."""
    return topic.endswith("tf_static")


def motion(translation: tuple[float, float, float], quaternion: tuple[float, float, float, float]) -> Floats:
    """float64 (4,4) of a translation in metres and a quaternion (x, y, z, w), which is normalised.

    Raises:
        InputError: A number is not finite, or the quaternion is zero.
    """
    norm = math.hypot(*quaternion)
    if not (math.isfinite(norm) and norm > _SMALLEST_NORM and all(map(math.isfinite, translation))):
        raise InputError(
            f"translation {list(translation)} with quaternion {list(quaternion)} is no motion",
            hint="the publisher left the transform unset",
        )
    T = np.eye(4)
    T[:3, :3] = _rotation(*(value / norm for value in quaternion))
    T[:3, 3] = translation
    return T


def encode_tf(transforms: Sequence[Transform], stamp_ns: int) -> bytes:
    """A TFMessage in CDR; the topic, not the message, tells static transforms apart.

    Args:
        transforms: What it states.
        stamp_ns: Stamp of all of them, ns.
    """
    return ros.serialize(TFMessage([_stamped(transform, stamp_ns) for transform in transforms]), TYPE)


def _decoded(stamped: TransformStamped, *, static: bool) -> Decoded:
    parent, child = ros.frame_name(stamped.header.frame_id), ros.frame_name(stamped.child_frame_id)
    shift, turn = stamped.transform.translation, stamped.transform.rotation
    try:
        T = motion((shift.x, shift.y, shift.z), (turn.x, turn.y, turn.z, turn.w))
    except InputError as error:
        raise InputError(f"transform '{parent}' -> '{child}': {error.what}", hint=error.hint) from error
    return Decoded(ros.stamp_ns(stamped.header.stamp), parent, Transform(parent, child, T, static))


def _stamped(transform: Transform, stamp_ns: int) -> TransformStamped:
    x, y, z = (float(value) for value in transform.T_parent_child[:3, 3])
    turn = _quaternion(transform.T_parent_child[:3, :3])
    return TransformStamped(
        ros.header(stamp_ns, transform.parent),
        transform.child,
        RosTransform(Vector3(x, y, z), Quaternion(*turn)),
    )


def _rotation(x: float, y: float, z: float, w: float) -> Floats:
    """Rotation (3,3) of a unit quaternion; scipy's would cost every command some 0.3 s of start-up."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(R: Floats) -> tuple[float, float, float, float]:
    """Quaternion (x, y, z, w) of a rotation (3,3): the dominant axis of q q^T, which R determines."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    outer = np.array(
        [
            [1 + a - e - i, b + d, c + g, h - f],
            [b + d, 1 - a + e - i, f + h, c - g],
            [c + g, f + h, 1 - a - e + i, d - b],
            [h - f, c - g, d - b, 1 + a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(outer)[1][:, -1].tolist()
    return x, y, z, w


CODECS: dict[str, Codec] = {TYPE: decode, "tf/msg/tfMessage": decode}
