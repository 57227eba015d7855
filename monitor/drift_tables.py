"""An evaluation of the verdict as Markdown and as CSV, for people."""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from monitor.drift_summary import RECORDED, SIMULATED, Calling, Cell, Honest, Share, Smallest, Summary
from monitor.outputs import write_whole
from monitor.status import STATES
from pipeline.drift_trials import Kind
from pipeline.errors import CalibwatchError
from pipeline.staging import CROPPED_PX, MOVED_M, TURNED_DEG

_TITLES: dict[Kind, str] = {
    "compensating": "Two axes wrong that leave the bearing at 20 m as it was.",
    "ramp": "Drift that grows evenly from nothing to the end of the drive; told at any time.",
    "vibration": "A camera that shakes, with no drift: 'drifted' would be false.",
    "time-offset": "Wrong stamps of the images, no drift: 'drifted' would blame the mount.",
    "focal": "Wrong focal length, no drift: likewise.",
    "offline": "Axes of the camera, as in the published offline check.",
    "slip": "A mount that moves along one axis at two thirds of the drive; told, and until told, after that.",
}
"""Of the kinds that have a table label by label."""

_NOTHING_MOVED = ("vibration", "time-offset", "focal")


def drift_text(found: Summary) -> str:
    """All tables."""
    parts = ["\n".join(_head(found))]
    if found.calling:
        parts.append("\n".join(_callings(found.calling)))
    if found.smallest:
        parts.append("\n".join(_smallest(found.smallest)))
    widest = _widest(found)
    for kind in _TITLES:
        cells = [cell for cell in found.cells if cell.kind == kind and cell.group in widest]
        if cells:
            parts.append("\n".join(_cells(kind, cells)))
    if found.honest:
        parts.append("\n".join(_honest(found.honest)))
    return "\n\n".join(parts)


def drift_csv(found: Summary) -> str:
    """One line a group, kind and label."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(
        [
            "group",
            "kind",
            "label",
            "runs",
            *STATES,
            "told",
            "told_low",
            "told_high",
            "noticed",
            "delay_s",
            "T",
        ]
    )
    for cell in found.cells:
        writer.writerow(
            [
                cell.group,
                cell.kind,
                cell.label,
                cell.runs,
                *(cell.states.get(state, 0) for state in STATES),
                cell.told.hits,
                f"{cell.told.low:.4f}",
                f"{cell.told.high:.4f}",
                cell.noticed,
                "" if cell.delay_s is None else f"{cell.delay_s:.3f}",
                "" if cell.statistic is None else f"{cell.statistic:.2f}",
            ]
        )
    return out.getvalue()


def _widest(found: Summary) -> set[str]:
    """Groups that no other group holds: their drives stand in the CSV one by one."""
    groups = {cell.group for cell in found.cells}
    return groups & {RECORDED, SIMULATED} if RECORDED in groups else groups


def _head(found: Summary) -> Iterator[str]:
    limits = "each rig's own alert limits"
    if found.header.limits is not None:
        deg, m = found.header.limits
        limits = f"alert limits {deg:g} deg and {m:g} m on every axis"
    baseline = "a baseline from the other drives" if found.header.baseline else "no baseline"
    deg, m = found.header.reference_sigma
    drives = "1 drive" if len(found.drives) == 1 else f"{len(found.drives)} drives"
    yield (
        f"{found.runs} runs on {drives} (seed {found.header.seed}), {limits}, {baseline}; "
        f"recordings are taken to know their extrinsic to {deg:g} deg and {m:g} m."
    )
    yield (
        f"In each run LiDAR axes are turned by up to {TURNED_DEG:g} deg and moved by up to {MOVED_M:g} m, "
        f"images cropped by up to {CROPPED_PX} px a side. Runs of one drive are not independent."
    )


def _callings(rows: Sequence[Calling]) -> Iterator[str]:
    yield (
        "Healthy runs against wrong ones. *Called*: 'healthy' or 'drifted' at the end. Balanced accuracy is "
        "that of the called runs; intervals are Clopper-Pearson, 95 %. Delays are s of data: median, longest."
    )
    yield ""
    yield (
        "| drive | drives | healthy runs | wrong runs | false alarms | told | called healthy though wrong | "
        "balanced accuracy | not called | unobservable | until told | until called | T: area, best |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|---|---|"
    for one in rows:
        accuracy = "-"
        if one.accuracy is not None:
            a = one.accuracy
            accuracy = f"{100 * a.value:.1f} % ({100 * a.low:.0f} to {100 * a.high:.0f})"
        curve = "-" if one.roc is None else f"{one.roc.area:.3f}, {one.roc.best:.3f}"
        yield (
            f"| {one.group} | {one.drives} | {one.healthy} | {one.wrong} | {_share(one.false_alarms)} | "
            f"{_share(one.told)} | {_share(one.missed)} | {accuracy} | {_share(one.not_called)} | "
            f"{_share(one.unobservable)} | {_pair(one.delay_s)} | {_pair(one.called_s)} | {curve} |"
        )


def _smallest(rows: Sequence[Smallest]) -> Iterator[str]:
    yield "Share of runs told 'drifted' with one axis wrong, both signs; found: told in 90 % from there on."
    yield ""
    groups = list(dict.fromkeys(one.group for one in rows))
    for unit, axes in (("deg", ("roll", "pitch", "yaw")), ("m", ("forward", "left", "up"))):
        chosen = [one for one in rows if one.axis in axes]
        amounts = sorted({amount for one in chosen for amount in one.shares}, key=float)
        if not amounts:
            continue
        yield f"| drive | axis | {' | '.join(f'{a} {unit}' for a in amounts)} | found | suspected |"
        yield "|---|---|" + "---|" * (len(amounts) + 2)
        for group in groups:
            for one in chosen:
                if one.group == group:
                    cells = " | ".join(_part(one.shares.get(amount)) for amount in amounts)
                    ends = f"{_number(one.told, unit)} | {_number(one.noticed, unit)}"
                    yield f"| {group} | {one.axis} | {cells} | {ends} |"
        if unit == "deg":
            yield ""


def _cells(kind: Kind, cells: Sequence[Cell]) -> Iterator[str]:
    yield _TITLES[kind]
    yield ""
    yield "| drive | what | runs | told | at the end | until told, s | T |"
    yield "|---|---|---|---|---|---|---|"
    for cell in cells:
        # Where nothing moved the reason tells whether the cause was named.
        ends = cell.codes if kind in _NOTHING_MOVED else cell.states
        states = ", ".join(f"{n} {end}" for end, n in sorted(ends.items()))
        delay = "-" if cell.delay_s is None else f"{cell.delay_s:.1f}"
        statistic = "-" if cell.statistic is None else f"{cell.statistic:.0f}"
        yield (
            f"| {cell.group} | {cell.label} | {cell.runs} | {_part(cell.told)} | {states} | {delay} | "
            f"{statistic} |"
        )


def _honest(rows: Sequence[Honest]) -> Iterator[str]:
    yield (
        "Stated errors against true ones, over observable axes; what the reference may be off is allowed "
        "for. *Unavailable*: protection level above the alert limit. *Misleading*: error beyond the "
        "protection level; *hazardous*: beyond the alert limit too, with the protection level within it."
    )
    yield ""
    yield (
        "| drive | kind | axes | within 1 sigma | within 2 | nominal | unavailable | misleading | hazardous |"
    )
    yield "|---|---|---|---|---|---|---|---|---|"
    for one in rows:
        yield (
            f"| {one.group} | {one.kind} | {one.axes} | {_percent(one.within_one)} | "
            f"{_percent(one.within_two)} | {one.nominal} | {one.unavailable} | {one.misleading} | "
            f"{one.hazardous} |"
        )


def _share(one: Share) -> str:
    if one.of == 0:
        return "-"
    return f"{one.hits} ({100 * one.low:.0f} to {100 * one.high:.0f} %)"


def _part(one: Share | None) -> str:
    return "-" if one is None else f"{one.hits}/{one.of}"


def _pair(values: tuple[float, float] | None) -> str:
    return "-" if values is None else f"{values[0]:.1f}, {values[1]:.1f}"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"


def _number(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:g} {unit}"


def write(out: Path, found: Summary, pictures: Mapping[str, bytes]) -> None:
    """Writes ``drift.md``, ``.csv``, ``.json`` and the pictures ``drift_NAME.png`` into a folder."""
    files = {
        "drift.md": f"{drift_text(found)}\n".encode(),
        "drift.csv": drift_csv(found).encode(),
        "drift.json": f"{found.model_dump_json(indent=1)}\n".encode(),
    } | {f"drift_{name}.png": data for name, data in pictures.items()}
    try:
        for file, data in files.items():
            write_whole(out / file, data)
    except OSError as error:
        raise CalibwatchError(
            f"--out {out} can not be written: {error.strerror}", hint="name another folder"
        ) from error
