"""Drawn rigs: they look ahead, LiDAR and camera at the same moment, whatever the LiDAR calls forward."""

import dataclasses

import numpy as np
import pytest

from pipeline import se3
from pipeline.cameras import undistort
from pipeline.simulation.rigs import draw_rig


@pytest.fixture(scope="module")
def rigs():
    return [draw_rig(np.random.default_rng([3, k])) for k in range(60)]


def test_the_camera_looks_along_the_road(rigs):
    for rig in rigs:
        T_vehicle_camera = rig.T_vehicle_lidar @ se3.inverse(rig.T_stored)
        assert np.degrees(np.arccos(T_vehicle_camera[0, 2])) < 10
        assert T_vehicle_camera[2, 1] < -0.98  # upright
        assert 1.1 < T_vehicle_camera[2, 3] < 2.4
        assert np.linalg.norm(T_vehicle_camera[:3, 3] - rig.T_vehicle_lidar[:3, 3]) < 1.5


def test_the_lidar_looks_ahead_when_the_camera_is_exposed(rigs):
    for rig in rigs:
        beam = rig.lidar.azimuths[np.argmin(np.abs(rig.lidar.times - rig.exposure))]
        direction = rig.T_vehicle_lidar[:3, :3] @ np.array([np.cos(beam), np.sin(beam), 0.0])
        # 5 ms before or after the middle of the sweep are 18 deg of its turn.
        assert np.degrees(np.arctan2(direction[1], direction[0])) == pytest.approx(0, abs=22)


def test_rigs_differ_in_what_nothing_may_assume(rigs):
    assert {len(rig.lidar.elevations) for rig in rigs} == {16, 32, 64, 128}
    forward = {
        round(float(np.degrees(np.arctan2(*rig.T_vehicle_lidar[:2, 0][::-1]))) / 90) % 4 for rig in rigs
    }
    assert forward == {0, 1, 2, 3}
    assert {rig.lidar.clockwise for rig in rigs} == {True, False}
    assert {rig.camera.model for rig in rigs} == {"pinhole", "plumb_bob"}
    assert len({(rig.camera.width, rig.camera.height) for rig in rigs}) >= 4


def test_every_pixel_of_a_drawn_lens_is_a_ray(rigs):
    for camera in (rig.camera for rig in rigs):
        corners = np.array(
            [[0, 0], [camera.width - 1, 0], [0, camera.height - 1], [camera.width - 1, camera.height - 1]]
        )
        assert np.isfinite(undistort(camera, corners.astype(float))).all()


def test_the_same_seed_gives_the_same_rig():
    one, again = (draw_rig(np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(one.T_stored, again.T_stored)
    assert np.array_equal(one.camera.K, again.camera.K)
    assert (one.seed, dataclasses.asdict(one.scene)) == (again.seed, dataclasses.asdict(again.scene))
