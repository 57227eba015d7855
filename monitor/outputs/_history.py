"""What was said of each pair: the last status and every change."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, StringConstraints

from monitor.status import Code, State, Status


class Change(BaseModel):
    """A state that was entered, or a new reason for the state that holds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    state: State
    code: Code
    reason: Annotated[str, StringConstraints(min_length=1)]
    stamp_ns: int


class History:
    """Remembers the last status and the changes of one pair."""

    def __init__(self, first: Status) -> None:
        self.last = first
        self._changes = [_change(first, first.since_ns)]

    @property
    def timeline(self) -> tuple[Change, ...]:
        """Every change of state or code, the first state included."""
        return tuple(self._changes)

    def note(self, status: Status) -> None:
        """Takes the next status of the pair."""
        if status.state != self.last.state:
            self._changes.append(_change(status, status.since_ns))
        elif status.code != self.last.code:
            self._changes.append(_change(status, status.stamp_ns))
        self.last = status


def _change(status: Status, stamp_ns: int) -> Change:
    return Change(state=status.state, code=status.code, reason=status.reason, stamp_ns=stamp_ns)
