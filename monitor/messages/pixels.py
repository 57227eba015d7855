"""Uncompressed pixels of any encoding that ROS and Foxglove name -> BGR, 8 bits."""

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from monitor.messages import Codec
from pipeline.errors import InputError

CODECS: dict[str, Codec] = {}
"""This module is shared by those of the images and decodes no type by itself."""

MOST_PIXELS = 64_000_000
"""px; four times the largest camera on vehicles: more is a damaged or hostile size."""


class Raster(NamedTuple):
    """How pixels lie in a buffer: ``step`` bytes a row, at least what the width needs."""

    encoding: str
    width: int
    height: int
    step: int
    big_endian: bool


class _Layout(NamedTuple):
    """``channels`` values of ``bits`` bits a pixel; ``convert`` is OpenCV's code to BGR, or None."""

    channels: int
    bits: int
    convert: int | None


_GREY, _RGB, _RGBA, _BGRA = cv2.COLOR_GRAY2BGR, cv2.COLOR_RGB2BGR, cv2.COLOR_RGBA2BGR, cv2.COLOR_BGRA2BGR
_LAYOUTS = {
    **{name: _Layout(1, 8, _GREY) for name in ("mono8", "8uc1")},
    **{name: _Layout(1, 16, _GREY) for name in ("mono16", "16uc1")},
    **{name: _Layout(3, 8, None) for name in ("bgr8", "8uc3")},
    **{name: _Layout(4, 8, _BGRA) for name in ("bgra8", "8uc4")},
    "rgb8": _Layout(3, 8, _RGB),
    "rgba8": _Layout(4, 8, _RGBA),
    "bgr16": _Layout(3, 16, None),
    "rgb16": _Layout(3, 16, _RGB),
    "bgra16": _Layout(4, 16, _BGRA),
    "rgba16": _Layout(4, 16, _RGBA),
    **{
        f"bayer_{pattern}{bits}": _Layout(1, bits, code)
        for bits in (8, 16)
        for pattern, code in (
            ("rggb", cv2.COLOR_BayerRGGB2BGR),
            ("bggr", cv2.COLOR_BayerBGGR2BGR),
            ("gbrg", cv2.COLOR_BayerGBRG2BGR),
            ("grbg", cv2.COLOR_BayerGRBG2BGR),
        )
    },
    **{name: _Layout(2, 8, cv2.COLOR_YUV2BGR_UYVY) for name in ("yuv422", "uyvy")},
    **{name: _Layout(2, 8, cv2.COLOR_YUV2BGR_YUY2) for name in ("yuv422_yuy2", "yuyv")},
}
_PLANAR = {"nv12": cv2.COLOR_YUV2BGR_NV12, "nv21": cv2.COLOR_YUV2BGR_NV21}
_SENSOR_BITS = (8, 10, 12, 14, 16)


def check_size(width: int, height: int) -> None:
    """InputError where an image is empty or larger than any camera's."""
    if width <= 0 or height <= 0 or width * height > MOST_PIXELS:
        raise InputError(f"an image of {width}x{height} px", hint=f"1 to {MOST_PIXELS} px are accepted")


def bgr_pixels(data: NDArray[np.uint8], raster: Raster) -> NDArray[np.uint8]:
    """uint8 (H,W,3), BGR, owned by the caller.

    Values of 16 bits are cut to the top eight of 8, 10, 12, 14 or 16 bits: the fewest that hold the image's
    largest value, since cameras of 10 and 12 bits publish their counts unscaled.

    Args:
        data: (bytes,) of the message.
        raster: How they are to be read.

    Raises:
        InputError: The encoding is not known, the size is not an image's, or the data are shorter than
            declared.
    """
    encoding = raster.encoding.lower()
    check_size(raster.width, raster.height)
    if encoding in _PLANAR:
        return _semi_planar(data, raster, _PLANAR[encoding])
    layout = _LAYOUTS.get(encoding)
    if layout is None:
        raise InputError(
            f"image encoding '{raster.encoding}' is not understood",
            hint=f"understood: {', '.join(sorted({*_LAYOUTS, *_PLANAR}))}",
        )
    if layout.channels == 2 and raster.width % 2:
        raise InputError(f"image encoding '{raster.encoding}' with an odd width of {raster.width} px")
    if encoding.startswith("bayer") and min(raster.width, raster.height) < 2:
        raise InputError(f"a Bayer pattern needs 2x2 px, the image has {raster.width}x{raster.height}")
    pixel = layout.channels * layout.bits // 8
    dtype = np.dtype(np.uint8 if layout.bits == 8 else ">u2" if raster.big_endian else "<u2")
    rows = _rows(data, raster, raster.height, raster.width * pixel)
    values: NDArray[Any] = np.ascontiguousarray(rows).view(dtype)
    values = values.reshape(raster.height, raster.width, layout.channels)
    if layout.bits == 16:
        values = _top_bits(values)
    if layout.convert is None:
        return values.copy()
    return cv2.cvtColor(values, layout.convert).astype(np.uint8, copy=False)


def _rows(data: NDArray[np.uint8], raster: Raster, height: int, used: int) -> NDArray[np.uint8]:
    """(height, used) view of rows of ``step`` bytes; the last row may lack its padding."""
    if raster.step < used:
        raise InputError(f"rows of {raster.step} bytes can not hold {raster.width} px of '{raster.encoding}'")
    needed = (height - 1) * raster.step + used
    if len(data) < needed:
        raise InputError(
            f"{raster.width}x{raster.height} px of '{raster.encoding}' need {needed} bytes, "
            f"the data have {len(data)}",
            hint="the message was cut short",
        )
    return np.ndarray((height, used), np.uint8, buffer=data, strides=(raster.step, 1))


def _top_bits(values: NDArray[np.uint16]) -> NDArray[np.uint8]:
    bits = next(bits for bits in _SENSOR_BITS if int(values.max()) < 1 << bits)
    return (values >> np.uint16(bits - 8)).astype(np.uint8)


def _semi_planar(data: NDArray[np.uint8], raster: Raster, convert: int) -> NDArray[np.uint8]:
    """NV12, NV21: a luma plane, then chroma pairs at half the height, both ``step`` bytes a row."""
    if raster.width % 2 or raster.height % 2:
        raise InputError(
            f"'{raster.encoding}' needs an even size, the image has {raster.width}x{raster.height} px"
        )
    rows = _rows(data, raster, raster.height * 3 // 2, raster.width)
    return cv2.cvtColor(np.ascontiguousarray(rows), convert).astype(np.uint8, copy=False)
