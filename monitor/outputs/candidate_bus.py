"""The extrinsic proposed for a pair, on the bus (zenoh): put, taken back, and asked for.

``calibwatch/<vehicle>/<pair>/candidate`` carries each proposal as JSON, and a DELETE where it does not hold
any more. A query on that key (``*`` for all pairs) is answered with the proposal that stands.
"""

import threading

import zenoh

from monitor.bus import every_pair_key, pair_key
from monitor.events import Event, ProposalEvent
from monitor.outputs import OutputKind, session_of
from pipeline.errors import TransportError


class CandidateBus:
    """Speaks on an open session, which the caller owns and closes after this.

    Args:
        session: The session.
        vehicle: Name of the vehicle, one chunk of a key.
    """

    def __init__(self, session: zenoh.Session, vehicle: str) -> None:
        self._session = session
        self._vehicle = vehicle
        self._lock = threading.Lock()
        self._standing: dict[str, bytes] = {}
        try:
            self._queryable = session.declare_queryable(every_pair_key(vehicle, "candidate"), self._answer)
        except zenoh.ZError as error:
            raise TransportError("candidates can not be declared on the bus") from error

    @property
    def lost(self) -> str | None:
        """Never: the session reconnects by itself, and a failed put is raised where it happens."""
        return None

    def handle(self, event: Event) -> None:
        """Publishes a proposal, or takes it back; TransportError where the session is closed."""
        if not isinstance(event, ProposalEvent):
            return
        key = pair_key(self._vehicle, event.pair, "candidate")
        try:
            if event.document is None:
                with self._lock:
                    stood = self._standing.pop(key, None)
                if stood is not None:
                    self._session.delete(key)
                return
            data = event.document.to_json()
            with self._lock:
                self._standing[key] = data
            self._session.put(key, data, encoding=zenoh.Encoding.APPLICATION_JSON)
        except zenoh.ZError as error:
            raise TransportError(
                f"a candidate could not be put on {key}", hint="the session is closed"
            ) from error

    def close(self) -> None:
        """Takes back what was declared."""
        try:
            # The stubs of zenoh leave out what undeclare returns.
            self._queryable.undeclare()  # type: ignore[no-untyped-call]
        except zenoh.ZError as error:
            raise TransportError("the bus was closed before the candidates") from error

    def _answer(self, query: zenoh.Query) -> None:
        with self._lock:
            standing = dict(self._standing)
        for key, data in standing.items():
            if query.key_expr.intersects(zenoh.KeyExpr(key)):
                query.reply(key, data, encoding=zenoh.Encoding.APPLICATION_JSON)


OUTPUT = OutputKind(
    "candidate_bus",
    "bus",
    lambda surroundings: CandidateBus(session_of(surroundings), surroundings.vehicle),
)
