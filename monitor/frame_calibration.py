"""One frame calibrated from a start, timed, and held against its truth: what evaluations share."""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from monitor.clock import Clock
from monitor.evaluated_frames import EvaluatedFrame
from pipeline import se3
from pipeline.calibration import Calibrated, CalibrationParameters, Calibrator
from pipeline.parameters import Parameters
from pipeline.records import Floats
from pipeline.segmentation import Segmenter
from pipeline.watch import Mount


@dataclass(slots=True)
class Stopwatch:
    """Adds up how long stages take, ms."""

    clock: Clock
    ms: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Times one stage."""
        begun = self.clock.monotonic_ns()
        try:
            yield
        finally:
            took = (self.clock.monotonic_ns() - begun) / 1e6
            self.ms[name] = self.ms.get(name, 0.0) + took


def calibrated(frame: EvaluatedFrame, mount: Mount, segmenter: Segmenter, times: Stopwatch) -> Calibrated:
    """What ``calibwatch calibrate`` makes of a frame from the extrinsic of a mount as first guess."""
    calibrator = Calibrator(mount, Parameters(), segmenter, CalibrationParameters())
    calibrator.step(frame.pair, times.stage)
    return calibrator.finish(times.stage)


def drawn_start(frame: EvaluatedFrame, start: int, widest: Floats, seed: int) -> Floats:
    """Drift (6,) of a start: uniform on each axis; the same for a frame whatever is evaluated beside it."""
    rng = np.random.default_rng([seed, zlib.crc32(frame.name.encode()), start])
    return np.asarray(rng.uniform(-1.0, 1.0, 6) * widest, dtype=np.float64)


def errors_of(frame: EvaluatedFrame, T_cam_lidar: Floats) -> Floats:
    """Motion of the mount from the truth to an extrinsic, (6,), rad and m: 0 where it is right."""
    truth = frame.mount
    return se3.mount_drift(truth.T_cam_lidar, T_cam_lidar, truth.R_vehicle_cam)
