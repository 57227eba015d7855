"""PLK-Calib's experiments as Markdown and pictures, for people, and as files."""

import math
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from monitor.charts import Axis, Curve, Panel, PlacedBox, decades, png, steps
from monitor.outputs import write_whole
from monitor.plk_evaluation import BoxPlots, Errors, Median, Offsets, Row, Sweep, Table
from pipeline.errors import CalibwatchError
from pipeline.plk_scenes import METHODS
from pipeline.plk_starts import box

LEGEND = ("method I", "method II", "ours")
_SCENES = {
    "a": "(a) three lines",
    "b": "(b) coplanar",
    "c": "(c) parallel",
    "d": "(d) coplanar, parallel",
    "e": "(e) ten lines",
    "corner": "three through one point",
}


def table_text(found: Table) -> str:
    """Table I: medians, what is observed, and whether the bar is held."""
    lines = [
        f"{found.runs} runs (seed {found.seed}) from 5 deg about and 0.5 m along each axis off.",
        "Medians: rotation, rad (deg) / translation, m.",
        "",
        "| scene | noise, px | method I | method II | ours (II, then I) |",
        "|---|---|---|---|---|",
    ]
    lines += [_medians(row, found.runs) for row in found.rows]
    lines += [
        "",
        "What ours says of itself: the rank of its information; the angle between the direction that it",
        "holds and the right one (worst run); medians of its error in the directions that it sees; its",
        "squared normalised error against chi-square: mean over freedom, share below the 95 % point, p.",
        "",
        "| scene | noise, px | rank (runs) | held, deg off | seen, rad / m | mean | below 95 % | p |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [_statement(row) for row in found.rows]
    lines += ["", "| scene | noise, px | demand | bar |", "|---|---|---|---|"]
    lines += chain.from_iterable(_demands(row) for row in found.rows)
    demands = [demand for row in found.rows for demand in row.demands]
    missed = sum(not demand.met for demand in demands)
    said = f"MISSED: {missed} of {len(demands)}" if missed else f"held: {len(demands)} of {len(demands)}"
    lines += ["", f"The bar is {said} demands."]
    return "\n".join(lines)


def _medians(row: Row, runs: int) -> str:
    one, two, ours = (_median(row.methods[method], runs) for method in METHODS)
    if max(row.ranks) < 6:
        # Ours knows that what the start left along the held direction is no answer, and does not tell it.
        ours = (
            f"{_rotation(row.seen_rotation_rad)} / {row.seen_translation_m:.3g}, one direction not observed"
        )
    return f"| {_SCENES[row.scene]} | {row.sigma_px:g} | {one} | {two} | {ours} |"


def _median(found: Median, runs: int) -> str:
    if found.rotation_rad is None or found.translation_m is None:
        return "says: not to be solved"
    few = "" if found.answers == runs else f" ({found.answers} answers)"
    return f"{_rotation(found.rotation_rad)} / {found.translation_m:.3g}{few}"


def _rotation(value_rad: float) -> str:
    return f"{value_rad:.4g} ({math.degrees(value_rad):.2g})"


def _statement(row: Row) -> str:
    ranks = ", ".join(f"{rank} ({count})" for rank, count in row.ranks.items())
    held = "-" if row.held_deg is None else f"{row.held_deg:.1g}"
    return (
        f"| {_SCENES[row.scene]} | {row.sigma_px:g} | {ranks} | {held} | {row.seen_rotation_rad:.4g} / "
        f"{row.seen_translation_m:.3g} | {row.chi_square_mean:.2f} | {row.chi_square_within:.3f} | "
        f"{row.chi_square_p:.2f} |"
    )


def _demands(row: Row) -> Iterator[str]:
    for demand in row.demands:
        said = "held" if demand.met else "MISSED"
        yield f"| {_SCENES[row.scene]} | {row.sigma_px:g} | {demand.demand} | {said} |"


def box_text(found: BoxPlots) -> str:
    """Fig. 5 in figures: medians and quartiles."""
    lines = [
        f"{found.runs} runs a box (seed {found.seed}), ten lines drawn anew for each, noise 1 px, from 5 deg",
        "about and 0.5 m along each axis off: median [quartiles].",
        "",
        "| lines | method | answers | rotation, deg | translation, m |",
        "|---|---|---|---|---|",
    ]
    for name, methods in found.surroundings.items():
        for method, label in zip(METHODS, LEGEND, strict=True):
            one = methods[method]
            cells = f"{_quartiles(one.rotation_deg)} | {_quartiles(one.translation_m)}"
            lines.append(f"| {name} | {label} | {len(one.rotation_deg)} | {cells} |")
    return "\n".join(lines)


def _quartiles(values: tuple[float, ...]) -> str:
    if not values:
        return "-"
    one = box(np.array(values))
    return f"{one.median:.3g} [{one.q1:.3g}, {one.q3:.3g}]"


def box_picture(found: BoxPlots) -> bytes:
    """Fig. 5."""
    names = list(found.surroundings)
    x = Axis("lines, depth", 0.0, float(len(names)), tuple((i + 0.5, name) for i, name in enumerate(names)))
    panels = []
    for title, unit, of in (("rotation", "deg", _rotations), ("translation", "m", _translations)):
        marks = tuple(
            PlacedBox(k, i + 0.25 + 0.25 * k, 0.18, box(np.array(of(methods[method]))))
            for i, methods in enumerate(found.surroundings.values())
            for k, method in enumerate(METHODS)
            if of(methods[method])
        )
        values = chain.from_iterable((m.box.low, m.box.high, *m.box.outside) for m in marks)
        panels.append(
            Panel(
                f"Error of {title}, start 5 deg and 0.5 m off on each axis, {found.runs} runs a box",
                x,
                decades(values, f"{title} error, {unit}"),
                marks,
            )
        )
    return png(panels, LEGEND, 2)


def _rotations(one: Errors) -> tuple[float, ...]:
    return one.rotation_deg


def _translations(one: Errors) -> tuple[float, ...]:
    return one.translation_m


def offsets_text(found: Offsets) -> str:
    """Fig. 6 in figures."""
    lines = [
        f"{found.runs} runs an offset (seed {found.seed}), the five longest of ten lines, noise 1 px.",
        "A run in which the initial guess leaves fewer than three lines in the image counts as failed.",
    ]
    for half, sweep in found.halves.items():
        head = " | ".join(f"{label}: success, median {sweep.unit}" for label in LEGEND)
        lines += [
            "",
            f"Only {half} sought, the rest right and held.",
            f"Success: error below {sweep.success_below:g} {sweep.unit}.",
            "",
            f"| initial {half} error, {sweep.unit} | {head} |",
            "|---|---|---|---|",
        ]
        for points in zip(*(sweep.methods[method] for method in METHODS), strict=True):
            cells = " | ".join(
                f"{100 * p.success:.0f} %, {'-' if p.median is None else f'{p.median:.2g}'}" for p in points
            )
            lines.append(f"| {points[0].offset:g} | {cells} |")
    return "\n".join(lines)


_AXES = {
    "translation": "initial error along the LiDAR's y axis, m",
    "rotation": "initial error about the LiDAR's z axis, deg",
}


def offsets_picture(found: Offsets) -> bytes:
    """Fig. 6: success share above, median error below."""
    above, below = [], []
    for half, sweep in found.halves.items():
        last = next(iter(sweep.methods.values()))[-1].offset
        x = steps(0.0, last, 1.0 if half == "translation" else 5.0, _AXES[half])
        # Above 1, so that a curve at 1 is not taken for the frame.
        shares = steps(0.0, 1.05, 0.2, f"share below {sweep.success_below:g} {sweep.unit}")
        above.append(Panel(f"Success, only {half} sought", x, shares, _curves(sweep, median=False)))
        medians = _curves(sweep, median=True)
        values = [y for curve in medians for y in curve.y if y is not None]
        y = decades(values, f"median error, {sweep.unit}")
        below.append(Panel(f"Median error where there is an answer, only {half} sought", x, y, medians))
    return png([*above, *below], LEGEND, 2)


def _curves(sweep: Sweep, *, median: bool) -> tuple[Curve, ...]:
    return tuple(
        Curve(
            k,
            tuple(point.offset for point in sweep.methods[method]),
            tuple(point.median if median else point.success for point in sweep.methods[method]),
        )
        for k, method in enumerate(METHODS)
    )


def write(out: Path, name: str, text: str, document: str, picture: bytes | None) -> None:
    """Writes ``NAME.md``, ``NAME.json`` and, where there is one, ``NAME.png`` into a folder."""
    files = {f"{name}.md": f"{text}\n".encode(), f"{name}.json": f"{document}\n".encode()}
    if picture is not None:
        files[f"{name}.png"] = picture
    try:
        for file, data in files.items():
            write_whole(out / file, data)
    except OSError as error:
        raise CalibwatchError(
            f"--out {out} can not be written: {error.strerror}", hint="name another folder"
        ) from error
