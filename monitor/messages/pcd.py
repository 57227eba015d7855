"""PCD files of the Point Cloud Library: ascii, binary, binary_compressed."""

import struct
from typing import Any, NamedTuple

import numpy as np

from monitor.messages import Codec, Decoded, Message, lzf
from monitor.messages.point_fields import (
    KNOWN,
    Column,
    Field,
    Packing,
    cloud_of,
    packed_columns,
    text_columns,
)
from pipeline.errors import InputError

_LONGEST_HEADER = 65536
"""Bytes; headers take some 300."""

_TYPES = {"F": ("f4", "f8"), "I": ("i1", "i2", "i4", "i8"), "U": ("u1", "u2", "u4", "u8")}


class _Column(NamedTuple):
    name: str
    size: int
    repeat: int
    dtype: np.dtype[Any] | None

    @property
    def nbytes(self) -> int:
        return self.size * self.repeat


class _Header(NamedTuple):
    columns: list[_Column]
    points: int
    data: str
    end: int


def decode(message: Message) -> tuple[Decoded, ...]:
    """The cloud of a PCD file, under the stamp that the source knows (0 where it knows none).

    VIEWPOINT is not applied: points stay in the frame they were written in, as with the library itself.

    Raises:
        InputError: No PCD, no x, y, z, or sizes that do not fit the file.
    """
    header = _header(message.data)
    body = memoryview(message.data)[header.end :]
    columns = _READERS[header.data](body, header)
    stamp_ns = message.stamp_ns or 0
    return (Decoded(stamp_ns, "", cloud_of(columns, stamp_ns)),)


def _header(data: bytes) -> _Header:
    entries: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in entries:
        end = data.find(b"\n", at, _LONGEST_HEADER)
        if end < 0:
            raise InputError("the file has no PCD header", hint="a PCD header ends with a line 'DATA ...'")
        words = data[at:end].decode("ascii", "replace").split()
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
        at = end + 1
    kind = " ".join(entries["DATA"]).lower()
    if kind not in _READERS:
        raise InputError(f"PCD data '{kind}' are not understood", hint=f"understood: {', '.join(_READERS)}")
    names = entries.get("FIELDS", [])
    sizes = _numbers(entries, "SIZE", len(names))
    counts = _numbers(entries, "COUNT", len(names)) if "COUNT" in entries else [1] * len(names)
    types = entries.get("TYPE", [])
    if not len(names) == len(types) > 0 or min(counts) < 1:
        raise InputError(f"the PCD header has {len(names)} fields and {len(types)} types, counts {counts}")
    columns = [_column(*column) for column in zip(names, types, sizes, counts, strict=True)]
    (width,), (height,) = _numbers(entries, "WIDTH", 1), _numbers(entries, "HEIGHT", 1)
    points = _numbers(entries, "POINTS", 1)[0] if "POINTS" in entries else width * height
    if points != width * height:
        raise InputError(f"the PCD header has {points} points in {height} rows of {width}")
    return _Header(columns, points, kind, at)


def _numbers(entries: dict[str, list[str]], key: str, count: int) -> list[int]:
    words = entries.get(key, [])
    if len(words) != count or not all(word.isascii() and word.isdigit() and len(word) < 16 for word in words):
        raise InputError(
            f"the PCD header has {key} {' '.join(words)[:80] or 'missing'}, wanted {count} whole numbers"
        )
    return [int(word) for word in words]


def _column(name: str, kind: str, size: int, count: int) -> _Column:
    code = f"{kind.lower()}{size}"
    known = code in _TYPES.get(kind.upper(), ())
    if not known and name.lower() in KNOWN:
        raise InputError(f"PCD field '{name}' has the unknown type {kind} of {size} bytes")
    return _Column(name, size, count, np.dtype(f"<{code}") if known else None)


def _placed(columns: list[_Column], *, bytewise: bool) -> tuple[list[Field], int]:
    """Fields with their offsets in a point, and the size of a point: in bytes, or in numbers."""
    fields, at = [], 0
    for column in columns:
        if column.dtype is not None:
            fields.append(Field(column.name, at, column.dtype))
        at += column.nbytes if bytewise else column.repeat
    return fields, at


def _ascii(body: memoryview, header: _Header) -> dict[str, Column]:
    fields, per_point = _placed(header.columns, bytewise=False)
    tokens = bytes(body).split()
    if len(tokens) != header.points * per_point:
        raise InputError(
            f"{header.points} points of {per_point} numbers, the file has {len(tokens)} numbers",
            hint="the file was cut short, or its header belongs to another file",
        )
    return text_columns(tokens, fields, per_point)


def _binary(body: memoryview, header: _Header) -> dict[str, Column]:
    fields, step = _placed(header.columns, bytewise=True)
    return packed_columns(body, Packing(header.points, 1, step, header.points * step, fields))


def _compressed(body: memoryview, header: _Header) -> dict[str, Column]:
    """Compressed data stand field by field: all x, then all y, ..."""
    try:
        packed, size = struct.unpack_from("<II", body)
    except struct.error as error:
        raise InputError("the file ends before its compressed data") from error
    step = sum(column.nbytes for column in header.columns)
    if packed > len(body) - 8 or size != header.points * step:
        raise InputError(
            f"{header.points} points of {step} bytes, the file declares {size} bytes in {packed} compressed "
            f"ones and has {len(body) - 8}",
            hint="the file was cut short, or its header belongs to another file",
        )
    plain = lzf.decompress(body[8 : 8 + packed], size)
    fields, at = {}, 0
    for column in header.columns:
        if column.dtype is not None:
            here = [Field(column.name, 0, column.dtype)]
            block = Packing(header.points, 1, column.nbytes, header.points * column.nbytes, here)
            fields.update(packed_columns(memoryview(plain)[at:], block))
        at += header.points * column.nbytes
    return fields


_READERS = {"ascii": _ascii, "binary": _binary, "binary_compressed": _compressed}

CODECS: dict[str, Codec] = {"file/pcd": decode}
