"""The page of the report: what is known of each pair, put into words and into the template."""

import base64
import math
from dataclasses import dataclass
from importlib import resources
from typing import Any

from monitor.events import EndEvent, ProposalEvent
from monitor.outputs._history import Change
from monitor.outputs._overlays import Crop, Overlay
from monitor.outputs._proposal import proposal_section
from monitor.outputs._series import Sample
from monitor.status import (
    AXIS_NAMES,
    AxisDrift,
    AxisName,
    Status,
    TimeOffset,
    Witness,
    first_in_precedence,
    unit_of,
)
from monitor.wording import moved_axes, next_step, onset_text, size_text, stamp_text, verdict_sentence

_MOST_CHANGES_SHOWN = 60
"""rows of the table of states; the first and the last half of them are shown."""

_SIGNS = {
    "vehicle": "Drift is the motion of the camera mount in vehicle axes: x forward, y left, z up",
    "camera": "Drift is the motion of the camera mount in the stored camera's own axes (no vehicle frame)",
}
_RELATIVE = {
    "stored": "relative to the stored extrinsic",
    "baseline": "relative to the rig's learned baseline",
}


_SEEN_LIMITS = 2.0
"""Alert limits that the sigma of an axis may reach for it to be observable (DESIGN 4)."""


@dataclass(frozen=True, slots=True, eq=False)
class PairMaterial:
    """What the report has of one pair.

    Attributes:
        last: The last status.
        timeline: Every change.
        first_ns: Stamp of the first status, ns.
        samples: Drift over time.
        overlays: (title, overlay), the most telling first.
        overlays_left_out: Number of pictures that the size of the page did not allow.
        proposal: What is proposed for a mount that has moved, or why nothing is; None while it has not.
    """

    last: Status
    timeline: tuple[Change, ...]
    first_ns: int
    samples: tuple[Sample, ...]
    overlays: tuple[tuple[str, Overlay], ...]
    overlays_left_out: int
    proposal: ProposalEvent | None = None


def page(vehicle: str, pairs: tuple[PairMaterial, ...], end: EndEvent) -> str:
    """The whole page as HTML; everything that came from outside is escaped."""
    # Loaded here: commands that draw nothing need no templates.
    from jinja2 import Environment, StrictUndefined  # noqa: PLC0415
    from markupsafe import Markup  # noqa: PLC0415

    files = resources.files("monitor.outputs")
    assets = {
        name: Markup(files.joinpath(file).read_text())  # noqa: S704 # our own files, not input
        for name, file in (
            ("uplot_css", "uplot.css"),
            ("uplot_js", "uplot.js"),
            ("css", "report.css"),
            ("js", "report.js"),
        )
    }
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    template = environment.from_string(files.joinpath("report.html").read_text())
    return template.render(page=_page(vehicle, pairs, end), assets=assets)


def _page(vehicle: str, pairs: tuple[PairMaterial, ...], end: EndEvent) -> dict[str, Any]:
    state = first_in_precedence(pair.last.state for pair in pairs)
    # The pair that decides stands first.
    ordered = sorted(pairs, key=lambda pair: pair.last.state != state)
    span = "No data."
    if pairs:
        first, last = min(pair.first_ns for pair in pairs), max(pair.last.stamp_ns for pair in pairs)
        span = f"Data from {stamp_text(first)} to {stamp_text(last)} ({(last - first) / 1e9:.0f} s)."
    return {
        "vehicle": vehicle,
        "state": state,
        "span": span,
        "complete": end.complete,
        "note": end.note,
        "warnings": end.warnings,
        "parts": [part.sentence for part in end.parts],
        "pairs": [_pair(index, pair) for index, pair in enumerate(ordered)],
        "series": [_plotted(index, pair) for index, pair in enumerate(ordered)],
    }


def _pair(index: int, pair: PairMaterial) -> dict[str, Any]:
    status = pair.last
    shown = pair.timeline
    if len(shown) > _MOST_CHANGES_SHOWN:
        half = _MOST_CHANGES_SHOWN // 2
        shown = (*shown[:half], *shown[-half:])
    beyond = moved_axes(status) if status.state == "drifted" else ()
    return {
        "name": status.pair,
        "state": status.state,
        "sentence": verdict_sentence(status),
        "next_step": _with_commands(next_step(status)),
        "signs": f"{_SIGNS[status.drift.axes]}, {_RELATIVE[status.drift.relative_to]}. Signs: +yaw turns "
        "left, +pitch nose down, +roll right side down; forward, left and up are those of the camera centre.",
        "strip": _strip(pair),
        "onset": _onset_mark(pair),
        "states_seen": list(dict.fromkeys(change.state for change in pair.timeline)),
        "timeline": [
            change.model_dump()
            | {
                "when": stamp_text(change.stamp_ns),
                "second": f"{(change.stamp_ns - pair.first_ns) / 1e9:.1f}",
            }
            for change in shown
        ],
        "changes_left_out": len(pair.timeline) - len(shown),
        "axes": [
            _axis(name, axis, f"plot-{index}-{name}") | {"beyond": name in beyond}
            for name, axis in status.drift.items()
        ],
        "overlays": [_overlay(title, overlay) for title, overlay in pair.overlays],
        "no_overlay": _no_overlay(pair),
        "proposal": None if pair.proposal is None else proposal_section(pair.proposal),
        "tables": _tables(status),
    }


def _with_commands(text: str) -> list[tuple[str, bool]]:
    """Pieces of a text and whether each is a command (stood between backticks)."""
    return [(piece, place % 2 == 1) for place, piece in enumerate(text.split("`")) if piece]


def _axis(name: AxisName, axis: AxisDrift, plot_id: str) -> dict[str, Any]:
    known = axis.observable
    return {
        "id": plot_id,
        "name": name,
        "value": size_text(name, axis.value, sign=True) if known else "held",
        "sigma": size_text(name, axis.sigma),
        "limit": size_text(name, axis.alert_limit),
        "protection_level": size_text(name, axis.protection_level) if known else "none",
        "detectable": size_text(name, axis.detectable) if known else "none",
        "observable": "yes" if known else "no",
        "monitored": "yes" if axis.monitored else "no",
        "last_seen": "never" if axis.last_seen_ns is None else stamp_text(axis.last_seen_ns),
    }


def _spans(pair: PairMaterial) -> list[tuple[Change, int, int]]:
    """(change, from, to) in ns, clipped to the data; states that hold no time are left out."""
    last_ns = pair.last.stamp_ns
    starts = [max(pair.first_ns, change.stamp_ns) for change in pair.timeline]
    ends = [*starts[1:], last_ns]
    return [
        (change, start, end)
        for change, start, end in zip(pair.timeline, starts, ends, strict=True)
        if end > start
    ]


def _strip(pair: PairMaterial) -> list[dict[str, Any]]:
    total = max(1, pair.last.stamp_ns - pair.first_ns)
    return [
        {
            "state": change.state,
            "x": f"{1000 * (start - pair.first_ns) / total:.2f}",
            "width": f"{1000 * (end - start) / total:.2f}",
            "label": f"{change.state} from {stamp_text(start)}, {(end - start) / 1e9:.1f} s: {change.reason}",
        }
        for change, start, end in _spans(pair)
    ]


def _onset_mark(pair: PairMaterial) -> dict[str, str] | None:
    """Where the onset lies in the strip of states, with its interval; None where there is none."""
    onset = pair.last.onset
    if onset is None:
        return None
    total = max(1, pair.last.stamp_ns - pair.first_ns)
    at, first, last = (
        1000 * min(max(stamp - pair.first_ns, 0), total) / total
        for stamp in (onset.stamp_ns, onset.from_ns, onset.to_ns)
    )
    return {
        "at": f"{at:.2f}",
        "x": f"{first:.2f}",
        "width": f"{max(last - first, 1.0):.2f}",
        "label": f"the drift: {onset_text(pair.last)}",
    }


def _plotted(index: int, pair: PairMaterial) -> dict[str, Any]:
    """What the script draws: seconds from the start, degrees and metres."""

    def second(stamp_ns: int) -> float:
        return round((stamp_ns - pair.first_ns) / 1e9, 3)

    def rounded(values: list[float | None]) -> list[float | None]:
        return [None if value is None else round(value, 5) for value in values]

    onset = pair.last.onset
    return {
        "name": pair.last.pair,
        "seconds": [second(sample.stamp_ns) for sample in pair.samples],
        "onset": None
        if onset is None
        else {"at": second(onset.stamp_ns), "from": second(onset.from_ns), "to": second(onset.to_ns)},
        "states": [
            {"state": change.state, "from": second(start), "to": second(end)}
            for change, start, end in _spans(pair)
        ],
        "axes": [
            {
                "id": f"plot-{index}-{name}",
                "name": name,
                "unit": unit_of(name),
                "limit": float(f"{pair.last.drift[name].alert_limit:.4g}"),
                "value": rounded([sample.values[place] for sample in pair.samples]),
                "sigma": rounded([sample.sigmas[place] for sample in pair.samples]),
            }
            for place, name in enumerate(AXIS_NAMES)
        ],
    }


def _overlay(title: str, overlay: Overlay) -> dict[str, Any]:
    note = (
        "Where the two extrinsics lie farthest apart and the image has edges to judge by. Points are jumps "
        "of range seen by the LiDAR, coloured lines its matched lines, white lines those of the image."
    )
    return {
        "title": title,
        "when": stamp_text(overlay.stamp_ns),
        "note": note if overlay.crops else "No place has enough points under both extrinsics to judge by.",
        "overview": _data_url(overlay.overview),
        "places": [
            {
                "caption": f"the extrinsics lie {crop.place.apart_px:.1f} px apart "
                f"({crop.place.points} points, {crop.place.width}x{crop.place.height} px enlarged).",
                "stored": _data_url(crop.stored),
                "estimated": _data_url(crop.estimated),
            }
            for crop in overlay.crops
        ],
    }


def _no_overlay(pair: PairMaterial) -> str:
    if pair.overlays_left_out:
        return f"{pair.overlays_left_out} more pictures were left out to keep this page small."
    return (
        ""
        if pair.overlays
        else "No frame with an estimate was seen: there is nothing to lay over each other."
    )


def _tables(status: Status) -> list[dict[str, Any]]:
    frames, window, rates, offset = status.frames, status.window, status.rates, status.time_offset
    dropped = [(f"dropped: {reason}", str(number)) for reason, number in sorted(frames.dropped.items())]
    return [
        {
            "title": "Sweeps and images",
            "rows": [("received", str(frames.received)), ("used", str(frames.used)), *dropped],
        },
        {
            "title": "Evidence in the window",
            "rows": [
                ("frames", str(window.frames)),
                ("span", f"{window.span_s:.1f} s"),
                ("lane lines", str(window.lines_lane)),
                ("poles", str(window.lines_pole)),
                ("structure lines", str(window.lines_structure)),
            ],
        },
        {
            "title": "Inputs",
            "rows": [
                ("LiDAR", _figure(rates.lidar_hz, "Hz")),
                ("camera", _figure(rates.camera_hz, "Hz")),
                ("image after sweep", _figure(rates.gap_ms, "ms")),
                ("time offset", _offset_text(offset)),
                ("masks and lines on", _figure(rates.lines_hz, "Hz")),
                ("edges on", _figure(rates.edges_hz, "Hz")),
            ],
        },
        *_consequence_tables(status),
        *_witness_tables(status),
        {
            "title": "Time per frame (median, 95 %)",
            "rows": [(name, f"{t.p50:.1f}, {t.p95:.1f} ms") for name, t in sorted(status.timing_ms.items())],
        },
        {
            "title": "Provenance",
            "rows": [
                ("extrinsic", _provenance(status.extrinsic.hash, status.extrinsic.version)),
                ("model", _provenance(status.model.hash, status.model.version)),
                ("software", status.software),
            ],
        },
    ]


def _consequence_tables(status: Status) -> list[dict[str, Any]]:
    """What the drift does at each distance; nothing where nothing is known."""
    return [
        {
            "title": f"What the drift does {at.range_m:.0f} m away",
            "rows": [
                ("middle of the image", f"{_figure(at.shift_px, 'px')} ± {_figure(at.sigma_px, 'px')}"),
                ("anywhere in the image", f"up to {_figure(at.worst_px, 'px')}"),
                ("things stand left", f"{at.left_m:+.3f} ± {at.sigma_left_m:.3f} m"),
                ("things stand above", f"{at.up_m:+.3f} ± {at.sigma_up_m:.3f} m"),
            ],
        }
        for at in status.consequence
    ]


def _witness_tables(status: Status) -> list[dict[str, Any]]:
    said = (("lines", status.witnesses.lines), ("edges", status.witnesses.edges))
    return [
        {"title": f"Witness: {name}", "rows": _witness(witness, status) if witness else [("said", "nothing")]}
        for name, witness in said
    ]


def _witness(witness: Witness, status: Status) -> list[tuple[str, str]]:
    rows = [("frames", str(witness.frames))]
    if witness.chi2 is not None:
        rows.append(("chi2 per degree of freedom", _figure(witness.chi2, "")))
    for name, axis in status.drift.items():
        value, sigma = getattr(witness.drift, name), getattr(witness.sigma, name)
        # As an axis is observable or not: a drift of 0.1 deg known to 50 would be read as one.
        seen = sigma is not None and sigma <= _SEEN_LIMITS * axis.alert_limit
        told = f"{size_text(name, value, sign=True)} ± {size_text(name, sigma)}" if seen else "not seen"
        rows.append((name, told))
    return rows


def _provenance(digest: str | None, version: str | None) -> str:
    told = [part for part in (f"version {version}" if version else "", digest[:16] if digest else "") if part]
    return ", ".join(told) or "none"


def _figure(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:.1f} {unit}".rstrip()


def _offset_text(offset: TimeOffset) -> str:
    """The time offset with its sigma, or that it is not told from a moved mount."""
    if offset.ms is None or offset.sigma_ms is None:
        return "not told from a forward drift"
    return f"{offset.ms:+.1f} ms (sigma {offset.sigma_ms:.1f} ms)"


def _data_url(jpeg: bytes) -> str:
    return "data:image/jpeg;base64," + base64.b64encode(jpeg).decode()


def picture_bytes(overlay: Overlay) -> int:
    """What the pictures of an overlay take in the page, bytes."""
    pictures = [overlay.overview, *(part for crop in overlay.crops for part in _both(crop))]
    return sum(4 * math.ceil(len(picture) / 3) for picture in pictures)


def _both(crop: Crop) -> tuple[bytes, bytes]:
    return crop.stored, crop.estimated
