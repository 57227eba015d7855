"""Scenes of image-level simulated streets, as the watch hears them: what the evidence model is fitted to."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import FramePair
from pipeline.scene_filter import Scene
from pipeline.simulation.drive import Drive, DriveParameters, Motion
from pipeline.simulation.rigs import draw_rig
from pipeline.watch import Watch
from pipeline.window import WindowParameters

SIGMA_RAD, SIGMA_M = math.radians(0.1), 0.02
"""Of a stored extrinsic that says nothing else (DESIGN 3)."""

STREET_M = 130.0
"""m of each street: five scenes or six."""

_AHEAD_M = 150.0
"""m of street beyond its end, to look at."""

_APART_M = 3.8
"""m between frames: six of them hold the road of a window at 10 Hz, at a fifth of the cost."""

_FRAMES = 6

_WIDTH = 640
_MOST_RINGS = 64
_MOST_PIXELS = 470_000
"""Images and clouds that are drawn in half a second; wider images are reduced to ``_WIDTH`` px."""


def street_drive(seed: int, index: int) -> DriveParameters:
    """Drive ``index`` of a seed: a drawn rig on a drawn street."""
    rng = np.random.default_rng([seed, index])
    drive = draw_rig(rng)
    while (
        drive.camera.width * drive.camera.height > _MOST_PIXELS or len(drive.lidar.elevations) > _MOST_RINGS
    ):
        drive = draw_rig(rng)
    scale = _WIDTH / drive.camera.width
    camera = dataclasses.replace(
        drive.camera,
        K=np.diag([scale, scale, 1.0]) @ drive.camera.K,
        width=_WIDTH,
        height=int(drive.camera.height * scale),
    )
    speed = float(rng.uniform(6.0, 14.0))
    return dataclasses.replace(
        drive,
        camera=camera,
        duration=STREET_M / speed,
        motion=Motion(speed=speed, swing=1.0, bob=math.radians(0.15)),
        scene=dataclasses.replace(drive.scene, length=STREET_M + _AHEAD_M),
    )


def street_scenes(seed: int, index: int) -> list[Scene]:
    """The scenes that a watch without lines hears on one street, whose stored extrinsic is the true one."""
    parameters = street_drive(seed, index)
    drive = Drive(parameters)
    window = WindowParameters(most_frames=_FRAMES, dense_frames=_FRAMES)
    watch = Watch(_mount(parameters), Parameters(window=window), None)
    ways = parameters.motion.along(parameters.lidar.period * np.arange(len(drive), dtype=np.float64))
    found: list[Scene] = []
    last = -math.inf
    for number, way in enumerate(ways):
        if way - last < _APART_M:
            continue
        last = float(way)
        frame = drive.frame(number)
        watch.step(
            FramePair(
                "front",
                frame.cloud,
                frame.image,
                frame.cloud_stamp_ns,
                frame.image_stamp_ns,
                parameters.lidar.period,
            )
        )
        heard, total = watch.belief, watch.scenes.total
        if heard is not None and total.scenes > len(found) and total.way_m is not None:
            evidence = heard.evidence
            found.append(
                Scene(
                    evidence.drift,
                    evidence.covariance,
                    evidence.feigned,
                    total.way_m,
                    frame.image_stamp_ns,
                )
            )
    return found


def _mount(drive: DriveParameters) -> Mount:
    """The drive's rig, its extrinsic known as well as one that says nothing else."""
    return Mount(
        drive.camera,
        drive.T_stored,
        drive.T_vehicle_lidar,
        SIGMA_RAD,
        SIGMA_M,
        np.array([*np.radians([0.75, 0.5, 0.5]), 0.20, 0.15, 0.15]),
        ("yaw", "pitch"),
    )


def image_level(streets: int, seed: int, progress: Callable[[str, int, int], None]) -> list[list[Scene]]:
    """Scenes of several streets; one of 30 frames takes half a minute."""
    found: list[list[Scene]] = []
    for index in range(streets):
        progress("image-level street", index + 1, streets)
        found.append(street_scenes(seed, index))
    return found
