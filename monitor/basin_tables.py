"""Basins of attraction as Markdown and as a picture, for people."""

import math
from collections.abc import Callable

from monitor import charts
from monitor.basin_evaluation import WAYS, Basin, Curve, Point, Way
from monitor.charts import Panel, decades, png, steps
from pipeline.basin import SUCCESS_M, SUCCESS_RAD, Sweep

_LINES: tuple[Way, ...] = ("method I", "method II", "I from II")
_LEGEND = ("I", "II", "I from II", "Alg. 1", "evolution", "calibrate")
_TITLES: dict[Sweep, str] = {
    "rotation": "Turned about the vehicle's up axis",
    "translation": "Shifted along the vehicle's left axis",
    "both": "Off on all axes, 1 m for 6 deg",
}
_OFFSETS: dict[Sweep, str] = {
    "rotation": "initial error, deg",
    "translation": "initial error, m",
    "both": "widest initial error on an axis, deg",
}


def _wanted(sweep: Sweep) -> str:
    deg, m = f"{math.degrees(SUCCESS_RAD):g} deg", f"{SUCCESS_M:g} m"
    return {"rotation": deg, "translation": m, "both": f"{deg} and {m}"}[sweep]


def basin_text(found: Basin) -> str:
    """One table a sweep."""
    lines = [
        f"{found.frames} frames, {found.starts} starts each at every initial error (seed {found.seed}).",
        "Success, then medians of the answers: (16) of CRLF in deg / (15) in m.",
        f"Methods I, II and I from II know their matches: {_matches(found)}.",
        "Calibrate is told how far off the start may be (--prior-sigma) where that is more than its default.",
    ]
    for sweep, curve in found.sweeps.items():
        lines += ["", f"{_TITLES[sweep]}. Success: within {_wanted(sweep)}.", ""]
        lines.append(f"| {_OFFSETS[sweep]} | {' | '.join(WAYS)} |")
        lines.append("|---|" + "---|" * len(WAYS))
        for place, point in enumerate(curve.ways["calibrate"]):
            cells = " | ".join(_cell(curve, way, place) for way in WAYS)
            lines.append(f"| {point.offset:g} | {cells} |")
    return "\n".join(lines)


def _matches(found: Basin) -> str:
    counts = sorted(found.matched.values())
    few = sum(count < len(_LINES) for count in counts)
    return f"{counts[0]} to {counts[-1]} a frame, fewer than three in {few} frames"


def _cell(curve: Curve, way: Way, place: int) -> str:
    point = curve.ways[way][place]
    if point.rotation_deg is None or point.translation_m is None:
        return "no answer"
    return f"{100 * point.success:.0f} %, {point.rotation_deg:.2g} / {point.translation_m:.2g}"


def basin_picture(found: Basin) -> bytes:
    """Success above, median error below, a column for each sweep."""
    above, below = [], []
    for sweep, curve in found.sweeps.items():
        last = curve.ways["calibrate"][-1].offset
        step = {"rotation": 10.0, "translation": 1.0, "both": 1.0}[sweep]
        x = steps(0.0, step * math.ceil(last / step - 1e-9), step, _OFFSETS[sweep])
        shares = steps(0.0, 1.05, 0.2, f"share within {_wanted(sweep)}")
        above.append(Panel(_TITLES[sweep], x, shares, _curves(curve, lambda p: p.success)))
        if sweep == "translation":
            medians, unit = _curves(curve, lambda p: p.translation_m), "m"
        else:
            medians, unit = _curves(curve, lambda p: p.rotation_deg), "deg"
        values = [y for one in medians for y in one.y if y is not None]
        below.append(
            Panel("Median error of the answers", x, decades(values, f"median error, {unit}"), medians)
        )
    return png([*above, *below], _LEGEND, len(above))


def _curves(curve: Curve, value: Callable[[Point], float | None]) -> tuple[charts.Curve, ...]:
    return tuple(
        charts.Curve(
            index, tuple(p.offset for p in curve.ways[way]), tuple(value(p) for p in curve.ways[way])
        )
        for index, way in enumerate(WAYS)
    )
