"""The status on the bus (zenoh): published, asked for, and a token that says that the watch is alive.

Keys: ``calibwatch/<vehicle>/<pair>/status`` carries each status as JSON from an advanced publisher, whose
cache gives late subscribers the last ones. A query on that key (``*`` for all pairs) is answered with the
last status of each pair; with the parameter ``from_seq=N`` with a JSON array of those from sequence number N
on, as far back as they are kept: that is how a fleet fetches what was said while the link was down.
``calibwatch/<vehicle>/alive`` is a liveliness token.
"""

import logging
import threading
from collections import deque
from typing import TYPE_CHECKING

import zenoh
import zenoh.ext

from monitor.bus import alive_key, every_pair_key, pair_key
from monitor.events import Event, StatusEvent
from monitor.outputs import OutputKind, session_of
from pipeline.errors import TransportError

if TYPE_CHECKING:
    from monitor.status import Status

_LOG = logging.getLogger(__name__)

_CACHED = 16
"""statuses per pair that a late advanced subscriber gets by itself."""

_KEPT = 3600
"""statuses per pair that can be asked for by sequence number; an hour, some 6 MB."""

_LONGEST_NUMBER = 18
"""digits of a sequence number in a query; more would cost time and mean nothing."""


class StatusBus:
    """Speaks on an open session, which the caller owns and closes after this.

    Args:
        session: The session.
        vehicle: Name of the vehicle, one chunk of a key.
    """

    def __init__(self, session: zenoh.Session, vehicle: str) -> None:
        self._session = session
        self._vehicle = vehicle
        self._lock = threading.Lock()
        self._said: dict[str, deque[Status]] = {}
        self._publishers: dict[str, zenoh.ext.AdvancedPublisher] = {}
        try:
            self._queryable = session.declare_queryable(every_pair_key(vehicle, "status"), self._answer)
            self._token = session.liveliness().declare_token(alive_key(vehicle))
        except zenoh.ZError as error:
            raise TransportError("the status can not be declared on the bus") from error

    @property
    def lost(self) -> str | None:
        """Never: the session reconnects by itself, and a failed put is raised where it happens."""
        return None

    def handle(self, event: Event) -> None:
        """Publishes a status; TransportError where the session is closed."""
        if not isinstance(event, StatusEvent):
            return
        status = event.status
        key = self._key(status.pair)
        with self._lock:
            self._said.setdefault(status.pair, deque(maxlen=_KEPT)).append(status)
        try:
            if status.pair not in self._publishers:
                self._publishers[status.pair] = self._publisher(key)
            self._publishers[status.pair].put(status.to_json())
        except zenoh.ZError as error:
            raise TransportError(
                f"a status could not be put on {key}", hint="the session is closed"
            ) from error

    def close(self) -> None:
        """Takes back everything that was declared; the token goes, so that others see the end at once."""
        try:
            # The stubs of zenoh leave out what undeclare returns.
            self._token.undeclare()  # type: ignore[no-untyped-call]
            self._queryable.undeclare()  # type: ignore[no-untyped-call]
            for publisher in self._publishers.values():
                publisher.undeclare()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            raise TransportError("the bus was closed before the status") from error
        finally:
            self._publishers.clear()

    def _key(self, pair: str) -> str:
        return pair_key(self._vehicle, pair, "status")

    def _publisher(self, key: str) -> zenoh.ext.AdvancedPublisher:
        return zenoh.ext.declare_advanced_publisher(
            self._session,
            key,
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=zenoh.CongestionControl.DROP,
            express=True,
            cache=zenoh.ext.CacheConfig(max_samples=_CACHED),
            # Numbers the samples, so that the cache needs no clock in the session's configuration.
            sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            publisher_detection=True,
        )

    def _answer(self, query: zenoh.Query) -> None:
        """Top of a thread of the bus: what is raised here would reach the asker as silence."""
        try:
            self._reply(query)
        except ValueError as error:
            query.reply_err(str(error))
        except Exception:  # noqa: BLE001 # top of a thread: logged and answered
            _LOG.exception("a query for the status failed")
            query.reply_err("the query failed; the log of the watch says why")

    def _reply(self, query: zenoh.Query) -> None:
        asked = query.parameters.get("from_seq")
        from_seq = None if asked is None else _number(asked)
        with self._lock:
            said = {pair: tuple(statuses) for pair, statuses in self._said.items()}
        for pair, statuses in said.items():
            key = self._key(pair)
            if not query.key_expr.intersects(zenoh.KeyExpr(key)):
                continue
            if from_seq is None:
                text = statuses[-1].to_json()
            else:
                text = f"[{','.join(status.to_json() for status in statuses if status.seq >= from_seq)}]"
            query.reply(key, text, encoding=zenoh.Encoding.APPLICATION_JSON)


def _number(text: str) -> int:
    """A sequence number from a query; ValueError says what would be accepted."""
    if not (text.isascii() and text.isdigit() and len(text) <= _LONGEST_NUMBER):
        raise ValueError("from_seq must be a sequence number, as in from_seq=120")
    return int(text)


OUTPUT = OutputKind(
    "status_bus", "bus", lambda surroundings: StatusBus(session_of(surroundings), surroundings.vehicle)
)
