"""Single frames whose extrinsic is known: out of recordings, one by one, or simulated."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np

from monitor.daemon import mount_of
from monitor.intake import Intake, pairs_of
from monitor.preparation import prepare
from monitor.rig import Rig, parse_rig
from monitor.sources import kinds, open_source
from pipeline.errors import CalibwatchError, InputError
from pipeline.mount import Mount
from pipeline.records import CameraModel, Floats, FramePair
from pipeline.se3 import stored_before
from pipeline.simulation.drive import Drive
from pipeline.simulation.rigs import draw_rig

_DEEPEST = 4
"""Folders within folders that are searched for recordings."""

SIMULATED = "simulated"
"""Set that simulated frames belong to."""

_PAIR = "front"


@dataclass(frozen=True, slots=True, eq=False)
class EvaluatedFrame:
    """One frame and its truth.

    Attributes:
        name: Of the frame.
        group: Of the set that it belongs to.
        pair: Sweep and image.
        mount: Its extrinsic is the true one.
        reference_sigma: float64 (6,), how well that is known on each axis, rad and m; 0 in simulation.
    """

    name: str
    group: str
    pair: FramePair
    mount: Mount
    reference_sigma: Floats

    def off_by(self, drift: Floats) -> Mount:
        """The mount as it was stored before it moved by ``drift`` (6,), rad, m, to where it is."""
        T_vehicle_lidar = self.mount.T_vehicle_lidar
        R_vehicle_lidar = None if T_vehicle_lidar is None else T_vehicle_lidar[:3, :3]
        T_stored = stored_before(self.mount.T_cam_lidar, drift, R_vehicle_lidar)
        return dataclasses.replace(self.mount, T_cam_lidar=T_stored)

    @property
    def camera(self) -> CameraModel:
        """Intrinsics."""
        return self.mount.camera


@dataclass(frozen=True, slots=True, eq=False)
class EvaluatedFrames:
    """Frames that are read or drawn when they are asked for.

    Attributes:
        count: How many there are.
        read: Begins to read them.
    """

    count: int
    read: Callable[[], Iterator[EvaluatedFrame]]

    def __iter__(self) -> Iterator[EvaluatedFrame]:
        return self.read()

    def __len__(self) -> int:
        return self.count


def chained(parts: Sequence[EvaluatedFrames]) -> EvaluatedFrames:
    """The frames of all parts, one part after the other."""
    return EvaluatedFrames(
        sum(part.count for part in parts), lambda: (frame for part in parts for frame in part)
    )


def simulated_frames(count: int, seed: int) -> EvaluatedFrames:
    """Frames of drawn rigs on drawn streets; frame k of a seed is always the same."""
    return EvaluatedFrames(count, lambda: (_simulated(seed, k) for k in range(count)))


def _simulated(seed: int, index: int) -> EvaluatedFrame:
    parameters = draw_rig(np.random.default_rng([seed, index]))
    frame = Drive(parameters).frame(0)
    pair = FramePair(_PAIR, frame.cloud, frame.image, frame.cloud_stamp_ns, frame.image_stamp_ns)
    camera = parameters.camera
    # As a rig file that leaves open all that may be left open.
    document = {
        "name": _PAIR,
        "camera": {
            "model": camera.model,
            "K": camera.K.tolist(),
            "D": camera.D.tolist(),
            "width": camera.width,
            "height": camera.height,
        },
        "extrinsic": {"T_cam_lidar": frame.T_cam_lidar.tolist()},
        "T_vehicle_lidar": parameters.T_vehicle_lidar.tolist(),
    }
    mount = mount_of(parse_rig({"pairs": [document]}, where=SIMULATED).pairs[0])
    name = f"{len(parameters.lidar.elevations)} rings {seed}/{index}"
    return EvaluatedFrame(name, SIMULATED, pair, mount, np.zeros(6))


def recorded_frames(
    places: Sequence[Path],
    most: int,
    reference_sigma: Floats,
    tell: Callable[[str], None] = lambda _: None,
    *,
    of_sets: Mapping[str, Floats] = MappingProxyType({}),
) -> EvaluatedFrames:
    """Frames of every recording in some folders, each with the extrinsic that the recording states.

    Args:
        places: Recordings, or folders that contain recordings.
        most: Frames of each pair of each recording; those of a longer one are spread evenly over it.
        reference_sigma: float64 (6,), how well the recordings know their extrinsic, rad and m.
        tell: Told what of the recordings could not be used, one sentence each.
        of_sets: The same for single sets, by name.

    Raises:
        CalibwatchError: ``of_sets`` names a set that is not there, a place holds no recording, or a recording
            can not be used at all or does not state its extrinsic; before any frame is given.
    """
    recordings = [found for place in places for found in _recordings(place)]
    sets = list(dict.fromkeys(group for _, group in recordings))
    for name in of_sets:
        if name not in sets:
            raise InputError(f"there is no set '{name}'", hint=f"there are: {', '.join(sets)}")
    listed = [_listed(location, group, most, tell) for location, group in recordings]
    count = sum(len(one.chosen) for one in listed)
    return EvaluatedFrames(
        count,
        lambda: (frame for one in listed for frame in _read(one, of_sets.get(one.group, reference_sigma))),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Recording:
    """A recording whose frames were counted.

    Attributes:
        location: Where it is.
        group: The set that it belongs to.
        rig: Complete.
        chosen: Frames that are taken: name of the pair, number among the pair's frames.
        several: Whether the number is part of a frame's name.
    """

    location: Path
    group: str
    rig: Rig
    chosen: frozenset[tuple[str, int]]
    several: bool


def _recordings(place: Path) -> list[tuple[Path, str]]:
    """Recordings at or below a place, each with the name of its set.

    A place of which recordings lie deeper than in its own folders is a folder of sets, else it is one set.
    """
    if not place.exists():
        raise InputError(f"{place} does not exist")
    if _is_recording(place):
        return [(place, place.resolve().name)]
    found = [path for path in _below(place, _DEEPEST) if _is_recording(path)]
    if not found:
        raise InputError(
            f"{place} holds no frames",
            hint="wanted are folders with calib.json, KITTI raw drives, .mcap, .bag or rosbag2 recordings",
        )
    parts = [path.relative_to(place).parts for path in found]
    sets = max(map(len, parts)) > 1
    return [
        (path, part[0] if sets else place.resolve().name) for path, part in zip(found, parts, strict=True)
    ]


def _below(folder: Path, depth: int) -> Iterator[Path]:
    """What lies below a folder, in the order of names; not what lies inside recordings."""
    try:
        entries = sorted(folder.iterdir()) if depth and folder.is_dir() else []
    except OSError as error:
        raise InputError(f"{folder} can not be read: {error.strerror}") from error
    for path in entries:
        yield path
        if not _is_recording(path):
            yield from _below(path, depth - 1)


def _is_recording(path: Path) -> bool:
    return any(kind.matches(str(path)) for kind in kinds())


def _listed(location: Path, group: str, most: int, tell: Callable[[str], None]) -> _Recording:
    rig, cameras = _stated(location)
    counts = dict.fromkeys(cameras, 0)
    intake = Intake(rig)
    with open_source(str(location)) as source:
        for pair in pairs_of(source, intake):
            camera = cameras[pair.pair]
            if pair.image.size != (camera.width, camera.height):
                width, height = pair.image.size
                raise InputError(
                    f"{location}: an image of pair {pair.pair} is {width}x{height} px, the intrinsics are "
                    f"for {camera.width}x{camera.height}",
                    hint="give the intrinsics for this size",
                )
            counts[pair.pair] += 1
        notes = [*source.losses.notes, *intake.notes]
    if not any(counts.values()):
        why = notes[0] if notes else "no sweep and image belong together"
        raise InputError(f"{location}: {why}", hint="calibwatch inspect tells what the recording holds")
    for note in notes:
        tell(f"{location}: {note}")
    chosen = frozenset((name, k) for name, count in counts.items() for k in _spread(count, most))
    return _Recording(location, group, rig, chosen, several=max(counts.values()) > 1)


def _stated(location: Path) -> tuple[Rig, dict[str, CameraModel]]:
    """The rig that a recording states, and the cameras of its pairs; what is refused names the recording."""
    try:
        rig = prepare(str(location), None, None).rig
        return rig, {pair.name: mount_of(pair).camera for pair in rig.pairs}
    except CalibwatchError as error:
        if str(location) in error.what:
            raise
        raise type(error)(f"{location}: {error.what}", hint=error.hint) from error


def _spread(count: int, most: int) -> list[int]:
    """At most so many of ``count`` numbers, first and last among them; of one, the middle."""
    if count <= most:
        return list(range(count))
    if most == 1:
        return [count // 2]
    return [round(k * (count - 1) / (most - 1)) for k in range(most)]


def _read(recording: _Recording, reference_sigma: Floats) -> Iterator[EvaluatedFrame]:
    mounts = {pair.name: mount_of(pair) for pair in recording.rig.pairs}
    counts = dict.fromkeys(mounts, 0)
    with open_source(str(recording.location)) as source:
        for pair in pairs_of(source, Intake(recording.rig)):
            number = counts[pair.pair]
            counts[pair.pair] += 1
            if (pair.pair, number) in recording.chosen:
                name = _name(recording, pair.pair, number)
                yield EvaluatedFrame(name, recording.group, pair, mounts[pair.pair], reference_sigma)


def _name(recording: _Recording, pair: str, number: int) -> str:
    name = recording.location.resolve().name
    if len(recording.rig.pairs) > 1:
        name += f" {pair}"
    return f"{name} #{number}" if recording.several else name
