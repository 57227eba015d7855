"""The only place that asks what time it is: stamps of the data decide verdicts, this decides staleness and cost."""

import time
from typing import Protocol


class Clock(Protocol):
    """A clock that tests can move."""

    def monotonic_ns(self) -> int:
        """Nanoseconds that never run back."""

    def wall_ns(self) -> int:
        """Nanoseconds since 1970, for people and for live stamps."""


class SystemClock:
    """The machine's own clocks."""

    def monotonic_ns(self) -> int:
        """Nanoseconds that never run back."""
        return time.monotonic_ns()

    def wall_ns(self) -> int:
        """Nanoseconds since 1970."""
        return time.time_ns()
