"""One short simulated drive, and recordings that are derived from it by rewriting its MCAP.

The camera mount turns by :data:`SLIP_DEG` in yaw at :data:`SLIP_S`; what comes before is a healthy drive.
"""

import dataclasses
import math
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from monitor.simulated_recording import CLOUD_TOPIC, IMAGE_TOPIC, INFO_TOPIC, TF_TOPIC, write_drive
from pipeline.records import CameraModel
from pipeline.simulation.drive import START_NS, DriveParameters
from pipeline.simulation.lidar import spinning

SLIP_DEG, SLIP_S, DURATION_S = 1.0, 2.0, 6.0
SLIP_NS = START_NS + round(SLIP_S * 1e9)
WIDTH, HEIGHT, FOCAL = 640, 203, 427.0

PARAMETERS = DriveParameters(
    seed=3,
    duration=DURATION_S,
    lidar=spinning(32),
    camera=CameraModel(
        "pinhole",
        np.array([[FOCAL, 0.0, 319.5], [0.0, FOCAL, 96.5], [0.0, 0.0, 1.0]]),
        np.zeros(0),
        WIDTH,
        HEIGHT,
    ),
    drift=np.array([0.0, 0.0, math.radians(SLIP_DEG), 0.0, 0.0, 0.0]),
    drift_time=SLIP_S,
)


@dataclass(frozen=True)
class Recorded:
    """One message of a recording."""

    topic: str
    type: str
    data: bytes
    log_ns: int
    sequence: int


def simulate(path: Path) -> None:
    write_drive(PARAMETERS, path)


def read(path: Path) -> list[Recorded]:
    with path.open("rb") as file:
        return [
            Recorded(channel.topic, schema.name, message.data, message.log_time, message.sequence)
            for schema, channel, message in make_reader(file).iter_messages()
            if schema is not None
        ]


def write(path: Path, messages: Iterable[Recorded], *, chunk_bytes: int = 1 << 20) -> Path:
    """Writes messages as they are; definitions are left out, for types are known by name."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_bytes, compression=CompressionType.LZ4)
        writer.start(profile="ros2")
        channels: dict[tuple[str, str], int] = {}
        for message in messages:
            key = message.topic, message.type
            if key not in channels:
                schema = writer.register_schema(message.type, "ros2msg", b"")
                channels[key] = writer.register_channel(message.topic, "cdr", schema)
            writer.add_message(
                channels[key],
                log_time=message.log_ns,
                publish_time=message.log_ns,
                data=message.data,
                sequence=message.sequence,
            )
        writer.finish()
    return path


def first_frames(messages: Iterable[Recorded], frames: int) -> list[Recorded]:
    """The first frames of every topic: ``frames`` images and sweeps."""
    return [message for message in messages if message.sequence < frames]


def changed(
    messages: Iterable[Recorded], topic: str, change: Callable[[Recorded], Recorded]
) -> list[Recorded]:
    return [change(message) if message.topic == topic else message for message in messages]


def with_data(data: bytes) -> Callable[[Recorded], Recorded]:
    return lambda message: dataclasses.replace(message, data=data)


def stamped(message: Recorded, stamp_ns: int) -> Recorded:
    """The message with another stamp in its header; the log time stays."""
    head = struct.pack("<iI", *divmod(stamp_ns, 10**9))
    return dataclasses.replace(message, data=message.data[:4] + head + message.data[12:])


def stamp_of(message: Recorded) -> int:
    sec, nanosec = struct.unpack_from("<iI", message.data, 4)
    return int(sec) * 10**9 + int(nanosec)


__all__ = ["CLOUD_TOPIC", "IMAGE_TOPIC", "INFO_TOPIC", "TF_TOPIC"]

RIG = f"""vehicle = "van-1"
[[pairs]]
name = "front"
lidar = {{ topic = "{CLOUD_TOPIC}" }}
camera = {{ topic = "{IMAGE_TOPIC}", info = "{INFO_TOPIC}" }}
"""

INTRINSICS = f"width = {WIDTH}, height = {HEIGHT}, K = [[{FOCAL}, 0, 319.5], [0, {FOCAL}, 96.5], [0, 0, 1]]"
"""May stand in place of ``info``."""
