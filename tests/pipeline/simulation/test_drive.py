import dataclasses
import math

import numpy as np
import pytest

from pipeline.cameras import project
from pipeline.errors import InputError
from pipeline.records import AXES, CameraModel
from pipeline.se3 import apply, displaced, inverse, log_so3, mount_drift, vehicle_axes
from pipeline.simulation.drive import START_NS, Drive, DriveParameters, Motion
from pipeline.simulation.lidar import spinning
from pipeline.simulation.scene import SceneParameters

CAMERA = CameraModel(
    "pinhole", np.array([[520.0, 0.0, 319.5], [0.0, 520.0, 99.5], [0.0, 0.0, 1.0]]), np.zeros(0), 640, 208
)
DRIFT = np.array([0.0, 0.0, math.radians(0.5), 0.0, 0.05, 0.0])
PARAMETERS = DriveParameters(
    seed=3,
    duration=2.0,
    scene=SceneParameters(length=160.0),
    lidar=dataclasses.replace(spinning(32), sigma=0.01),
    camera=CAMERA,
    drift=DRIFT,
    drift_time=1.0,
)


@pytest.fixture(scope="module")
def drive():
    return Drive(PARAMETERS)


def edges_in_world(frame, drive):
    """Middles of range jumps along the rings, float64 (n,3), world: half a step beyond the nearer point."""
    model, start = drive.parameters.lidar, (frame.cloud_stamp_ns - START_NS) / 1e9
    column = np.rint(frame.cloud.time / model.period * model.columns - 0.5).astype(int)
    distance = np.full((len(model.elevations), model.columns), np.nan)
    distance[frame.cloud.ring, column] = np.linalg.norm(frame.cloud.xyz, axis=1)
    azimuth = model.azimuths
    found = []
    for side in (1, -1):
        beyond = np.roll(distance, -side, axis=1)
        ring, at = np.nonzero((beyond - distance > np.maximum(1.0, 0.15 * distance)) & (distance < 40.0))
        a, e = azimuth[at] + side * 0.5 * (azimuth[1] - azimuth[0]), model.elevations[ring]
        beam = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        moment = start + model.times[at] + side * 0.5 * model.period / model.columns
        T = drive.T_world_lidar(moment)
        point = distance[ring, at][:, None] * beam
        found.append(np.einsum("nij,nj->ni", T[:, :3, :3], point) + T[:, :3, 3])
    return np.concatenate(found)


def signed_misses(frame, drive, T_cam_lidar):
    """Horizontal distance from projected range jumps to the nearest border between labels, px."""
    exposed = np.array([(frame.image_stamp_ns - START_NS) / 1e9])
    T_cam_world = T_cam_lidar @ inverse(drive.T_world_lidar(exposed)[0])
    uv, seen = project(drive.parameters.camera, apply(T_cam_world, edges_in_world(frame, drive)))
    border = frame.labels[:, 1:] != frame.labels[:, :-1]
    misses = []
    for u, v in uv[seen]:
        at = np.flatnonzero(border[round(v)]) + 0.5
        if at.size:
            misses.append(at[np.argmin(np.abs(at - u))] - u)
    return np.array(misses)


@pytest.mark.parametrize("index", [4, 15])
def test_range_jumps_lie_on_borders_of_labels_under_the_true_extrinsic_only(drive, index):
    frame = drive.frame(index)
    assert frame.drifted == (index >= 10)
    misses = signed_misses(frame, drive, frame.T_cam_lidar)
    assert len(misses) > 60
    assert np.median(np.abs(misses)) < 1.0
    assert abs(np.mean(misses[np.abs(misses) < 2.0])) < 0.25
    R = vehicle_axes(frame.T_cam_lidar, PARAMETERS.T_vehicle_lidar)
    for yaw_deg in (-0.4, 0.4):
        off = displaced(frame.T_cam_lidar, np.array([0, 0, math.radians(yaw_deg), 0, 0, 0]), R)
        assert np.median(np.abs(signed_misses(frame, drive, off))) > 1.5


def test_the_mount_moves_at_its_moment_by_what_was_asked(drive):
    frames = [drive.frame(index) for index in (9, 10)]
    R = vehicle_axes(PARAMETERS.T_stored, PARAMETERS.T_vehicle_lidar)
    seen = [mount_drift(PARAMETERS.T_stored, frame.T_cam_lidar, R) for frame in frames]
    np.testing.assert_allclose(seen[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(seen[1], DRIFT, atol=1e-12)
    assert frames[0].image_stamp_ns < PARAMETERS.drift_stamp_ns <= frames[1].image_stamp_ns
    assert DriveParameters().drift_stamp_ns is None


def test_the_picture_moves_the_way_the_mount_turns():
    # +yaw turns the camera left: what it sees moves right, by f tan(yaw) in the middle of the image.
    still = Motion(speed=0.0, swing=0.0, weave=0.0, bob=0.0)
    turned = dataclasses.replace(
        PARAMETERS, motion=still, drift=np.array([0.0, 0.0, math.radians(1.0), 0.0, 0.0, 0.0]), drift_time=0.1
    )
    drive = Drive(dataclasses.replace(turned, scene=SceneParameters(length=160.0, traffic=0)))
    before, after = (drive.frame(index).image.pixels[20:120, :, 1].astype(float) for index in (0, 1))
    shift = round(520.0 * math.tan(math.radians(1.0)))
    scores = [
        np.corrcoef(before[:, 220:-220].ravel(), np.roll(after, -s, axis=1)[:, 220:-220].ravel())[0, 1]
        for s in range(-12, 13)
    ]
    assert range(-12, 13)[int(np.argmax(scores))] == shift


def test_frames_are_the_same_in_any_order(drive):
    again = Drive(PARAMETERS)
    later, first = again.frame(7), again.frame(2)
    for frame, other in ((later, drive.frame(7)), (first, drive.frame(2))):
        np.testing.assert_array_equal(frame.cloud.xyz, other.cloud.xyz)
        np.testing.assert_array_equal(frame.image.pixels, other.image.pixels)
        np.testing.assert_array_equal(frame.labels, other.labels)
    assert (later.cloud_stamp_ns - first.cloud_stamp_ns) == 500_000_000
    assert first.image_stamp_ns - first.cloud_stamp_ns == 53_000_000


def test_it_has_as_many_frames_as_whole_sweeps(drive):
    assert len(drive) == PARAMETERS.frames == 20
    assert next(iter(drive)).index == 0


def test_the_vehicle_moves_smoothly_on_the_road(drive):
    times = np.linspace(0.0, 2.0, 4001)
    T = drive.T_world_vehicle(times)
    step = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) / np.diff(times)
    assert (step > 9.0).all()
    assert (step < 14.5).all()
    # Between two moments of the LiDAR nothing jumps: 0.1 rad/s and 1 m/s^2 are far above what is driven.
    turn = np.array(
        [np.linalg.norm(log_so3(a.T @ b)) for a, b in zip(T[:-1, :3, :3], T[1:, :3, :3], strict=True)]
    )
    assert turn.max() / (times[1] - times[0]) < 0.3
    forward = T[:-1, :3, 0]
    assert (np.einsum("ni,ni->n", forward, np.diff(T[:, :3, 3], axis=0)) / np.diff(times) > 0.97 * step).all()


def test_a_street_that_is_too_short_is_refused():
    with pytest.raises(InputError, match="street"):
        DriveParameters(duration=60.0)


def test_axes_of_the_drift_are_in_the_order_of_the_records():
    assert AXES.index("yaw") == 2
    assert AXES.index("left") == 4
