"""The only place that asks what time it is; verdicts go by the stamps of the data."""

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
