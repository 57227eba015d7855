"""Paint on the road, in road coordinates: longitudinal lines, patches (bars, arrows) and slanting strokes."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.surface import F32

WHITE, YELLOW = 1, 2
"""Colours of paint; 0 is none."""
_MANY = 24
"""Patches and strokes from which sorting the points once is quicker than looking at all of them each time."""


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A line along the road.

    Attributes:
        d: Its middle, m to the left of the centre line.
        width: m.
        dash: Length of a dash, m; 0 for a solid line.
        gap: Length of a gap, m.
        phase: Arc length at which a dash begins, m.
        colour: WHITE or YELLOW.
    """

    d: float
    width: float
    dash: float = 0.0
    gap: float = 0.0
    phase: float = 0.0
    colour: int = WHITE


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A trapezoid: stop line, crossing bar, shaft or head of an arrow.

    Attributes:
        s: First and last arc length, m.
        d: Middle, m.
        half: Half width at the first and at the last arc length, m.
        colour: WHITE or YELLOW.
    """

    s: tuple[float, float]
    d: float
    half: tuple[float, float]
    colour: int = WHITE


@dataclass(frozen=True, slots=True, eq=False)
class Stroke:
    """A straight stroke of any direction: hatching, letters, a line that leaves its lane.

    Attributes:
        start: Arc length and distance to the left of the first end, m.
        end: Of the last end, m.
        width: Across the stroke, m.
        colour: WHITE or YELLOW.
    """

    start: tuple[float, float]
    end: tuple[float, float]
    width: float
    colour: int = WHITE


@dataclass(frozen=True, slots=True, eq=False)
class Paint:
    """Everything painted on a road; what comes later lies on top."""

    lines: tuple[Line, ...]
    patches: tuple[Patch, ...]
    strokes: tuple[Stroke, ...] = ()

    def covers(self, s: F32, d: F32) -> NDArray[np.bool_]:
        """Whether road coordinates (N,), m, lie on paint."""
        return self.colours(s, d) > 0

    def colours(self, s: F32, d: F32) -> NDArray[np.uint8]:
        """Colour of the paint at road coordinates (N,), m; 0 where there is none."""
        found = np.zeros(s.shape, dtype=np.uint8)
        for line in self.lines:
            near = np.flatnonzero(np.abs(d - np.float32(line.d)) < line.width / 2)
            if line.dash > 0.0:
                near = near[np.mod(s[near] - np.float32(line.phase), line.dash + line.gap) < line.dash]
            found[near] = line.colour
        within = _Within(s, many=len(self.patches) + len(self.strokes) >= _MANY)
        for patch in self.patches:
            near = within.between(*patch.s)
            share = (s[near] - np.float32(patch.s[0])) / np.float32(patch.s[1] - patch.s[0])
            half = patch.half[0] + share * (patch.half[1] - patch.half[0])
            found[near[np.abs(d[near] - np.float32(patch.d)) < half]] = patch.colour
        for stroke in self.strokes:
            way = np.subtract(stroke.end, stroke.start)
            length = max(float(np.hypot(*way)), 1e-6)
            first, last = sorted((stroke.start[0], stroke.end[0]))
            near = within.between(first - stroke.width / 2, last + stroke.width / 2)
            ds, dd = s[near] - np.float32(stroke.start[0]), d[near] - np.float32(stroke.start[1])
            along = (ds * np.float32(way[0]) + dd * np.float32(way[1])) / np.float32(length)
            across = np.abs(ds * np.float32(way[1]) - dd * np.float32(way[0])) / np.float32(length)
            found[near[(along > 0) & (along < length) & (across < stroke.width / 2)]] = stroke.colour
        return found


class _Within:
    """Which points lie between two arc lengths; a life of one look-up, sorted where that pays."""

    def __init__(self, s: F32, *, many: bool) -> None:
        self._s = s
        self._order = np.argsort(s) if many else None
        self._sorted = s if self._order is None else s[self._order]

    def between(self, first: float, last: float) -> NDArray[np.int64]:
        if self._order is None:
            return np.flatnonzero((self._s > first) & (self._s < last))
        a, b = np.searchsorted(self._sorted, np.array([first, last], dtype=np.float32))
        return np.asarray(self._order[a:b])


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
