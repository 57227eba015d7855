"""Cloud files written byte by byte, independently of the code that reads them."""

import io
import struct
import zipfile

import numpy as np

TYPES = {"f": "F", "i": "I", "u": "U"}


def lzf_literals(data: bytes) -> bytes:
    """LZF without a single back reference: runs of at most 32 literal bytes."""
    return b"".join(bytes([len(data[k : k + 32]) - 1]) + data[k : k + 32] for k in range(0, len(data), 32))


def pcd(points: np.ndarray, kind: str, **changes: str) -> bytes:
    """A PCD file of a structured array; names starting with ``_`` are written as the padding ``_``."""
    names = points.dtype.names
    kinds = [points.dtype.fields[name][0] for name in names]
    header = {
        "VERSION": "0.7",
        "FIELDS": " ".join("_" if name.startswith("_") else name for name in names),
        "SIZE": " ".join(str(k.base.itemsize) for k in kinds),
        "TYPE": " ".join(TYPES[k.base.kind] for k in kinds),
        "COUNT": " ".join(str(k.shape[0] if k.shape else 1) for k in kinds),
        "WIDTH": str(len(points)),
        "HEIGHT": "1",
        "VIEWPOINT": "5 5 5 0 1 0 0",
        "POINTS": str(len(points)),
        "DATA": kind,
    } | changes
    text = "# .PCD v0.7\n" + "".join(f"{key} {value}\n" for key, value in header.items() if value)
    if kind == "ascii":
        rows = (" ".join(str(v) for part in row for v in np.atleast_1d(part)) for row in points)
        body = "\n".join(rows).encode() + b"\n"
    elif kind == "binary":
        body = points.tobytes()
    else:
        plain = b"".join(np.ascontiguousarray(points[name]).tobytes() for name in names)
        packed = lzf_literals(plain)
        body = struct.pack("<II", len(packed), len(plain)) + packed
    return text.encode() + body


PLY_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}


def ply(
    points: np.ndarray, form: str, *, before: str = "", after: str = "", head: bytes = b"", eol: str = "\n"
):
    """A PLY file of a structured array; ``head`` is the body of the elements declared in ``before``."""
    order = ">" if form == "binary_big_endian" else "<"
    kinds = {name: points.dtype.fields[name][0].str[1:] for name in points.dtype.names}
    lines = ["ply", f"format {form} 1.0", "comment made by hand", *([before] if before else [])]
    lines += [f"element vertex {len(points)}", *(f"property {PLY_NAMES[k]} {n}" for n, k in kinds.items())]
    text = eol.join([*lines, *([after] if after else []), "end_header", ""])
    if form == "ascii":
        body = "\n".join(" ".join(str(v) for v in row) for row in points).encode()
    else:
        body = points.astype([(n, order + k) for n, k in kinds.items()]).tobytes()
    return text.encode() + head + body


def npz(**arrays: np.ndarray) -> bytes:
    """A NumPy archive, deflated."""
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def zipped(**members: bytes) -> bytes:
    """An archive of raw members."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name + ".npy", data)
    return out.getvalue()
