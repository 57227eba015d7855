"""Tunnels, open country, woods and traffic jams: unobservable with the reason, never healthy (DESIGN 4)."""

import dataclasses
import functools
import importlib.util
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline import se3
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import CameraImage, CameraModel, FramePair
from pipeline.simulation.camera import Look
from pipeline.simulation.drive import Drive, DriveParameters, Motion
from pipeline.simulation.lidar import spinning
from pipeline.simulation.scene import SceneParameters
from pipeline.verdict import VerdictParameters
from pipeline.watch import Watch

_spec = importlib.util.spec_from_file_location(
    "bad_roads", Path(__file__).parents[1] / "oracles" / "bad_roads.py"
)
roads = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(roads)

LIMITS = np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.20, 0.15, 0.15])
CAMERA = CameraModel(
    "pinhole", np.array([[360.0, 0, 269.5], [0, 360, 89.5], [0, 0, 1]]), np.zeros(0), 540, 180
)
DARK, DIM, DAY = Look(grey=20.0, noise=3.5), Look(grey=70.0, noise=2.5), Look()
DRIVING, JAMMED = Motion(), Motion(speed=0.4, swing=0.0, weave=0.0, bob=math.radians(0.02))
BARREN = {
    "tunnel": (roads.tunnel, DARK, DRIVING),
    "marked tunnel": (functools.partial(roads.tunnel, marked=True), DARK, DRIVING),
    "lit tunnel": (functools.partial(roads.tunnel, lamps=True, marked=True), DIM, DRIVING),
    "open country": (roads.open_country, DAY, DRIVING),
}
"""Where image and cloud have nothing in common that would tell where the camera looks."""
CROWDED = {
    "bushes": (functools.partial(roads.open_country, bushes=80), DAY, DRIVING),
    "woods": (functools.partial(roads.open_country, bushes=40, woods=True), DAY, DRIVING),
    "jam": (roads.jam, DAY, JAMMED),
}
"""Where a second shows too little for a healthy mount, and enough for one that is off."""
ROADS = BARREN | CROWDED
WRONG = {"pitch": (0.0, 1.0, 0.0), "yaw": (0.0, 0.0, -1.0)}
WHY = ("nothing_in_common", "too_short", "no_scan_pattern", "ambiguous", "axes_not_monitored")


@functools.cache
def driven(road, seed, frames):
    """Parameters and pairs of a drive at 10 Hz with small sensors."""
    scene, look, motion = ROADS[road]
    return _driven(scene(seed), seed, range(frames), look, motion)


def _driven(scene, seed, which, look=DAY, motion=DRIVING):
    parameters = DriveParameters(
        seed=seed,
        duration=0.1 * which.stop,
        camera=CAMERA,
        lidar=spinning(64, 900),
        scene=SceneParameters(length=260.0),
        look=look,
        motion=motion,
    )
    drive = Drive(parameters, scene)
    frames = (drive.frame(index) for index in which)
    pairs = [FramePair("front", f.cloud, f.image, f.cloud_stamp_ns, f.image_stamp_ns, 0.1) for f in frames]
    return parameters, pairs


def mount_of(parameters, turn_deg=(0.0, 0.0, 0.0)):
    """What is stored where the mount has turned since."""
    drift = np.array([*np.radians(turn_deg), 0.0, 0.0, 0.0])
    return Mount(
        camera=parameters.camera,
        T_cam_lidar=se3.stored_before(parameters.T_stored, drift, parameters.T_vehicle_lidar[:3, :3]),
        T_vehicle_lidar=parameters.T_vehicle_lidar,
        sigma_rad=math.radians(0.1),
        sigma_m=0.02,
        limits=LIMITS,
        required=("pitch", "yaw"),
    )


def watched(mount, pairs, settings=None):
    """A watch that has seen the pairs to their end, and the states it went through."""
    watch, states = Watch(mount, Parameters() if settings is None else settings, None), []
    for pair in pairs:
        watch.step(pair)
        states.append(watch.memory.state)
    watch.finish()
    return watch, [*states, watch.memory.state]


def each(names, fast, seeds, frames):
    """Cases (road, seed, frames): the fast ones with one seed and a second, the others slow."""
    short = [pytest.param(name, 1, 8, id=f"{name}-1") for name in names if name in fast]
    long = [
        pytest.param(name, seed, frames, id=f"{name}-{seed}-long", marks=pytest.mark.slow)
        for name in names
        for seed in seeds
    ]
    return [*short, *long]


@pytest.mark.parametrize(
    ("road", "seed", "frames"), each(BARREN, ("tunnel", "lit tunnel", "open country"), (1, 2, 3), 24)
)
def test_a_barren_road_is_unobservable_wherever_the_camera_looks(road, seed, frames):
    parameters, pairs = driven(road, seed, frames)
    for turn_deg in ((0.0, 0.0, 0.0), *WRONG.values()):
        watch, states = watched(mount_of(parameters, turn_deg), pairs)
        assert set(states) <= {"starting", "unobservable"}, (turn_deg, watch.memory.reason)
        assert states[-1] == "unobservable"
        assert watch.memory.code in WHY


@pytest.mark.parametrize(("road", "seed", "frames"), each(CROWDED, ("jam",), (1, 2), 24))
def test_a_crowded_road_tells_a_camera_that_is_off_and_calls_none_healthy_for_it(road, seed, frames):
    parameters, pairs = driven(road, seed, frames)
    watch, states = watched(mount_of(parameters), pairs)
    assert not {"drifted", "suspect"} & set(states), watch.memory.reason
    if states[-1] == "unobservable":
        assert watch.memory.code in WHY
    for axis, turn_deg in WRONG.items():
        watch, states = watched(mount_of(parameters, turn_deg), pairs)
        assert "healthy" not in states, axis
        assert frames < 20 or states[-1] in ("suspect", "drifted"), (axis, watch.memory.reason)


STREET = 8
PATIENCE_S, WINDOW_S = 2, 4
"""Of the verdict; and what the window lasts on the way, with a judgement."""


def covered(pair):
    """Tape over the lens."""
    texture = np.random.default_rng(1).integers(20, 90, pair.image.pixels.shape).astype(np.float32)
    pixels = cv2.GaussianBlur(texture, (0, 0), 3.0)
    pixels += np.random.default_rng(pair.image_stamp_ns % 2**32).normal(0.0, 1.0, pixels.shape)
    image = CameraImage(np.clip(pixels, 0, 255).astype(np.uint8))
    return dataclasses.replace(pair, image=image)


def after(what, seconds):
    """What follows a street of STREET frames, in its stamps."""
    which = range(STREET, STREET + 10 * seconds)
    if what == "covered":
        return [covered(pair) for pair in _driven(None, 3, which)[1]]
    scene, look, motion = ROADS[what]
    return _driven(scene(1), 1, which, look, motion)[1]


@pytest.mark.parametrize(
    ("what", "seconds"),
    [
        ("open country", PATIENCE_S + 1),
        pytest.param("tunnel", PATIENCE_S + WINDOW_S, marks=pytest.mark.slow),
        pytest.param("covered", PATIENCE_S + WINDOW_S, marks=pytest.mark.slow),
    ],
)
def test_who_was_healthy_is_so_no_longer_than_patience_once_nothing_is_seen(what, seconds):
    parameters, pairs = _driven(None, 3, range(STREET))
    settings = Parameters(verdict=VerdictParameters(patience_ns=PATIENCE_S * 10**9))
    watch, states = watched(mount_of(parameters), [*pairs, *after(what, seconds)], settings)
    assert states[STREET - 1] == "healthy"
    assert set(states) <= {"starting", "healthy", "unobservable"}
    assert states[-1] == "unobservable", watch.memory.reason
    assert watch.memory.code in WHY
