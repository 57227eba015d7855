"""zenoh: sensor messages as they come (DESIGN 6), from rmw_zenoh, zenoh-bridge-ros2dds or what names types.

Every subscription has a ring of its own, so that a slow reader never holds back the session, and a thread
that takes from it into the inbox, which is bounded per topic and counts what it drops. What the rings
overwrite shows as gaps in the publisher's sequence number (attachment of rmw_zenoh, else the number that an
AdvancedPublisher gives), else, estimated, in the stamps.
"""

import logging
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from types import TracebackType
from typing import Self, TypeAlias

import zenoh
import zenoh.ext

from monitor import bus
from monitor.bus_samples import SampleReader, Subscription
from monitor.clock import SystemClock
from monitor.messages import Message, codecs
from monitor.rig import Rig
from monitor.sources import Losses, Tick, TopicInfo
from pipeline.errors import InputError, TransportError

_log = logging.getLogger(__name__)

RING = 16
"""Samples that a ring holds: 1.6 s of a 10 Hz sensor, while its thread copies the one before."""
INBOX = 16
"""Messages per topic that wait for the reader; more would be late rather than useful."""
PERIOD_S = 0.5
"""s; without a message a Tick comes this often: four times within the 2 s after which inputs are stale."""
JOIN_S = 2.0
"""s; a thread that takes longer to end is told of."""
_MOST_TOPICS = 1024
"""Topics that are told apart; a hostile bus may invent any number."""
_MOST_NOTES = 64
"""Sentences about losses; counts tell the rest."""
_LATCHED = 64
"""Samples per key that are asked for from before: every broadcaster of static transforms once."""

_Channel: TypeAlias = zenoh.Handler[zenoh.Sample]
_Samples: TypeAlias = "zenoh.Subscriber[_Channel] | zenoh.ext.AdvancedSubscriber[_Channel]"


def subscriptions(rig: Rig) -> tuple[Subscription, ...]:
    """What a rig listens to: clouds, images, intrinsics, and transforms where it states no extrinsic."""
    wanted: dict[str, Subscription] = {}
    for pair in rig.pairs:
        for topic, kind, latched in (
            (pair.lidar.topic, pair.lidar.type, False),
            (pair.camera.topic, pair.camera.type, False),
            (pair.camera.info, "sensor_msgs/msg/CameraInfo", True),
        ):
            if topic is not None:
                wanted[topic] = Subscription(topic, bus.keys_of(topic), kind, latched)
        if pair.T_cam_lidar is None and pair.store is None:
            for topic in ("/tf_static", "/tf"):
                keys = bus.keys_of(topic)
                wanted[topic] = Subscription(topic, keys, "tf2_msgs/msg/TFMessage", latched=True)
    return tuple(wanted.values())


class Inbox:
    """Messages between the bus and the reader: bounded per topic, the oldest goes, all is counted.

    Args:
        losses: Where losses are counted; guarded by the inbox.
        per_topic: Messages of one topic that wait at most.
    """

    def __init__(self, losses: Losses, *, per_topic: int = INBOX) -> None:
        self._losses = losses
        self._per_topic = per_topic
        self._condition = threading.Condition()
        self._waiting: deque[Message] = deque()
        self._counts: Counter[str] = Counter()
        self._seen: dict[str, tuple[str, int, int, int]] = {}
        self._closed = False

    @property
    def closed(self) -> bool:
        """Whether :meth:`close` was called."""
        with self._condition:
            return self._closed

    def put(self, message: Message) -> None:
        """Takes a message; the oldest of its topic goes when that has too many waiting."""
        with self._condition:
            if message.topic not in self._seen and len(self._seen) >= _MOST_TOPICS:
                self._losses.add("too_many_topics")
                return
            if self._counts[message.topic] >= self._per_topic:
                oldest = next(i for i, old in enumerate(self._waiting) if old.topic == message.topic)
                del self._waiting[oldest]
                self._counts[message.topic] -= 1
                self._losses.add("queue_overflow")
            self._waiting.append(message)
            self._counts[message.topic] += 1
            _, count, first_ns, _ = self._seen.get(message.topic, ("", 0, message.log_ns, 0))
            self._seen[message.topic] = (message.type, count + 1, first_ns, message.log_ns)
            self._condition.notify()

    def lose(self, reason: str, number: int = 1, note: str = "") -> None:
        """Counts a loss; the same note is kept once."""
        with self._condition:
            self._losses.add(reason, number)
            if note and note not in self._losses.notes and len(self._losses.notes) < _MOST_NOTES:
                self._losses.notes.append(note)

    def take(self, timeout_s: float) -> Message | None:
        """The oldest message; None when none came in time, or the inbox is closed and empty."""
        with self._condition:
            self._condition.wait_for(lambda: self._waiting or self._closed, timeout_s)
            if not self._waiting:
                return None
            message = self._waiting.popleft()
            self._counts[message.topic] -= 1
            return message

    def close(self) -> None:
        """Wakes the reader; what waits may still be taken."""
        with self._condition:
            self._closed = True
            self._condition.notify_all()

    def describe(self, wanted: Mapping[str, str | None]) -> tuple[TopicInfo, ...]:
        """Topics that came, with counts, and wanted ones that did not."""
        with self._condition:
            seen = dict(self._seen)
        found = [
            TopicInfo(topic, kind or "", 0, None, understood=kind in codecs())
            for topic, kind in wanted.items()
            if topic not in seen
        ]
        for topic, (kind, count, first_ns, last_ns) in seen.items():
            rate = (count - 1) * 1e9 / (last_ns - first_ns) if last_ns > first_ns else None
            found.append(TopicInfo(topic, kind, count, rate, understood=kind in codecs()))
        return tuple(sorted(found, key=lambda topic: topic.name))


class ZenohLive:
    """Messages from the bus.

    Args:
        session: An open session.
        wanted: What to listen to.
        now_ns: The clock that stamps what arrives, and Ticks, ns.
        stop: Ends the iteration, at the latest after ``period_s``.
        period_s: Without a message a Tick comes this often, s.
        owns_session: Whether leaving the source closes the session.
    """

    def __init__(
        self,
        session: zenoh.Session,
        wanted: tuple[Subscription, ...],
        *,
        now_ns: Callable[[], int],
        stop: threading.Event,
        period_s: float = PERIOD_S,
        owns_session: bool = False,
    ) -> None:
        self.losses = Losses()
        self._session = session
        self._wanted = wanted
        self._now_ns = now_ns
        self._stop = stop
        self._period_s = period_s
        self._inbox = Inbox(self.losses)
        self._stack = ExitStack()
        if owns_session:
            self._stack.enter_context(session)

    def __enter__(self) -> Self:
        try:
            for subscription in self._wanted:
                for key in subscription.keys:
                    self._listen(subscription, key)
        except zenoh.ZError as error:
            self._stack.close()
            raise TransportError(
                "the bus refuses a subscription", hint="is the session still open?"
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Undeclares what was declared and joins the threads."""
        self._inbox.close()
        self._stack.close()

    def __iter__(self) -> Iterator[Message | Tick]:
        while not self._stop.is_set():
            message = self._inbox.take(self._period_s)
            if message is not None:
                yield message
            elif self._inbox.closed or self._stop.is_set():
                return
            else:
                yield Tick(self._now_ns())

    def describe(self) -> tuple[TopicInfo, ...]:
        """What came so far, and what was asked for and did not come."""
        return self._inbox.describe({sub.topic: sub.type for sub in self._wanted if sub.topic is not None})

    def rig_document(self) -> dict[str, object] | None:
        """None: a bus carries no rig but tf and CameraInfo."""
        return None

    def _listen(self, subscription: Subscription, key: str) -> None:
        """Declares one subscriber and starts its thread; both end with the source."""
        samples = self._declare(key, latched=subscription.latched)
        reader = SampleReader(self._session, subscription, self._now_ns)
        thread = threading.Thread(target=self._run, args=(samples, reader), name=f"zenoh {key}", daemon=True)
        thread.start()
        self._stack.callback(thread.join, JOIN_S)
        self._stack.callback(samples.undeclare)

    def _declare(self, key: str, *, latched: bool) -> _Samples:
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(RING)
        if not latched:
            return self._session.declare_subscriber(key, ring)
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=_LATCHED)
        return zenoh.ext.declare_advanced_subscriber(self._session, key, ring, history=history)

    def _run(self, samples: _Samples, reader: SampleReader) -> None:
        """Until the subscriber is undeclared; a fault of ours ends this input and is told."""
        try:
            for sample in samples:
                if sample.kind == zenoh.SampleKind.PUT:
                    self._take(sample, reader)
        except Exception as error:  # noqa: BLE001 - top of a thread: reported, and the input ends
            _log.exception("an input of the bus ended")
            self._inbox.lose("input_ended", note=f"{threading.current_thread().name} ended: {error}")

    def _take(self, sample: zenoh.Sample, reader: SampleReader) -> None:
        try:
            message = reader.message(sample)
        except InputError as error:
            self._inbox.lose("undecodable", note=str(error))
            return
        missing, estimated = reader.lost_before(sample, message)
        if missing:
            self._inbox.lose("bus_gap_estimated" if estimated else "bus_gap", missing)
        self._inbox.put(message)


class ZenohKind:
    """Kind of source: an endpoint of a zenoh router or peer, everything that is published there."""

    name = "zenoh_live"

    def matches(self, location: str) -> bool:
        """An endpoint such as ``tcp/127.0.0.1:7447``."""
        return location.partition("/")[0] in bus.PROTOCOLS and "/" in location

    def open(self, location: str) -> ZenohLive:
        """Connects as a client and listens to every key that says its type."""
        session = bus.open_session(bus.BusSettings(connect=(location,)))
        everything = Subscription(topic=None, keys=("**",))
        return ZenohLive(
            session, (everything,), now_ns=SystemClock().wall_ns, stop=threading.Event(), owns_session=True
        )


SOURCE = ZenohKind()
