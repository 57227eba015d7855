"""A process beside the one that judges: it looks at the pairs that it is given, one after the other.

It ends when nobody is at the other end of its link any more.
"""

import os
import select
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

from monitor.clock import SystemClock
from monitor.handover import give, link, receive, share
from monitor.memory import keep_freed
from monitor.threads import one_thread
from pipeline.frame_evidence import Glimpse, Scout, Stage
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import FramePair
from pipeline.segmentation import Segmenter

Equipment = tuple[Mount, Parameters, Segmenter | None]
"""What a scout is made of and never changes."""

_PATIENCE_S = 0.0
"""s to wait for the process to be there: pairs are looked at without it meanwhile."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """What was found in a pair, the scout that goes on after it, and what the stages cost: (name, ms)."""

    glimpse: Glimpse
    scout: Scout
    spent: tuple[tuple[str, float], ...]


class Lookout:
    """The process, as the one that judges has it; it begins with what it will need anyway."""

    def __init__(self) -> None:
        self._known: dict[str, object] = {}
        self._asked: deque[tuple[int, FramePair]] = deque()
        self._count = 0
        self._there = False
        self._lost = False
        self._end, other = link()
        self._process: subprocess.Popen[bytes] | None = None
        with other:
            try:
                self._process = _started(other)
            except OSError:
                self._lost = True

    def equip(self, equipment: Mapping[str, Equipment]) -> None:
        """Tells it, once, what every pair's scout is made of, by name of the pair."""
        self._known = _named(equipment)
        self._tell(dict(equipment), {})

    def ready(self) -> bool:
        """Whether it is there."""
        if not self._there and not self._lost and select.select([self._end], [], [], _PATIENCE_S)[0]:
            self._there = self._heard({}) is not None
        return self._there and not self._lost

    def begin(self, name: str, scout: Scout) -> None:
        """The pairs of this name that follow are looked at by this scout."""
        self._tell((name, scout), self._known)

    def ask(self, pair: FramePair) -> tuple[FramePair, int]:
        """Gives it a pair to look at: the pair as both have it, and the number of the question."""
        if not self._lost:
            try:
                pair = share(self._end, pair, {})
            except OSError:
                self._lost = True
        self._count += 1
        self._asked.append((self._count, pair))
        return pair, self._count

    def answer(self, number: int) -> Seen | None:
        """Waits for what was found in a pair; None where it failed, or has failed before."""
        found: Seen | None = None
        if not self._there:
            self._there = self._heard({}) is not None
        while self._asked and self._asked[0][0] <= number:
            asked, pair = self._asked.popleft()
            answer = self._heard({**self._known, **_arrays(pair)})
            found = answer if isinstance(answer, Seen) and asked == number else None
        return found

    def close(self) -> None:
        """Ends it."""
        self._end.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def _tell(self, value: object, known: Mapping[str, object]) -> None:
        if self._lost:
            return
        try:
            give(self._end, value, known)
        except OSError:
            self._lost = True

    def _heard(self, known: Mapping[str, object]) -> object:
        if self._lost:
            return None
        try:
            return receive(self._end, known)
        except (EOFError, OSError):
            self._lost = True
            return None


def _started(end: socket.socket) -> "subprocess.Popen[bytes]":
    """The process, with its end of the link."""
    return subprocess.Popen(  # noqa: S603 - this very interpreter
        [sys.executable, "-c", f"from {__name__} import main; main()", str(end.fileno())],
        pass_fds=[end.fileno()],
        # It finds what this process has found, and a terminal's interrupt is not for it.
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        start_new_session=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def main() -> None:
    """The process itself; its argument is the number of its end of the link."""
    keep_freed()
    with one_thread(), socket.socket(fileno=int(sys.argv[1])) as end:
        try:
            _serve(end)
        except (EOFError, OSError):
            return


def _serve(end: socket.socket) -> None:
    known = _named(receive(end, {}))
    give(end, "ready", {})
    scouts: dict[str, Scout | None] = {}
    while True:
        asked = receive(end, known)
        if isinstance(asked, FramePair):
            try:
                found = _look(scouts.get(asked.pair), asked)
            except Exception:  # noqa: BLE001 - the other side looks at the pair itself, and meets it there
                found = None
            if found is None:
                scouts[asked.pair] = None
            give(end, found, {**known, **_arrays(asked)})
        else:
            name, scout = asked
            scouts[name] = scout


def _look(scout: Scout | None, pair: FramePair) -> Seen | None:
    if scout is None:
        return None
    stage, spent = measured()
    return Seen(scout.glimpse(pair, stage), scout, tuple(spent))


def measured() -> tuple[Stage, list[tuple[str, float]]]:
    """Measures stages, and what they cost as it is known: (name, ms)."""
    spent: list[tuple[str, float]] = []
    clock = SystemClock()

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        begun = clock.monotonic_ns()
        yield
        spent.append((name, (clock.monotonic_ns() - begun) / 1e6))

    return stage, spent


def _named(equipment: Mapping[str, Equipment]) -> dict[str, object]:
    """The parts of the equipment, named."""
    return {f"{name}/{k}": part for name, parts in equipment.items() for k, part in enumerate(parts)}


def _arrays(pair: FramePair) -> dict[str, object]:
    """The arrays of a pair, named: both sides have them."""
    cloud = pair.cloud
    return {
        "xyz": cloud.xyz,
        "intensity": cloud.intensity,
        "ring": cloud.ring,
        "time": cloud.time,
        "pixels": pair.image.pixels,
    }
