"""A small ONNX file written by hand: the contract is tested without the exporter's packages.

The network in it answers with the mean of each 2x2 block of the input, its three channels repeated to
nine: what comes out says where every pixel went.
"""

from collections.abc import Mapping


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes(out) + bytes([number])


def _field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _end(name: str, channels: int, elements: int) -> bytes:
    """ValueInfoProto of a tensor (1, channels, rows, columns)."""
    fixed = [_field(1, _field(1, size)) for size in (1, channels)]
    free = [_field(1, _field(2, f"{name}_{side}")) for side in ("rows", "columns")]
    shape = b"".join(fixed + free)
    return _field(1, name) + _field(2, _field(1, _field(1, elements) + _field(2, shape)))


def _node(kind: str, inputs: list[str], output: str, attributes: bytes) -> bytes:
    return b"".join(_field(1, name) for name in inputs) + _field(2, output) + _field(4, kind) + attributes


def _ints(name: str, values: list[int]) -> bytes:
    return _field(5, _field(1, name) + b"".join(_field(8, v) for v in values) + _field(20, 7))


def block_means(metadata: Mapping[str, str], *, classes: int = 9, pool: int = 2) -> bytes:
    """Return the file; ``classes`` in threes, ``pool`` is the side of a block."""
    sides = _ints("kernel_shape", [pool, pool]) + _ints("strides", [pool, pool])
    axis = _field(5, _field(1, "axis") + _field(3, 1) + _field(20, 2))
    graph = (
        _field(1, _node("AveragePool", ["rgb"], "means", sides))
        + _field(1, _node("Concat", ["means"] * (classes // 3), "probabilities", axis))
        + _field(2, "block means")
        + _field(11, _end("rgb", 3, 1))
        + _field(12, _end("probabilities", classes, 1))
    )
    properties = b"".join(_field(14, _field(1, key) + _field(2, value)) for key, value in metadata.items())
    return _field(1, 8) + _field(7, graph) + _field(8, _field(2, 17)) + properties
