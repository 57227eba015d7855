"""Commands on the bus: the queryable of a running watch, and the question that a person asks it.

``calibwatch/<vehicle>/<pair>/cmd/acknowledge`` with a JSON payload ``{"by": ..., "reason": ...}`` is answered
with ``{"acknowledged": true}``, or with an error whose text says why not.
"""

import json
import logging
from types import TracebackType
from typing import Self

import zenoh

from monitor import bus
from monitor.requests import Acknowledgement, Note, Requests, note_of
from pipeline.errors import CalibwatchError, InputError, TransportError

_log = logging.getLogger(__name__)

_PATIENCE_S = 10.0
"""s; a watch answers between two frames."""


class CommandBus:
    """Listens for commands while it is entered.

    Args:
        session: An open session, closed by the caller after this.
        vehicle: Name of the vehicle.
        pairs: Names of its pairs.
        requests: Where requests go.
        refusal: Why nobody may command over this session, or None where who reaches it may.
    """

    def __init__(
        self,
        session: zenoh.Session,
        vehicle: str,
        pairs: tuple[str, ...],
        requests: Requests,
        refusal: str | None,
    ) -> None:
        self._session = session
        self._requests = requests
        self._refusal = refusal
        self._keys = {bus.command_key(vehicle, pair, "acknowledge"): pair for pair in pairs}
        self._queryables: list[zenoh.Queryable[None]] = []

    def __enter__(self) -> Self:
        try:
            self._queryables = [self._session.declare_queryable(key, self._take) for key in self._keys]
        except zenoh.ZError as error:
            raise TransportError("the commands can not be declared on the bus") from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Listens no more; who still waits is told that the watch has ended."""
        for queryable in self._queryables:
            # The stubs of zenoh leave out what undeclare returns.
            queryable.undeclare()  # type: ignore[no-untyped-call]
        for request in self._requests.take():
            request.answer("the watch has ended")

    def _take(self, query: zenoh.Query) -> None:
        """Top of a thread of the bus: what is raised here would reach the asker as silence."""
        try:
            self._requests.put(self._request_of(query))
        except CalibwatchError as error:
            _reply(query, str(error))
        except Exception:  # noqa: BLE001 # top of a thread: logged and answered
            _log.exception("a command failed")
            _reply(query, "the command failed; the log of the watch says why")

    def _request_of(self, query: zenoh.Query) -> Acknowledgement:
        pair = self._keys.get(str(query.key_expr))
        if pair is None:
            raise InputError("a command is for one pair", hint=f"one of {', '.join(sorted(self._keys))}")
        if self._refusal is not None:
            raise InputError(self._refusal)
        note = note_of(b"" if query.payload is None else query.payload.to_bytes())
        return Acknowledgement(pair, note, lambda refusal: _reply(query, refusal))


def _reply(query: zenoh.Query, refusal: str | None) -> None:
    try:
        if refusal is None:
            encoding = zenoh.Encoding.APPLICATION_JSON
            query.reply(query.key_expr, json.dumps({"acknowledged": True}), encoding=encoding)
        else:
            query.reply_err(refusal)
        # Until it is dropped the asker waits for more.
        query.drop()  # type: ignore[no-untyped-call]  # the stubs leave out what it returns
    except zenoh.ZError:
        _log.warning("the answer to a command could not be sent: who asked has gone")


def acknowledge(session: zenoh.Session, vehicle: str, pair: str, note: Note) -> None:
    """Takes note of the drift of a pair, over the bus.

    Raises:
        TransportError: Nobody answers, or the watch refuses, which it says.
    """
    key = bus.command_key(vehicle, pair, "acknowledge")
    try:
        replies = list(session.get(key, payload=note.model_dump_json(), timeout=_PATIENCE_S))
    except zenoh.ZError as error:
        raise TransportError(f"{key} could not be asked", hint="is the session open?") from error
    for reply in replies:
        if reply.ok is not None:
            return
    if not replies:
        raise TransportError(
            f"nobody answers for {vehicle}/{pair}",
            hint="is the watch running on this bus, and are vehicle and pair spelt as in its rig file?",
        )
    refusal = replies[0].err
    text = "without a reason" if refusal is None else refusal.payload.to_string()
    raise TransportError(f"{vehicle}/{pair} was not acknowledged: {text}")
