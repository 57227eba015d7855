"""``recording.rrd``: what was seen and said, for the viewer of rerun.

Data go through a bounded queue to a thread of their own: the engine never waits for the disk. A full queue
drops its oldest event of the kind that comes. A second thread flushes on a timer, so that a kill loses little
and a full disk is noticed soon: the recording is then lost, which :attr:`Recording.lost` says. Nothing
listens on the network, and the part of rerun that writes files sends no analytics (its viewer does until
``rerun analytics disable`` was run).
"""

import threading
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from monitor.events import EndEvent, Event, FrameEvent, ProposalEvent, StatusEvent
from monitor.outputs import OutputKind, folder_of, rename_whole

if TYPE_CHECKING:  # half a second and 500 MB of library that commands without a recording do without
    from monitor.outputs._rerun_log import RerunLog

_Recorded: TypeAlias = FrameEvent | StatusEvent | EndEvent

FILE_NAME = "recording.rrd"
PARTIAL_NAME = "recording.partial.rrd"
"""The viewer tells files by their suffix, so the mark stands before it."""

_MOST_FRAMES = 32
"""frames in the queue; 16 s of one pair at 2 images a second, some 100 MB of pictures and clouds at most."""

_MOST_STATUSES = 4096
"""statuses in the queue; an hour of one pair, some 20 MB."""

_FLUSH_PERIOD_S = 2.0
"""s; what a kill loses at most, and how late a full disk is noticed."""

_STOP_S = 30.0
"""s; how long the end of a run waits for a slow disk to take the rest of the queue."""

_SAME_RATE = 0.95
"""A frame is due when this part of the period has passed: jitter of the stamps must not halve the rate."""


class Recording:
    """Writes the recording beside the engine's thread.

    Args:
        folder: Where the file goes.
        vehicle: Name of the vehicle.
        images_hz: Frames kept per second of the data's clock and pair.
    """

    def __init__(self, folder: Path, vehicle: str, images_hz: float) -> None:
        self._path = folder / FILE_NAME
        self._partial = folder / PARTIAL_NAME
        self._period_ns = _SAME_RATE * 1e9 / images_hz
        self._kept_ns: dict[str, int] = {}
        self._queue: deque[_Recorded] = deque()
        self._changed = threading.Condition()
        self._stop = threading.Event()
        self._ended = False
        self._dropped = 0
        self._lost: str | None = None
        self._log = self._open(vehicle)
        self._threads = (
            threading.Thread(target=self._write, name="recording", daemon=True),
            threading.Thread(target=self._flush_on_time, name="recording-flush", daemon=True),
        )
        for thread in self._threads:
            thread.start()

    @property
    def lost(self) -> str | None:
        """Why the recording is lost, or None."""
        return self._lost

    @property
    def dropped(self) -> int:
        """Number of events that a full queue dropped."""
        return self._dropped

    def handle(self, event: Event) -> None:
        """Queues the event; the end waits until all is written and gives the file its name."""
        if isinstance(event, EndEvent):
            self._end(event)
        elif isinstance(event, ProposalEvent):
            return  # a file of its own, and no entity of the recording
        elif self._lost is None and not (isinstance(event, FrameEvent) and self._too_soon(event)):
            with self._changed:
                self._make_room(
                    type(event), _MOST_FRAMES if isinstance(event, FrameEvent) else _MOST_STATUSES
                )
                self._queue.append(event)
                self._changed.notify()

    def close(self) -> None:
        """Stops the threads; without an end before it the file keeps its partial name."""
        if not self._ended:
            self._finish()

    def _open(self, vehicle: str) -> "RerunLog":
        from monitor.outputs._rerun_log import RerunLog  # noqa: PLC0415 # see TYPE_CHECKING above

        return RerunLog(self._partial, vehicle)

    def _too_soon(self, frame: FrameEvent) -> bool:
        last_ns = self._kept_ns.get(frame.pair)
        # A stamp before the last one is a clock that was set, not a frame too many.
        if last_ns is not None and 0 <= frame.stamp_ns - last_ns < self._period_ns:
            return True
        self._kept_ns[frame.pair] = frame.stamp_ns
        return False

    def _make_room(self, kind: type[_Recorded], most: int) -> None:
        """Drops the oldest event of a kind where the queue holds as many as it may."""
        places = [place for place, event in enumerate(self._queue) if isinstance(event, kind)]
        if len(places) >= most:
            del self._queue[places[0]]
            self._dropped += 1

    def _end(self, end: EndEvent) -> None:
        if not end.complete:
            self._queue_end(end)
        self._finish()
        if self._lost is None:
            rename_whole(self._partial, self._path)

    def _queue_end(self, end: EndEvent) -> None:
        with self._changed:
            self._queue.append(end)
            self._changed.notify()

    def _finish(self) -> None:
        self._ended = True
        self._stop.set()
        with self._changed:
            self._changed.notify()
        for thread in self._threads:
            thread.join(_STOP_S)
        if any(thread.is_alive() for thread in self._threads):
            self._lose("the disk is too slow: the end of the recording is not written")
            return
        if self._dropped:
            self._log.note(
                "WARN", f"{self._dropped} frames or statuses were dropped: the disk was slower than the data"
            )
        self._flush()
        try:
            self._log.close()
        except OSError as error:
            self._lose(str(error))

    def _write(self) -> None:
        """Body of the writing thread: takes events until the end has come and the queue is empty."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue or self._stop.is_set())
                if not self._queue:
                    return
                event = self._queue.popleft()
            if self._lost is not None:
                continue  # what is left is let go
            try:
                self._put(event)
            except Exception as error:  # noqa: BLE001 # top of a thread: reports and lets the rest go
                self._lose(f"{type(error).__name__}: {error}")

    def _put(self, event: _Recorded) -> None:
        if isinstance(event, FrameEvent):
            self._log.frame(event)
        elif isinstance(event, EndEvent):
            self._log.note("WARN", f"the run was interrupted: {event.note or 'no reason given'}")
        else:
            self._log.status(event.status)

    def _flush_on_time(self) -> None:
        """Body of the flushing thread."""
        while not self._stop.wait(_FLUSH_PERIOD_S) and self._lost is None:
            self._flush()

    def _flush(self) -> None:
        try:
            self._log.flush()
        except OSError as error:
            self._lose(str(error))

    def _lose(self, why: str) -> None:
        if self._lost is None:
            self._lost = f"{self._partial.name} is lost: {why}"


OUTPUT = OutputKind(
    "recording",
    "folder",
    lambda surroundings: Recording(folder_of(surroundings), surroundings.vehicle, surroundings.images_hz),
)
