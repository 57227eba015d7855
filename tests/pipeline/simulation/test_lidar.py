import dataclasses
import math

import numpy as np
import pytest

from pipeline.simulation import lidar
from pipeline.simulation.lidar import LidarModel, spinning, sweep
from pipeline.simulation.scene import SceneParameters, draw_scene
from pipeline.simulation.solids import Material, Shape, upright

PERIOD = 0.1


@pytest.fixture(scope="module")
def scene():
    return draw_scene(SceneParameters(length=160.0), np.random.default_rng(2))


def exact(rings=16, columns=900, **changes):
    """A sensor without noise and losses."""
    return dataclasses.replace(spinning(rings, columns), sigma=0.0, loss=0.0, reach=1e4, **changes)


def driving(scene, speed=15.0, yaw_rate=0.2):
    """T_world_lidar along the road, turning as it goes."""

    def pose(times):
        place, heading, _ = scene.surface.pose(20.0 + speed * times, scene.ego_left)
        T = np.tile(np.eye(4), (len(times), 1, 1))
        for k, t in enumerate(times):
            T[k, :3, :3] = upright(float(heading[k]) + yaw_rate * t, (0.01, -0.02))
        T[:, :3, 3] = place + np.array([0.0, 0.0, 1.75])
        return T

    return pose


def misfit(scene, world, times, middle):
    """Distance of world points to the nearest surface, m: ground in height, solids along a radius."""
    raised = np.where(
        np.abs(scene.surface.lateral(world[:, 0].astype(np.float32), world[:, 1].astype(np.float32)))
        > scene.surface.kerb_left,
        scene.surface.kerb_height,
        0.0,
    )
    ground = np.interp(world[:, 0], scene.surface.x, scene.surface.height)
    best = np.abs(world[:, 2] - ground - raised)
    # The face of a kerb is upright.
    lateral = np.abs(scene.surface.lateral(world[:, 0].astype(np.float32), world[:, 1].astype(np.float32)))
    on_face = (world[:, 2] > ground - 1e-3) & (world[:, 2] < ground + scene.surface.kerb_height + 1e-3)
    best = np.where(on_face, np.minimum(best, np.abs(lateral - scene.surface.kerb_left)), best)
    solids = scene.solids_at(middle)
    for k in range(len(solids)):
        offset = world - solids.centre[k] - solids.velocity[k] * (times - middle)[:, None]
        unit = offset @ solids.to_unit[k].T
        near = np.flatnonzero(np.abs(unit).max(axis=1) < 1.2)
        u, half = unit[near], solids.half[k]
        if solids.shape[k] == Shape.BOX:
            off = np.min(
                np.abs(np.abs(u) - 1.0) * half + 10 * (np.abs(u).max(axis=1) > 1.001)[:, None], axis=1
            )
        elif solids.shape[k] == Shape.CYLINDER:
            side = np.abs(np.hypot(u[:, 0], u[:, 1]) - 1.0) * half[0]
            off = np.minimum(side, np.abs(np.abs(u[:, 2]) - 1.0) * half[2])
        else:
            off = np.abs(np.linalg.norm(u, axis=1) - 1.0) * half.max()
        best[near] = np.minimum(best[near], off)
    return best


def in_world(cloud, pose, start):
    times = start + cloud.time.astype(float)
    T = pose(times)
    return np.einsum("nij,nj->ni", T[:, :3, :3], cloud.xyz.astype(float)) + T[:, :3, 3], times


def test_every_point_lies_on_a_surface_once_its_own_motion_is_undone(scene):
    pose, start = driving(scene), 0.4
    cloud = sweep(scene, exact(), pose, start, np.random.default_rng(1))
    assert len(cloud) > 8000
    world, times = in_world(cloud, pose, start)
    off = misfit(scene, world, times, start + PERIOD / 2)
    assert np.quantile(off, 0.999) < 0.01
    # With one pose for the whole turn the points miss the surfaces: the distortion is really there.
    T = pose(np.array([start]))[0]
    frozen = cloud.xyz @ T[:3, :3].T + T[:3, 3]
    upright_hit = np.abs(world[:, 2] - np.interp(world[:, 0], scene.surface.x, scene.surface.height)) > 0.5
    assert np.median(np.linalg.norm(frozen - world, axis=1)) > 0.5
    assert np.quantile(misfit(scene, frozen, times, start + PERIOD / 2)[upright_hit], 0.5) > 0.05


def test_ring_and_time_are_those_of_the_beam(scene):
    for clockwise in (True, False):
        model = exact(32, 720, clockwise=clockwise, start=0.7)
        cloud = sweep(scene, model, driving(scene), 0.0, np.random.default_rng(1))
        xyz = cloud.xyz.astype(float)
        elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
        np.testing.assert_allclose(elevation, model.elevations[cloud.ring], atol=1e-5)
        sign = -1.0 if clockwise else 1.0
        azimuth = 0.7 + sign * 2 * math.pi * cloud.time / PERIOD
        difference = np.angle(np.exp(1j * (np.arctan2(xyz[:, 1], xyz[:, 0]) - azimuth)))
        np.testing.assert_allclose(difference, 0.0, atol=1e-5)
        assert (np.diff(cloud.time) >= 0).all()


def test_leaving_out_what_is_out_of_sight_changes_nothing(scene, monkeypatch):
    model, pose = exact(16, 360), driving(scene)
    quick = sweep(scene, model, pose, 0.2, np.random.default_rng(1))
    every = slice(None)
    monkeypatch.setattr(
        lidar, "_windows", lambda _model, solids, *_: [(k, every, every, 0.0) for k in range(len(solids))]
    )
    slow = sweep(scene, model, pose, 0.2, np.random.default_rng(1))
    np.testing.assert_array_equal(quick.xyz, slow.xyz)


def test_noise_and_losses_are_those_of_the_model(scene):
    pose = driving(scene)
    model = exact(32, 720)
    clean = sweep(scene, model, pose, 0.0, np.random.default_rng(1))
    noisy = sweep(scene, dataclasses.replace(model, sigma=0.03), pose, 0.0, np.random.default_rng(1))
    error = np.linalg.norm(noisy.xyz, axis=1) - np.linalg.norm(clean.xyz, axis=1)
    assert error.std() == pytest.approx(0.03, rel=0.03)
    lossy = sweep(scene, dataclasses.replace(model, loss=0.2), pose, 0.0, np.random.default_rng(1))
    assert len(lossy) / len(clean) == pytest.approx(0.8, abs=0.02)
    weak = sweep(scene, dataclasses.replace(model, reach=20.0), pose, 0.0, np.random.default_rng(1))
    ranges = [np.linalg.norm(c.xyz, axis=1) for c in (clean, weak)]
    shares = [(r > 40.0).sum() / (r < 15.0).sum() for r in ranges]
    assert shares[1] < 0.7 * shares[0]


def test_paint_is_brighter_than_asphalt_but_single_points_overlap(scene):
    pose = driving(scene)
    cloud = sweep(scene, exact(64, 1800), pose, 0.0, np.random.default_rng(1))
    world, _ = in_world(cloud, pose, 0.0)
    s, d = scene.surface.road_coordinates(world[:, 0].astype(np.float32), world[:, 1].astype(np.float32))
    height = np.abs(world[:, 2] - np.interp(world[:, 0], scene.surface.x, scene.surface.height))
    road = (height < 0.005) & (np.abs(d) < scene.surface.kerb_left - 0.05)
    paint = scene.paint.covers(s, d)
    bright, dark = cloud.intensity[road & paint], cloud.intensity[road & ~paint]
    assert len(bright) > 150
    assert 0.35 < bright.mean() < 0.6
    assert 0.12 < dark.mean() < 0.28
    rank = np.searchsorted(np.sort(dark), bright).mean() / len(dark)
    assert 0.85 < rank <= 1.0


def test_sign_plates_reflect_most(scene):
    pose = driving(scene, speed=0.0, yaw_rate=0.0)
    cloud = sweep(scene, exact(64, 900), pose, 0.0, np.random.default_rng(1))
    world, _ = in_world(cloud, pose, 0.0)
    standing = scene.standing
    plates = []
    for k in np.flatnonzero(standing.material == Material.PLATE):
        unit = (world - standing.centre[k]) @ standing.to_unit[k].T
        plates += cloud.intensity[(np.abs(unit).max(axis=1) < 1.01)].tolist()
    assert len(plates) > 5
    assert np.median(plates) > 0.7


def test_the_usual_sensors_have_their_rings():
    for rings in (16, 32, 64, 128):
        model = spinning(rings)
        assert len(model.elevations) == rings
        assert (np.diff(model.elevations) > 0).all()


def test_a_sensor_that_lies_on_its_side_sees_the_same_world(scene):
    turn = upright(0.0, (0.0, math.radians(60.0)))

    def pose(times):
        T = driving(scene)(times)
        T[:, :3, :3] = T[:, :3, :3] @ turn
        return T

    model = LidarModel(np.radians(np.linspace(-20, 20, 16)), 360, sigma=0.0, loss=0.0, reach=1e4)
    cloud = sweep(scene, model, pose, 0.1, np.random.default_rng(1))
    world, times = in_world(cloud, pose, 0.1)
    assert np.quantile(misfit(scene, world, times, 0.15), 0.999) < 0.01
