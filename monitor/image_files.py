"""Image files -> pixels as the watch sees them, and label files -> values. Everything in them is hostile."""

import stat
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from monitor.messages.picture import picture, picture_size
from monitor.messages.pixels import check_size
from pipeline.errors import InputError

_MOST_BYTES = 256 << 20
"""Bytes; 64 million px of BGR, the most that is decoded, have fewer."""

_PNG, _DEPTH_AT = b"\x89PNG", 24
"""How a PNG begins, and where its bits per value stand."""

_DARK = 64
"""A picture of 16 bits whose brightest value is below a quarter of them may hold counts of 10 to 14 bits."""


@dataclass(frozen=True, slots=True, eq=False)
class StoredImage:
    """An image file decoded.

    Attributes:
        pixels: uint8 (H,W,3), BGR, as stored: EXIF orientation is ignored, since K belongs to stored pixels.
            Grey becomes three equal channels, alpha is dropped, of 16 bits the upper eight are kept.
        note: What a person should look at, or empty.
    """

    pixels: NDArray[np.uint8]
    note: str


def read_image(path: Path) -> StoredImage:
    """Read a JPEG, PNG or BMP by its content.

    Raises:
        InputError: It can not be read, is another format, too large, damaged or cut short. The text names
            the file.
    """
    data = _content(path)
    try:
        pixels = picture(memoryview(data)).pixels
    except InputError as error:
        hint = error.hint or "copy or export it anew"
        raise InputError(f"{path}: {error.what}", hint=hint) from error
    note = ""
    if data.startswith(_PNG) and data[_DEPTH_AT] == 16 and 0 < pixels.max() < _DARK:
        note = "its 16 bits are used up to a quarter at most; scale counts of fewer bits up to 65535 first"
    return StoredImage(pixels, note)


def read_label(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Read a label image: PNG of 8 bits and one channel.

    Args:
        path: The file.
        size: Width and height of the image it belongs to, px.

    Returns:
        uint8 (H,W), values as stored.

    Raises:
        InputError: It can not be read, is no such PNG, or of another size. The text names the file.
    """
    data = _content(path)
    hint = "labels are PNG of 8 bits and one channel, of their image's size"
    try:
        found = picture_size(memoryview(data))
        check_size(*found)
    except InputError as error:
        raise InputError(f"{path}: {error.what}", hint=hint) from error
    if found != size:
        raise InputError(f"{path}: {found[0]}x{found[1]} px, its image has {size[0]}x{size[1]}", hint=hint)
    values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None or values.ndim != 2 or values.dtype != np.uint8:
        raise InputError(f"{path}: no label image", hint=hint)
    return values.astype(np.uint8, copy=False)


def _content(path: Path) -> bytes:
    """The bytes of a file of sensible size."""
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise InputError(f"{path} is a folder", hint=f"name the images in it, as in {path / '*.png'}")
        if not stat.S_ISREG(status.st_mode):
            raise InputError(f"{path} is no regular file", hint="name an image file")
        if not 0 < status.st_size <= _MOST_BYTES:
            raise InputError(
                f"{path} has {status.st_size} bytes", hint=f"an image has 1 to {_MOST_BYTES} bytes"
            )
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path} can not be read: {error.strerror or error}", hint="check the name and the rights"
        ) from error
    except ValueError as error:  # a name with a zero byte
        raise InputError(f"{path!s:.80} is no name of a file", hint="name an image file") from error
