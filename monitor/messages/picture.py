"""Compressed pictures (JPEG, PNG, BMP) -> BGR pixels; their heads are read before anything is allocated."""

import struct
import zlib

import cv2
import numpy as np

from monitor.messages import Codec
from monitor.messages.pixels import check_size
from pipeline.errors import InputError
from pipeline.records import CameraImage

CODECS: dict[str, Codec] = {}
"""This module is shared by those of the images and decodes no type by itself."""

_PNG = b"\x89PNG\r\n\x1a\n"

_MOST_PIXELS_PER_BYTE = {0x89: 8 * 1032, 0xFF: 512, 0x42: 128}
"""By the first byte. PNG: deflate expands at most 1032 times, a pixel has at least one bit. JPEG: a block of
64 px has at least one bit. BMP: a run of 255 px has two bytes."""

_JPEG_STANDALONE = frozenset((0x01, *range(0xD0, 0xD8)))
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}

_MOST_JPEG_SEGMENTS = 1000
"""Segments (and fill bytes) before the frame header; cameras write ten, a long ICC profile some hundred."""

_OS2_HEADER = struct.pack("<I", 12)
"""Length of the oldest BMP header, the only one with sizes of 16 bits."""


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
        if head.startswith(_PNG):
            return _png_size(data)
        if head.startswith(b"BM") and head[14:18] == _OS2_HEADER:
            width, height = struct.unpack_from("<HH", head, 18)
            return int(width), int(height)
        if head.startswith(b"BM"):
            width, height = struct.unpack_from("<ii", head, 18)
            return int(width), abs(int(height))
        if head.startswith(b"\xff\xd8"):
            return _jpeg_size(data)
    except struct.error as error:
        raise InputError(f"the picture of {len(data)} bytes ends before it should") from error
    raise InputError(
        f"a picture that starts with {head[:4].hex(' ') or 'nothing'} is not understood",
        hint="understood: jpeg, png, bmp",
    )


def _png_size(data: memoryview) -> tuple[int, int]:
    """Size in the first chunk of a PNG, whose chunks are all checked against their lengths and sums.

    OpenCV allocates what a chunk declares before it looks for the bytes: 4 GB at worst, for a file of 200.
    """
    width, height = struct.unpack_from(">II", data, len(_PNG) + 8)
    at, kind = len(_PNG), b""
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 8 + length
        if (at == len(_PNG)) != (kind == b"IHDR") or kind == b"acTL":
            raise InputError(f"the PNG has a chunk {kind!r} at byte {at}", hint="animations are not read")
        (stated,) = struct.unpack_from(">I", data, end)
        if zlib.crc32(data[at + 4 : end]) != stated:
            raise InputError(f"the PNG is damaged between bytes {at} and {end}")
        at = end + 4
    return int(width), int(height)


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
