"""The whole product on a simulated drive: simulate, record, replay over zenoh, judge, tell."""

import math
import shutil
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from monitor.outputs.summary import Summary
from monitor.replaying import replay
from monitor.simulated_recording import CLOUD_TOPIC, IMAGE_TOPIC, INFO_TOPIC, write_drive
from pipeline.errors import InputError
from pipeline.records import Floats
from pipeline.simulation.drive import START_NS, DriveParameters

YAW_DEG, LEFT_M = 0.5, 0.05
"""How the mount slips: half a degree puts a lane line 50 m ahead aside by 0.44 m."""

DURATION_S, DRIFT_S = 12.0, 6.0
"""Length of the drive, and when the mount slips: a few seconds of health, then time to be told."""

RIG = f"""# A vehicle whose extrinsic was measured well: what it says of its own uncertainty decides how small
# a drift can be told from it.
vehicle = "demo-1"

[[pairs]]
name = "front"
lidar = {{ topic = "{CLOUD_TOPIC}" }}
camera = {{ topic = "{IMAGE_TOPIC}", info = "{INFO_TOPIC}" }}

[pairs.extrinsic]      # T_cam_lidar itself comes from the recording's tf_static
sigma_deg = 0.03
sigma_m = 0.01
"""

_FREE_BYTES = 800 << 20
"""bytes of disk that the recordings of the demo need."""


@dataclass(frozen=True, slots=True)
class Told:
    """What the demo showed.

    Attributes:
        summary: Of the replay.
        lines: The timeline, for people.
        success: Whether the drift was told, and not before it was there.
    """

    summary: Summary
    lines: tuple[str, ...]
    success: bool


def demo_drive(seed: int) -> DriveParameters:
    """The drive of the demo."""
    return DriveParameters(seed=seed, duration=DURATION_S, drift=demo_drift(), drift_time=DRIFT_S)


def demo_drift() -> Floats:
    """Motion of the mount, float64 (6,), rad and m."""
    return np.array([0.0, 0.0, math.radians(YAW_DEG), 0.0, LEFT_M, 0.0])


def demo(out: Path, seed: int, stop: threading.Event, progress: Callable[[str], None]) -> Told:
    """Simulates, records, replays and judges; all files go to ``out``.

    Raises:
        CalibwatchError: Something in the way: the folder, the disk, the model.
        KeyboardInterrupt: ``stop`` was set before the drive was there.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        if shutil.disk_usage(out).free < _FREE_BYTES:
            raise InputError(
                f"{out} has less than {_FREE_BYTES >> 20} MiB of free disk",
                hint="name another folder with --out",
            )
        recording, rig_file = out / "drive.mcap", out / "rig.toml"
        rig_file.write_text(RIG, encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"folder {out} can not be used: {error.strerror}", hint="--out wants a folder"
        ) from error

    def simulated(done: int, total: int) -> None:
        if stop.is_set():
            raise KeyboardInterrupt  # half a drive is worth nothing
        progress(f"simulating frame {done} of {total}")

    write_drive(demo_drive(seed), recording, progress=simulated)
    summary = replay(
        str(recording),
        rig_file,
        None,
        out,
        model=None,
        images_hz=2.0,
        over_zenoh=True,
        stop=stop,
        progress=lambda pairs: progress(f"replaying over zenoh, pair {pairs}"),
    )
    return Told(summary, *timeline(summary))


def timeline(summary: Summary) -> tuple[tuple[str, ...], bool]:
    """What was told when, in seconds of the drive, and whether that is what should be told."""
    pair = summary.pairs["front"]
    truth = f"the mount turns {YAW_DEG:+.2f} deg in yaw and slips {LEFT_M:+.3f} m left"
    lines = [f"{DRIFT_S:6.2f} s  TRUTH       {truth}"]
    drifted_s = None
    for change in pair.timeline:
        seconds = (change.stamp_ns - START_NS) / 1e9
        lines.append(f"{seconds:6.2f} s  {change.state:<12}{change.reason}")
        if change.state == "drifted" and drifted_s is None:
            drifted_s = seconds
    lines.sort(key=lambda line: float(line.split()[0]))
    if drifted_s is None:
        return (*lines, "The drift was not told."), False
    drift = pair.last.drift
    lines.append(
        f"told {drifted_s - DRIFT_S:.2f} s after it happened: "
        f"yaw {drift.yaw.value:+.2f} deg (truth {YAW_DEG:+.2f}), "
        f"left {drift.left.value:+.3f} m (truth {LEFT_M:+.3f})"
    )
    if (onset := pair.last.onset) is not None:
        at, first, last = ((stamp - START_NS) / 1e9 for stamp in (onset.stamp_ns, onset.from_ns, onset.to_ns))
        lines[-1] += f"; dated to {at:.2f} s, between {first:.2f} and {last:.2f} s (truth {DRIFT_S:.2f})"
    return tuple(lines), drifted_s >= DRIFT_S
