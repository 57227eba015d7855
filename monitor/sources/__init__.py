"""Sources: where messages come from. Every module here offers ``SOURCE`` (a :class:`SourceKind`).

A source is opened once and iterated once; it yields :class:`~monitor.messages.Message` in the order of log
time, and :class:`Tick` when nothing came for a period (live sources only). It is a context manager: leaving
it frees the file.
"""

import importlib
import pkgutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

from monitor.messages import Message
from pipeline.errors import InputError


@dataclass(frozen=True, slots=True)
class Tick:
    """Nothing came for a period: ``now_ns`` is the clock of the source's stamps as far as it is known."""

    now_ns: int


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """What ``inspect`` tells of one topic.

    Attributes:
        name: Topic or folder.
        type: Type name of its messages.
        count: Number of messages, or None where the source can not know.
        rate_hz: Mean rate, or None.
        understood: Whether a codec exists.
    """

    name: str
    type: str
    count: int | None
    rate_hz: float | None
    understood: bool


@dataclass(slots=True)
class Losses:
    """What a source could not give: reason -> how many; ``notes`` are one-line sentences for people."""

    counts: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, reason: str, number: int = 1) -> None:
        """Counts a loss under a reason."""
        self.counts[reason] = self.counts.get(reason, 0) + number


class Source(Protocol):
    """An open source."""

    losses: Losses

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def __iter__(self) -> Iterator[Message | Tick]: ...

    def describe(self) -> tuple[TopicInfo, ...]:
        """The topics of this source."""

    def rig_document(self) -> dict[str, object] | None:
        """The rig that the recording carries in itself (``calib.json``, KITTI calib files), or None.

        In the form of the rig file of DESIGN 3 or of ``calib.json``; ``monitor.rig`` parses it.
        """


class SourceKind(Protocol):
    """One kind of source."""

    name: str

    def matches(self, location: str) -> bool:
        """Whether ``location`` (a path, or for live sources an endpoint) is of this kind; reads little."""

    def open(self, location: str) -> Source:
        """Opens it; InputError names what is wrong."""


@cache
def kinds() -> tuple[SourceKind, ...]:
    """Every kind of source in this folder, in the order of their names."""
    modules = [importlib.import_module(f"{__name__}.{m.name}") for m in pkgutil.iter_modules(__path__)]
    return tuple(module.SOURCE for module in modules)


def open_source(location: str) -> Source:
    """The source that ``location`` is; InputError says what would be accepted."""
    if not location:
        raise InputError("the name of the recording is empty", hint="name a file or a folder")
    for kind in kinds():
        if kind.matches(location):
            return kind.open(location)
    if not Path(location).exists():
        raise InputError(f"{location} does not exist", hint="name a recording: a file or a folder")
    raise InputError(
        f"{location} is not a recording that is understood",
        hint="understood: .mcap, .bag, rosbag2 folder, KITTI raw drive folder, folder with calib.json",
    )
