"""The tail of a statistic over healthy stretches of road, and the threshold that a wanted run length takes.

Nobody drives twenty vehicle-years to set a threshold: the uppermost tenth of the stretches' largest values is
continued as an exponential (as chi-square falls, in the end), with the interval of a bootstrap over whole
stretches, which are the blocks that do not depend on each other (FORMULAS F4).
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from pipeline.records import Floats

_TAIL = 0.10
"""Share of the stretches whose values make the tail: the exponential is to hold there, not in the middle."""

_RUN_LENGTH_FACTOR = 10.0
"""A run length that is known to a factor of ten either way is worth stating."""

_QUANTILE = 1.96
"""Two-sided normal quantile of 95 %."""

_RESAMPLES = 400
"""Bootstrap samples: the ends of a 95 % interval rest on ten of them."""


@dataclass(frozen=True, slots=True)
class Tail:
    """What healthy stretches say of a threshold.

    Attributes:
        stretches: Stretches that there are.
        needed: Stretches at which the wanted run length is known to a factor of ten.
        wanted_s: The wanted run length between two false alarms, s.
        threshold: Upper end of the interval of the extrapolated threshold, or None: too few stretches, only
            one recording, or a tail that falls more slowly than an exponential.
        interval: Its 95 % interval, or None.
    """

    stretches: int
    needed: int
    wanted_s: float
    threshold: float | None
    interval: tuple[float, float] | None


def unknown_tail(seconds: Floats, wanted_s: float) -> Tail:
    """What is said of the tail before a value was looked at; arguments as of :func:`tail_of`."""
    return Tail(len(seconds), stretches_needed(wanted_s / _block_s(seconds)), wanted_s, None, None)


def _block_s(seconds: Floats) -> float:
    # A lone window lasts no time; a stretch of road takes seconds.
    return max(float(np.mean(seconds)), 1.0)


def tail_of(values: Floats, seconds: Floats, wanted_s: float, rng: np.random.Generator) -> Tail:
    """The tail of the stretches' largest values.

    Args:
        values: float64 (N,), the largest value of each stretch; in any order, it does not matter.
        seconds: float64 (N,), durations of the stretches, s: their mean is the time of one block.
        wanted_s: Wanted run length, s.
        rng: Draws the bootstrap samples.
    """
    block_s = _block_s(seconds)
    unknown = unknown_tail(seconds, wanted_s)
    ordered = np.sort(values)
    if len(values) < unknown.needed or not _exponential(ordered):
        return unknown
    drawn = np.sort(rng.choice(ordered, (_RESAMPLES, len(ordered))), axis=1)
    thresholds = np.array([_extrapolated(sample, wanted_s / block_s) for sample in drawn])
    low, high = np.quantile(thresholds, [0.025, 0.975])
    return dataclasses.replace(unknown, threshold=float(high), interval=(float(low), float(high)))


def stretches_needed(blocks: float) -> int:
    """Stretches at which a run length of ``blocks`` stretches is known to a factor of ten, at 95 %.

    With m values in the tail, its slope is known to ``1 / sqrt(m)``, and the logarithm of the run length at
    a threshold to that share of the e-folds that are extrapolated.
    """
    folds = math.log(max(blocks * _TAIL, math.e))
    return math.ceil((_QUANTILE * folds / math.log(_RUN_LENGTH_FACTOR)) ** 2 / _TAIL)


def _excesses(ordered: Floats) -> tuple[float, Floats]:
    """Where the tail begins, and by how much its values exceed that."""
    count = max(2, round(_TAIL * len(ordered)))
    begin = float(ordered[-count - 1])
    return begin, ordered[-count:] - begin


def _extrapolated(ordered: Floats, blocks: float) -> float:
    begin, excess = _excesses(ordered)
    return begin + float(excess.mean()) * math.log(max(blocks * _TAIL, 1.0))


def _exponential(ordered: Floats) -> bool:
    """Whether the tail falls at least as fast as an exponential, whose coefficient of variation is 1."""
    _, excess = _excesses(ordered)
    return float(excess.std() / excess.mean()) <= 1.0 + _QUANTILE / math.sqrt(len(excess))
