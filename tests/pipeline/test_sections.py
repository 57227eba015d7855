import dataclasses
import math

import numpy as np
import pytest

from pipeline import edge_score, se3
from pipeline.causes import CLOCK, LENS, CauseParameters, explain
from pipeline.deskew import Twist
from pipeline.edge_parameters import EdgeParameters
from pipeline.edge_score import EdgeFrame
from pipeline.edge_witness import EdgeWitnessParameters
from pipeline.edges import find_edges
from pipeline.gradients import gradient_pyramid
from pipeline.ground import fit_ground
from pipeline.mount import Mount
from pipeline.records import CameraModel
from pipeline.sections import Move, Passage, Place, fresh, linearised

P = EdgeWitnessParameters()
CAUSES = CauseParameters()
LIMITS = np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.20, 0.15, 0.15])
FLOOR = np.diag([math.radians(0.05) ** 2] * 3 + [0.03**2] * 3)
SOUND = FLOOR + np.diag([math.radians(0.1) ** 2] * 3 + [0.02**2] * 3)
TWISTS = (
    Twist(np.zeros(3), np.zeros(3)),
    Twist(np.array([0.0, 0.0, 0.2]), np.array([6.0, 0.0, 0.0])),
    Twist(np.array([0.0, 0.02, -0.1]), np.array([14.0, 0.0, 0.0])),
)
"""As if the three frames had been taken at these motions: stopped, in a bend, fast."""
DELAY_S = 0.02


@pytest.fixture(scope="module")
def seen(drive, straight_frames):
    """Edges and gradients of three frames, and the mount that they were taken with."""
    p = drive.parameters
    frames = []
    for number, frame in enumerate(straight_frames):
        ground = fit_ground(frame.cloud, np.array([0.0, 0.0, 1.0]), np.random.default_rng(number))
        edges = find_edges(frame.cloud, ground, p.camera, p.T_stored, EdgeParameters())
        frames.append(EdgeFrame(frame.image_stamp_ns, edges, gradient_pyramid(frame.image, p.camera)))
    mount = Mount(p.camera, p.T_stored, p.T_vehicle_lidar, math.radians(0.1), 0.02, LIMITS, ("pitch", "yaw"))
    return frames, mount


def place_of(mount):
    return Place(mount.camera, mount.T_cam_lidar, mount.R_vehicle_cam, FLOOR, CAUSES.zoom)


def passages_of(frames, mount, delay_s=0.0, twists=TWISTS):
    """The frames as a camera sees them that exposes ``delay_s`` later than its stamps say."""
    passages = []
    for number, (frame, twist) in enumerate(zip(frames, twists, strict=True)):
        # Where the cloud is put by a stamp that comes too early (FORMULAS G1).
        put = twist.pose(delay_s)
        edges = dataclasses.replace(
            frame.edges,
            position=se3.apply(put, frame.edges.position),
            direction=frame.edges.direction @ put[:3, :3].T,
        )
        move = Move(number, mount.motion(twist), tracked=True, sync_s=0.003)
        passages.append(Passage(dataclasses.replace(frame, edges=edges, stamp_ns=number), move))
    return passages


def told(section):
    return explain([section], SOUND, LIMITS, CAUSES)


@pytest.fixture(scope="module")
def healthy(seen):
    frames, mount = seen
    return linearised(passages_of(frames, mount), np.zeros(6), place_of(mount), P)


def test_the_curvature_is_symmetric_and_semidefinite(healthy):
    for matrix in (healthy.curvature, healthy.certainty):
        scale = np.sqrt(np.outer(np.diag(matrix), np.diag(matrix)))
        np.testing.assert_allclose(matrix / scale, (matrix / scale).T, atol=1e-6)
        assert np.linalg.eigvalsh(matrix / scale).min() > -1e-9


def test_nothing_is_found_where_nothing_is_wrong(healthy):
    found = told(healthy)
    assert abs(found.time_offset_s) < 3 * found.time_sigma_s
    assert abs(found.zoom) < 3 * found.zoom_sigma
    assert found.unexplained < 10.0
    assert healthy.speed == pytest.approx(np.mean([np.linalg.norm(m) for m in _velocities(healthy)]), rel=0.1)


def _velocities(_):
    return [twist.velocity for twist in TWISTS]


def test_a_delay_comes_back_with_its_sign(seen):
    frames, mount = seen
    found = told(linearised(passages_of(frames, mount, DELAY_S), np.zeros(6), place_of(mount), P))
    assert found.time_offset_s == pytest.approx(DELAY_S, abs=3 * found.time_sigma_s)
    assert found.time_offset_s > 3 * found.time_sigma_s
    assert found.cause(CAUSES) in ("time_offset", "forward_or_sync")


def test_frames_of_one_motion_tell_no_delay(seen):
    frames, mount = seen
    passages = passages_of(frames, mount, twists=(TWISTS[2],) * 3)
    found = told(linearised(passages, np.zeros(6), place_of(mount), P))
    assert found.time_sigma_s > 0.3
    assert not found.separable


def test_another_focal_length_comes_back(seen):
    frames, mount = seen
    K = mount.camera.K.copy()
    K[:2, :2] /= 1.012
    camera = CameraModel("pinhole", K, np.zeros(0), mount.camera.width, mount.camera.height)
    mount = dataclasses.replace(mount, camera=camera)
    found = told(linearised(passages_of(frames, mount), np.zeros(6), place_of(mount), P))
    assert found.zoom == pytest.approx(0.012, abs=3 * found.zoom_sigma)
    assert found.zoom > 4 * found.zoom_sigma


@pytest.mark.parametrize("axis", range(6))
def test_a_moved_mount_is_in_the_pull(seen, axis):
    frames, mount = seen
    drift = (math.radians(0.3) if axis < 3 else 0.08) * np.eye(6)[axis]
    moved = dataclasses.replace(
        mount, T_cam_lidar=se3.stored_before(mount.T_cam_lidar, drift, mount.T_vehicle_lidar[:3, :3])
    )
    xi = se3.vehicle_block(moved.R_vehicle_cam).T @ drift
    section = linearised(passages_of(frames, moved), xi, place_of(moved), P)
    mount_only = np.linalg.solve(section.curvature[:6, :6], section.pull[:6])
    np.testing.assert_allclose(np.degrees(mount_only[:3]), np.degrees(drift[:3]), atol=0.1)
    np.testing.assert_allclose(mount_only[3:], drift[3:], atol=0.03)


def test_the_slope_by_the_zoom_is_that_of_the_score(seen):
    """Against differences of the score under cameras of other focal lengths."""
    frames, mount = seen
    passages = passages_of(frames, mount)
    section = linearised(passages, np.zeros(6), place_of(mount), P)
    batch = edge_score.batch_of([p.frame for p in passages], mount.camera, P.most_edges)
    top = np.linalg.solve(section.curvature[np.ix_([*range(6), LENS], [*range(6), LENS])],
                          section.pull[[*range(6), LENS]])  # fmt: skip
    assert np.isfinite(top).all()

    def at(log_f):
        K = mount.camera.K.copy()
        K[:2, :2] *= math.exp(log_f)
        camera = dataclasses.replace(mount.camera, K=K)
        T = se3.retract(mount.T_cam_lidar, se3.vehicle_block(mount.R_vehicle_cam).T @ top[:6])
        return edge_score.score(dataclasses.replace(batch, camera=camera), T, 0)[0]

    # At its own top the score falls to both sides, by about half the curvature.
    fall = [at(top[6]) - at(top[6] + step) for step in (-0.002, 0.002)]
    assert np.mean(fall) == pytest.approx(0.5 * section.curvature[LENS, LENS] * 0.002**2, rel=0.4)


def moving(numbers, speed, way):
    return [
        Passage(
            EdgeFrame(number, None, None, distance_m=way * number),
            Move(number, np.array([0.0, 0.0, 0.0, speed, 0.0, 0.0]), tracked=True, sync_s=0.003),
        )
        for number in numbers
    ]


def test_new_road_makes_a_section(healthy):
    assert fresh(moving(range(4), 10.0, 1.0), None, 5, 10) == ()
    assert fresh(moving(range(12), 10.0, 1.0), None, 5, 10)
    last = dataclasses.replace(healthy, to_ns=20, speed=10.0)
    assert fresh(moving(range(40), 10.0, 1.0), last, 5, 10) == ()
    new = fresh(moving(range(42), 10.0, 1.0), last, 5, 10)
    assert [p.move.stamp_ns for p in new] == list(range(21, 42))


def test_the_same_road_at_another_speed_makes_one_too(healthy):
    last = dataclasses.replace(healthy, to_ns=20, speed=10.0)
    stopped = moving(range(32), 0.0, 0.0)
    assert len(fresh(stopped, last, 5, 10)) == 11
    assert fresh(stopped, dataclasses.replace(last, speed=0.5), 5, 10) == ()


def test_frames_of_unknown_motion_make_none():
    unknown = [
        dataclasses.replace(p, move=dataclasses.replace(p.move, tracked=False))
        for p in moving(range(30), 10.0, 2.0)
    ]
    assert fresh(unknown, None, 5, 10) == ()


def test_the_delay_has_a_place_of_its_own():
    assert CLOCK != LENS
