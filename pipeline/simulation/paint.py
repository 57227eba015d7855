"""Paint on the road, in road coordinates: longitudinal lines, and patches (bars, arrows)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.surface import F32


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A line along the road.

    Attributes:
        d: Its middle, m to the left of the centre line.
        width: m.
        dash: Length of a dash, m; 0 for a solid line.
        gap: Length of a gap, m.
        phase: Arc length at which a dash begins, m.
    """

    d: float
    width: float
    dash: float = 0.0
    gap: float = 0.0
    phase: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A trapezoid: stop line, crossing bar, shaft or head of an arrow.

    Attributes:
        s: First and last arc length, m.
        d: Middle, m.
        half: Half width at the first and at the last arc length, m.
    """

    s: tuple[float, float]
    d: float
    half: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Paint:
    """Everything painted on a road."""

    lines: tuple[Line, ...]
    patches: tuple[Patch, ...]

    def covers(self, s: F32, d: F32) -> NDArray[np.bool_]:
        """Whether road coordinates (N,), m, lie on paint."""
        covered = np.zeros(s.shape, dtype=np.bool_)
        for line in self.lines:
            near = np.flatnonzero(np.abs(d - np.float32(line.d)) < line.width / 2)
            if line.dash > 0.0:
                near = near[np.mod(s[near] - np.float32(line.phase), line.dash + line.gap) < line.dash]
            covered[near] = True
        for patch in self.patches:
            near = np.flatnonzero((s > patch.s[0]) & (s < patch.s[1]))
            share = (s[near] - np.float32(patch.s[0])) / np.float32(patch.s[1] - patch.s[0])
            half = patch.half[0] + share * (patch.half[1] - patch.half[0])
            covered[near[np.abs(d[near] - np.float32(patch.d)) < half]] = True
        return covered


def crossing(s: float, right: float, left: float) -> tuple[Patch, ...]:
    """A zebra crossing 3 m long with bars of 0.5 m, from d = right to left."""
    count = int((left - right) // 1.0)
    middles = right + 0.5 + np.arange(count)
    return tuple(Patch((s, s + 3.0), float(d), (0.25, 0.25)) for d in middles)


def arrow(s: float, d: float, *, forward: bool) -> tuple[Patch, ...]:
    """A straight arrow 5 m long: shaft 0.15 m, head 0.8 m wide."""
    if forward:
        return (Patch((s, s + 3.2), d, (0.08, 0.08)), Patch((s + 3.2, s + 5.0), d, (0.4, 0.0)))
    return (Patch((s + 1.8, s + 5.0), d, (0.08, 0.08)), Patch((s, s + 1.8), d, (0.0, 0.4)))
