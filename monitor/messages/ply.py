"""PLY files: the ``vertex`` element of ascii and of binary files of both byte orders, with any properties."""

from typing import Any, NamedTuple

import numpy as np

from monitor.messages import Codec, Decoded, Message
from monitor.messages.point_fields import Column, Field, Packing, cloud_of, packed_columns, text_columns
from pipeline.errors import InputError

_LONGEST_HEADER = 65536
"""Bytes; headers take some 500."""

_TYPES = {
    name: code
    for code, names in {
        "i1": ("char", "int8"),
        "u1": ("uchar", "uint8"),
        "i2": ("short", "int16"),
        "u2": ("ushort", "uint16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
    }.items()
    for name in names
}
_ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Element(NamedTuple):
    name: str
    items: int
    properties: list[tuple[str, np.dtype[Any]]]

    @property
    def step(self) -> int:
        """Bytes of one item."""
        return sum(dtype.itemsize for _, dtype in self.properties)


def decode(message: Message) -> tuple[Decoded, ...]:
    """The vertices of a PLY file as a cloud, under the stamp that the source knows (0 where it knows none).

    Raises:
        InputError: No PLY, no vertices with x, y, z, or a file shorter than its header says.
    """
    form, elements, end = _header(message.data)
    at = next((k for k, element in enumerate(elements) if element.name == "vertex"), None)
    if at is None:
        raise InputError("the PLY file has no element 'vertex'")
    before, vertex = elements[:at], elements[at]
    body = memoryview(message.data)[end:]
    columns = _ascii(body, before, vertex) if form == "ascii" else _binary(body, before, vertex)
    stamp_ns = message.stamp_ns or 0
    return (Decoded(stamp_ns, "", cloud_of(columns, stamp_ns)),)


def _header(data: bytes) -> tuple[str, list[_Element], int]:
    if not data.startswith((b"ply\n", b"ply\r\n")):
        raise InputError("the file does not start with 'ply'")
    form = ""
    elements: list[_Element] = []
    at = data.index(b"\n") + 1
    while True:
        end = data.find(b"\n", at, _LONGEST_HEADER)
        if end < 0:
            raise InputError("the PLY header has no end", hint="it ends with a line 'end_header'")
        words = data[at:end].decode("ascii", "replace").split()
        at = end + 1
        match words:
            case ["end_header"]:
                break
            case ["format", name, _] if name in _ORDERS:
                form = name
            case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 16:
                elements.append(_Element(name, int(count), []))
            case ["property", kind, name] if kind in _TYPES and elements and form:
                elements[-1].properties.append((name, np.dtype(_ORDERS[form] + _TYPES[kind])))
            case ["property", "list", *_] if elements and _vertex_seen(elements):
                continue
            case [] | ["comment" | "obj_info", *_]:
                continue
            case _:
                raise InputError(f"the PLY header line '{' '.join(words)[:80]}' is not understood")
    return form, elements, at


def _vertex_seen(elements: list[_Element]) -> bool:
    """Whether the current element stands behind the vertices: only there may items have unequal lengths."""
    return elements[-1].name != "vertex" and any(element.name == "vertex" for element in elements)


def _binary(body: memoryview, before: list[_Element], vertex: _Element) -> dict[str, Column]:
    start = sum(element.items * element.step for element in before)
    fields, offset = [], 0
    for name, dtype in vertex.properties:
        fields.append(Field(name, offset, dtype))
        offset += dtype.itemsize
    return packed_columns(body[start:], Packing(vertex.items, 1, offset, vertex.items * offset, fields))


def _ascii(body: memoryview, before: list[_Element], vertex: _Element) -> dict[str, Column]:
    start = sum(element.items * len(element.properties) for element in before)
    per_point = len(vertex.properties)
    tokens = bytes(body).split()
    wanted = vertex.items * per_point
    if len(tokens) < start + wanted:
        raise InputError(
            f"{vertex.items} vertices of {per_point} numbers, the file has {len(tokens) - start} numbers",
            hint="the file was cut short",
        )
    fields = [Field(name, k, dtype) for k, (name, dtype) in enumerate(vertex.properties)]
    return text_columns(tokens[start : start + wanted], fields, per_point)


CODECS: dict[str, Codec] = {"file/ply": decode}
