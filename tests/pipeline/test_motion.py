import dataclasses
import functools
import importlib.util
import itertools
import math
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline import se3
from pipeline.deskew import Spin, Twist, sweep_times
from pipeline.motion import Motion, MotionUnknown, estimate_twist
from pipeline.records import PointCloud
from pipeline.surfels import Surfels, surfels

ROOT = Path(__file__).parents[2]
DATA = Path(os.environ.get("CALIBWATCH_DATA", ROOT.parent / "shared" / "data"))

_spec = importlib.util.spec_from_file_location("box_sweeps", ROOT / "tests" / "oracles" / "box_sweeps.py")
sweeps = importlib.util.module_from_spec(_spec)
sys.modules["box_sweeps"] = sweeps
_spec.loader.exec_module(sweeps)

UP = np.array([0.0, 0.0, 1.0])
BACK = np.array([-1.0, 0.0, 0.0])
DRIVE = Twist(np.array([0.01, -0.02, 0.2]), np.array([13.0, 0.2, 0.1]))
STILL = Twist(np.zeros(3), np.zeros(3))


@functools.cache
def pair(kind="street", twist=DRIVE, *, clockwise=True, gap=1, seed=1):
    """Two sweeps, ``gap`` tenths of a second apart, in a street, a tunnel or an open field."""
    rng = np.random.default_rng(seed)
    boxes = {
        "street": sweeps.street(rng),
        "tunnel": sweeps.street(rng, recesses=False),
        "field": np.zeros((0, 2, 3)),
    }[kind]
    motion = {"omega": twist.omega, "velocity": twist.velocity, "clockwise": clockwise}
    return tuple(sweeps.sweep(boxes, rng, start=0.1 * k, **motion) for k in (0, gap))


def untimed(cloud):
    return dataclasses.replace(cloud, time=None)


def in_frame(cloud, T):
    return dataclasses.replace(cloud, xyz=se3.apply(T, cloud.xyz).astype(np.float32))


def close(motion, twist, *, deg_s=0.15, m_s=0.05):
    assert isinstance(motion, Motion), motion.reason
    assert np.degrees(np.abs(motion.twist.omega - twist.omega)).max() < deg_s
    assert np.abs(motion.twist.velocity - twist.velocity).max() < m_s


@pytest.mark.parametrize("clockwise", [True, False])
def test_twist_of_a_sensor_in_motion_is_recovered(clockwise):
    first, second = pair(clockwise=clockwise)
    motion = estimate_twist(first, second, 0.1, None)
    close(motion, DRIVE)
    assert motion.overlap > 0.5
    assert motion.residual_m < 0.03
    sigma = np.sqrt(np.diag(motion.covariance))
    assert (np.abs(motion.twist.vector - DRIVE.vector) < 4 * sigma).all()
    assert sigma[3:].max() < 0.1
    close(estimate_twist(first, second, 0.1, motion.twist), DRIVE)


def test_fast_vehicle_is_found_without_a_start():
    fast = Twist(np.array([0.0, 0.0, 0.05]), np.array([31.0, 0.0, 0.0]))
    close(estimate_twist(*pair(twist=fast, seed=2), 0.1, None), fast, m_s=0.1)


def test_standing_vehicle_stands():
    close(estimate_twist(*pair(twist=STILL), 0.1, None), STILL, deg_s=0.05, m_s=0.02)


def test_errors_stay_within_the_covariance():
    z = []
    for seed in range(3, 8):
        rng = np.random.default_rng(seed)
        twist = Twist(rng.normal(0, [0.02, 0.02, 0.15]), np.array([rng.uniform(3, 18), 0.1, 0.0]))
        motion = estimate_twist(*pair(twist=twist, seed=seed), 0.1, None)
        assert isinstance(motion, Motion)
        z.append((motion.twist.vector - twist.vector) / np.sqrt(np.diag(motion.covariance)))
    # Five draws of six: honest ones stay below 3.5 but once in 70, and are not all near zero.
    assert np.abs(z).max() < 4.0
    assert 0.2 < math.sqrt(np.mean(np.square(z))) < 1.8


def test_without_times_the_motion_is_less_sure():
    first, second = pair()
    timed = estimate_twist(first, second, 0.1, DRIVE)
    motion = estimate_twist(untimed(first), untimed(second), 0.1, DRIVE)
    close(motion, DRIVE, m_s=0.4, deg_s=0.3)
    assert (np.diag(motion.covariance)[3:] > np.diag(timed.covariance)[3:]).all()
    assert np.abs(motion.twist.velocity - DRIVE.velocity)[0] < 3 * math.sqrt(motion.covariance[3, 3])


def test_turned_and_moved_lidar_gives_the_same_motion_in_its_axes():
    T = se3.transform(se3.exp_so3(np.array([1.1, -0.7, 2.0])), np.array([0.4, -0.3, 0.2]))
    first, second = (in_frame(cloud, T) for cloud in pair())
    close(estimate_twist(first, second, 0.1, None), DRIVE.in_frame(T))


def test_order_of_points_does_not_matter():
    rng = np.random.default_rng(1)
    first, second = pair()
    order = rng.permutation(len(second))
    mixed = PointCloud(second.xyz[order], time=second.time[order])
    plain, permuted = (estimate_twist(first, cloud, 0.1, DRIVE) for cloud in (second, mixed))
    np.testing.assert_allclose(plain.twist.vector, permuted.twist.vector, atol=1e-6)


def test_surfels_kept_from_the_last_call_give_the_same():
    first, second = pair()
    kept = estimate_twist(surfels(first), surfels(second), 0.1, DRIVE)
    assert np.array_equal(kept.twist.vector, estimate_twist(first, second, 0.1, DRIVE).twist.vector)


def carried_cars():
    """Cars that keep their place around the vehicle, as in a queue that moves."""
    places = [(8.0, 0.0), (-9.0, 0.0), (2.0, 3.0), (10.0, 3.0), (-7.0, 3.0), (17.0, 0.0)]
    return np.array([[[x, y - 0.9, 0.2], [x + 4.2, y + 0.9, 1.6]] for x, y in places])


def test_vehicles_that_keep_up_do_not_pull():
    rng = np.random.default_rng(3)
    boxes = sweeps.street(rng)
    motion = {"omega": DRIVE.omega, "velocity": DRIVE.velocity, "carried": carried_cars()[:3]}
    first, second = (sweeps.sweep(boxes, rng, start=start, **motion) for start in (0.0, 0.1))
    close(estimate_twist(first, second, 0.1, DRIVE), DRIVE, m_s=0.1)


@pytest.mark.parametrize("start", [None, DRIVE, STILL])
def test_a_tunnel_leaves_the_way_ahead_free(start):
    straight = Twist(np.zeros(3), np.array([13.0, 0.0, 0.0]))
    unknown = estimate_twist(*pair("tunnel", straight), 0.1, start)
    assert isinstance(unknown, MotionUnknown)
    assert unknown.reason == "free direction"
    assert abs(unknown.free[0]) > 0.99


def test_a_queue_in_a_tunnel_is_not_standing():
    """All that would tell the way ahead moves along: no motion may be claimed, least of all none."""
    rng = np.random.default_rng(3)
    boxes = sweeps.street(rng, recesses=False)
    motion = {"omega": np.zeros(3), "velocity": np.array([6.0, 0, 0]), "carried": carried_cars()}
    first, second = (sweeps.sweep(boxes, rng, start=start, **motion) for start in (0.0, 0.1))
    found = estimate_twist(first, second, 0.1, None)
    assert isinstance(found, MotionUnknown) or found.twist.velocity[0] < 0.3


def test_an_open_field_leaves_it_free():
    unknown = estimate_twist(*pair("field"), 0.1, None)
    assert isinstance(unknown, MotionUnknown)
    assert unknown.reason in ("free direction", "few planes")


def test_a_wrong_optimum_is_told():
    """From standstill only the road and the walls fit: what would fix the way ahead does not."""
    fast = Twist(np.zeros(3), np.array([28.0, 0.0, 0.0]))
    found = estimate_twist(*pair(twist=fast, seed=4), 0.1, STILL)
    assert isinstance(found, MotionUnknown)
    assert found.reason in ("no agreement", "free direction")


def test_nothing_to_see_is_a_reason():
    empty = PointCloud(np.zeros((0, 3), dtype=np.float32))
    assert estimate_twist(empty, pair()[0], 0.1, None).reason == "few planes"
    for seconds in (0.0, -0.1, 5.0, math.nan):
        assert estimate_twist(*pair(), seconds, None).reason == "too far apart"
    rng = np.random.default_rng(0)
    scattered = PointCloud(rng.uniform(-30, 30, (30_000, 3)).astype(np.float32))
    assert isinstance(estimate_twist(scattered, scattered, 0.1, None), MotionUnknown | Motion)


def recorded(name):
    """Surfels of a KITTI drive, with the seconds between sweeps."""
    folder = DATA / name / "2011_09_26"
    if not folder.is_dir():
        pytest.skip(f"{folder} is absent: set CALIBWATCH_DATA")
    files = sorted(next(folder.glob("*_sync")).glob("velodyne_points/data/*.bin"))
    return [np.fromfile(f, np.float32).reshape(-1, 4)[:, :3].copy() for f in files]


SWEEP_S = 0.1034


def followed(clouds: list[Surfels]):
    start, motions = None, []
    for first, second in itertools.pairwise(clouds):
        motion = estimate_twist(first, second, SWEEP_S, start)
        start = motion.twist if isinstance(motion, Motion) else None
        motions.append(motion)
    return motions


@pytest.mark.recordings
@pytest.mark.parametrize(
    ("name", "speed", "yaw_rate_deg"),
    [
        ("kitti_raw_0009_a", (10.2, 11.1), (-1.5, 0.8)),
        ("kitti_raw_0005_a", (3.0, 3.5), (6.4, 8.3)),
        ("kitti_odom_03_a", (8.9, 9.3), (-1.2, 1.2)),
    ],
)
def test_speed_and_yaw_rate_of_recorded_drives(name, speed, yaw_rate_deg):
    motions = followed([surfels(PointCloud(xyz)) for xyz in recorded(name)[:9]])
    assert all(isinstance(m, Motion) for m in motions)
    twists = np.array([m.twist.vector for m in motions])
    assert ((twists[:, 3] > speed[0]) & (twists[:, 3] < speed[1])).all()
    yaw = np.degrees(twists[:, 2])
    assert ((yaw > yaw_rate_deg[0]) & (yaw < yaw_rate_deg[1])).all()
    assert np.abs(twists[:, 4:]).max() < 0.25
    # Vehicles do not jerk: neighbouring speeds agree to their sigma.
    sigma = math.sqrt(np.mean([m.covariance[3, 3] for m in motions]))
    assert np.abs(np.diff(twists[:, 3], 2)).max() < 5 * sigma * math.sqrt(6)


@pytest.mark.recordings
def test_recorded_queue_is_not_taken_for_standing():
    motions = followed([surfels(PointCloud(xyz)) for xyz in recorded("kitti_raw_sfnd")[:5]])
    assert all(isinstance(m, MotionUnknown) and abs(m.free[0]) > 0.99 for m in motions)


@pytest.mark.recordings
def test_times_from_azimuth_fit_better_than_the_other_sense():
    clouds = recorded("kitti_raw_0009_a")[:3]
    residual = {}
    for sense in ("cw", "ccw"):
        spin = Spin(sense, UP, BACK)
        timed = [PointCloud(xyz) for xyz in clouds]
        timed = [dataclasses.replace(c, time=sweep_times(c, SWEEP_S, spin)) for c in timed]
        motion = estimate_twist(timed[0], timed[2], 2 * SWEEP_S, None)
        residual[sense] = motion.residual_m
    assert residual["cw"] < residual["ccw"]
