"""``calibwatch inspect``: what a recording holds, which pairs could be watched, and what is missing."""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from monitor import commands

if TYPE_CHECKING:
    from monitor.inspection_report import CloudReport, ImageReport, Inspection, PairReport, Span, TopicReport


@click.command(
    epilog="Examples: calibwatch inspect drive.mcap; "
    "calibwatch inspect drive.mcap --rig van.toml --json (for programs)"
)
@click.argument("recording")
@commands.rig_option
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON (calibwatch.inspection/1).")
def command(*, recording: str, rig_file: Path | None, as_json: bool) -> int:
    """Tell what RECORDING holds and which pairs could be watched, and what is missing.

    Reads it through once. Exits with 0 wherever it can be read, also if nothing in it can be watched.
    """
    from monitor.inspection import inspect  # noqa: PLC0415 - numpy and the decoders are not needed for --help

    found = inspect(recording, rig_file)
    click.echo(found.model_dump_json(indent=2) if as_json else "\n".join(_lines(found)))
    return 0


def _lines(found: "Inspection") -> Iterator[str]:
    yield f"{found.location} ({found.kind})"
    for note in found.notes:
        yield f"  note: {note}"
    if found.losses:
        yield f"  lost: {', '.join(f'{reason} {number}' for reason, number in sorted(found.losses.items()))}"
    yield ""
    yield "topics"
    for topic in found.topics:
        yield from _topic(topic)
    if found.transforms:
        yield ""
        yield "transforms (parent -> child)"
        for link in found.transforms:
            yield f"  {link.parent} -> {link.child}{'' if link.static else ' (changing)'}"
    yield ""
    yield f"pairs that can be watched (vehicle {found.vehicle})" if found.pairs else "no pair can be watched"
    for pair in found.pairs:
        yield from _pair(pair, next(topic for topic in found.topics if topic.name == pair.lidar))
    if found.missing:
        yield ""
        yield "missing"
        yield from (f"  {missing}" for missing in found.missing)


def _topic(topic: "TopicReport") -> Iterator[str]:
    rate = "" if topic.rate_hz is None else f", {topic.rate_hz:.2f} Hz"
    understood = "" if topic.understood else " (not understood)"
    yield f"  {topic.name}: {topic.type}{understood}, {_number(topic.count, 'message')}{rate}"
    delay = "" if topic.delay_ms is None else f", logged {topic.delay_ms:+.1f} ms after them"
    if topic.nominal:
        yield "    no stamps: files are counted as ten a second"
    elif topic.stamps is not None:
        yield f"    stamps {_span(topic.stamps)}{delay}"
    elif topic.logged is not None:
        yield f"    stamps are not read, logged {_span(topic.logged)}"
    if topic.backwards:
        yield f"    {topic.backwards} stamps run backwards"
    if topic.undecodable is not None:
        yield f"    can not be decoded: {topic.undecodable}"
    if topic.cloud is not None:
        yield f"    {_cloud(topic.cloud)}"
    if topic.image is not None:
        yield from (f"    {line}" for line in _image(topic.image))


def _cloud(cloud: "CloudReport") -> str:
    least, median, most = cloud.points
    points = f"{median} points" if least == most else f"{least} to {most} points (median {median})"
    fields = ", ".join(
        f"{name} {'yes' if present else 'no'}"
        for name, present in (("intensity", cloud.intensity), ("ring", cloud.ring), ("time", cloud.time))
    )
    source = "by its field" if cloud.ring else "found in the data"
    rings = "no rings found" if cloud.rings is None else f"{cloud.rings} rings ({source})"
    sweep = "" if cloud.sweep_s is None else f"; a sweep lasts {cloud.sweep_s * 1e3:.1f} ms"
    sweeps = f"{_number(cloud.sweeps, 'sweep')} looked at"
    return f"{_frame(cloud.frame)}{points} in {sweeps}; {fields}; {rings}{sweep}"


def _image(image: "ImageReport") -> Iterator[str]:
    yield f"{_frame(image.frame)}first image {image.size[0]}x{image.size[1]} px"
    if image.reading is None:
        yield "no intrinsics"
        return
    source = "" if image.info is None else f" ({image.info})"
    yield f"intrinsics {image.reading}{source}"
    if image.K is not None and image.D is not None:
        (fu, _, cu), (_, fv, cv), _ = image.K
        distortion = f" D {' '.join(f'{d:g}' for d in image.D)}" if any(image.D) else " no distortion"
        yield f"{image.model} fu {fu:.2f} fv {fv:.2f} cu {cu:.2f} cv {cv:.2f} px,{distortion}"


def _pair(pair: "PairReport", lidar: "TopicReport") -> Iterator[str]:
    yield f"  {pair.name}: {pair.lidar} with {pair.camera}"
    yield f"    {pair.how}"
    at, along = (" ".join(f"{v:+.3f}" for v in vector) for vector in (pair.camera_at_m, pair.looks_along))
    yield f"    camera at {at} m, looking along {along} (LiDAR axes)"
    yield f"    drift is told in {'vehicle axes' if pair.vehicle_frame else 'the camera axes (no base_link)'}"
    sweeps, images = _number(pair.sweeps, "sweep"), _number(pair.images, "image")
    yield f"    {_number(pair.pairs, 'pair')} of {sweeps} and {images}{_gap(pair, lidar)}"
    if pair.clock_offset_ms is not None:
        side = "ahead of" if pair.clock_offset_ms >= 0 else "behind"
        offset = f"{abs(pair.clock_offset_ms):.1f} ms {side}"
        yield f"    camera clock {offset} the LiDAR's by log times, transport included"
    if pair.in_view is not None:
        yield f"    {pair.in_view[0]} of {pair.in_view[1]} points of the first sweep fall into the image"
    for problem in pair.problems:
        yield f"    problem: {problem}"
    for warning in pair.warnings:
        yield f"    warning: {warning}"


def _gap(pair: "PairReport", lidar: "TopicReport") -> str:
    if pair.same_stamps:
        return "; both bear the same stamps (nominal or absent), so no gap can be told"
    if pair.gap_ms is None:
        return ""
    known = lidar.cloud is not None and lidar.cloud.middle_ms is not None
    since = "the middle of its sweep" if known else "its sweep's stamp, the duration being unknown"
    return f", image by median {pair.gap_ms:+.1f} ms from {since}"


def _frame(frame: str) -> str:
    return f"frame '{frame}', " if frame else ""


def _number(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _span(span: "Span") -> str:
    return f"{_instant(span.first_ns)} + {(span.last_ns - span.first_ns) / 1e9:.3f} s"


def _instant(stamp_ns: int) -> str:
    """A stamp as people read it: date and time in UTC, or seconds where it counts from elsewhere."""
    if stamp_ns < 10**18:  # before 2001: a clock that counts from the start of the sensor or drive
        return f"{stamp_ns / 1e9:.3f} s"
    return f"{datetime.fromtimestamp(stamp_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S.%f} UTC"
