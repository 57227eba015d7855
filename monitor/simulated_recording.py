"""A simulated drive as a recording: MCAP as a vehicle sends it, the stored extrinsic in tf_static.

The truth stands in the metadata record ``calibwatch.simulation``; who reads a vehicle's data does not look
there.
"""

import json
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import BinaryIO

from mcap.writer import CompressionType, Writer

from monitor.messages import Transform, ros
from monitor.messages.camera_info import TYPE as INFO_TYPE
from monitor.messages.camera_info import encode_camera_info
from monitor.messages.image import COMPRESSED as IMAGE_TYPE
from monitor.messages.image import encode_compressed_image
from monitor.messages.point_cloud2 import TYPE as CLOUD_TYPE
from monitor.messages.point_cloud2 import encode_point_cloud2
from monitor.messages.tf import TYPE as TF_TYPE
from monitor.messages.tf import encode_tf
from pipeline.errors import InputError
from pipeline.se3 import inverse
from pipeline.simulation.drive import START_NS, Drive, DriveFrame, DriveParameters

CLOUD_TOPIC, IMAGE_TOPIC, INFO_TOPIC, TF_TOPIC = (
    "/lidar/points",
    "/camera/image/compressed",
    "/camera/camera_info",
    "/tf_static",
)
VEHICLE_FRAME, LIDAR_FRAME, CAMERA_FRAME = "base_link", "lidar", "camera"
METADATA = "calibwatch.simulation"

_TYPES = {CLOUD_TOPIC: CLOUD_TYPE, IMAGE_TOPIC: IMAGE_TYPE, INFO_TOPIC: INFO_TYPE, TF_TOPIC: TF_TYPE}
_IMAGE_DELAY_NS = 12_000_000
"""ns from exposure to the bus: readout and compression."""
_CLOUD_DELAY_NS = 4_000_000
"""ns from the end of the sweep to the bus."""
_FRAMES_A_TASK = 12
"""A task draws the street anew (0.3 s against 0.6 s a frame), and its messages wait in memory (30 MB)."""
_CHUNK_BYTES = 4 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Sent:
    """One message as it goes onto the bus: topic, time of sending and time of measuring in ns, CDR bytes."""

    topic: str
    log_ns: int
    stamp_ns: int
    data: bytes


def static_transforms(parameters: DriveParameters) -> tuple[Transform, Transform]:
    """What the vehicle states for good: base_link -> lidar, base_link -> camera by the stored extrinsic."""
    T_vehicle_lidar = parameters.T_vehicle_lidar
    T_vehicle_camera = T_vehicle_lidar @ inverse(parameters.T_stored)
    return (
        Transform(VEHICLE_FRAME, LIDAR_FRAME, T_vehicle_lidar, static=True),
        Transform(VEHICLE_FRAME, CAMERA_FRAME, T_vehicle_camera, static=True),
    )


def messages_of(frame: DriveFrame, parameters: DriveParameters) -> list[Sent]:
    """The messages of one frame in the order in which they are sent."""
    image_ns, cloud_ns = frame.image_stamp_ns, frame.cloud_stamp_ns
    sent_ns = image_ns + _IMAGE_DELAY_NS
    cloud_sent_ns = cloud_ns + round(parameters.lidar.period * 1e9) + _CLOUD_DELAY_NS
    messages = [
        Sent(INFO_TOPIC, sent_ns, image_ns, encode_camera_info(parameters.camera, image_ns, CAMERA_FRAME)),
        Sent(IMAGE_TOPIC, sent_ns, image_ns, encode_compressed_image(frame.image, image_ns, CAMERA_FRAME)),
        Sent(CLOUD_TOPIC, cloud_sent_ns, cloud_ns, encode_point_cloud2(frame.cloud, cloud_ns, LIDAR_FRAME)),
    ]
    return sorted(messages, key=lambda m: m.log_ns)


def write_drive(
    parameters: DriveParameters,
    path: Path,
    *,
    workers: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Simulates a drive and writes it as MCAP, under a temporary name until it is whole.

    Args:
        parameters: The drive.
        path: Of the recording.
        workers: Processes that simulate.
        progress: Called with frames done and frames in all, or None.

    Raises:
        InputError: The file can not be written.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            _write(parameters, file, workers, progress)
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise InputError(f"{path}: {error.strerror or error}", hint="a folder that can be written") from error
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _write(
    parameters: DriveParameters,
    file: BinaryIO,
    workers: int,
    progress: Callable[[int, int], None] | None,
) -> None:
    writer = Writer(file, chunk_size=_CHUNK_BYTES, compression=CompressionType.LZ4)
    writer.start(profile="ros2", library="calibwatch")
    channels = {topic: _channel(writer, topic) for topic in _TYPES}
    tf = encode_tf(static_transforms(parameters), START_NS)
    counts = dict.fromkeys(_TYPES, 0)
    total = parameters.frames
    starts = range(0, total, _FRAMES_A_TASK)
    tasks = [range(first, min(first + _FRAMES_A_TASK, total)) for first in starts]
    writer.add_message(channels[TF_TOPIC], log_time=START_NS, publish_time=START_NS, data=tf)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        try:
            for messages in pool.map(_simulated, [parameters] * len(tasks), tasks):
                for sent in messages:
                    writer.add_message(
                        channels[sent.topic],
                        log_time=sent.log_ns,
                        publish_time=sent.stamp_ns,
                        data=sent.data,
                        sequence=counts[sent.topic],
                    )
                    counts[sent.topic] += 1
                if progress is not None:
                    progress(counts[CLOUD_TOPIC], total)
        except BaseException:
            # Whoever interrupts need not wait for the rest of the drive.
            pool.shutdown(cancel_futures=True)
            raise
    writer.add_metadata(METADATA, _truth(parameters))
    writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without a return type


def _channel(writer: Writer, topic: str) -> int:
    name = _TYPES[topic]
    definition = ros.typestore().generate_msgdef(name, ros_version=2)[0]
    schema = writer.register_schema(name=name, encoding="ros2msg", data=definition.encode())
    return writer.register_channel(topic, message_encoding="cdr", schema_id=schema)


def _simulated(parameters: DriveParameters, indices: range) -> list[Sent]:
    """The messages of some frames; runs in another process."""
    drive = Drive(parameters)
    return [sent for index in indices for sent in messages_of(drive.frame(index), parameters)]


def _truth(parameters: DriveParameters) -> dict[str, str]:
    drift_ns = parameters.drift_stamp_ns
    return {
        "seed": str(parameters.seed),
        "drift": json.dumps(parameters.drift.tolist()),
        "drift_stamp_ns": "" if drift_ns is None else str(drift_ns),
        "T_stored": json.dumps(parameters.T_stored.tolist()),
    }
