"""``summary.json``, ``calibwatch.summary/1``: what a run said, in one small file that a program reads."""

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from monitor.candidate_file import SUFFIX
from monitor.events import EndEvent, Event, ProposalEvent, StatusEvent
from monitor.outputs import OutputKind, folder_of, write_whole
from monitor.outputs._history import Change, History
from monitor.parts import Parts
from monitor.status import Frames, Name, State, Status, first_in_precedence

FILE_NAME = "summary.json"

SCHEMA: Literal["calibwatch.summary/1"] = "calibwatch.summary/1"


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", validate_by_name=True, serialize_by_alias=True)


class Proposed(_Part):
    """What was proposed for a pair whose mount has moved."""

    file: str | None = Field(description="the candidate beside this file; null: nothing is proposed")
    hash: str | None = Field(description="of the candidate, as in its file")
    reason: str = Field(description="why nothing is proposed; empty where something is")


class PairSummary(_Part):
    """What was said of one pair."""

    state: State = Field(description="at the end")
    timeline: tuple[Change, ...] = Field(
        description="every change of state or code, the first state included"
    )
    frames: Frames
    candidate: Proposed | None = Field(default=None, description="null: no drift stands")
    last: Status = Field(description="the last status")


class Summary(_Part):
    """What a run said of all pairs."""

    schema_: Literal["calibwatch.summary/1"] = Field(default=SCHEMA, alias="schema")
    state: State = Field(description="at the end: the first in precedence over the pairs")
    complete: bool = Field(description="the input was read to its end")
    note: str
    vehicle: Name
    pairs: dict[Name, PairSummary]
    parts: tuple[Parts, ...] = Field(
        default=(), description="which part has moved, for each LiDAR that several pairs share"
    )
    warnings: tuple[str, ...]


class SummaryFile:
    """Remembers the changes and the last status of every pair; writes them at the end."""

    def __init__(self, folder: Path, vehicle: str) -> None:
        self._path = folder / FILE_NAME
        self._vehicle = vehicle
        self._histories: dict[str, History] = {}
        self._proposed: dict[str, Proposed] = {}

    @property
    def lost(self) -> str | None:
        """Never: a failed write is raised where it happens."""
        return None

    def handle(self, event: Event) -> None:
        """Takes note of a status; writes the file at the end, whether the run was complete or not."""
        if isinstance(event, StatusEvent):
            status = event.status
            self._histories.setdefault(status.pair, History(status)).note(status)
        elif isinstance(event, ProposalEvent):
            document = event.document
            self._proposed[event.pair] = Proposed(
                file=None if document is None else f"{event.pair}{SUFFIX}",
                hash=None if document is None else document.hash,
                reason=event.reason,
            )
        elif isinstance(event, EndEvent):
            write_whole(self._path, self.summary(event).model_dump_json(indent=2).encode() + b"\n")

    def close(self) -> None:
        """Nothing is held."""

    def summary(self, end: EndEvent) -> Summary:
        """What has been said so far."""
        pairs = {
            pair: PairSummary(
                state=history.last.state,
                timeline=history.timeline,
                frames=history.last.frames,
                candidate=self._proposed.get(pair) if history.last.severity is not None else None,
                last=history.last,
            )
            for pair, history in sorted(self._histories.items())
        }
        return Summary(
            state=first_in_precedence(pair.state for pair in pairs.values()),
            complete=end.complete,
            note=end.note,
            vehicle=self._vehicle,
            pairs=pairs,
            parts=end.parts,
            warnings=end.warnings,
        )


OUTPUT = OutputKind(
    "summary", "folder", lambda surroundings: SummaryFile(folder_of(surroundings), surroundings.vehicle)
)
