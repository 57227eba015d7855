"""Pairs looked at before their turn, in a thread of its own, while those before them are judged.

What a pair says by itself does not wait for the verdict on the pair before, except where that makes the
watch forget (a gap, a clock that runs back): what was found ahead is then void, and begun anew. Verdicts are
those of one pair after the other.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

from monitor.clock import Clock
from monitor.intake import Accounts, Intake
from monitor.messages import Message
from monitor.sources import Tick
from pipeline.errors import CalibwatchError
from pipeline.frame_evidence import Scout
from pipeline.records import FramePair
from pipeline.watch import Foresight, Watch


@dataclass(frozen=True, slots=True, eq=False)
class Arrival:
    """Something that came, and what the intake made of it.

    Attributes:
        arrival_ns: When, on the clock of the source, ns.
        pairs: What it completed.
        accounts: Of every pair, up to it.
        notes: How many notes the intake had then.
    """

    arrival_ns: int
    pairs: tuple[FramePair, ...]
    accounts: Accounts
    notes: int


@dataclass(frozen=True, slots=True, eq=False)
class Ahead:
    """What was found in a pair before its turn, and what its stages cost: (name, ms)."""

    foresight: Foresight
    spent: tuple[tuple[str, float], ...]


def arrivals(
    messages: Iterable[Message | Tick], intake: Intake, most: int, see: Callable[[FramePair], None]
) -> Iterator[Arrival]:
    """What comes, in its order; read on until ``most`` pairs wait, each shown to ``see`` as it is completed.

    A source that fails does so after all that came before has been given.
    """
    waiting: deque[Arrival] = deque()
    pairs, source, failed = 0, iter(messages), None
    while True:
        try:
            item = next(source)
        except StopIteration:
            break
        except CalibwatchError as error:
            failed = error
            break
        found = tuple(intake.take(item)) if isinstance(item, Message) else ()
        for pair in found:
            see(pair)
        arrival_ns = item.now_ns if isinstance(item, Tick) else item.log_ns
        waiting.append(Arrival(arrival_ns, found, intake.accounts(), len(intake.notes)))
        pairs += len(found)
        while waiting and pairs >= most:
            arrival = waiting.popleft()
            pairs -= len(arrival.pairs)
            yield arrival
    yield from waiting
    if failed is not None:
        raise failed


class Forerunner:
    """Looks at pairs in a thread, one after the other.

    Args:
        watches: Who will judge them, by name of the pair.
        clock: Measures the stages.
    """

    def __init__(self, watches: Mapping[str, Watch], clock: Clock) -> None:
        self._watches = watches
        self._clock = clock
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="lookahead")
        self._runs: dict[str, _Run] = {}
        self._pending: dict[str, deque[tuple[FramePair, Future[Ahead | None]]]] = {}

    def see(self, pair: FramePair) -> None:
        """A pair that will come to its turn."""
        if pair.pair not in self._runs:
            self._begin(pair.pair)
        future = self._worker.submit(self._runs[pair.pair].look, pair)
        self._pending.setdefault(pair.pair, deque()).append((pair, future))

    def take(self, pair: FramePair) -> Ahead | None:
        """What was found in the pair whose turn it is; None where it has to be looked at again."""
        first, future = self._pending[pair.pair].popleft()
        assert first is pair  # noqa: S101 - pairs come to their turn in the order in which they were seen
        if self._void(pair.pair):
            future.cancel()
            return None
        return future.result()

    def settle(self, name: str) -> None:
        """The turn of a pair is over: what was found ahead of something that was forgotten is begun anew."""
        if not self._void(name):
            return
        self._runs[name].void = True
        self._begin(name)
        pending = self._pending[name]
        self._pending[name] = deque()
        for pair, future in pending:
            future.cancel()
            self.see(pair)

    def close(self) -> None:
        """Ends the thread; what it still had to do is left."""
        self._worker.shutdown(cancel_futures=True)

    def _void(self, name: str) -> bool:
        return self._runs[name].breaks != self._watches[name].breaks

    def _begin(self, name: str) -> None:
        watch = self._watches[name]
        self._runs[name] = _Run(watch.scout(), watch.breaks, self._clock)


class _Run:
    """Pairs of one stream from one break to the next."""

    def __init__(self, scout: Scout, breaks: int, clock: Clock) -> None:
        self.breaks = breaks
        self.void = False
        self._scout = scout
        self._clock = clock

    def look(self, pair: FramePair) -> Ahead | None:
        """What the next pair says; None where nobody will ask for it. Called in the thread alone."""
        if self.void:
            return None
        spent: list[tuple[str, float]] = []

        @contextmanager
        def stage(name: str) -> Iterator[None]:
            begun = self._clock.monotonic_ns()
            yield
            spent.append((name, (self._clock.monotonic_ns() - begun) / 1e6))

        evidence = self._scout.look(pair, stage)
        return Ahead(Foresight(evidence, self._scout.copy(), self.breaks), tuple(spent))
