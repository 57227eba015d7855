"""What a recording holds and what could be watched in it: the answer of ``calibwatch inspect``.

The recording is read through: stamps of every message from its head (:mod:`monitor.messages.header`), the
first sweeps and images decoded. Nothing is guessed: what was not looked at, or can not be told, is null.
"""

import itertools
import statistics
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from monitor.baseline_file import with_baselines
from monitor.discovery import Survey, discover, survey_in
from monitor.inspection_report import (
    CloudReport,
    ImageReport,
    Inspection,
    Link,
    Span,
    TopicReport,
)
from monitor.pair_inspection import pair_report
from monitor.preparation import prepare
from monitor.rig import Rig, RigPair, camera_from_info, load_rig
from monitor.seen_topics import NONE, Seen, read_through
from monitor.sources import TopicInfo, kinds, open_source
from monitor.sources.kitti_raw import NOMINAL_PERIOD_NS
from monitor.sync import middle_ns
from pipeline.errors import CalibwatchError, InputError
from pipeline.records import CameraModel, PointCloud
from pipeline.rings import scan_pattern

_LIVE = "zenoh_live"
"""The kind of source that never ends."""


def inspect(location: str, rig_file: Path | None) -> Inspection:
    """Reads a recording through and tells what it holds.

    Args:
        location: The recording.
        rig_file: A rig file or ``calib.json``, or None: the recording speaks for itself.

    Raises:
        CalibwatchError: The recording can not be read, or the rig file is wrong.
    """
    kind = next((kind.name for kind in kinds() if kind.matches(location)), "")
    if kind == _LIVE:
        raise InputError(f"{location} is live and has no end", hint="calibwatch inspect wants a recording")
    with open_source(location) as source:
        topics, own = source.describe(), source.rig_document()
        survey = survey_in(source, topics)
    with open_source(location) as source:
        seen, links = read_through(source)
        losses = source.losses
    rig, how, missing = _rig(location, rig_file, survey, own=own is not None)
    reports = tuple(_topic(topic, seen.get(topic.name, Seen()), survey, rig) for topic in topics)
    return Inspection(
        location=location,
        kind=kind,
        vehicle=None if rig is None else rig.vehicle,
        topics=reports,
        transforms=tuple(
            Link(parent=t.parent, child=t.child, static=t.static) for t in links.transforms.values()
        ),
        pairs=() if rig is None else tuple(pair_report(p, how[p.name], seen, reports) for p in rig.pairs),
        missing=missing,
        losses=dict(losses.counts),
        notes=tuple(losses.notes),
    )


def _rig(
    location: str, rig_file: Path | None, survey: Survey, *, own: bool
) -> tuple[Rig | None, dict[str, str], tuple[str, ...]]:
    """The rig that can be watched, how each pair came about, and what is missing."""
    if rig_file is None and not own:
        found = discover(survey)
        return found.rig, dict(note.split(": ", 1) for note in found.notes), found.missing
    try:
        prepared = prepare(location, rig_file, None, known=lambda rig: with_baselines(rig, None))
    except CalibwatchError as error:
        if rig_file is not None:
            raise
        return None, {}, (str(error),)
    open_ones = (
        () if rig_file is None else (p.name for p in load_rig(rig_file).pairs if p.T_cam_lidar is None)
    )
    how = {pair.name: "; ".join((*prepared.notes, *_learned(pair))) for pair in prepared.rig.pairs}
    return prepared.rig, how | {name: f"{how[name]}; extrinsic from tf" for name in open_ones}, ()


def _learned(pair: RigPair) -> tuple[str, ...]:
    """That a pair has a baseline, and how much road it rests on."""
    if pair.baseline is None:
        return ()
    count = len(pair.baseline.stretches)
    return (f"baseline of {count} stretch{'es' if count != 1 else ''} of road",)


def _topic(topic: TopicInfo, seen: Seen, survey: Survey, rig: Rig | None) -> TopicReport:
    both = [pair for pair in zip(seen.headers, seen.logged, strict=True) if pair[0] != NONE]
    headers, logged = [stamp for stamp, _ in both], [log_ns for log_ns in seen.logged if log_ns != NONE]
    delays = [log_ns - stamp for stamp, log_ns in both if log_ns != NONE]
    folder = topic.type.startswith("file/")
    return TopicReport(
        name=topic.name,
        type=topic.type,
        understood=topic.understood,
        count=len(seen.logged),
        rate_hz=_rate_hz(headers or logged),
        stamps=_span(headers),
        logged=_span(logged),
        nominal=folder
        and bool(headers)
        and min(headers) == 0
        and not any(h % NOMINAL_PERIOD_NS for h in headers),
        delay_ms=statistics.median(delays) / 1e6 if any(delays) and not folder else None,
        backwards=sum(1 for a, b in itertools.pairwise(headers) if b < a),
        undecodable=seen.undecodable or survey.undecodable.get(topic.name),
        cloud=_cloud(seen, topic.name, rig) if seen.clouds else None,
        image=_image(topic.name, survey, rig) if topic.name in survey.images else None,
    )


def _cloud(seen: Seen, topic: str, rig: Rig | None) -> CloudReport:
    clouds = [cloud for _, cloud, _ in seen.clouds]
    first = next((cloud for cloud in clouds if len(cloud)), clouds[0])
    sizes = [len(cloud) for cloud in clouds]
    pair = next((pair for pair in (rig.pairs if rig else ()) if pair.lidar.topic == topic), None)
    middles = [
        (middle_ns(stamp, cloud, sweep, pair.lidar.stamp) if pair else middle_ns(stamp, cloud, sweep)) - stamp
        for stamp, cloud, sweep in seen.clouds
    ]
    spans = [float(np.ptp(cloud.time)) for cloud in clouds if cloud.time is not None and len(cloud)]
    told = [sweep for _, _, sweep in seen.clouds if sweep is not None]
    return CloudReport(
        frame=seen.frame,
        sweeps=len(clouds),
        points=(min(sizes), round(statistics.median(sizes)), max(sizes)),
        intensity=first.intensity is not None,
        ring=first.ring is not None,
        time=first.time is not None,
        rings=_rings(first),
        sweep_s=statistics.median(spans or told) if spans or told else None,
        middle_ms=statistics.median(middles) / 1e6 if spans or told else None,
    )


def _rings(cloud: PointCloud) -> int | None:
    """Rings by the cloud's own field, else by its order or elevations; None where it shows none."""
    pattern = scan_pattern(cloud, np.ones(len(cloud), dtype=np.bool_))
    return None if pattern is None else len(np.unique(pattern.ring))


def _image(topic: str, survey: Survey, rig: Rig | None) -> ImageReport:
    frame, size = survey.images[topic]
    camera, reading, info_topic = _intrinsics(topic, survey, rig)
    return ImageReport(
        frame=frame,
        size=size,
        info=info_topic,
        reading=reading,
        model=None if camera is None else camera.model,
        K=None if camera is None else camera.K.tolist(),
        D=None if camera is None else camera.D.tolist(),
    )


def _intrinsics(
    topic: str, survey: Survey, rig: Rig | None
) -> tuple[CameraModel | None, str | None, str | None]:
    """Intrinsics, which reading of them holds and why, and the topic that states them."""
    pair = next((p for p in (rig.pairs if rig else ()) if p.camera.topic == topic), None)
    info_topic = (pair.camera.info if pair else None) or survey.info_of(topic)
    stated = survey.infos[info_topic][1] if info_topic in survey.infos else None
    if stated is None:
        model = pair.camera.model if pair else None
        return model, None if model is None else "K and D: the rig states them", None
    try:
        camera, why = camera_from_info(stated, rectified=pair.camera.rectified if pair else None, topic=topic)
    except CalibwatchError as error:
        return None, str(error), info_topic
    own = pair.camera.model if pair else None
    if own is not None and not _same(own, camera):
        return own, f"K and D: the rig states them, and {info_topic} states others", info_topic
    return camera, why, info_topic


def _same(a: CameraModel, b: CameraModel) -> bool:
    return a.model == b.model and np.allclose(a.K, b.K) and np.array_equal(a.D, b.D)


def _span(stamps: Sequence[int]) -> Span | None:
    return Span(first_ns=min(stamps), last_ns=max(stamps)) if stamps else None


def _rate_hz(stamps: Sequence[int]) -> float | None:
    """Mean rate; None for fewer than two stamps or a span of zero."""
    span = max(stamps, default=0) - min(stamps, default=0)
    return (len(stamps) - 1) * 1e9 / span if len(stamps) > 1 and span > 0 else None
