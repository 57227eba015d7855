"""``summary.json``, ``calibwatch.summary/1``: what a run said, in one small file that a program reads."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from monitor.events import EndEvent, Event, StatusEvent
from monitor.outputs import OutputKind, folder_of, write_whole
from monitor.status import Code, Frames, Name, State, Status, first_in_precedence

FILE_NAME = "summary.json"

SCHEMA: Literal["calibwatch.summary/1"] = "calibwatch.summary/1"


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", validate_by_name=True, serialize_by_alias=True)


class Change(_Part):
    """A state that was entered."""

    state: State
    code: Code
    reason: Annotated[str, StringConstraints(min_length=1)]
    stamp_ns: int


class PairSummary(_Part):
    """What was said of one pair."""

    state: State = Field(description="at the end")
    timeline: tuple[Change, ...] = Field(
        description="every change of state or code, the first state included"
    )
    frames: Frames
    last: Status = Field(description="the last status")


class Summary(_Part):
    """What a run said of all pairs."""

    schema_: Literal["calibwatch.summary/1"] = Field(default=SCHEMA, alias="schema")
    state: State = Field(description="at the end: the first in precedence over the pairs")
    complete: bool = Field(description="the input was read to its end")
    note: str
    vehicle: Name
    pairs: dict[Name, PairSummary]
    warnings: tuple[str, ...]


class SummaryFile:
    """Remembers the changes and the last status of every pair; writes them at the end."""

    def __init__(self, folder: Path, vehicle: str) -> None:
        self._path = folder / FILE_NAME
        self._vehicle = vehicle
        self._last: dict[str, Status] = {}
        self._timelines: dict[str, list[Change]] = {}

    @property
    def lost(self) -> str | None:
        """Never: a failed write is raised where it happens."""
        return None

    def handle(self, event: Event) -> None:
        """Takes note of a status; writes the file at the end, whether the run was complete or not."""
        if isinstance(event, StatusEvent):
            self._note(event.status)
        elif isinstance(event, EndEvent):
            write_whole(self._path, self.summary(event).model_dump_json(indent=2).encode() + b"\n")

    def close(self) -> None:
        """Nothing is held."""

    def summary(self, end: EndEvent) -> Summary:
        """What has been said so far."""
        pairs = {
            pair: PairSummary(
                state=status.state,
                timeline=tuple(self._timelines[pair]),
                frames=status.frames,
                last=status,
            )
            for pair, status in sorted(self._last.items())
        }
        return Summary(
            state=first_in_precedence(pair.state for pair in pairs.values()),
            complete=end.complete,
            note=end.note,
            vehicle=self._vehicle,
            pairs=pairs,
            warnings=end.warnings,
        )

    def _note(self, status: Status) -> None:
        timeline = self._timelines.setdefault(status.pair, [])
        last = self._last.get(status.pair)
        if last is None or (last.state, last.code) != (status.state, status.code):
            entered_ns = status.since_ns if last is None or last.state != status.state else status.stamp_ns
            timeline.append(
                Change(state=status.state, code=status.code, reason=status.reason, stamp_ns=entered_ns)
            )
        self._last[status.pair] = status


OUTPUT = OutputKind(
    "summary", "folder", lambda surroundings: SummaryFile(folder_of(surroundings), surroundings.vehicle)
)
