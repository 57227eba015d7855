"""Box plots and curves as PNG, drawn with OpenCV: axes, units, legend."""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.plk_starts import Box

Colour = tuple[int, int, int]
COLOURS: tuple[Colour, ...] = (
    (178, 114, 0),
    (0, 94, 213),
    (115, 158, 0),
    (167, 121, 204),
    (0, 159, 230),
    (60, 60, 60),
)
"""BGR of Okabe and Ito's blue, vermilion, green, purple and orange, and a dark grey, which colour-blind
readers tell apart."""

_THICKNESSES = (8, 5, 2)
"""px; of the first curves: those that lie on each other stay visible. All further ones are as the last."""

_BLACK: Colour = (30, 30, 30)
_GREY: Colour = (215, 215, 215)
_PANEL = (620, 430)
"""px of one panel."""

_LEFT, _RIGHT, _TOP, _BOTTOM = 84, 14, 64, 56
"""px around the axes of a panel."""

_TEXT = 0.48
_SUB = 4
"""Bits after the point in px coordinates."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis.

    Attributes:
        label: What and in which unit, ASCII.
        low: Value at its beginning; positive where logarithmic.
        high: Value at its end.
        ticks: Values with a mark, and their names.
        logarithmic: Whether equal ratios have equal lengths.
    """

    label: str
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]
    logarithmic: bool = False

    def place(self, value: float) -> float:
        """0 at the beginning, 1 at the end; values beyond are put on the border."""
        low, high = self.low, self.high
        if self.logarithmic:
            low, high, value = math.log(low), math.log(high), math.log(max(value, low))
        return min(max((value - low) / (high - low), 0.0), 1.0)


@dataclass(frozen=True, slots=True)
class Curve:
    """Points joined by lines, gaps where a value is None; ``index`` chooses colour and legend."""

    index: int
    x: tuple[float, ...]
    y: tuple[float | None, ...]


@dataclass(frozen=True, slots=True)
class PlacedBox:
    """A box at ``x``, ``width`` wide (units of the axis); ``index`` chooses colour and legend."""

    index: int
    x: float
    width: float
    box: Box


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes with what is drawn in it."""

    title: str
    x: Axis
    y: Axis
    marks: tuple[Curve | PlacedBox, ...]


def decades(values: Iterable[float], label: str) -> Axis:
    """A logarithmic axis of whole decades around positive values."""
    found = [math.log10(value) for value in values if value > 0.0]
    low, high = (math.floor(min(found)), math.ceil(max(found))) if found else (-1, 0)
    high = max(high, low + 1)
    ticks = tuple((10.0**power, f"{10.0**power:g}") for power in range(low, high + 1))
    return Axis(label, 10.0**low, 10.0**high, ticks, logarithmic=True)


def steps(low: float, high: float, step: float, label: str) -> Axis:
    """A linear axis with a mark every ``step``."""
    count = math.floor((high - low) / step + 0.5)
    ticks = tuple((low + i * step, f"{low + i * step:g}") for i in range(count + 1))
    return Axis(label, low, high, ticks)


def png(panels: Sequence[Panel], legend: Sequence[str], columns: int) -> bytes:
    """The panels row by row, each with the legend (one name for each index of the marks)."""
    rows = [panels[i : i + columns] for i in range(0, len(panels), columns)]
    width, height = _PANEL
    canvas = np.full((height * len(rows), width * columns, 3), 255, np.uint8)
    for i, row in enumerate(rows):
        for j, panel in enumerate(row):
            _draw(canvas[i * height : (i + 1) * height, j * width : (j + 1) * width], panel, legend)
    _, data = cv2.imencode(".png", canvas, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return data.tobytes()


def _draw(canvas: NDArray[np.uint8], panel: Panel, legend: Sequence[str]) -> None:
    left, right = _LEFT, _PANEL[0] - _RIGHT
    top, bottom = _TOP, _PANEL[1] - _BOTTOM

    def at(x: float, y: float) -> tuple[float, float]:
        return (
            left + panel.x.place(x) * (right - left),
            bottom - panel.y.place(y) * (bottom - top),
        )

    for value, name in panel.y.ticks:
        _, y = at(panel.x.low, value)
        _line(canvas, (left, y), (right, y), _GREY)
        _text(canvas, name, (left - 8, y + 5), anchor=1.0)
    for value, name in panel.x.ticks:
        x, _ = at(value, panel.y.low)
        _line(canvas, (x, bottom), (x, bottom + 5), _BLACK)
        _text(canvas, name, (x, bottom + 21), anchor=0.5)
    cv2.rectangle(canvas, (left, top), (right, bottom), _BLACK, 1)
    for mark in panel.marks:
        if isinstance(mark, Curve):
            _curve(
                canvas, [None if y is None else at(x, y) for x, y in zip(mark.x, mark.y, strict=True)], mark
            )
        else:
            _box(canvas, mark, at)
    _text(canvas, panel.title, (left, 20), anchor=0.0)
    _text(canvas, panel.x.label, ((left + right) / 2, bottom + 44), anchor=0.5)
    _upright(canvas, panel.y.label, (14, (top + bottom) // 2))
    # A long legend begins farther left.
    x = float(max(4, min(left, right - sum(28 + _width(name) + 20 for name in legend))))
    for name, colour in zip(legend, COLOURS, strict=False):
        _line(canvas, (x, 45), (x + 22, 45), colour, 3)
        x = _text(canvas, name, (x + 28, 50), anchor=0.0) + 20


def _curve(canvas: NDArray[np.uint8], points: Sequence[tuple[float, float] | None], curve: Curve) -> None:
    colour = COLOURS[curve.index]
    thickness = _THICKNESSES[min(curve.index, len(_THICKNESSES) - 1)]
    for one, other in itertools.pairwise(points):
        if one is not None and other is not None:
            _line(canvas, one, other, colour, thickness)
    for point in points:
        if point is not None:
            cv2.circle(canvas, _fixed(point), (thickness + 2) << (_SUB - 1), colour, -1, cv2.LINE_AA, _SUB)


def _box(
    canvas: NDArray[np.uint8], mark: PlacedBox, at: Callable[[float, float], tuple[float, float]]
) -> None:
    colour, box = COLOURS[mark.index], mark.box
    left, right, middle = mark.x - mark.width / 2, mark.x + mark.width / 2, mark.x
    for end, edge in ((box.low, box.q1), (box.high, box.q3)):
        _line(canvas, at(middle, end), at(middle, edge), colour)
        _line(canvas, at(middle - mark.width / 4, end), at(middle + mark.width / 4, end), colour)
    corners = (at(left, box.q1), at(right, box.q1), at(right, box.q3), at(left, box.q3))
    for one, other in zip(corners, (*corners[1:], corners[0]), strict=True):
        _line(canvas, one, other, colour, 2)
    _line(canvas, at(left, box.median), at(right, box.median), _BLACK, 2)
    for value in box.outside:
        cv2.circle(canvas, _fixed(at(middle, value)), 3 << _SUB, colour, 1, cv2.LINE_AA, _SUB)


def _fixed(point: tuple[float, float]) -> tuple[int, int]:
    return round(point[0] * 2**_SUB), round(point[1] * 2**_SUB)


def _line(
    canvas: NDArray[np.uint8],
    one: tuple[float, float],
    other: tuple[float, float],
    colour: Colour,
    thickness: int = 1,
) -> None:
    cv2.line(canvas, _fixed(one), _fixed(other), colour, thickness, cv2.LINE_AA, _SUB)


def _text(canvas: NDArray[np.uint8], text: str, point: tuple[float, float], *, anchor: float) -> float:
    """Writes on a base line; ``anchor`` 0 begins at the point, 1 ends there. Returns the x of the end."""
    width = _width(text)
    x = round(point[0] - anchor * width)
    cv2.putText(canvas, text, (x, round(point[1])), cv2.FONT_HERSHEY_SIMPLEX, _TEXT, _BLACK, 1, cv2.LINE_AA)
    return float(x + width)


def _width(text: str) -> int:
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _TEXT, 1)
    return int(width)


def _upright(canvas: NDArray[np.uint8], text: str, point: tuple[int, int]) -> None:
    """Writes from below to above, centred on the point."""
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _TEXT, 1)
    strip = np.full((height + below + 4, width + 4, 3), 255, np.uint8)
    _text(strip, text, (2, height + 2), anchor=0.0)
    turned = np.rot90(strip)
    top, left = max(point[1] - turned.shape[0] // 2, 0), max(point[0] - turned.shape[1] // 2, 0)
    space = canvas[top : top + turned.shape[0], left : left + turned.shape[1]]
    space[:] = turned[: space.shape[0], : space.shape[1]]
