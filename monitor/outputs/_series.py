"""Drift over time, thinned so that a day takes no more memory than an hour."""

from dataclasses import dataclass

from monitor.status import AXIS_NAMES, Status

Number = float | None


@dataclass(frozen=True, slots=True)
class Sample:
    """One status as the plots need it: per axis value and sigma, degrees and metres; None where not known."""

    stamp_ns: int
    values: tuple[Number, ...]
    sigmas: tuple[Number, ...]


class Series:
    """Keeps every sample until there are ``most``, then every second, and so on; the newest always.

    Args:
        most: Number of samples kept at most.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: list[Sample] = []
        self._newest: Sample | None = None
        self._stride = 1
        self._seen = 0

    @property
    def samples(self) -> tuple[Sample, ...]:
        """What is kept, in the order in which it came."""
        if self._newest is None or (self._kept and self._kept[-1] is self._newest):
            return tuple(self._kept)
        return (*self._kept, self._newest)

    def thinned(self, most: int) -> tuple[Sample, ...]:
        """At most ``most`` (two or more) of the samples, evenly, first and newest among them."""
        samples = self.samples
        if len(samples) <= most:
            return samples
        return tuple(samples[round(i * (len(samples) - 1) / (most - 1))] for i in range(most))

    def note(self, status: Status) -> None:
        """Takes the next status of the pair."""
        axes = [status.drift[name] for name in AXIS_NAMES]
        # An axis that is not observable is held at the stored value: that is no measurement to draw.
        self._newest = Sample(
            status.stamp_ns,
            tuple(axis.value if axis.observable else None for axis in axes),
            tuple(axis.sigma if axis.observable else None for axis in axes),
        )
        if self._seen % self._stride == 0:
            self._kept.append(self._newest)
        self._seen += 1
        if len(self._kept) > self._most:
            self._kept = self._kept[::2]
            self._stride *= 2
