"""``report.html``: one self-contained page that a person opens: verdict, plots, overlays, what to do next."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from monitor.events import EndEvent, Event, FrameEvent, ProposalEvent, StatusEvent
from monitor.outputs import OutputKind, folder_of, write_whole
from monitor.outputs._history import History
from monitor.outputs._overlays import KeptFrame, Overlay, keep, overlay
from monitor.outputs._report_page import PairMaterial, page, picture_bytes
from monitor.outputs._series import Series
from monitor.status import State, Status

FILE_NAME = "report.html"

_MOST_SAMPLES = 4000
"""samples over all pairs in one page: 100 bytes each, and more than a plot has pixels."""

_PICTURES_BYTES = 950_000
"""bytes of pictures in one page: with plots and script it stays below 1.5 MB, which mail still carries."""

_PLACES = 3
"""places shown of the frame that tells most."""
_PLACES_BEFORE = 1
"""places shown of the frame that shows how it was before."""


class _PairRecord:
    """What is kept of one pair: the first healthy frame, the last of each state, the newest as it came."""

    def __init__(self, first: Status) -> None:
        self.history = History(first)
        self.first_ns = first.stamp_ns
        self.series = Series(_MOST_SAMPLES)
        self.proposal: ProposalEvent | None = None
        self._newest: FrameEvent | None = None
        self._kept: dict[State, KeptFrame] = {}
        self._before: KeptFrame | None = None

    def note(self, status: Status) -> None:
        """Takes the next status."""
        if status.state != self.history.last.state:
            self._keep_newest()
        self.history.note(status)
        self.series.note(status)

    def show(self, frame: FrameEvent) -> None:
        """Takes the next frame."""
        if frame.T_estimated is None:
            return
        self._newest = frame
        # The last healthy frame may be younger than the onset: a drift is told some time after it came.
        if self._before is None and self.history.last.state == "healthy":
            self._before = keep(frame)

    def telling(self) -> Iterator[tuple[str, KeptFrame, int]]:
        """(title, frame, places) of the frames to show, the most telling first."""
        self._keep_newest()
        told: State | None = next((s for s in ("drifted", "suspect") if s in self._kept), None)
        if told is None:
            told = next(reversed(self._kept), None)
        if told is not None:
            yield f"Stored against estimated, while {told}", self._kept[told], _PLACES
        if told in ("drifted", "suspect") and self._before is not None:
            yield "For comparison, when first healthy", self._before, _PLACES_BEFORE

    def _keep_newest(self) -> None:
        frame = keep(self._newest) if self._newest is not None else None
        self._newest = None
        if frame is not None:
            state = self.history.last.state
            self._kept.pop(state, None)
            self._kept[state] = frame


class Report:
    """Collects what the page shows, in bounded memory, and writes it at the end."""

    def __init__(self, folder: Path, vehicle: str) -> None:
        self._path = folder / FILE_NAME
        self._vehicle = vehicle
        self._pairs: dict[str, _PairRecord] = {}

    @property
    def lost(self) -> str | None:
        """Never: a failed write is raised where it happens."""
        return None

    def handle(self, event: Event) -> None:
        """Takes note; writes the page at the end, whether the run was complete or not."""
        if isinstance(event, StatusEvent):
            status = event.status
            if status.pair not in self._pairs:
                self._pairs[status.pair] = _PairRecord(status)
            self._pairs[status.pair].note(status)
        elif isinstance(event, FrameEvent):
            if event.pair in self._pairs:
                self._pairs[event.pair].show(event)
        elif isinstance(event, ProposalEvent):
            if event.pair in self._pairs:
                self._pairs[event.pair].proposal = event
        else:
            self._write(event)

    def close(self) -> None:
        """Lets go of what was collected."""
        self._pairs.clear()

    def _write(self, end: EndEvent) -> None:
        records = [record for _, record in sorted(self._pairs.items())]
        pictures, left_out = _pictures(records)
        most = max(2, _MOST_SAMPLES // max(1, len(records)))
        pairs = tuple(
            PairMaterial(
                last=record.history.last,
                timeline=record.history.timeline,
                first_ns=record.first_ns,
                samples=record.series.thinned(most),
                overlays=tuple(pictures[place]),
                overlays_left_out=left_out[place],
                proposal=record.proposal if record.history.last.severity is not None else None,
            )
            for place, record in enumerate(records)
        )
        write_whole(self._path, page(self._vehicle, pairs, end).encode())


def _pictures(records: list[_PairRecord]) -> tuple[list[list[tuple[str, Overlay]]], list[int]]:
    """Overlays per pair as far as the page may grow: the most telling frame of every pair comes first."""
    shown: list[list[tuple[str, Overlay]]] = [[] for _ in records]
    left_out = [0] * len(records)
    room = _PICTURES_BYTES
    wanted = [
        (rank, index, title, frame, places)
        for index, record in enumerate(records)
        for rank, (title, frame, places) in enumerate(record.telling())
    ]
    wanted.sort(key=lambda want: want[:2])
    for served, (rank, index, title, frame, places) in enumerate(wanted):
        waiting = sum(other[0] == rank for other in wanted[served:])
        drawn = _within(room // waiting, overlay(frame, places), frame)
        if drawn is None:
            left_out[index] += 1
        else:
            room -= picture_bytes(drawn)
            shown[index].append((title, drawn))
    return shown, left_out


def _within(room: int, drawn: Overlay, frame: KeptFrame) -> Overlay | None:
    """The overlay with as many places as fit into ``room`` bytes; None where not even one does."""
    if picture_bytes(drawn) <= room:
        return drawn
    for places in range(len(drawn.crops) - 1, 0, -1):
        fewer = replace(drawn, crops=drawn.crops[:places])
        if picture_bytes(fewer) <= room:
            return overlay(frame, places)  # drawn again: the overview marks the places that are shown
    return None


OUTPUT = OutputKind(
    "report", "folder", lambda surroundings: Report(folder_of(surroundings), surroundings.vehicle)
)
