"""Drives seen badly, standing, or with gaps: never healthy without evidence, never drifted (DESIGN 4)."""

import dataclasses
import functools
import math
from importlib import resources

import cv2
import numpy as np
import pytest

from pipeline import se3
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import CameraImage, CameraModel, FramePair, PointCloud
from pipeline.segmentation import Segmenter
from pipeline.simulation.drive import Drive, DriveParameters
from pipeline.simulation.lidar import spinning
from pipeline.simulation.scene import SceneParameters
from pipeline.watch import Watch

LIMITS = np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.20, 0.15, 0.15])
CAMERA = CameraModel(
    "pinhole", np.array([[360.0, 0, 269.5], [0, 360, 89.5], [0, 0, 1]]), np.zeros(0), 540, 180
)
FRAMES, LATER = 14, 10
TENTH = 100_000_000


@functools.cache
def drive():
    """Two seconds at 10 Hz with small sensors: parameters and pairs."""
    parameters = DriveParameters(
        seed=3,
        duration=0.1 * (FRAMES + LATER),
        camera=CAMERA,
        lidar=spinning(64, 900),
        scene=SceneParameters(length=200.0),
    )
    pairs = [
        FramePair("front", f.cloud, f.image, f.cloud_stamp_ns, f.image_stamp_ns, 0.1)
        for f in Drive(parameters)
    ]
    return parameters, pairs


def mount_of(parameters, xi=None):
    T = parameters.T_stored if xi is None else se3.retract(parameters.T_stored, xi)
    return Mount(
        camera=parameters.camera,
        T_cam_lidar=T,
        T_vehicle_lidar=parameters.T_vehicle_lidar,
        sigma_rad=math.radians(0.1),
        sigma_m=0.02,
        limits=LIMITS,
        required=("pitch", "yaw"),
    )


def watched(pairs, xi=None):
    """A watch that has seen the pairs to their end, and the states it went through."""
    watch, states = Watch(mount_of(drive()[0], xi), Parameters(), None), []
    for pair in pairs:
        watch.step(pair)
        states.append(watch.memory.state)
    watch.finish()
    return watch, [*states, watch.memory.state]


def redrawn(pair, pixels):
    return dataclasses.replace(pair, image=CameraImage(np.clip(pixels, 0, 255).astype(np.uint8)))


def noise(pair, k, sigma):
    return np.random.default_rng(k).normal(0.0, sigma, pair.image.pixels.shape)


def night(pair, k):
    """A hundredth of the light, and the noise of the sensor."""
    return redrawn(pair, 0.01 * pair.image.pixels + 3.0 + noise(pair, k, 2.0))


def covered(pair, k):
    """Tape over the lens: its texture, nothing else."""
    texture = np.random.default_rng(1).integers(20, 90, pair.image.pixels.shape)
    return redrawn(pair, cv2.GaussianBlur(texture.astype(np.float32), (0, 0), 3.0) + noise(pair, k, 1.0))


def smeared(pair, k):
    """Dirt and grease: a fifth of the width of the image blurred into one, blobs over half of it."""
    rng = np.random.default_rng(2)
    pixels = cv2.GaussianBlur(pair.image.pixels.astype(np.float32), (0, 0), 40.0)
    for _ in range(60):
        centre = (int(rng.integers(0, 540)), int(rng.integers(0, 180)))
        cv2.circle(pixels, centre, int(rng.integers(10, 40)), (40.0, 45.0, 50.0), -1)
    return redrawn(pair, pixels + noise(pair, k, 1.0))


def downpour(pair, k):
    """Drops before lens and LiDAR: streaks everywhere, and most beams end in the spray."""
    rng = np.random.default_rng(k)
    pixels = cv2.GaussianBlur(pair.image.pixels.astype(np.float32), (0, 0), 6.0) * 0.3 + 80.0
    for _ in range(1500):
        u, v = int(rng.integers(0, 540)), int(rng.integers(0, 180))
        cv2.line(pixels, (u, v), (u + 2, v + 14), (200.0, 200.0, 200.0), 1)
    cloud = pair.cloud
    nearer = np.where(rng.random(len(cloud)) < 0.7, rng.uniform(0.02, 0.3, len(cloud)), 1.0)
    wet = PointCloud(
        (cloud.xyz * nearer[:, None]).astype(np.float32), cloud.intensity, cloud.ring, cloud.time
    )
    return dataclasses.replace(redrawn(pair, pixels), cloud=wet)


def fog(pair, k):
    """White, and the noise of the sensor."""
    return redrawn(pair, 0.0 * pair.image.pixels + 200.0 + noise(pair, k, 2.0))


def late(pair, k):
    """The image of a second later, under the stamp of now: eleven metres further on."""
    return dataclasses.replace(pair, image=drive()[1][k + LATER].image)


SIGHTS = [
    covered,
    late,
    night,
    *(pytest.param(sight, marks=pytest.mark.slow) for sight in (smeared, downpour, fog)),
]


@pytest.mark.parametrize("sight", SIGHTS)
def test_what_carries_no_evidence_is_neither_healthy_nor_drifted(sight):
    pairs = [sight(pair, k) for k, pair in enumerate(drive()[1][:FRAMES])]
    watch, states = watched(pairs)
    assert not {"healthy", "drifted"} & set(states)
    # And it says why.
    assert states[-1] in ("unobservable", "suspect")
    assert watch.memory.code in ("nothing_in_common", "too_short", "no_scan_pattern", "evidence_of_drift")


def test_the_same_drive_seen_well_does_carry_evidence():
    watch, states = watched(drive()[1][:FRAMES])
    assert not {"drifted", "suspect"} & set(states)
    assert not watch.belief.judgement.blind
    assert watch.belief.judgement.observable.all()


@pytest.mark.parametrize("sight", [covered, late])
def test_a_wrong_extrinsic_is_not_healthy_on_them_either(sight):
    pairs = [sight(pair, k) for k, pair in enumerate(drive()[1][:FRAMES])]
    _, states = watched(pairs, np.array([0.0, math.radians(2.0), 0.0, 0.0, 0.0, 0.0]))
    assert "healthy" not in states


def test_who_stands_grows_no_surer_however_long():
    parameters, pairs = drive()
    first = pairs[0]
    noisy = [
        dataclasses.replace(
            redrawn(first, first.image.pixels + noise(first, k, 2.0)),
            cloud_stamp_ns=first.cloud_stamp_ns + k * TENTH,
            image_stamp_ns=first.image_stamp_ns + k * TENTH,
        )
        for k in range(40)
    ]
    watch = Watch(mount_of(parameters), Parameters(), None)
    sigmas = []
    for pair in noisy:
        watch.step(pair)
        if watch.belief is not None:
            sigmas.append(watch.belief.judgement.sigma)
    assert (sigmas[-1] > 0.7 * sigmas[0]).all()
    assert watch.memory.state in ("starting", "unobservable", "healthy")
    assert watch.departed["repeats"] > 10
    assert (watch.belief.judgement.protection_level > 0).all()
    # The mount is what it was: no doubt arises from looking at one thing for long.
    assert not watch.belief.judgement.suspicious
    assert (np.abs(watch.belief.judgement.drift) < LIMITS).all()


def kept(pattern):
    """The drive without the frames that a pattern skips."""
    pairs = drive()[1]
    if pattern == "random":
        chosen = np.flatnonzero(np.random.default_rng(4).random(len(pairs)) < 0.6)
        return [pairs[k] for k in chosen]
    return {"all": pairs, "even": pairs[::2], "odd": pairs[1::2]}[pattern]


@pytest.mark.slow
def test_the_verdict_does_not_depend_on_which_frames_were_skipped():
    wrong = np.array([0.0, math.radians(1.0), 0.0, 0.0, 0.0, 0.0])
    for xi, end in ((None, ("starting", "healthy", "unobservable")), (wrong, ("drifted",))):
        judgements = {}
        for pattern in ("all", "even", "odd", "random"):
            watch, states = watched(kept(pattern), xi)
            assert states[-1] in end, (pattern, watch.memory.reason)
            assert "drifted" in end or not {"suspect", "drifted"} & set(states), pattern
            judgements[pattern] = watch.belief.judgement
        for pattern, judgement in judgements.items():
            off = np.abs(judgement.drift - judgements["all"].drift)
            assert (off < 2.0 * judgement.sigma).all(), pattern


@pytest.mark.slow
@pytest.mark.parametrize("turn_deg", [0.0, 1.0])
def test_the_verdict_does_not_depend_on_which_frames_got_lines(turn_deg):
    """Each, some, few, and at other moments: states end alike, and estimates agree within their sigma."""
    parameters, pairs = drive()
    segmenter = Segmenter((resources.files("models") / "bisenetv2.onnx").read_bytes(), threads=1)
    xi = np.array([0.0, math.radians(turn_deg), 0.0, 0.0, 0.0, 0.0])
    judgements, ends, counts = [], [], []
    for every_ns, first in ((TENTH, 0), (5 * TENTH, 0), (5 * TENTH, 3), (12 * TENTH, 0)):
        settings = Parameters(lines_every_ns=every_ns)
        watch, states = Watch(mount_of(parameters, xi), settings, segmenter), []
        for pair in pairs[first:]:
            watch.step(pair)
            states.append(watch.memory.state)
        watch.finish()
        judgements.append(watch.belief.judgement)
        ends.append(watch.memory.state)
        counts.append(len(watch.line_stamps))
        assert not ({"healthy"} if turn_deg else {"suspect", "drifted"}) & set(states)
    assert counts[0] > counts[1] > counts[3] > 0
    assert len(set(ends)) == 1
    for judgement in judgements[1:]:
        off = np.abs(judgement.drift - judgements[0].drift)
        assert (off < 2.0 * judgement.sigma).all()
