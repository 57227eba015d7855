"""Pairs looked at before their turn, in a process of its own, while those before them are judged.

What a pair says by itself does not wait for the verdict on the pair before, except where that makes the
watch forget (a gap, a clock that runs back): what was found ahead is then void, and begun anew. Verdicts are
those of one pair after the other. Where there is no other process, or it fails, pairs are looked at in turn.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass

from monitor.intake import Accounts, Intake
from monitor.lookout import Lookout, measured
from monitor.messages import Message
from monitor.sources import Tick
from monitor.threads import one_thread
from pipeline.errors import CalibwatchError
from pipeline.records import FramePair
from pipeline.watch import Foresight, Watch

_MOST_WAITING = 4096
"""Arrivals that are kept while pairs are awaited: a sensor may be missing for long, and others go on."""


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
    messages: Iterable[Message | Tick], intake: Intake, most: int, see: Callable[[FramePair], FramePair]
) -> Iterator[Arrival]:
    """What comes, in its order; read on until ``most`` pairs wait.

    A pair is shown to ``see`` when it is completed, and kept as that gives it. A source that fails does so
    after all that came before has been given.
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
        found = tuple(see(pair) for pair in intake.take(item)) if isinstance(item, Message) else ()
        arrival_ns = item.now_ns if isinstance(item, Tick) else item.log_ns
        waiting.append(Arrival(arrival_ns, found, intake.accounts(), len(intake.notes)))
        pairs += len(found)
        while waiting and (pairs >= most or len(waiting) > _MOST_WAITING):
            arrival = waiting.popleft()
            pairs -= len(arrival.pairs)
            yield arrival
    yield from waiting
    if failed is not None:
        raise failed


class Forerunner:
    """Has pairs looked at, one after the other.

    Args:
        most: Pairs that are read before the first of them is judged.
        expected: Pairs that will come, where that is known: a process that is worth it begins at once.
    """

    def __init__(self, most: int, expected: int | None = None) -> None:
        self.most = most
        self._watches: Mapping[str, Watch] = {}
        self._seen = 0
        self._lookout: Lookout | None = None
        self._threads: ExitStack = ExitStack()
        self._breaks: dict[str, int] = {}
        self._pending: dict[str, deque[tuple[FramePair, int | None]]] = {}
        if expected is not None and expected >= _WORTH_A_PROCESS:
            self._begin()

    def serve(self, watches: Mapping[str, Watch]) -> None:
        """Names those who will judge, by name of the pair; before the first pair."""
        self._watches = watches
        if self._lookout is not None:
            self._equip(self._lookout)
            # It may still be beginning: what is asked waits for it, and this process for the first answer.
            for name in watches:
                self._look_from_here(self._lookout, name)

    def see(self, pair: FramePair) -> FramePair:
        """A pair that will come to its turn; gives it as it is to be kept until then."""
        self._seen += 1
        if self._lookout is None and self._seen == _WORTH_A_PROCESS:
            self._equip(self._begin())
        number = None
        if self._lookout is not None and self._holds(pair.pair):
            pair, number = self._lookout.ask(pair)
        self._pending.setdefault(pair.pair, deque()).append((pair, number))
        return pair

    def take(self, pair: FramePair) -> Ahead | None:
        """What was found in the pair whose turn it is; None where it has to be looked at now."""
        first, number = self._pending[pair.pair].popleft()
        assert first is pair  # noqa: S101 - pairs come to their turn in the order in which they were seen
        if self._lookout is None or number is None:
            return None
        found = self._lookout.answer(number)
        if found is None:
            self._breaks.pop(pair.pair, None)
            return None
        breaks = self._breaks.get(pair.pair)
        if breaks is None or not self._holds(pair.pair):
            return None
        # Edges are found on this side: what remains on the other is still the longer part.
        stage, spent = measured()
        evidence = found.scout.with_edges(found.glimpse, stage)
        return Ahead(Foresight(evidence, found.scout, breaks), (*found.spent, *spent))

    def settle(self, name: str) -> None:
        """The turn of a pair is over: what was found ahead of something that was forgotten is begun anew."""
        if self._holds(name) or self._lookout is None or not self._lookout.ready():
            return
        self._look_from_here(self._lookout, name)
        pending = self._pending[name]
        # They come to their turn as they were kept before.
        self._pending[name] = deque((pair, self._lookout.ask(pair)[1]) for pair, _ in pending)

    def close(self) -> None:
        """Ends the process; what it still had to do is left."""
        if self._lookout is not None:
            self._lookout.close()
        self._threads.close()

    def _begin(self) -> Lookout:
        self._lookout = Lookout()
        # Two processes have two cores to themselves.
        self._threads.enter_context(one_thread())
        return self._lookout

    def _equip(self, lookout: Lookout) -> None:
        watches = self._watches.items()
        lookout.equip({name: (watch.mount, watch.parameters, watch.segmenter) for name, watch in watches})
        for watch in self._watches.values():
            if watch.segmenter is not None:
                watch.segmenter.rest()

    def _look_from_here(self, lookout: Lookout, name: str) -> None:
        """The pairs of this name that follow are looked at by a scout that goes on from where this one is."""
        watch = self._watches[name]
        lookout.begin(name, watch.scout())
        self._breaks[name] = watch.breaks

    def _holds(self, name: str) -> bool:
        """Whether what is found ahead is what will be asked for."""
        return self._breaks.get(name) == self._watches[name].breaks


_WORTH_A_PROCESS = 25
"""Pairs; a process needs the time of some 20 of them to be there."""
