"""What a recording holds and what could be watched in it: the answer of ``calibwatch inspect``.

The recording is read through: stamps of every message from its head (:mod:`monitor.messages.header`), the
first sweeps and images decoded. Nothing is guessed: what was not looked at, or can not be told, is null.
"""

import itertools
import statistics
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from monitor.baseline_file import with_baselines
from monitor.daemon import mount_of
from monitor.discovery import TF_TYPES, Survey, discover, survey_in
from monitor.inspection_report import (
    CloudReport,
    ImageReport,
    Inspection,
    Link,
    PairReport,
    Span,
    TopicReport,
)
from monitor.messages import CameraInfo, Message, decode
from monitor.messages.header import header_stamp_ns
from monitor.preparation import prepare
from monitor.rig import Rig, RigPair, camera_from_info, is_cloud, load_rig
from monitor.sources import Source, Tick, TopicInfo, kinds, open_source
from monitor.sources.kitti_raw import NOMINAL_PERIOD_NS
from monitor.sync import middle_ns, pairer_for
from monitor.wording import spin_warning
from pipeline.cameras import project
from pipeline.errors import CalibwatchError, InputError
from pipeline.records import CameraModel, PointCloud
from pipeline.rings import scan_pattern
from pipeline.se3 import apply, inverse
from pipeline.spin_check import told_spin

_SWEEPS = 5
"""Sweeps per topic that are decoded: enough to tell a constant number of points from a changing one."""
_TRANSFORMS = 1000
"""tf messages that are decoded for the list of transforms: ten seconds at the usual 100 Hz."""
_NONE = -1
"""Stands for an absent number in arrays: hours of a fast topic must fit into memory."""
_LIVE = "zenoh_live"
"""The kind of source that never ends."""


@dataclass(slots=True)
class _Seen:
    """What was seen of one topic; the three arrays have one number per message, -1 where there is none."""

    headers: "array[int]" = field(default_factory=lambda: array("q"))
    logged: "array[int]" = field(default_factory=lambda: array("q"))
    sequences: "array[int]" = field(default_factory=lambda: array("q"))
    clouds: list[tuple[int, PointCloud, float | None]] = field(default_factory=list)
    frame: str = ""
    undecodable: str | None = None

    def arrive(self, message: Message) -> None:
        """Takes note of a message; what is beyond 64 bits is no stamp."""
        for numbers, value in (
            (self.headers, header_stamp_ns(message)),
            (self.logged, message.log_ns),
            (self.sequences, message.sequence),
        ):
            numbers.append(value if value is not None and 0 <= value < 1 << 63 else _NONE)

    @property
    def stamps(self) -> list[int]:
        """Stamps as pairing sees them: of the header, else of the log."""
        both = zip(self.headers, self.logged, strict=True)
        return [log_ns if stamp in (0, _NONE) else stamp for stamp, log_ns in both]


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
        seen, links = _read_through(source)
        losses = source.losses
    rig, how, missing = _rig(location, rig_file, survey, own=own is not None)
    reports = tuple(_topic(topic, seen.get(topic.name, _Seen()), survey, rig) for topic in topics)
    return Inspection(
        location=location,
        kind=kind,
        vehicle=None if rig is None else rig.vehicle,
        topics=reports,
        transforms=tuple(
            Link(parent=t.parent, child=t.child, static=t.static) for t in links.transforms.values()
        ),
        pairs=() if rig is None else tuple(_pair(p, how[p.name], seen, reports) for p in rig.pairs),
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


def _read_through(source: Source) -> tuple[dict[str, _Seen], Survey]:
    """Every topic, and the transforms."""
    seen: dict[str, _Seen] = {}
    links, left = Survey(), _TRANSFORMS
    for message in source:
        if isinstance(message, Tick):
            continue
        topic = seen.setdefault(message.topic, _Seen())
        topic.arrive(message)
        if is_cloud(message.type) and len(topic.clouds) < _SWEEPS and topic.undecodable is None:
            _decode_cloud(message, topic)
        if message.type in TF_TYPES and left > 0:
            left -= 1
            links.see(message)
    return seen, links


def _decode_cloud(message: Message, topic: _Seen) -> None:
    try:
        decoded = decode(message)
    except InputError as error:
        topic.undecodable = str(error)
        return
    for one in decoded:
        if isinstance(one.value, PointCloud):
            topic.frame = one.frame
            topic.clouds.append((one.stamp_ns or message.log_ns, one.value, message.sweep_s))


def _topic(topic: TopicInfo, seen: _Seen, survey: Survey, rig: Rig | None) -> TopicReport:
    both = [pair for pair in zip(seen.headers, seen.logged, strict=True) if pair[0] != _NONE]
    headers, logged = [stamp for stamp, _ in both], [log_ns for log_ns in seen.logged if log_ns != _NONE]
    delays = [log_ns - stamp for stamp, log_ns in both if log_ns != _NONE]
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


def _cloud(seen: _Seen, topic: str, rig: Rig | None) -> CloudReport:
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
    stated: CameraInfo | None = survey.infos[info_topic][1] if info_topic in survey.infos else None
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


def _pair(pair: RigPair, how: str, seen: Mapping[str, _Seen], topics: Sequence[TopicReport]) -> PairReport:
    """One pair with its gaps, view and problems. Topics and extrinsic of the pair are known."""
    assert pair.T_cam_lidar is not None  # noqa: S101 - a prepared rig lacks nothing
    lidar, camera = pair.lidar.topic or "", pair.camera.topic or ""
    sweeps, images = seen.get(lidar, _Seen()), seen.get(camera, _Seen())
    by_name = {topic.name: topic for topic in topics}
    report = by_name[lidar].cloud
    middle = 0 if report is None or report.middle_ms is None else round(report.middle_ms * 1e6)
    same = by_name[camera].type.startswith("file/") and sorted(images.stamps) == sorted(sweeps.stamps)
    gaps = _gaps(pair, sweeps, images, middle)
    nearest = _nearest_ms([stamp + middle for stamp in sweeps.stamps], images.stamps)
    in_view = _in_view(pair, sweeps)
    T_lidar_cam = inverse(pair.T_cam_lidar)
    return PairReport(
        name=pair.name,
        lidar=lidar,
        camera=camera,
        how=how.removeprefix(f"{lidar} with {camera}, "),
        T_cam_lidar=pair.T_cam_lidar.tolist(),
        camera_at_m=T_lidar_cam[:3, 3].tolist(),
        looks_along=T_lidar_cam[:3, 2].tolist(),
        vehicle_frame=pair.T_vehicle_lidar is not None,
        sweeps=len(sweeps.logged),
        images=len(images.logged),
        pairs=len(gaps),
        same_stamps=same,
        gap_ms=statistics.median(gaps) if gaps and not same else None,
        nearest_ms=nearest,
        clock_offset_ms=_clock_offset_ms(by_name[lidar], by_name[camera]),
        in_view=in_view,
        problems=tuple(_problems(pair, by_name, len(gaps), nearest, in_view)),
        warnings=_warnings(pair, sweeps),
    )


def _warnings(pair: RigPair, sweeps: _Seen) -> tuple[str, ...]:
    """What the first sweeps say against the sense of rotation that the rig states."""
    spin, clouds = pair.lidar.spin, sweeps.clouds
    if spin is None or pair.camera.model is None or any(cloud.time is not None for _, cloud, _ in clouds):
        return ()
    told_s = next((sweep_s for _, _, sweep_s in clouds if sweep_s is not None), None)
    told = told_spin([(stamp_ns, cloud) for stamp_ns, cloud, _ in clouds], told_s, mount_of(pair).up)
    return () if told in (None, spin) else (spin_warning(told),)


def _gaps(pair: RigPair, sweeps: _Seen, images: _Seen, middle: int) -> list[float]:
    """Image stamp minus middle of the sweep, ms, of each pair; found as the monitor finds them."""
    pairer = pairer_for(pair)
    arrivals = [
        (log_ns, side, stamp, None if sequence == _NONE else sequence)
        for side, topic in (("camera", images), ("lidar", sweeps))
        for stamp, log_ns, sequence in zip(topic.stamps, topic.logged, topic.sequences, strict=True)
    ]
    paired = []
    for _, side, stamp, sequence in sorted(arrivals, key=lambda arrival: arrival[0]):
        if side == "lidar":
            paired += pairer.push_lidar(stamp + middle, None, sequence)
        else:
            paired += pairer.push_camera(stamp, None, sequence)
    paired += pairer.flush()
    return [(one.camera_ns - one.lidar_ns) / 1e6 for one in paired]


def _clock_offset_ms(lidar: TopicReport, camera: TopicReport) -> float | None:
    """How far the camera's clock is ahead of the LiDAR's if both take equally long from measuring to log.

    A sweep is sent when it ends, which its stamp does not tell where its duration is unknown.
    """
    if lidar.delay_ms is None or camera.delay_ms is None or lidar.cloud is None:
        return None
    cloud = lidar.cloud
    known = cloud.middle_ms is not None and cloud.sweep_s is not None
    end_ms = (cloud.middle_ms or 0.0) + 500.0 * (cloud.sweep_s or 0.0) if known else 0.0
    return lidar.delay_ms - end_ms - camera.delay_ms


def _nearest_ms(sweeps: Sequence[int], images: Sequence[int]) -> float | None:
    """Median of image stamp minus nearest sweep, ms; None where one of them is empty."""
    if not sweeps or not images:
        return None
    order = np.sort(np.array(sweeps, dtype=np.int64))
    stamps = np.array(images, dtype=np.int64)
    after = (
        np.clip(np.searchsorted(order, stamps), 1, len(order) - 1)
        if len(order) > 1
        else np.zeros_like(stamps)
    )
    before = np.maximum(after - 1, 0)
    differences = np.stack([stamps - order[before], stamps - order[after]])
    chosen = np.abs(differences).argmin(axis=0)
    return float(np.median(differences[chosen, np.arange(len(stamps))])) / 1e6


def _in_view(pair: RigPair, sweeps: _Seen) -> tuple[int, int] | None:
    """Points of the first sweep that the stored extrinsic puts into the image, and all of them."""
    cloud = next((cloud for _, cloud, _ in sweeps.clouds if len(cloud)), None)
    if cloud is None or pair.camera.model is None or pair.T_cam_lidar is None:
        return None
    _, inside = project(pair.camera.model, apply(pair.T_cam_lidar, cloud.xyz))
    return int(inside.sum()), len(cloud)


def _problems(
    pair: RigPair,
    topics: Mapping[str, TopicReport],
    pairs: int,
    nearest: float | None,
    in_view: tuple[int, int] | None,
) -> list[str]:
    """What will keep the pair from being judged."""
    lidar, camera = topics[pair.lidar.topic or ""], topics[pair.camera.topic or ""]
    found = [f"{topic.name}: {topic.undecodable}" for topic in (lidar, camera) if topic.undecodable]
    found += [f"{topic.name} has no message" for topic in (lidar, camera) if topic.count == 0]
    model = pair.camera.model
    if camera.image is not None and model is not None and camera.image.size != (model.width, model.height):
        width, height = camera.image.size
        found.append(f"images are {width}x{height} px, the intrinsics are for {model.width}x{model.height}")
    if pairs == 0 and nearest is not None:
        found.append(
            f"no sweep and image belong together: camera stamps are {nearest / 1e3:+.3f} s from the nearest "
            f"sweep, the limit is {pair.max_gap_ns / 1e6:g} ms"
        )
    if in_view is not None and in_view[0] == 0:
        found.append("no point of the first sweep falls into the image: is T_cam_lidar inverted?")
    if lidar.cloud is not None and lidar.cloud.rings is None:
        found.append("the clouds show no rings: only lines can be compared, no edges")
    return found


def _span(stamps: Sequence[int]) -> Span | None:
    return Span(first_ns=min(stamps), last_ns=max(stamps)) if stamps else None


def _rate_hz(stamps: Sequence[int]) -> float | None:
    """Mean rate; None for fewer than two stamps or a span of zero."""
    span = max(stamps, default=0) - min(stamps, default=0)
    return (len(stamps) - 1) * 1e9 / span if len(stamps) > 1 and span > 0 else None
