"""Drives as trials tell them: in other words they stay true, and what is wrong is wrong by what it says."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import drift_trials, se3, staging
from pipeline.cameras import project, project_unbounded
from pipeline.drift_trials import KINDS, Trial
from pipeline.records import CameraImage, FramePair, PointCloud
from tests.pipeline.test_drift_trials import CAMERA, mount

BENT = dataclasses.replace(CAMERA, model="plumb_bob", D=np.array([-0.2, 0.03, 0.0, 0.0, 0.0]))
PERIOD_NS = 100_000_000


def frames(count=4, seed=0, camera=CAMERA):
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        cloud = PointCloud(rng.uniform([4, -8, -2], [30, 8, 4], (300, 3)).astype(np.float32))
        pixels = rng.integers(0, 255, (camera.height, camera.width, 3), dtype=np.uint8)
        stamp = 10**18 + k * PERIOD_NS
        out.append(FramePair("front", cloud, CameraImage(pixels), stamp, stamp + 50_000_000))
    return out


def staged(trial, true, drive, seed=5):
    found = staging.stage(trial, true, drive, np.random.default_rng(seed))
    return found.mount, list(found.frames)


def trial(drift=None, **fields):
    return Trial("healthy", "x", 0, np.zeros(6) if drift is None else np.array(drift), **fields)


def drift_between(stored, now):
    """Of a mount whose true extrinsic is ``now``."""
    R = se3.vehicle_axes(stored.T_cam_lidar, stored.T_vehicle_lidar)
    return se3.mount_drift(stored.T_cam_lidar, now, R)


def aligned(points, targets):
    """The rigid T with ``T points = targets``, by Kabsch."""
    a, b = points - points.mean(axis=0), targets - targets.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return se3.transform(R, targets.mean(axis=0) - R @ points.mean(axis=0))


@pytest.mark.parametrize("seed", [5, 6, 7])
def test_another_frame_and_a_crop_tell_the_same_scene(seed):
    true, drive = mount(), frames()
    told, out = staged(trial(), true, drive, seed)
    for before, after in zip(drive, out, strict=True):
        uv, inside = project(true.camera, se3.apply(true.T_cam_lidar, before.cloud.xyz))
        moved, still = project(told.camera, se3.apply(told.T_cam_lidar, after.cloud.xyz))
        shift = uv[still] - moved[still]
        assert np.ptp(shift, axis=0) == pytest.approx(0.0, abs=1e-2)
        left, top = np.round(shift.mean(axis=0)).astype(int)
        assert inside[still].all()
        height, width = told.camera.height, told.camera.width
        assert np.array_equal(
            after.image.pixels, before.image.pixels[top : top + height, left : left + width]
        )
        assert after.image.size == (width, height)
        assert not np.allclose(before.cloud.xyz, after.cloud.xyz, atol=1e-3)
    assert told.camera.width < true.camera.width
    assert drift_between(true, true.T_cam_lidar) == pytest.approx(np.zeros(6))


def test_axes_move_no_further_than_they_say():
    for seed in range(50):
        told, _ = staged(trial(), mount(), frames(1), seed)
        G = se3.inverse(told.T_cam_lidar) @ mount().T_cam_lidar
        assert math.degrees(se3.rotation_angle(np.eye(3), G[:3, :3])) <= staging.TURNED_DEG + 1e-6
        assert np.linalg.norm(G[:3, 3]) <= staging.MOVED_M + 1e-9


@given(st.integers(0, 2**32 - 1), st.booleans(), st.sampled_from(KINDS), st.integers(0, 60))
@settings(max_examples=60, deadline=None)
def test_the_stored_extrinsic_is_wrong_by_the_drift(seed, vehicle, kind, number):
    true = mount(seed % 7, vehicle=vehicle)
    drawn = drift_trials.draw(kind, number, true, np.random.default_rng(seed))
    drive = frames(3)
    told, out = staged(drawn, true, drive, seed)
    # Where points that were not turned by the trial lie now, in the axes that are told.
    now = aligned(out[-1].cloud.xyz.astype(float), se3.apply(true.T_cam_lidar, drive[len(out) - 1].cloud.xyz))
    if kind == "time-offset":
        return
    assert drift_between(told, now)[:3] == pytest.approx(drawn.drift[:3], abs=2e-5)
    assert drift_between(told, now)[3:] == pytest.approx(drawn.drift[3:], abs=2e-4)


def test_a_ramp_grows_evenly():
    true, drive = mount(), frames(5)
    drift = np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.0])
    told, out = staged(trial(drift, ramp=True), true, drive)
    for k, (before, after) in enumerate(zip(drive, out, strict=True)):
        now = aligned(after.cloud.xyz.astype(float), se3.apply(true.T_cam_lidar, before.cloud.xyz))
        assert drift_between(told, now) == pytest.approx(k / 4 * drift, abs=1e-4)


@pytest.mark.parametrize(("count", "first"), [(5, 3), (6, 4)])
def test_a_mount_that_slips_moves_at_once_at_two_thirds_of_the_drive(count, first):
    true, drive = mount(), frames(count)
    slip = trial(np.array([0.0, 0.01, 0.0, 0.0, 0.0, -0.1]), slips=True)
    assert slip.first_wrong(count) == first
    told, out = staged(slip, true, drive)
    for k, (before, after) in enumerate(zip(drive, out, strict=True)):
        now = aligned(after.cloud.xyz.astype(float), se3.apply(true.T_cam_lidar, before.cloud.xyz))
        assert drift_between(told, now) == pytest.approx((k >= first) * slip.drift, abs=2e-4)


@pytest.mark.parametrize("camera", [CAMERA, BENT], ids=["pinhole", "lens"])
def test_a_turned_camera_sees_things_where_they_project(camera):
    """Blobs painted at the pixels of some rays are found at the pixels of the turned rays."""
    rng = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.linspace(-0.35, 0.35, 6), np.linspace(-0.15, 0.15, 4)), axis=-1)
    rays = np.column_stack([grid.reshape(-1, 2), np.ones(24)])
    uv = project(camera, rays)[0]
    v, u = np.mgrid[: camera.height, : camera.width]
    turn = rng.normal(0.0, math.radians(0.3), 3)
    expected = project_unbounded(camera, rays @ se3.exp_so3(turn).T)[0]
    for at, wanted in zip(uv, expected, strict=True):
        blob = 250.0 * np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 18.0)
        image = np.repeat(blob[..., None], 3, axis=2).astype(np.uint8)
        weight = staging.turned_image(image, camera, turn)[..., 0].astype(float)
        found = [(weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()]
        assert found == pytest.approx(wanted, abs=0.12)


def test_a_camera_that_does_not_turn_sees_the_same():
    pixels = frames(1)[0].image.pixels
    assert np.array_equal(staging.turned_image(pixels, CAMERA, np.zeros(3)), pixels)


def test_shaking_has_its_size_and_no_mean():
    turns = staging.shaking(0.01, 4000, np.random.default_rng(1))
    assert turns.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-15)
    assert math.sqrt((turns**2).sum(axis=1).mean()) == pytest.approx(0.01, rel=0.03)
    true, drive = mount(), frames(3)
    told, out = staged(trial(shake_rad=0.01), true, drive)
    still, calm = staged(trial(), true, drive)
    assert all(one.image.size == (told.camera.width, told.camera.height) for one in out)
    assert not any(np.array_equal(a.image.pixels, b.image.pixels) for a, b in zip(out, calm, strict=True))
    assert np.array_equal(still.T_cam_lidar, told.T_cam_lidar)


@pytest.mark.parametrize(
    ("late_ms", "pairs"),
    [
        (0, [(0, 0), (1, 1), (2, 2), (3, 3)]),
        (20, [(0, 0), (1, 1), (2, 2), (3, 3)]),
        (-20, [(0, 0), (1, 1), (2, 2), (3, 3)]),
        (100, [(1, 0), (2, 1), (3, 2)]),
        (-100, [(0, 1), (1, 2), (2, 3)]),
    ],
)
def test_late_images_go_with_the_sweep_that_their_stamp_fits(late_ms, pairs):
    drive = frames(4)
    found = staging.late_images(drive, late_ms * 1_000_000)
    images = [frame.image for frame in drive]
    clouds = [frame.cloud for frame in drive]
    assert [(clouds.index(f.cloud), images.index(f.image)) for f in found] == pairs
    for frame, (_, image) in zip(found, pairs, strict=True):
        assert frame.image_stamp_ns == drive[image].image_stamp_ns + late_ms * 1_000_000


def test_a_wrong_focal_length_is_stored_and_nothing_else():
    true = mount()
    told, _ = staged(trial(focal=1.02), true, frames(1))
    right, _ = staged(trial(), true, frames(1))
    assert np.diag(told.camera.K)[:2] == pytest.approx(1.02 * np.diag(right.camera.K)[:2])
    assert np.array_equal(told.camera.K[:2, 2], right.camera.K[:2, 2])
    assert np.array_equal(told.T_cam_lidar, right.T_cam_lidar)
    assert cv2.norm(told.camera.K - right.camera.K) > 1.0
