"""Values handed to another process of this software: large arrays lie in shared memory, not in the message.

Only processes that this software has started itself share a link: what comes over it is trusted.
"""

import io
import mmap
import os
import pickle
import socket
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeVar

import numpy as np

T = TypeVar("T")

_SHARED_BYTES = 1 << 18
"""Arrays from this size on are read where they lie, which keeps all of a message; smaller ones are copied."""

_ALIGNED = 64
"""Bytes; where arrays begin in shared memory: a line of the cache."""

_LONGEST_NOTE = 1 << 16
"""Bytes of the sizes that go with a message: thousands of arrays."""


class Buffer(Protocol):
    """What :class:`pickle.PickleBuffer` offers."""

    def raw(self) -> memoryview:
        """Its bytes."""


def link() -> tuple[socket.socket, socket.socket]:
    """Both ends of a link; each message arrives whole."""
    return socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)


def give(end: socket.socket, value: object, known: Mapping[str, object]) -> None:
    """Hands a value over.

    Args:
        end: Of the link.
        value: Anything that pickle can write.
        known: What the other side has: named instead of sent. Arrays are known by where their data lie.

    Raises:
        OSError: Nobody is there any more.
    """
    file, sizes = _stored(value, known)
    try:
        _send(end, file, sizes)
    finally:
        os.close(file)


def share(end: socket.socket, value: T, known: Mapping[str, object]) -> T:
    """Hands a value over as :func:`give` does, and gives what the other side receives.

    Large arrays of it lie in the memory of both, once.
    """
    file, sizes = _stored(value, known)
    try:
        _send(end, file, sizes)
        same: T = _loaded(file, sizes, known)
    finally:
        os.close(file)
    return same


def _send(end: socket.socket, file: int, sizes: Sequence[int]) -> None:
    socket.send_fds(end, [struct.pack(f"<{len(sizes)}q", *sizes)], [file])


def _stored(value: object, known: Mapping[str, object]) -> tuple[int, list[int]]:
    """A file in memory that holds the value, and the sizes of its parts."""
    shared: list[memoryview] = []

    def lies_in_message(buffer: Buffer) -> bool:
        raw = buffer.raw()
        if raw.nbytes < _SHARED_BYTES:
            return True
        shared.append(raw)
        return False

    stream = io.BytesIO()
    _Writer(stream, known, lies_in_message).dump(value)
    parts = [stream.getbuffer(), *shared]
    file = os.memfd_create("calibwatch")
    try:
        for part in parts:
            _write(file, part)
            _write(file, memoryview(bytes(-part.nbytes % _ALIGNED)))
    except OSError:
        os.close(file)
        raise
    return file, [part.nbytes for part in parts]


def receive(end: socket.socket, known: Mapping[str, object]) -> Any:  # noqa: ANN401 - what was given
    """Waits for a value; ``known`` as in :func:`give`. Large arrays are read-only.

    Raises:
        EOFError: Nobody is there any more.
    """
    note, files, _, _ = socket.recv_fds(end, _LONGEST_NOTE, 1)
    if not note:
        raise EOFError
    try:
        return _loaded(files[0], struct.unpack(f"<{len(note) // 8}q", note), known)
    finally:
        os.close(files[0])


def _loaded(file: int, sizes: Sequence[int], known: Mapping[str, object]) -> Any:  # noqa: ANN401 - what was stored
    """The value that a file in memory holds; large arrays are read where they lie."""
    memory = memoryview(mmap.mmap(file, 0, access=mmap.ACCESS_READ))
    parts, begin = [], 0
    for size in sizes:
        parts.append(memory[begin : begin + size])
        begin += size + -size % _ALIGNED
    return _Reader(io.BytesIO(parts[0]), known, parts[1:]).load()


def _write(file: int, part: memoryview) -> None:
    left = part.cast("B") if part.nbytes else part
    while left.nbytes:
        left = left[os.write(file, left) :]


def _place(value: object) -> object:
    """By what a value is known again."""
    if not isinstance(value, np.ndarray):
        return id(value)
    return value.__array_interface__["data"][0], value.shape, value.strides, value.dtype.str


class _Writer(pickle.Pickler):
    def __init__(
        self, file: io.BytesIO, known: Mapping[str, object], callback: Callable[[Buffer], bool]
    ) -> None:
        super().__init__(file, protocol=5, buffer_callback=callback)
        self._names = {_place(value): name for name, value in known.items() if value is not None}

    def persistent_id(self, obj: object) -> str | None:
        """Name of what the other side has."""
        return self._names.get(_place(obj))


class _Reader(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, known: Mapping[str, object], buffers: list[memoryview]) -> None:
        super().__init__(file, buffers=buffers)
        self._known = known

    def persistent_load(self, pid: str) -> object:
        """What is named."""
        return self._known[pid]
