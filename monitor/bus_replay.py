"""Recordings over the bus: a writer that publishes a source, a reader that is a source again.

No message is lost when the reader acknowledges (``pace`` None): the writer has at most WINDOW messages in
flight, which is less than any ring or inbox on the way holds, and waits for the reader to have CONSUMED
the earlier ones; it publishes with congestion control BLOCK and starts when the reader's token says that
it listens. One subscription carries all topics, so their order is that of the recording. An end marker
carries the number of messages and what the source lost; a reader that does not get it says so.
"""

import json
import threading
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import zenoh

from monitor import bus
from monitor.bus_samples import Subscription, encoding_of
from monitor.messages import Message
from monitor.sources import Losses, Source, Tick, TopicInfo
from monitor.sources.zenoh_live import JOIN_S, ZenohLive
from pipeline.errors import CalibwatchError, TransportError

WINDOW = 8
"""Messages in flight: half of what a ring (RING) or a topic of the inbox (INBOX) holds."""
READER_S = 10.0
"""s; how long a writer waits for a reader, and a reader for its acknowledgement to count."""
_ROUTE_S = 0.01
"""s; how often a writer looks whether its session knows the reader's subscription."""
_END_TYPE = "calibwatch.replay-end/1"
_END_ENCODING = f"application/json;{_END_TYPE}"


@dataclass(frozen=True, slots=True)
class Pace:
    """At the recorded rate.

    Attributes:
        factor: Times the recorded rate, > 0.
        monotonic_s: A clock that never jumps, s.
    """

    factor: float
    monotonic_s: Callable[[], float]


class ReplayWriter:
    """Publishes recordings.

    Args:
        session: An open session.
        run: Name of the replay, one chunk of a key.
        stop: Ends the publishing.
        pace: The recorded rate times a factor, dropping what the reader does not take in time; None: as
            fast as the reader acknowledges, losing nothing.
    """

    def __init__(
        self, session: zenoh.Session, run: str, *, stop: threading.Event, pace: Pace | None = None
    ) -> None:
        self._session = session
        self._run = run
        self._prefix = bus.replay_prefix(run)
        self._stop = stop
        self._pace = pace
        self._gid = uuid.uuid4().bytes
        self._numbers: Counter[str] = Counter()
        self._condition = threading.Condition()
        self._acknowledged = 0
        self._reading = False
        self._pause = threading.Event()

    def publish(self, source: Source) -> int:
        """Publishes a source from start to end; gives the number of messages.

        Raises:
            TransportError: Nobody reads, or the reader went away.
        """
        sent = 0
        start: tuple[int, float] | None = None
        with ExitStack() as stack:
            liveliness = self._session.liveliness()
            stack.callback(liveliness.declare_token(f"{self._prefix}/writer").undeclare)
            acks = self._session.declare_subscriber(f"{self._prefix}/ack", _ring())
            self._follow(stack, acks, self._on_ack)
            readers = liveliness.declare_subscriber(f"{self._prefix}/reader", _ring(), history=True)
            self._follow(stack, readers, self._on_reader)
            self._await(lambda: self._reading, f"nobody reads {self._prefix}")
            ending = self._session.declare_publisher(
                f"{self._prefix}/feed/end",
                encoding=_END_ENCODING,
                congestion_control=zenoh.CongestionControl.BLOCK,
            )
            stack.callback(ending.undeclare)
            self._await_route(ending)
            for message in source:
                if self._stop.is_set():
                    return sent
                if isinstance(message, Tick):
                    continue
                if self._pace is None:
                    self._await_credit(sent)
                else:
                    start = self._await_time(message.log_ns, start, self._pace)
                self._put(message)
                sent += 1
            if self._pace is None:
                self._await_credit(sent)
            end = {"messages": sent, "counts": source.losses.counts, "notes": source.losses.notes}
            ending.put(json.dumps(end))
            self._await(
                lambda: self._acknowledged > sent or not self._reading,
                f"{self._prefix} was not read to its end",
            )
        return sent

    def _put(self, message: Message) -> None:
        key = bus.replay_key(self._run, message.topic)
        origin = bus.Origin(self._numbers[key], message.log_ns, self._gid)
        self._numbers[key] += 1
        lossless = self._pace is None
        self._session.put(
            key,
            message.data,
            encoding=encoding_of(message),
            attachment=origin.to_bytes(),
            congestion_control=zenoh.CongestionControl.BLOCK if lossless else zenoh.CongestionControl.DROP,
        )

    def _follow(
        self,
        stack: ExitStack,
        samples: "zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]",
        take: Callable[[zenoh.Sample], None],
    ) -> None:
        """Hands samples to ``take`` in a thread of our own, which ends with the stack.

        Callbacks of zenoh run in threads that may outlive the session and abort the interpreter at its exit.
        """

        def run() -> None:
            for sample in samples:
                take(sample)

        thread = threading.Thread(target=run, name=f"zenoh {samples.key_expr}", daemon=True)
        thread.start()
        stack.callback(thread.join, JOIN_S)
        stack.callback(samples.undeclare)

    def _await_route(self, ending: zenoh.Publisher) -> None:
        """Until this session knows the reader's subscription: its token may be known a moment earlier."""
        for _ in range(round(READER_S / _ROUTE_S)):
            status = ending.matching_status
            if status.matching or self._stop.is_set():  # type: ignore[attr-defined]  # the stub says bool
                return
            self._pause.wait(_ROUTE_S)
        raise TransportError(
            f"the reader of {self._prefix} has no subscription", hint="start the reader first"
        )

    def _await_credit(self, sent: int) -> None:
        """Until fewer than WINDOW messages are in flight, or the reader is gone or the stop is set."""
        with self._condition:
            while sent - self._acknowledged >= WINDOW and not self._stop.is_set():
                if not self._reading:
                    raise TransportError(f"the reader of {self._prefix} went away after {sent} messages")
                self._condition.wait(0.2)

    def _await_time(self, log_ns: int, start: tuple[int, float] | None, pace: Pace) -> tuple[int, float]:
        """Until a message is due; gives the first log time and when it was published."""
        now = pace.monotonic_s()
        if start is None:
            return log_ns, now
        due = start[1] + (log_ns - start[0]) * 1e-9 / pace.factor
        self._stop.wait(max(0.0, due - now))
        return start

    def _await(self, condition: Callable[[], bool], refusal: str) -> None:
        with self._condition:
            if not self._condition.wait_for(lambda: condition() or self._stop.is_set(), READER_S):
                raise TransportError(refusal, hint="start the reader first")

    def _on_ack(self, sample: zenoh.Sample) -> None:
        text = sample.payload.to_bytes()[:20]
        with self._condition:
            if text.isdigit():
                self._acknowledged = max(self._acknowledged, int(text))
            self._condition.notify_all()

    def _on_reader(self, sample: zenoh.Sample) -> None:
        with self._condition:
            self._reading = sample.kind == zenoh.SampleKind.PUT
            self._condition.notify_all()


class ReplayReader:
    """A recording that is replayed over the bus, as a source.

    Args:
        session: An open session.
        run: Name of the replay, as the writer has it.
        stop: Ends the iteration.
    """

    def __init__(self, session: zenoh.Session, run: str, *, stop: threading.Event) -> None:
        self._session = session
        self._prefix = bus.replay_prefix(run)
        feed = Subscription(topic=None, keys=(f"{self._prefix}/feed/**",))
        # Ticks only tell when to look after the writer; they carry no time of the data.
        self._live = ZenohLive(session, (feed,), now_ns=lambda: 0, stop=stop)
        self.losses = self._live.losses
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(self._live)
            token = self._session.liveliness().declare_token(f"{self._prefix}/reader")
            stack.callback(token.undeclare)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Withdraws the token and the subscription; the session stays open."""
        self._stack.close()

    def __iter__(self) -> Iterator[Message]:
        consumed = 0
        for item in self._live:
            if isinstance(item, Tick):
                if consumed and not self._writer_lives():
                    raise TransportError(
                        f"the replay ended after {consumed} messages, before its recording did",
                        hint="the replaying side was stopped or lost the bus",
                    )
                # An acknowledgement may have come before the writer's subscription was known here.
                self._acknowledge(consumed)
                continue
            if item.type == _END_TYPE:
                self._end(item, consumed)
                self._acknowledge(consumed + 1)
                return
            yield item
            consumed += 1
            self._acknowledge(consumed)

    def describe(self) -> tuple[TopicInfo, ...]:
        """What came so far."""
        return tuple(topic for topic in self._live.describe() if topic.type != _END_TYPE)

    def rig_document(self) -> dict[str, object] | None:
        """None: the rig comes from where the recording lies."""
        return None

    def _acknowledge(self, consumed: int) -> None:
        self._session.put(
            f"{self._prefix}/ack",
            str(consumed),
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )

    def _writer_lives(self) -> bool:
        replies = self._session.liveliness().get(f"{self._prefix}/writer", timeout=1.0)
        return any(reply.ok is not None for reply in replies)

    def _end(self, marker: Message, consumed: int) -> None:
        """Takes over what the writer's source lost, and tells what is missing."""
        try:
            told = json.loads(marker.data)
            sent, counts, notes = (
                int(told["messages"]),
                dict(told["counts"]),
                [str(note) for note in told["notes"]],
            )
        except (ValueError, KeyError, TypeError, RecursionError):
            self.losses.notes.append("the end marker of the replay is damaged")
            return
        for reason, number in counts.items():
            self.losses.add(str(reason)[:64], int(number))
        self.losses.notes += notes
        if sent != consumed:
            self.losses.notes.append(f"{consumed} of {sent} replayed messages came over the bus")


def _ring() -> "zenoh.handlers.RingChannel[zenoh.Sample]":
    """The newest samples; acknowledgements and tokens are worth only their latest state."""
    return zenoh.handlers.RingChannel(4)


class OverBus:
    """A source, read through two real sessions on the loopback: what ``replay --over-zenoh`` runs on.

    Args:
        source: The recording; it is opened and closed with this one.
        run: Name of the replay, one chunk of a key.
    """

    def __init__(self, source: Source, run: str) -> None:
        self.losses = Losses()
        self._source = source
        self._run = run
        self._stop = threading.Event()
        self._failure: CalibwatchError | None = None
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(self._source)
            hub = stack.enter_context(
                bus.open_session(bus.BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",)))
            )
            spoke = stack.enter_context(
                bus.open_session(bus.BusSettings(mode="peer", connect=bus.listening_at(hub)))
            )
            self._reader = ReplayReader(spoke, self._run, stop=self._stop)
            self.losses = self._reader.losses
            writer = ReplayWriter(hub, self._run, stop=self._stop)
            thread = threading.Thread(target=self._write, args=(writer,), name="replay writer", daemon=True)
            stack.callback(thread.join, READER_S)
            stack.enter_context(self._reader)
            stack.callback(self._stop.set)
            thread.start()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops the writer, closes both sessions and the source."""
        self._stack.close()

    def __iter__(self) -> Iterator[Message]:
        try:
            yield from self._reader
        except TransportError:
            # The writer's own failure says more than its silence.
            if self._failure is None:
                raise
        if self._failure is not None:
            raise self._failure

    def describe(self) -> tuple[TopicInfo, ...]:
        """What the recording describes."""
        return self._source.describe()

    def rig_document(self) -> dict[str, object] | None:
        """What the recording carries."""
        return self._source.rig_document()

    def _write(self, writer: ReplayWriter) -> None:
        try:
            writer.publish(self._source)
        except CalibwatchError as error:
            self._failure = error
            self._stop.set()
