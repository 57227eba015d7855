"""An evaluation of the verdict as pictures: ROC and delay, detection along one axis, Stanford diagrams."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from monitor.charts import COLOURS, Axis, Curve, Panel, decades, png, steps
from monitor.drift_rows import Row
from monitor.drift_summary import StanfordPoint, Summary, groups_of, stanford_points
from monitor.status import AXIS_NAMES, AxisName

_ANGLES: tuple[AxisName, ...] = AXIS_NAMES[:3]
_SHIFTS: tuple[AxisName, ...] = AXIS_NAMES[3:]
_HALVES = ((_ANGLES, "deg", "angles"), (_SHIFTS, "m", "shifts"))
_AXES_LEGEND = tuple(f"{angle}, {shift}" for angle, shift in zip(_ANGLES, _SHIFTS, strict=True))

_SHARE = steps(0.0, 1.05, 0.2, "share of runs told 'drifted'")


def pictures(found: Summary, rows: Sequence[Row]) -> dict[str, bytes]:
    """PNGs by name, of what was run; detection and Stanford diagrams are of the last group, the widest."""
    drawn = {}
    if any(one.roc is not None for one in found.calling):
        drawn["calling"] = _calling(found, rows)
    if not rows:
        return drawn
    group, those = list(groups_of(rows).items())[-1]
    if any(one.group == group for one in found.smallest):
        drawn["axes"] = _one_axis(found, group)
    points = [point for row in those for point in stanford_points(row)]
    if points:
        drawn["stanford"] = _stanford(group, points)
    return drawn


def _calling(found: Summary, rows: Sequence[Row]) -> bytes:
    """ROC of T and share told over time, a curve for each of the last groups."""
    shown = [one for one in found.calling if one.roc is not None][-len(COLOURS) :]
    x = steps(0.0, 1.05, 0.2, "share of healthy runs above the threshold")
    y = steps(0.0, 1.05, 0.2, "share of wrong runs above it")
    curves = tuple(
        Curve(k, one.roc.false, one.roc.found) for k, one in enumerate(shown) if one.roc is not None
    )
    groups = groups_of(rows)
    told = tuple(
        _told(k, [row for row in groups[one.group] if row.kind == "combined"]) for k, one in enumerate(shown)
    )
    longest = max((end for curve in told for end in curve.x), default=0.0)
    time = steps(0.0, max(1.0, float(np.ceil(longest))), max(1.0, float(np.ceil(longest / 6.0))), "s of data")
    panels = (
        Panel("ROC of the joint statistic T", x, y, curves),
        Panel("Wrong by 0.5 to 1.2 deg and 0.1 to 0.2 m: when it is told", time, _SHARE, told),
    )
    return png(panels, tuple(one.group for one in shown), 2)


def _told(index: int, wrong: Sequence[Row]) -> Curve:
    """Share told by each moment, a staircase."""
    delays = sorted(row.told_s for row in wrong if row.told_s is not None)
    x, y = [0.0], [0.0]
    for k, delay in enumerate(delays):
        x += [delay, delay]
        y += [k / len(wrong), (k + 1) / len(wrong)]
    return Curve(index, tuple(x), tuple(y))


def _one_axis(found: Summary, group: str) -> bytes:
    panels = []
    for axes, unit, what in _HALVES:
        chosen = [one for one in found.smallest if one.group == group and one.axis in axes]
        amounts = [float(amount) for one in chosen for amount in one.shares]
        curves = tuple(
            Curve(
                axes.index(one.axis),
                tuple(float(amount) for amount in one.shares),
                tuple(part.hits / part.of for part in one.shares.values()),
            )
            for one in chosen
        )
        x = _logarithmic(amounts, f"wrong by, {unit}")
        panels.append(Panel(f"One of the {what} wrong ({group})", x, _SHARE, curves))
    return png(panels, _AXES_LEGEND, 2)


def _logarithmic(amounts: Sequence[float], label: str) -> Axis:
    """An axis with a mark at each amount."""
    known = sorted(set(amounts))
    ticks = tuple((amount, f"{amount:g}") for amount in known)
    return Axis(label, 0.8 * known[0], 1.25 * known[-1], ticks, logarithmic=True)


def _stanford(group: str, points: Sequence[StanfordPoint]) -> bytes:
    """Errors against protection levels, both in alert limits; what lies right of the diagonal misleads."""
    errors = [max(p.error / p.alert_limit, 0.01) for p in points]
    levels = [p.protection_level / p.alert_limit for p in points]
    x, y = decades(errors, "error / alert limit"), decades(levels, "protection level / alert limit")
    ends = (max(x.low, y.low), min(x.high, y.high))
    lines = (Curve(len(COLOURS) - 1, ends, ends),) if ends[0] < ends[1] else ()
    panels = []
    for axes, _, what in _HALVES:
        clouds = tuple(_cloud(axes.index(axis), [p for p in points if p.axis == axis]) for axis in axes)
        panels.append(Panel(f"Stanford diagram, {what} ({group})", x, y, (*lines, *clouds)))
    return png(panels, _AXES_LEGEND, 2)


def _cloud(index: int, points: Sequence[StanfordPoint]) -> Curve:
    """Points that no line joins; errors below a hundredth of the limit lie on the border."""
    return Curve(
        index,
        tuple(_apart(max(p.error / p.alert_limit, 0.01) for p in points)),
        tuple(
            None if k % 2 else value
            for k, value in enumerate(_apart(p.protection_level / p.alert_limit for p in points))
        ),
    )


def _apart(values: Iterator[float]) -> Iterator[float]:
    """Each value twice: the second stands for the gap between two points."""
    return itertools.chain.from_iterable((value, value) for value in values)
