"""LZF, the compression of ``DATA binary_compressed`` in PCD files."""

from monitor.messages import Codec
from pipeline.errors import InputError

CODECS: dict[str, Codec] = {}
"""This module serves the PCD codec and decodes no type by itself."""

_LITERALS = 0x20
"""Control bytes below it announce that many bytes, plus one, as they are."""


def decompress(data: memoryview, size: int) -> bytearray:
    """The ``size`` bytes that ``data`` hold; what is allocated grows with what was found, not with ``size``.

    Raises:
        InputError: The data do not yield exactly ``size`` bytes.
    """
    source = bytes(data)
    out = bytearray()
    at, end = 0, len(source)
    try:
        while at < end and len(out) <= size:
            control = source[at]
            at += 1
            if control < _LITERALS:
                out += source[at : at + control + 1]
                at += control + 1
                continue
            length = (control >> 5) + 2
            if length == 9:  # seven in three bits: the length goes on in the next byte
                length += source[at]
                at += 1
            back = ((control & 0x1F) << 8 | source[at]) + 1
            at += 1
            _copy_back(out, back, length)
    except IndexError as error:
        raise InputError(
            "the compressed data end within an instruction", hint="the file is damaged"
        ) from error
    if at != end or len(out) != size:
        raise InputError(f"the compressed data do not hold {size} bytes", hint="the file is damaged")
    return out


def _copy_back(out: bytearray, back: int, length: int) -> None:
    """Repeats what stands ``back`` bytes before the end; it may overlap with what it writes."""
    start = len(out) - back
    if start < 0:
        raise InputError("the compressed data refer to bytes before their start", hint="the file is damaged")
    if back >= length:
        out += out[start : start + length]
    else:
        out += (out[start:] * (length // back + 1))[:length]
