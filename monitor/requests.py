"""What people ask of a running watch, on its way from the bus to the thread that owns the engines."""

import queue
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated

from pydantic import BaseModel, ConfigDict, StringConstraints, ValidationError

from pipeline.errors import InputError

MOST_BYTES = 4096
"""Of a request: two names and a sentence."""

_MOST_WAITING = 16
"""Requests that wait; people do not ask as often, and each is answered within half a second."""

_Line = Annotated[
    str,
    StringConstraints(strip_whitespace=True, min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$"),
]
"""One line for people; it is told in a status."""


class Note(BaseModel):
    """The payload of ``cmd/acknowledge``: who takes note of a drift, and why."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    by: _Line
    reason: _Line


def note_of(payload: bytes) -> Note:
    """The note in a payload; InputError says what would be accepted."""
    if len(payload) > MOST_BYTES:
        raise InputError(f"a request of {len(payload)} bytes is not read", hint=f"at most {MOST_BYTES}")
    try:
        return Note.model_validate_json(payload)
    except ValidationError as error:
        raise InputError(
            "the request is no note of who and why",
            hint='as in {"by": "Ada", "reason": "bracket tightened"}, one line of 200 characters each',
        ) from error


@dataclass(frozen=True, slots=True, eq=False)
class Acknowledgement:
    """A person takes note of the drift of a pair.

    Attributes:
        pair: Name of the pair.
        note: Who and why.
        answer: Called once: None where it was done, else why not.
    """

    pair: str
    note: Note
    answer: Callable[[str | None], None]


class Requests:
    """A bounded queue between threads: what does not fit is refused at once."""

    def __init__(self) -> None:
        self._waiting: queue.Queue[Acknowledgement] = queue.Queue(_MOST_WAITING)

    def put(self, request: Acknowledgement) -> None:
        """Takes a request, or answers that there are too many."""
        try:
            self._waiting.put_nowait(request)
        except queue.Full:
            request.answer("too many requests wait; ask again")

    def take(self) -> Iterator[Acknowledgement]:
        """What waits now."""
        while True:
            try:
                yield self._waiting.get_nowait()
            except queue.Empty:
                return
