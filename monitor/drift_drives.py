"""Drives whose extrinsic is known: recordings, decoded once, or simulated."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from monitor.daemon import mount_of
from monitor.intake import Intake, pairs_of
from monitor.preparation import prepare
from monitor.rig import parse_rig
from monitor.sources import open_source
from pipeline.errors import CalibwatchError, InputError
from pipeline.mount import Mount
from pipeline.records import Floats, FramePair, read_only
from pipeline.simulation.drive import Drive, DriveParameters
from pipeline.simulation.rigs import draw_rig

_STREET_M = 130.0
"""m of street that a drive needs beyond its own way."""

SIMULATED_S = 4.0
"""s of each simulated drive: a window and some judgements at 10 Hz."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownDrive:
    """One pair of one drive.

    Attributes:
        name: Of recording and, where it has several, pair.
        simulated: Whether the truth is exact.
        mount: With the true extrinsic.
        reference_sigma: float64 (6,), how well that is known, rad and m; 0 in simulation.
        frames: Decoded.
    """

    name: str
    simulated: bool
    mount: Mount
    reference_sigma: Floats
    frames: tuple[FramePair, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "reference_sigma", read_only(self.reference_sigma))

    @property
    def span_s(self) -> float:
        """From the first to the last image, s."""
        return (self.frames[-1].image_stamp_ns - self.frames[0].image_stamp_ns) / 1e9


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where drives come from; they are decoded or simulated when they are asked for.

    Attributes:
        name: Of the recording, or of the simulated drive.
        read: Gives its drives, one for each pair.
    """

    name: str
    read: Callable[[], list[KnownDrive]]


def recorded(locations: Sequence[str], reference_sigma: Floats) -> list[Place]:
    """Recordings, any that ``replay`` takes, each with the extrinsic that it states.

    Args:
        locations: Of the recordings.
        reference_sigma: float64 (6,), how well the recordings know their extrinsic, rad and m.

    Raises:
        CalibwatchError: A recording can not be used, or does not state its extrinsic; before any is decoded.
    """
    names = [Path(location).resolve().name for location in locations]
    twice = {name for name in names if names.count(name) > 1}
    places = []
    for location, short in zip(locations, names, strict=True):
        _stated(location)
        name = location if short in twice else short
        places.append(Place(name, _reader(location, name, reference_sigma)))
    return places


def simulated(count: int, seed: int) -> list[Place]:
    """Drives of drawn rigs on drawn streets; drive k of a seed is always the same."""
    return [Place(_name(seed, k), _simulator(seed, k)) for k in range(count)]


def _stated(location: str) -> dict[str, Mount]:
    """The mounts that a recording states; what is refused names the recording."""
    try:
        return {pair.name: mount_of(pair) for pair in prepare(location, None, None).rig.pairs}
    except CalibwatchError as error:
        if location in error.what:
            raise
        raise type(error)(f"{location}: {error.what}", hint=error.hint) from error


def _reader(location: str, name: str, reference_sigma: Floats) -> Callable[[], list[KnownDrive]]:
    def read() -> list[KnownDrive]:
        mounts = _stated(location)
        frames: dict[str, list[FramePair]] = {pair: [] for pair in mounts}
        intake = Intake(prepare(location, None, None).rig)
        with open_source(location) as source:
            for pair in pairs_of(source, intake):
                camera = mounts[pair.pair].camera
                if pair.image.size == (camera.width, camera.height) and len(pair.cloud) > 0:
                    frames[pair.pair].append(pair)
        drives = [
            KnownDrive(
                name if len(mounts) == 1 else f"{name} {pair}",
                simulated=False,
                mount=mounts[pair],
                reference_sigma=reference_sigma,
                frames=tuple(found),
            )
            for pair, found in frames.items()
            if found
        ]
        if not drives:
            raise InputError(
                f"{location}: no sweep and image belong together",
                hint="calibwatch inspect tells what the recording holds",
            )
        return drives

    return read


def _name(seed: int, index: int) -> str:
    return f"simulated {seed}/{index}"


def _simulator(seed: int, index: int) -> Callable[[], list[KnownDrive]]:
    def read() -> list[KnownDrive]:
        parameters = drive_of(seed, index)
        drive = Drive(parameters)
        frames = tuple(
            FramePair("front", frame.cloud, frame.image, frame.cloud_stamp_ns, frame.image_stamp_ns)
            for frame in drive
        )
        return [
            KnownDrive(
                _name(seed, index),
                simulated=True,
                mount=_mount_of(parameters),
                reference_sigma=np.zeros(6),
                frames=frames,
            )
        ]

    return read


def drive_of(seed: int, index: int) -> DriveParameters:
    """A drawn rig that drives for ``SIMULATED_S``."""
    drawn = draw_rig(np.random.default_rng([seed, index]))
    way = float(drawn.motion.along(np.array(SIMULATED_S)))
    length = max(drawn.scene.length, way + _STREET_M)
    return dataclasses.replace(
        drawn, duration=SIMULATED_S, scene=dataclasses.replace(drawn.scene, length=length)
    )


def _mount_of(parameters: DriveParameters) -> Mount:
    """As a rig file that leaves open all that may be left open."""
    camera = parameters.camera
    document = {
        "name": "front",
        "camera": {
            "model": camera.model,
            "K": camera.K.tolist(),
            "D": camera.D.tolist(),
            "width": camera.width,
            "height": camera.height,
        },
        "extrinsic": {"T_cam_lidar": parameters.T_stored.tolist()},
        "T_vehicle_lidar": parameters.T_vehicle_lidar.tolist(),
    }
    return mount_of(parse_rig({"pairs": [document]}, where="simulated").pairs[0])
