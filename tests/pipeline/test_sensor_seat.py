"""How a sensor sits in the frame of its cloud, and that edges do not mind the frame once that is known."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline import se3, sensor_seat
from pipeline.edge_parameters import EdgeParameters
from pipeline.edges import find_edges
from pipeline.ground import fit_ground
from pipeline.records import PointCloud
from pipeline.sensor_seat import sensor_origin

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[3] / "shared" / "data"))


@pytest.fixture(scope="module")
def cloud(street):
    return street.cloud


def told_in(cloud, T):
    """The cloud in other axes."""
    return dataclasses.replace(cloud, xyz=se3.apply(T, cloud.xyz).astype(np.float32))


@pytest.mark.parametrize("shift", [(1.2, -0.4, 1.7), (-0.9, 0.0, 0.3), (0.0, 0.0, 1.8)])
def test_where_the_sensor_stands_is_found_in_a_cloud_of_the_vehicle(cloud, shift):
    moved = dataclasses.replace(cloud, xyz=(cloud.xyz + np.array(shift)).astype(np.float32))
    np.testing.assert_allclose(sensor_origin(moved), shift, atol=0.1)


def test_a_sensor_at_its_own_origin_and_a_cloud_without_rings_are_left_alone(cloud):
    assert not sensor_origin(cloud).any()
    some = np.random.default_rng(0).normal(0.0, 5.0, (3000, 3)).astype(np.float32)
    assert not sensor_origin(PointCloud(some)).any()


@pytest.mark.parametrize(
    ("shift", "tilt_deg", "yaw_deg"),
    [
        ((0.0, 0.0, 0.0), (1.0, -0.8), 0.5),
        ((0.12, -0.2, 0.1), (1.0, -0.8), 0.5),
        ((0.12, -0.2, 0.1), (3.0, 1.5), 80.0),
        ((-0.9, 0.0, 0.3), (1.0, -0.8), 0.5),
        ((1.2, -0.4, 1.7), (0.3, 0.0), 0.0),
    ],
)
def test_how_a_sensor_sits_is_found_in_a_cloud_that_was_turned_and_moved(cloud, shift, tilt_deg, yaw_deg):
    R = Rotation.from_rotvec([*tilt_deg, 0.0], degrees=True) * Rotation.from_euler("z", yaw_deg, degrees=True)
    R = R.as_matrix()
    T = se3.transform(R, np.array(shift))
    seat = sensor_seat.sensor_seat(dataclasses.replace(cloud, xyz=se3.apply(T, cloud.xyz).astype(np.float32)))
    np.testing.assert_allclose(seat.origin, shift, atol=0.06)
    assert np.degrees(np.arccos(min(1.0, seat.axis @ R[:, 2]))) < 0.1


def test_a_sensor_that_sits_straight_spins_about_the_axis_of_its_frame(cloud):
    seat = sensor_seat.sensor_seat(cloud)
    assert not seat.origin.any()
    assert np.array_equal(seat.axis, [0.0, 0.0, 1.0])


def test_the_slopes_of_the_rings_are_those_of_differences(cloud):
    p = cloud.xyz[::400].astype(float)
    group = np.sort(np.arange(len(p)) % 7)
    error, J = sensor_seat._cone_errors(p, group)  # noqa: SLF001 - the oracle is of this function

    def moved(step):
        # The median slope of a ring moves with the apex too; held, as the Gauss-Newton step holds it.
        q = (p - step[:3]) @ se3.exp_so3(np.array([step[3], step[4], 0.0])).T
        rho0 = np.hypot(p[:, 0], p[:, 1])
        k = np.array([np.median((p[:, 2] / rho0)[group == g]) for g in range(7)])[group]
        reach = np.hypot(rho0, p[:, 2]) * np.sqrt(1 + k * k)
        raw = (q[:, 2] - k * np.hypot(q[:, 0], q[:, 1])) / reach
        means = np.array([raw[group == g].mean() for g in range(7)])
        return raw - means[group]

    np.testing.assert_allclose(moved(np.zeros(5)), error, atol=1e-12)
    for i, step in enumerate(1e-6 * np.eye(5)):
        np.testing.assert_allclose(J[:, i], (moved(step) - moved(-step)) / 2e-6, atol=1e-6)


@pytest.mark.parametrize("yaw_deg", [0.4, 90.6])
def test_edges_are_the_same_in_every_frame(drive, street, yaw_deg):
    """Turned by a degree and moved by 0.3 m, which bends the rings: the edges go along."""
    R = Rotation.from_rotvec([0.8, -1.1, 0.0], degrees=True) * Rotation.from_euler("z", yaw_deg, degrees=True)
    T = se3.transform(R.as_matrix(), np.array([0.2, -0.2, 0.1]))
    p, camera, T_cam_lidar = EdgeParameters(), drive.parameters.camera, street.T_cam_lidar
    up = drive.parameters.T_vehicle_lidar[2, :3]
    own = find_edges(
        street.cloud, fit_ground(street.cloud, up, np.random.default_rng(0)), camera, T_cam_lidar, p
    )
    cloud = told_in(street.cloud, T)
    ground = fit_ground(cloud, T[:3, :3] @ up, np.random.default_rng(0))
    seat = sensor_seat.sensor_seat(cloud)
    moved = T_cam_lidar @ se3.inverse(T)
    there = find_edges(cloud, ground, camera, moved, p, seat.origin, seat.axis)
    blind = find_edges(cloud, ground, camera, moved, p)

    def shared(found):
        """Share of the edges that lie where one of the same kind lies in the sensor's own frame."""
        back = se3.apply(se3.inverse(T), found.position)
        turned = found.direction @ T[:3, :3]
        near = 0
        for position, direction, kind in zip(back, turned, found.kind, strict=True):
            same = np.flatnonzero(own.kind == kind)
            apart = np.linalg.norm(own.position[same] - position, axis=1)
            k = int(np.argmin(apart))
            near += apart[k] < 0.02 and abs(direction @ own.direction[same[k]]) > 0.999
        return near / len(found)

    assert abs(len(there) - len(own)) < 0.05 * len(own)
    assert shared(there) > 0.9
    assert shared(blind) < shared(there)


@pytest.mark.recordings
def test_a_recorded_sensor_is_found_alike_in_other_axes():
    paths = sorted((DATA / "kitti_raw_0009_a").glob("**/velodyne_points/data/*.bin"))
    if not paths:
        pytest.skip(f"no sweeps in {DATA / 'kitti_raw_0009_a'}")
    xyz = np.fromfile(paths[0], np.float32).reshape(-1, 4)[:, :3]
    cloud = PointCloud(np.ascontiguousarray(xyz[xyz.any(axis=1)]))
    own = sensor_seat.sensor_seat(cloud)
    rng = np.random.default_rng(4)
    for _ in range(3):
        T = se3.transform(se3.exp_so3(np.radians(rng.uniform(-1, 1, 3))), rng.uniform(-0.2, 0.2, 3))
        found = sensor_seat.sensor_seat(told_in(cloud, T))
        assert found.origin == pytest.approx(se3.apply(T, own.origin[None])[0], abs=0.02)
        assert found.axis == pytest.approx(T[:3, :3] @ own.axis, abs=5e-4)


UNTURNED = sensor_seat.SensorSeat(np.zeros(3), np.eye(3)[2])


@pytest.mark.parametrize(
    ("shift", "tilt_deg"), [((0.0, 0.0, 0.0), (0.0, 0.0)), ((0.12, -0.2, 1.1), (2.0, -1.0))]
)
def test_rings_that_only_elevations_tell_are_numbered_as_they_are(cloud, shift, tilt_deg):
    R = Rotation.from_rotvec([*tilt_deg, 0.0], degrees=True).as_matrix()
    moved = told_in(dataclasses.replace(cloud, ring=None), se3.transform(R, np.array(shift)))
    lost = np.zeros(len(cloud), dtype=bool)
    lost[::97] = True
    xyz = np.where(lost[:, None], np.nan, moved.xyz).astype(np.float32)
    seat = sensor_seat.SensorSeat(np.array(shift), R[:, 2])
    found = sensor_seat.numbered(dataclasses.replace(moved, xyz=xyz), seat)
    assert found.ring.dtype == np.uint16
    np.testing.assert_array_equal(found.time, cloud.time)
    # One number means one ring for all but near objects between the lasers.
    given, true = found.ring[~lost].astype(int), cloud.ring[~lost].astype(int)
    table = np.zeros((given.max() + 1, true.max() + 1), dtype=int)
    np.add.at(table, (given, true), 1)
    assert table.max(axis=0).sum() > 0.98 * len(given)
    assert len(set(table.argmax(axis=0))) == true.max() + 1


def test_rings_that_are_named_or_told_by_order_are_left_to_them(cloud):
    assert sensor_seat.numbered(cloud, UNTURNED) is None
    azimuth = np.arctan2(cloud.xyz[:, 1], cloud.xyz[:, 0])
    order = np.lexsort((np.mod(azimuth, 2.0 * np.pi), cloud.ring))
    assert sensor_seat.numbered(PointCloud(cloud.xyz[order]), UNTURNED) is None
    noise = np.random.default_rng(0).normal(0.0, 5.0, (3000, 3)).astype(np.float32)
    for xyz in (noise, noise[:2], noise[:0], np.full((50, 3), np.nan, np.float32)):
        assert sensor_seat.numbered(PointCloud(xyz), UNTURNED) is None
