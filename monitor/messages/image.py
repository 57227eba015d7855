"""sensor_msgs/CompressedImage, sensor_msgs/Image and image files -> BGR pixels."""

import struct
from typing import Literal

import cv2
import numpy as np
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__CompressedImage as CompressedImage
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Image as Image

from monitor.messages import Codec, Decoded, Message, ros
from monitor.messages.pixels import Raster, bgr_pixels, check_size
from pipeline.errors import InputError
from pipeline.records import CameraImage

COMPRESSED = "sensor_msgs/msg/CompressedImage"
RAW = "sensor_msgs/msg/Image"

_MOST_PIXELS_PER_BYTE = {0x89: 8 * 1032, 0xFF: 512, 0x42: 128}
"""By the first byte. PNG: deflate expands at most 1032 times, a pixel has at least one bit. JPEG: a block of
64 px has at least one bit. BMP: a run of 255 px has two bytes."""

_JPEG_STANDALONE = frozenset((0x01, *range(0xD0, 0xD8)))
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}

_MOST_JPEG_SEGMENTS = 1000
"""Segments (and fill bytes) before the frame header; cameras write ten, a long ICC profile some hundred."""

_OS2_HEADER = struct.pack("<I", 12)
"""Length of the oldest BMP header, the only one with sizes of 16 bits."""


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


def picture(data: memoryview) -> CameraImage:
    """The pixels of a JPEG, PNG or BMP; EXIF orientation is ignored, since K belongs to the pixels as stored.

    Raises:
        InputError: Another format, too large, damaged or cut short.
    """
    width, height = picture_size(data)
    check_size(width, height)
    if width * height > _MOST_PIXELS_PER_BYTE[data[0]] * len(data):
        raise InputError(
            f"a picture of {len(data)} bytes declares {width}x{height} px",
            hint="it is damaged or was cut short",
        )
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise InputError(f"the picture can not be read ({error.err})") from error
    if pixels is None:
        raise InputError(f"the picture of {len(data)} bytes is damaged or was cut short")
    return CameraImage(pixels.astype(np.uint8, copy=False))


def picture_size(data: memoryview) -> tuple[int, int]:
    """(width, height) in px that the head of a JPEG, PNG or BMP declares.

    Raises:
        InputError: The bytes are none of these.
    """
    head = bytes(data[:32])
    try:
        if head.startswith(b"\x89PNG\r\n\x1a\n"):
            width, height = struct.unpack_from(">II", head, 16)
            return int(width), int(height)
        if head.startswith(b"BM") and head[14:18] == _OS2_HEADER:
            width, height = struct.unpack_from("<HH", head, 18)
            return int(width), int(height)
        if head.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", head, 18)
            return int(width), abs(int(height))
        if head.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
    except struct.error as error:
        raise InputError(f"the picture of {len(data)} bytes ends before its size is told") from error
    raise InputError(
        f"a picture that starts with {head[:4].hex(' ') or 'nothing'} is not understood",
        hint="understood: jpeg, png, bmp",
    )


def _jpeg_size(data: memoryview) -> tuple[int, int]:
    """Size in the frame header of a JPEG: segments are walked by their lengths (ITU T.81, B.1.1)."""
    at = 2
    for _ in range(_MOST_JPEG_SEGMENTS):
        prefix, marker = struct.unpack_from(">BB", data, at)
        if prefix != 0xFF:
            raise InputError(f"the JPEG has no marker at byte {at}")
        if marker == 0xFF or marker in _JPEG_STANDALONE:  # a fill byte, or a marker without a segment
            at += 1 if marker == 0xFF else 2
            continue
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, at + 5)
            return int(width), int(height)
        (length,) = struct.unpack_from(">H", data, at + 2)
        at += 2 + max(2, length)
    raise InputError(f"the JPEG tells no size in its first {_MOST_JPEG_SEGMENTS} segments")


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
