"""Clouds that are nothing but float32, little endian: KITTI's .bin and nuScenes' .pcd.bin."""

from functools import partial

import numpy as np

from monitor.messages import Codec, Decoded, Message
from monitor.messages.point_fields import cloud_of
from pipeline.errors import InputError


def decode(message: Message, names: tuple[str, ...]) -> tuple[Decoded, ...]:
    """The cloud of such a file, under the stamp that the source knows (0 where it knows none).

    Args:
        message: The file.
        names: What the numbers of one point mean, in order.

    Raises:
        InputError: The length is not a whole number of points.
    """
    step = 4 * len(names)
    if len(message.data) % step:
        raise InputError(
            f"{len(message.data)} bytes are not a whole number of points ({', '.join(names)})",
            hint="the file was cut short, or has other columns",
        )
    values = np.frombuffer(message.data, "<f4").reshape(-1, len(names))
    stamp_ns = message.stamp_ns or 0
    cloud = cloud_of({name: values[:, k] for k, name in enumerate(names)}, stamp_ns)
    return (Decoded(stamp_ns, "", cloud),)


CODECS: dict[str, Codec] = {
    "file/bin": partial(decode, names=("x", "y", "z", "reflectance")),
    "file/pcd.bin": partial(decode, names=("x", "y", "z", "intensity", "ring")),
}
