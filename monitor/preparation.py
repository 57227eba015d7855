"""From a recording and, perhaps, a rig file to a rig in which nothing is missing (DESIGN 3)."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from monitor.discovery import VEHICLE_FRAMES, Survey, compose, discover, path, survey_in
from monitor.injection import inject
from monitor.rig import (
    Rig,
    RigPair,
    bind,
    camera_from_info,
    is_cloud,
    is_image,
    load_rig,
    parse_rig,
)
from monitor.sources import Source, TopicInfo, open_source, zenoh_live
from pipeline.errors import InputError, RigError
from pipeline.records import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """A rig whose every pair has topics, intrinsics and an extrinsic.

    Attributes:
        rig: The rig.
        notes: How it came about, one sentence each.
        frames: Pairs of a sweep and an image that the recording can hold, or None where it does not say.
    """

    rig: Rig
    notes: tuple[str, ...]
    frames: int | None = None


def prepare(
    location: str,
    rig_file: Path | None,
    drift: Floats | None,
    *,
    needs_extrinsic: bool = True,
    known: Callable[[Rig], Rig] = lambda rig: rig,
) -> Prepared:
    """The rig for a recording: from ``rig_file``, else from the recording itself.

    Args:
        location: The recording.
        rig_file: A rig file or ``calib.json``, or None.
        drift: float64 (6,), altered into every stored extrinsic (``--inject``), or None.
        needs_extrinsic: False leaves it open where neither rig nor recording tells it.
        known: Adds what else is known of the complete rig, under the extrinsics as they are stored.

    Raises:
        InputError: The recording can not be read or does not hold what the rig names.
        RigError: The rig file is wrong, or something it leaves open is not in the recording.
    """
    if zenoh_live.SOURCE.matches(location) and not Path(location).exists():
        raise InputError(f"{location} is a bus, not a recording", hint="calibwatch run watches a bus")
    with open_source(location) as source:
        own = source.rig_document()
        topics = source.describe()
        if rig_file is not None:
            rig, notes = _from_file(rig_file, own, topics, location), (f"rig from {rig_file}",)
        elif own is not None:
            rig, notes = (
                bind(parse_rig(own, where=location), topics, where=location),
                ("rig from the folder",),
            )
        else:
            found, found_notes = _discovered(source, topics, location)
            return _prepared(known(found), found_notes, drift, topics)
    _check_types(rig, topics, location)
    rig = completed(rig, lambda: _survey(location, topics), needs_extrinsic=needs_extrinsic)
    return _prepared(known(rig), notes, drift, topics)


def _check_types(rig: Rig, topics: Sequence[TopicInfo], location: str) -> None:
    """InputError where a topic of the rig carries something else than its side of the pair needs."""
    types = {topic.name: topic.type for topic in topics}
    for pair in rig.pairs:
        for topic, fits, what in (
            (pair.lidar.topic, is_cloud, "a point cloud"),
            (pair.camera.topic, is_image, "an image"),
        ):
            if topic is not None and not fits(types[topic]):
                fitting = ", ".join(name for name, kind in types.items() if fits(kind))
                raise InputError(
                    f"{location}: topic {topic} (pair {pair.name}) carries "
                    f"{types[topic] or 'no known type'}, not {what}",
                    hint=f"{what} is in: {fitting}" if fitting else f"no topic here carries {what}",
                )


def _prepared(
    rig: Rig, notes: tuple[str, ...], drift: Floats | None, topics: Sequence[TopicInfo]
) -> Prepared:
    if drift is not None:
        rig = dataclasses.replace(rig, pairs=tuple(inject(pair, drift) for pair in rig.pairs))
    counts = {topic.name: topic.count for topic in topics}
    frames = 0
    for pair in rig.pairs:
        sweeps, images = counts.get(pair.lidar.topic or ""), counts.get(pair.camera.topic or "")
        if sweeps is None or images is None:
            return Prepared(rig, notes)
        frames += min(sweeps, images)
    return Prepared(rig, notes, frames)


def _from_file(rig_file: Path, own: dict[str, object] | None, topics: Sequence[TopicInfo], where: str) -> Rig:
    """The rig of a file; what it leaves open of topics and pairing is taken from the folder's own rig."""
    rig = load_rig(rig_file)
    if own is None:
        return bind(rig, topics, where=where)
    folder = parse_rig(own, where=where)
    return bind(
        dataclasses.replace(rig, pairs=tuple(_placed(pair, folder) for pair in rig.pairs)),
        topics,
        where=where,
    )


def _placed(pair: RigPair, folder: Rig) -> RigPair:
    """What a pair leaves open comes from the folder's pair of its topics, of its name, else the first."""
    named = pair.lidar.topic is not None or pair.camera.topic is not None
    fits = [
        other
        for other in folder.pairs
        if (pair.lidar.topic in (None, other.lidar.topic) and pair.camera.topic in (None, other.camera.topic))
    ]
    if named and not fits:
        return pair
    own = next((other for other in fits if other.name == pair.name), fits[0])
    return dataclasses.replace(
        pair,
        lidar=dataclasses.replace(pair.lidar, topic=own.lidar.topic, spin=pair.lidar.spin or own.lidar.spin),
        camera=dataclasses.replace(pair.camera, topic=own.camera.topic),
        pairing=own.pairing,
    )


def _discovered(source: Source, topics: Sequence[TopicInfo], location: str) -> tuple[Rig, tuple[str, ...]]:
    found = discover(survey_in(source, topics))
    if found.rig is None:
        raise InputError(
            f"{location} does not say how its sensors are mounted: {'; '.join(found.missing)}",
            hint="give a rig file with --rig",
        )
    return found.rig, found.notes


def _survey(location: str, topics: Sequence[TopicInfo]) -> Survey:
    with open_source(location) as source:
        return survey_in(source, topics)


def completed(rig: Rig, survey: Callable[[], Survey], *, needs_extrinsic: bool = True) -> Rig:
    """The rig with intrinsics and extrinsics that its file leaves open, taken from the messages.

    Args:
        rig: Topics are named.
        survey: Reads the beginning of the messages; called only if something is open.
        needs_extrinsic: Whether an extrinsic that nothing tells is an error.
    """
    if all(pair.camera.model is not None and pair.T_cam_lidar is not None for pair in rig.pairs):
        return rig
    seen = survey()
    pairs = tuple(_completed(pair, seen, needs_extrinsic=needs_extrinsic) for pair in rig.pairs)
    return dataclasses.replace(rig, pairs=pairs)


def _completed(pair: RigPair, survey: Survey, *, needs_extrinsic: bool) -> RigPair:
    if pair.store is not None and needs_extrinsic:
        raise RigError(
            f"pair {pair.name} wants extrinsic 'store:{pair.store}', but there is no extrinsic store here",
            hint="give T_cam_lidar in the rig file, or import one with calibwatch extrinsic import",
        )
    image, cloud = pair.camera.topic or "", pair.lidar.topic or ""
    camera = pair.camera
    if camera.model is None:
        info_topic = camera.info or survey.info_of(image)
        if info_topic is None or info_topic not in survey.infos:
            raise RigError(
                f"pair {pair.name}: no intrinsics for {image}",
                hint="give K, D, width, height or info in the rig",
            )
        model, _ = camera_from_info(survey.infos[info_topic][1], rectified=camera.rectified, topic=image)
        camera = dataclasses.replace(camera, model=model)
    T, T_vehicle_lidar = pair.T_cam_lidar, pair.T_vehicle_lidar
    source = pair.lidar.frame or survey.clouds.get(cloud, "")
    if T_vehicle_lidar is None:
        chains = (path(survey.transforms.values(), frame, source) for frame in VEHICLE_FRAMES)
        T_vehicle_lidar = next((compose(chain) for chain in chains if chain is not None), None)
    if T is None:
        target = camera.frame or (survey.images[image][0] if image in survey.images else "")
        # Frames without names are not one and the same.
        chain = path(survey.transforms.values(), target, source) if source and target else None
        if chain is None and needs_extrinsic:
            raise RigError(
                f"pair {pair.name}: no extrinsic, and no chain of transforms from {source or '(no frame)'} "
                f"to {target or '(no frame)'}",
                hint="give T_cam_lidar in the rig file, record tf_static, or calibrate --no-prior",
            )
        T = None if chain is None else compose(chain)
    return dataclasses.replace(pair, camera=camera, T_cam_lidar=T, T_vehicle_lidar=T_vehicle_lidar)
