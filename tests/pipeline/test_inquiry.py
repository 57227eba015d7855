import dataclasses
import functools
import math

import numpy as np
import pytest

from pipeline import inquiry as module
from pipeline import verdict
from pipeline.drift_trials import turned_image
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import CameraImage, CameraModel, FramePair
from pipeline.simulation.drive import Drive, DriveParameters, Motion
from pipeline.simulation.lidar import spinning
from pipeline.simulation.scene import SceneParameters
from pipeline.watch import Watch

LIMITS = np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.20, 0.15, 0.15])
CAMERA = CameraModel(
    "pinhole", np.array([[360.0, 0, 269.5], [0, 360, 89.5], [0, 0, 1]]), np.zeros(0), 540, 180
)
DELAY_MS = 40
FOCAL = 1.03
SHAKE = math.radians(0.3)


@functools.cache
def drive(frames):
    """A drive that brakes from 14 to 4 m/s and speeds up again, over and over."""
    parameters = DriveParameters(
        seed=4,
        duration=0.1 * frames,
        scene=SceneParameters(length=260.0),
        motion=Motion(speed=9.0, swing=5.0, swing_period=5.0),
        lidar=spinning(64, 900),
        camera=CAMERA,
    )
    pairs = [
        FramePair("front", f.cloud, f.image, f.cloud_stamp_ns, f.image_stamp_ns, 0.1)
        for f in Drive(parameters)
    ]
    return parameters, pairs


def shaken(pair, hertz):
    """The image of a camera that swings by 0.3 deg about each of its axes."""
    phase = 2.0 * math.pi * hertz * (pair.image_stamp_ns % 10**12) / 1e9
    turn = SHAKE * np.sin(phase + np.array([0.0, 2.0, 4.0]))
    return dataclasses.replace(pair, image=CameraImage(turned_image(pair.image.pixels, CAMERA, turn)))


def watched(frames=12, *, delay_ms=0, focal=1.0, drift=None, hertz=None):
    """A watch that has seen the drive with stamps, lens, extrinsic or mount made wrong; its states."""
    parameters, pairs = drive(frames)
    K = parameters.camera.K.copy()
    K[:2, :2] /= focal
    T = parameters.T_stored
    if drift is not None:
        T = module.se3.stored_before(T, drift, parameters.T_vehicle_lidar[:3, :3])
    mount = Mount(
        camera=dataclasses.replace(parameters.camera, K=K),
        T_cam_lidar=T,
        T_vehicle_lidar=parameters.T_vehicle_lidar,
        sigma_rad=math.radians(0.03),
        sigma_m=0.01,
        limits=LIMITS,
        required=("pitch", "yaw"),
    )
    watch, states = Watch(mount, Parameters(), None), []
    for pair in pairs:
        stamp_ns = pair.image_stamp_ns - delay_ms * 1_000_000
        seen = pair if hertz is None else shaken(pair, hertz)
        watch.step(dataclasses.replace(seen, image_stamp_ns=stamp_ns))
        states.append(watch.memory.state)
    return watch, states


def test_a_healthy_drive_is_not_doubted():
    watch, states = watched()
    assert set(states) <= {"starting", "healthy"}
    found = watch.inquiry.explanation
    assert found.sections >= 1
    assert found.unexplained < 12.6
    assert abs(found.time_offset_s) < 3 * found.time_sigma_s
    assert abs(found.zoom) < 3 * found.zoom_sigma


def test_a_delay_is_no_drift():
    watch, states = watched(delay_ms=DELAY_MS)
    assert "drifted" not in states
    assert watch.memory.state == "suspect"
    assert watch.memory.code in ("forward_or_sync", "time_offset")
    assert "ms" in watch.memory.reason
    found = watch.inquiry.explanation
    assert found.time_alone_s == pytest.approx(1e-3 * DELAY_MS, abs=0.01)


def test_another_focal_length_is_no_drift():
    watch, states = watched(focal=FOCAL)
    assert "drifted" not in states
    assert (watch.memory.state, watch.memory.code) == ("suspect", "intrinsics_changed")
    found = watch.inquiry.explanation
    assert found.zoom == pytest.approx(math.log(FOCAL), abs=3 * found.zoom_sigma)


def test_a_turn_of_the_mount_is_a_drift():
    watch, states = watched(drift=math.radians(0.8) * np.eye(6)[2])
    assert states[-1] == "drifted"
    assert watch.memory.code == "drift_confirmed"


@pytest.mark.parametrize(
    "hertz", [23.7, pytest.param(7.3, marks=pytest.mark.slow), pytest.param(13.1, marks=pytest.mark.slow)]
)
def test_a_mount_that_shakes_has_not_drifted(hertz):
    watch, states = watched(hertz=hertz)
    assert set(states) <= {"starting", "healthy", "unobservable"}
    # Frames scatter by half a limit and more; what is believed of all of them does not.
    judgement = watch.belief.judgement
    assert not judgement.suspicious
    assert (np.abs(judgement.drift) < 0.5 * LIMITS).all()


@pytest.mark.slow
def test_at_changing_speed_a_delay_is_named_with_its_size():
    watch, states = watched(40, delay_ms=DELAY_MS)
    assert "drifted" not in states
    assert (watch.memory.state, watch.memory.code) == ("suspect", "time_offset")
    found = watch.inquiry.explanation
    assert found.separable
    assert found.time_offset_s == pytest.approx(1e-3 * DELAY_MS, abs=0.008)


@pytest.mark.slow
def test_at_changing_speed_a_step_ahead_is_a_drift():
    watch, states = watched(40, drift=0.4 * np.eye(6)[3])
    assert states[-1] == "drifted"
    assert abs(watch.inquiry.explanation.time_offset_s) < 0.008


@pytest.mark.slow
def test_at_changing_speed_a_sound_drive_knows_its_clocks():
    watch, states = watched(40)
    assert set(states) <= {"starting", "healthy"}
    found = watch.inquiry.explanation
    assert found.separable
    assert abs(found.time_offset_s) < 3 * found.time_sigma_s < 0.015


def test_what_was_seen_is_forgotten():
    watch, _ = watched()
    assert watch.inquiry.explanation is not None
    watch.inquiry.forget()
    assert watch.inquiry.explanation is None
    doubt = watch.inquiry.ask((), watch.belief, watch.memory, stirred=True, claimed=True)
    assert doubt is None


def test_every_cause_but_the_mount_has_a_reason_and_a_code():
    assert set(module.REASONS) == set(verdict.CODES) & set(module.REASONS)
    assert all(verdict.CODES[code] == "suspect" for code in module.REASONS)
