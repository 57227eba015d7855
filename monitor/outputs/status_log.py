"""``status.jsonl``: every status, one line of JSON each, in the order in which they came.

It grows as ``status.jsonl.partial`` and gets its name when a complete run has ended: one that was interrupted
or killed leaves the partial name, every line in it whole.
"""

import os
from pathlib import Path

from monitor.events import EndEvent, Event, StatusEvent
from monitor.outputs import PARTIAL, OutputKind, folder_of, rename_whole

FILE_NAME = "status.jsonl"


class StatusLog:
    """Writes each status to the file at once."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE_NAME
        self._partial = folder / (FILE_NAME + PARTIAL)
        # Without a buffer: what was handled is with the system, and a full disk shows at the line it hits.
        self._file = self._partial.open("wb", buffering=0)
        self._whole = 0

    @property
    def lost(self) -> str | None:
        """Never: a failed write is raised where it happens."""
        return None

    def handle(self, event: Event) -> None:
        """Appends a status; the end of a complete run gives the file its name."""
        if isinstance(event, StatusEvent):
            self._append(event.status.to_json().encode() + b"\n")
        elif isinstance(event, EndEvent):
            os.fsync(self._file.fileno())
            self._file.close()
            if event.complete:
                rename_whole(self._partial, self._path)

    def close(self) -> None:
        """Closes the file; without a complete end it keeps its partial name."""
        self._file.close()

    def _append(self, line: bytes) -> None:
        written = 0
        try:
            while written < len(line):
                # None only from a file that does not block; a full disk writes a part, then raises.
                written += self._file.write(line[written:]) or 0
        except OSError:
            self._file.truncate(self._whole)  # no torn last line
            raise
        self._whole += len(line)


OUTPUT = OutputKind("status_log", "folder", lambda surroundings: StatusLog(folder_of(surroundings)))
