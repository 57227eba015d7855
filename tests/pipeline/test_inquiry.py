import dataclasses
import functools
import math
import re
import typing

import numpy as np
import pytest

from pipeline import inquiry as module
from pipeline import se3, verdict
from pipeline.causes import Cause, CauseParameters, Explanation
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import CameraImage, CameraModel, FramePair
from pipeline.simulation.drive import Drive, DriveParameters, Motion
from pipeline.simulation.lidar import spinning
from pipeline.simulation.scene import SceneParameters
from pipeline.staging import turned_image
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
    return [
        FramePair("front", f.cloud, f.image, f.cloud_stamp_ns, f.image_stamp_ns, 0.1)
        for f in Drive(parameters)
    ]


def shaken(pair, hertz):
    """The image of a camera that swings by 0.3 deg about each of its axes."""
    phase = 2.0 * math.pi * hertz * (pair.image_stamp_ns % 10**12) / 1e9
    turn = SHAKE * np.sin(phase + np.array([0.0, 2.0, 4.0]))
    return dataclasses.replace(pair, image=CameraImage(turned_image(pair.image.pixels, CAMERA, turn)))


def mount_of(focal=1.0, drift=None):
    """What is stored, with a focal length and an extrinsic made wrong."""
    K = CAMERA.K.copy()
    K[:2, :2] /= focal
    rig = DriveParameters()
    drift = np.zeros(6) if drift is None else drift
    return Mount(
        camera=dataclasses.replace(CAMERA, K=K),
        T_cam_lidar=se3.stored_before(rig.T_stored, drift, rig.T_vehicle_lidar[:3, :3]),
        T_vehicle_lidar=rig.T_vehicle_lidar,
        sigma_rad=math.radians(0.03),
        sigma_m=0.01,
        limits=LIMITS,
        required=("pitch", "yaw"),
    )


def watched(frames=12, *, delay_ms=0, delayed_from=0, focal=1.0, drift=None, hertz=None):
    """A watch that has seen the drive with stamps, lens, extrinsic or mount made wrong; its states."""
    pairs = drive(frames)
    mount = mount_of(focal, drift)
    watch, states = Watch(mount, Parameters(), None), []
    for number, pair in enumerate(pairs):
        stamp_ns = pair.image_stamp_ns - (number >= delayed_from) * delay_ms * 1_000_000
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


def test_clocks_that_come_apart_on_the_way_are_no_drift():
    watch, states = watched(20, delay_ms=DELAY_MS, delayed_from=12)
    assert "drifted" not in states
    assert (watch.memory.state, watch.memory.code) == ("suspect", "forward_or_sync")
    told_ms = float(re.search(r"images ([+-]\d+) ms off", watch.memory.reason)[1])
    assert told_ms == pytest.approx(DELAY_MS, abs=10.0)


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
    watch, states = watched(60, delay_ms=DELAY_MS)
    assert "drifted" not in states
    assert (watch.memory.state, watch.memory.code) == ("suspect", "time_offset")
    found = watch.inquiry.explanation
    assert found.time_offset_s == pytest.approx(1e-3 * DELAY_MS, abs=0.012)


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
    assert watch.inquiry.ask((), watch.belief, watch.memory, None) is None


def explanation(**changes):
    """Nothing found, but for the changes."""
    found = Explanation(
        time_offset_s=0.0,
        time_sigma_s=0.001,
        time_alone_s=0.0,
        separable=True,
        zoom=0.0,
        zoom_sigma=0.001,
        motion=np.array([0.0, 0.0, 0.2, 12.0, 0.0, 0.0]),
        needed=np.zeros(3),
        alone=np.zeros(3),
        unexplained=100.0,
        sections=20,
    )
    return dataclasses.replace(found, **changes)


LATE = {"time_offset_s": 0.025, "needed": np.array([0.0, 400.0, 0.0])}
ZOOMED = {"zoom": 0.03, "needed": np.array([0.0, 0.0, 400.0])}


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({}, None),
        (LATE, "time_offset"),
        (LATE | {"separable": False}, None),
        (LATE | {"time_offset_s": 0.010}, None),
        (LATE | {"needed": np.array([0.0, 10.0, 0.0])}, None),
        (ZOOMED, "intrinsics_changed"),
        (ZOOMED | {"zoom": 0.01}, None),
        (ZOOMED | {"needed": np.array([0.0, 0.0, 10.0])}, None),
    ],
)
def test_while_nothing_stirs_only_what_is_sure_and_matters_is_told(changes, code):
    mount = mount_of()
    doubt = module.doubt_of(explanation(**changes), mount, CauseParameters(), stirred=False, claimed=False)
    assert (None if doubt is None else doubt.code) == code


@pytest.mark.parametrize(
    ("alone", "claimed", "code"),
    [
        ((0.0, 90.0, 90.0), True, None),
        ((90.0, 0.0, 90.0), True, "time_offset"),
        ((90.0, 90.0, 0.0), True, "intrinsics_changed"),
        ((3.0, 0.0, 90.0), True, "forward_or_sync"),
        ((3.0, 0.0, 90.0), False, "forward_or_sync"),
        ((0.0, 90.0, 5.0), True, None),
        ((90.0, 2.0, 0.0), True, "cause_open"),
        ((90.0, 2.0, 0.0), False, None),
        ((90.0, 80.0, 70.0), True, "cause_open"),
    ],
)
def test_what_stirs_is_doubted_where_the_mount_is_not_the_best_cause(alone, claimed, code):
    mount = mount_of()
    found = explanation(alone=np.array(alone))
    doubt = module.doubt_of(found, mount, CauseParameters(), stirred=True, claimed=claimed)
    assert (None if doubt is None else doubt.code) == code
    for silent in ({"needed": np.array([50.0, 0.0, 0.0])}, {"unexplained": 5.0}):
        sure = dataclasses.replace(found, **silent)
        assert module.doubt_of(sure, mount, CauseParameters(), stirred=True, claimed=claimed) is None


def test_every_cause_but_the_mount_has_a_reason_and_a_code():
    assert set(module.REASONS) == set(typing.get_args(Cause)) - {"mount"}
    assert all(verdict.CODES[code] == "suspect" for code in module.REASONS)
