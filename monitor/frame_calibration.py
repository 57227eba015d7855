"""One frame calibrated from a start, timed, and held against its truth: what evaluations share."""

import dataclasses
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from monitor.calibrating import settings
from monitor.clock import Clock
from monitor.evaluated_frames import EvaluatedFrame
from monitor.first_guess import PriorSigma, masks_of_network
from pipeline import no_prior, se3
from pipeline.calibration import Calibrated, Calibrator
from pipeline.cloud_lanes import find_lanes
from pipeline.cloud_poles import find_poles
from pipeline.frame_modes import Prior
from pipeline.ground import Ground, fit_ground
from pipeline.masks import horizon_line
from pipeline.mount import Mount
from pipeline.no_prior import FoundExtrinsic, find_extrinsic
from pipeline.parameters import Parameters
from pipeline.records import CloudLine, Floats
from pipeline.segmentation import Segmenter
from pipeline.sensor_seat import sensor_origin


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


def calibrated(
    frame: EvaluatedFrame,
    mount: Mount,
    segmenter: Segmenter,
    times: Stopwatch,
    prior_sigma: PriorSigma | None = None,
) -> Calibrated:
    """What ``calibwatch calibrate`` makes of a frame from the extrinsic of a mount.

    Args:
        frame: The frame.
        mount: With the stored extrinsic.
        segmenter: The network.
        times: Of the stages.
        prior_sigma: ``--prior-sigma``, how far off the extrinsic may be; None: it is a first guess.
    """
    guess, stored = None, None
    if prior_sigma is not None:
        stored = Prior(prior_sigma.sigma_rad, prior_sigma.sigma_m)
        with times.stage("first guess"):
            guess = _found(frame, mount, segmenter, prior_sigma)
    if guess is not None:
        mount = dataclasses.replace(mount, T_cam_lidar=guess)
    believed = settings(found=guess is not None, stored=stored)
    calibrator = Calibrator(mount, Parameters(), segmenter, believed)
    calibrator.step(frame.pair, times.stage)
    return calibrator.finish(times.stage)


def _found(frame: EvaluatedFrame, mount: Mount, segmenter: Segmenter, sigma: PriorSigma) -> Floats | None:
    """The extrinsic (4,4) that is found around that of a mount, or None."""
    horizon = horizon_line(mount.camera, mount.R_vehicle_cam[2])
    found = find_extrinsic(
        frame.pair.cloud,
        frame.pair.image,
        masks_of_network(segmenter, frame.pair, horizon),
        mount.camera,
        np.random.default_rng([Parameters().seed, 0]),
        prior=no_prior.Prior(mount.T_cam_lidar, sigma.sigma_rad, sigma.sigma_m),
    )
    return found.T_cam_lidar if isinstance(found, FoundExtrinsic) else None


def lines_around(frame: EvaluatedFrame, rng: np.random.Generator) -> tuple[list[CloudLine], Ground | None]:
    """Lanes and poles of the whole turn of a frame's LiDAR, and the ground that they stand on."""
    cloud = frame.pair.cloud
    ground = fit_ground(cloud, frame.mount.up, rng)
    if ground is None:
        return [], None
    everywhere = np.ones(len(cloud), dtype=np.bool_)
    origin = sensor_origin(cloud)
    lanes = find_lanes(cloud, ground, everywhere, rng, origin=origin)
    return [*lanes, *find_poles(cloud, ground, everywhere, origin=origin)], ground


def drawn_start(frame: EvaluatedFrame, start: int, widest: Floats, seed: int) -> Floats:
    """Drift (6,) of a start: uniform on each axis; the same for a frame whatever is evaluated beside it."""
    rng = np.random.default_rng([seed, zlib.crc32(frame.name.encode()), start])
    return np.asarray(rng.uniform(-1.0, 1.0, 6) * widest, dtype=np.float64)


def errors_of(frame: EvaluatedFrame, T_cam_lidar: Floats) -> Floats:
    """Motion of the mount from the truth to an extrinsic, (6,), rad and m: 0 where it is right."""
    truth = frame.mount
    return se3.mount_drift(truth.T_cam_lidar, T_cam_lidar, truth.R_vehicle_cam)
