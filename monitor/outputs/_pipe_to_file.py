"""A file for a library that can not be trusted with a full disk.

The library writes into a pipe, as it believes a file; a thread of ours carries the bytes to the disk. When
the disk fails, the thread remembers why and goes on emptying the pipe: the library never waits and never
fails, which matters where its own way of failing is to hang.
"""

import os
import threading
from pathlib import Path

_CHUNK = 1 << 20
"""bytes taken from the pipe at once."""


class PipeToFile:
    """Carries what is written to :attr:`source` into a file. OSError where the file can not be made.

    Args:
        path: The file; what it held is lost.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self._read, self._write = os.pipe()
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._carry, name="recording-file", daemon=True)
        self._thread.start()

    @property
    def source(self) -> str:
        """The path to which the library writes; it must be open there before :meth:`opened` is called."""
        return f"/proc/self/fd/{self._write}"

    @property
    def error(self) -> OSError | None:
        """Why the file is lost, or None."""
        return self._error

    def opened(self) -> None:
        """The library holds its end of the pipe: when it closes that, the file ends."""
        os.close(self._write)

    def join(self, timeout_s: float) -> bool:
        """Waits until the library has closed its end and all is on the disk; False: it took too long."""
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _carry(self) -> None:
        """Body of the thread."""
        with self._file:
            while chunk := os.read(self._read, _CHUNK):
                self._keep(chunk)
            self._sync()
        os.close(self._read)

    def _keep(self, chunk: bytes) -> None:
        written = 0
        try:
            while self._error is None and written < len(chunk):
                written += self._file.write(chunk[written:]) or 0
        except OSError as error:
            self._error = error

    def _sync(self) -> None:
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            self._error = self._error or error
