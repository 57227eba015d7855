"""Clouds as NumPy archives: ``xyz`` (N,3) and, where known, ``intensity``, ``ring``, ``time`` (N,).

Array headers are read here rather than by ``numpy.load``, which allocates what a header declares before it
looks at the data.
"""

import io
import math
import re
import struct
import zipfile
import zlib

import numpy as np

from monitor.messages import Codec, Decoded, Message
from monitor.messages.point_fields import INTENSITY, RING, TIME, Column, cloud_of
from pipeline.errors import InputError

_LARGEST = 256 * 1024 * 1024
"""Bytes of all arrays; 10 million points with every field: beyond any sweep, small enough not to hurt."""

_HEADER = re.compile(
    rb"\{'descr': '([<>|=](?:f[248]|[iu][1248]))', 'fortran_order': (True|False), "
    rb"'shape': \((\d{1,12}),(?: ?(\d{1,2}))?\), \} *\n?"
)
_PLAIN = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)

_ARRAYS = frozenset(("xyz", *INTENSITY, *RING, *TIME))
_ZIP_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    ValueError,
    OverflowError,
    NotImplementedError,
)
"""What zipfile raises on damaged archives, by experiment with every byte flipped."""


def decode(message: Message) -> tuple[Decoded, ...]:
    """The cloud of an archive, under the stamp that the source knows (0 where it knows none).

    Raises:
        InputError: No archive, no ``xyz``, arrays of other types, of unequal lengths or of other sizes than
            declared.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(message.data)) as archive:
            members = [info for info in archive.infolist() if _name(info) in _ARRAYS]
            total = sum(info.file_size for info in members)
            if total > _LARGEST:
                raise InputError(f"the archive declares {total} bytes", hint=f"at most {_LARGEST} are read")
            arrays = {_name(info): _array(archive, info) for info in members}
    except _ZIP_ERRORS as error:
        raise InputError(f"the file is no NumPy archive ({error})", hint="the file is damaged") from error
    xyz = arrays.pop("xyz", None)
    if xyz is None or xyz.ndim != 2 or xyz.shape[1] != 3:
        raise InputError("the archive has no array 'xyz' of shape (N, 3)")
    for name, array in arrays.items():
        if array.shape != (len(xyz),):
            raise InputError(f"array '{name}' has shape {array.shape}, 'xyz' has {len(xyz)} points")
    columns = {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], **arrays}
    stamp_ns = message.stamp_ns or 0
    return (Decoded(stamp_ns, "", cloud_of(columns, stamp_ns)),)


def _name(info: zipfile.ZipInfo) -> str:
    return info.filename.removesuffix(".npy")


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Column:
    """One member as an array; its bytes are read only up to the size that was checked."""
    name = info.filename
    if info.compress_type not in _PLAIN or info.flag_bits & 1:
        raise InputError(f"member '{name}' is encrypted, or compressed otherwise than by deflate")
    data = archive.read(info)
    if data[:6] != b"\x93NUMPY" or data[6:7] not in (b"\x01", b"\x02"):
        raise InputError(f"member '{name}' is no NumPy array")
    start = 10 if data[6] == 1 else 12
    length = int.from_bytes(data[8:start], "little")
    match = _HEADER.fullmatch(data, start, start + length)
    if match is None:
        raise InputError(
            f"member '{name}' is no array of numbers with one or two dimensions",
            hint="objects and text are not read",
        )
    descr, fortran, rows, columns = match.groups()
    shape = (int(rows),) if columns is None else (int(rows), int(columns))
    dtype = np.dtype(descr.decode())
    body = memoryview(data)[start + length :]
    if len(body) != dtype.itemsize * math.prod(shape):
        raise InputError(f"member '{name}' declares {shape} of {dtype}, has {len(body)} bytes")
    return np.frombuffer(body, dtype).reshape(shape, order="F" if fortran == b"True" else "C")


CODECS: dict[str, Codec] = {"file/npz": decode}
