"""sensor_msgs/CompressedImage, sensor_msgs/Image and image files -> BGR pixels."""

from typing import Literal

import cv2
import numpy as np
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__CompressedImage as CompressedImage
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Image as Image

from monitor.messages import Codec, Decoded, Message, ros
from monitor.messages.picture import picture
from monitor.messages.pixels import Raster, bgr_pixels
from pipeline.errors import InputError
from pipeline.records import CameraImage

COMPRESSED = "sensor_msgs/msg/CompressedImage"
RAW = "sensor_msgs/msg/Image"


def decode_compressed(message: Message) -> tuple[Decoded, ...]:
    """The pixels of a CompressedImage; what it is tells its content, not the ``format`` string.

    Raises:
        InputError: No CompressedImage, or no picture that can be read.
    """
    msg = ros.deserialize(message, CompressedImage, COMPRESSED)
    image = picture(msg.data.data)
    return (Decoded(ros.stamp_ns(msg.header.stamp), ros.frame_name(msg.header.frame_id), image),)


def decode_raw(message: Message) -> tuple[Decoded, ...]:
    """The pixels of an Image.

    Raises:
        InputError: No Image, an encoding that is not known, or data shorter than declared.
    """
    msg = ros.deserialize(message, Image, RAW)
    raster = Raster(msg.encoding, msg.width, msg.height, msg.step, big_endian=bool(msg.is_bigendian))
    image = CameraImage(bgr_pixels(msg.data, raster))
    return (Decoded(ros.stamp_ns(msg.header.stamp), ros.frame_name(msg.header.frame_id), image),)


def decode_file(message: Message) -> tuple[Decoded, ...]:
    """The pixels of an image file, under the stamp that the source knows (0 where it knows none)."""
    return (Decoded(message.stamp_ns or 0, "", picture(memoryview(message.data))),)


def encode_compressed_image(
    image: CameraImage, stamp_ns: int, frame: str, form: Literal["jpeg", "png"] = "jpeg"
) -> bytes:
    """A CompressedImage in CDR.

    Args:
        image: Pixels.
        stamp_ns: Stamp, ns.
        frame: Frame id of the camera.
        form: "png" keeps every pixel, "jpeg" is what cameras send (quality 95).
    """
    done, data = cv2.imencode(f".{form}", image.pixels)
    if not done:
        raise InputError(f"an image of {image.size} px can not be written as {form}")
    msg = CompressedImage(ros.header(stamp_ns, frame), form, data.reshape(-1).astype(np.uint8, copy=False))
    return ros.serialize(msg, COMPRESSED)


CODECS: dict[str, Codec] = {
    COMPRESSED: decode_compressed,
    RAW: decode_raw,
    **dict.fromkeys(("file/png", "file/jpg", "file/jpeg", "file/bmp"), decode_file),
}
