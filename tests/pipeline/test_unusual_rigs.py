"""Sensors mounted any way round and lenses of every kind: the same street gives the same answer."""

import dataclasses
import math

import numpy as np
import pytest

from pipeline import se3
from pipeline.association import associate
from pipeline.cameras import ideal_pixels, lens_of, limit_of, project, undistort
from pipeline.line_witness import find_lines, in_view, solve_lines
from pipeline.observability import in_vehicle_axes, observable
from pipeline.records import CameraModel, CloudLine, ImageLine, Masks, PointCloud
from pipeline.simulation.drive import START_NS, Drive, DriveParameters
from pipeline.simulation.lidar import spinning
from pipeline.structure_lines import find_structure_lines

FRONT = CameraModel(
    "pinhole", np.array([[640.0, 0, 479.5], [0, 640.0, 120.0], [0, 0, 1]]), np.zeros(0), 960, 304
)
TURNS = {
    "upside down": (math.pi, 0.0, 0.0),
    "left is forward": (0.0, 0.0, math.pi / 2),
    "backward is forward": (0.0, 0.0, math.pi),
    "on its side": (math.pi / 2, 0.0, 0.0),
    "on its nose": (0.0, math.pi / 2, 0.0),
    "any": (1.0, -2.0, 0.5),
}


def exact_masks(labels):
    lane, pole = labels == 1, labels == 2
    return Masks(lane, pole, lane.astype(np.float32), pole.astype(np.float32), 1.0, 1.0)


def mount(roll, pitch, yaw, place=(1.25, 0.06, 1.62)):
    """T_vehicle_camera of a camera that is turned so, degrees, from looking ahead."""
    R = np.eye(3)
    for axis, angle in ((2, yaw), (1, pitch), (0, roll)):
        R = R @ se3.exp_so3(math.radians(angle) * np.eye(3)[axis])
    return se3.transform(R, np.array(place)) @ se3.transform(se3.AXES_CAM_IN_VEHICLE, np.zeros(3))


def at_one_instant(drive, frame):
    """The cloud as all of it stood at the exposure."""
    start = (frame.cloud_stamp_ns - START_NS) / 1e9
    moments, which = np.unique(frame.cloud.time, return_inverse=True)
    exposed = np.array([(frame.image_stamp_ns - START_NS) / 1e9])
    T = se3.inverse(drive.T_world_lidar(exposed)[0]) @ drive.T_world_lidar(start + moments.astype(float))
    xyz = np.einsum("nij,nj->ni", T[which, :3, :3], frame.cloud.xyz) + T[which, :3, 3]
    return dataclasses.replace(frame.cloud, xyz=xyz.astype(np.float32), time=None)


class Rig:
    """One frame of a street, with what the vehicle frame tells of it."""

    def __init__(self, *, seed=5, camera=FRONT, turn=(0.3, 1.5, -0.5), rings=64):
        parameters = DriveParameters(seed=seed, duration=1.0, camera=camera, lidar=spinning(rings))
        T_vehicle_lidar = parameters.T_vehicle_lidar
        T_stored = se3.inverse(mount(*turn)) @ T_vehicle_lidar
        drive = Drive(dataclasses.replace(parameters, T_stored=T_stored))
        frame = drive.frame(4)
        self.camera, self.image, self.masks = camera, frame.image, exact_masks(frame.labels)
        self.cloud, self.T = at_one_instant(drive, frame), frame.T_cam_lidar
        self.R_vehicle_lidar = T_vehicle_lidar[:3, :3]

    def moved(self, motion):
        """The same with the LiDAR's frame elsewhere: p' = motion p."""
        other = object.__new__(Rig)
        other.__dict__ |= self.__dict__
        xyz = se3.apply(motion, self.cloud.xyz.astype(np.float64)).astype(np.float32)
        other.cloud = dataclasses.replace(self.cloud, xyz=xyz)
        other.T = self.T @ se3.inverse(motion)
        other.R_vehicle_lidar = self.R_vehicle_lidar @ motion[:3, :3].T
        return other

    def lines(self):
        up, forward = self.R_vehicle_lidar[2], self.R_vehicle_lidar[0]
        rng = np.random.default_rng(0)
        return find_lines(
            self.cloud, self.image, self.masks, self.camera, self.T, up=up, forward=forward, rng=rng
        )

    def structure(self, origin=None):
        seen = in_view(self.cloud, self.camera, self.T)
        return find_structure_lines(self.cloud, seen, np.random.default_rng(0), origin)

    def errors(self, lines, drift=None):
        """Scores along the observed directions, from a stored extrinsic that is off by ``drift``."""
        limits = np.array([*np.radians([0.75, 0.5, 0.5]), 0.20, 0.15, 0.15])
        true = np.zeros(6) if drift is None else drift
        stored = se3.stored_before(self.T, true, self.R_vehicle_lidar)
        solution = solve_lines([lines], self.camera, stored)
        R_vehicle_cam = self.R_vehicle_lidar @ self.T[:3, :3].T
        found, information = in_vehicle_axes(
            solution.estimate.xi, solution.estimate.information, R_vehicle_cam
        )
        sees = observable(information, limits)
        V = sees.directions[:, sees.observed]
        score = V.T @ ((found - true) / limits) / sees.sigmas[sees.observed]
        return score, sees, solution


@pytest.fixture(scope="module")
def front():
    rig = Rig()
    return rig, rig.lines()


def in_camera(rig, lines):
    """Class and ends (n,2,3) of cloud lines in camera axes."""
    return [(a.label, se3.apply(rig.T, np.stack([a.start, a.end]))) for a in lines.cloud_lines]


@pytest.mark.parametrize("turn", TURNS)
def test_turning_the_lidar_changes_nothing(front, turn):
    rig, lines = front
    other = rig.moved(se3.transform(se3.exp_so3(np.array(TURNS[turn])), np.zeros(3)))
    found = other.lines()
    wanted = in_camera(rig, lines)
    assert len(wanted) >= 6
    given = in_camera(other, found)
    # Cells lie elsewhere: what just passes a threshold may just miss it.
    assert abs(len(given) - len(wanted)) <= 1
    again = [
        any(name == label and np.abs(e - ends).max() < 0.02 for name, e in given) for label, ends in wanted
    ]
    assert sum(again) >= len(wanted) - 1
    estimate, turned = (
        solve_lines([part], rig.camera, r.T).estimate for r, part in ((rig, lines), (other, found))
    )
    # xi is told in camera axes, which do not turn.
    assert abs(turned.features - estimate.features) <= 1
    assert estimate.features >= 4
    off = turned.xi - estimate.xi
    assert off @ estimate.information @ off < 1.0


@pytest.mark.parametrize("turn", ["upside down", "left is forward", "on its side"])
def test_turning_the_lidar_keeps_structure_lines(front, turn):
    """Cells and draws lie elsewhere, so some lines come and go; what stays stays where it is."""
    rig, _ = front
    other = rig.moved(se3.transform(se3.exp_so3(np.array(TURNS[turn])), np.zeros(3)))
    wanted, found = rig.structure(), other.structure()
    assert len(wanted) >= 10
    assert abs(len(found) - len(wanted)) <= 4
    ends = [se3.apply(other.T, np.stack([a.start, a.end])) for a in found]
    again = 0
    for line in wanted:
        start, end = se3.apply(rig.T, np.stack([line.start, line.end]))
        along = (end - start) / np.linalg.norm(end - start)
        middles = np.stack([e.mean(axis=0) for e in ends]) - start
        off = np.linalg.norm(np.cross(middles, along), axis=1)
        again += bool((off < 0.1 + 0.01 * np.linalg.norm(start)).any())
    assert again >= 0.7 * len(wanted)


def test_a_cloud_in_the_frame_of_the_vehicle_keeps_its_lanes_and_structure(front):
    """Poles and far lanes are fewer there: reach and height are judged from the cloud's origin."""
    rig, lines = front
    shift = np.array([1.0, 0.5, 1.7])
    other = rig.moved(se3.transform(np.eye(3), shift))
    lanes = [ends for label, ends in in_camera(rig, lines) if label == "lane"]
    given = [ends for label, ends in in_camera(other, other.lines()) if label == "lane"]
    same = sum(any(np.abs(e - ends).max() < 0.5 for e in given) for ends in lanes)
    assert same >= len(lanes) - 2
    assert abs(len(other.structure(shift)) - len(rig.structure())) <= 3


MOUNTS = {
    "backwards": (FRONT, (0.0, 1.5, 180.0)),
    "to the left": (FRONT, (0.0, 5.0, 90.0)),
    "half left": (FRONT, (0.0, 3.0, 45.0)),
    "upside down": (FRONT, (180.0, 0.0, 0.0)),
    "lying": (FRONT, (90.0, 0.0, 0.0)),
    "portrait": (
        CameraModel(
            "pinhole", np.array([[640.0, 0, 151.5], [0, 640.0, 400.0], [0, 0, 1]]), np.zeros(0), 304, 960
        ),
        (0.0, 10.0, 0.0),
    ),
}


@pytest.mark.parametrize("way", MOUNTS)
def test_a_camera_that_looks_any_way_gives_no_wrong_answer(way):
    """Much of a street may be out of view; what is said is right within its sigma."""
    camera, turn = MOUNTS[way]
    rig = Rig(seed=6, camera=camera, turn=turn)
    lines = rig.lines()
    assert lines.image_lines
    score, _, solution = rig.errors(lines)
    values = np.linalg.eigvalsh(solution.estimate.information)
    assert values[0] >= -1e-9 * max(values[5], 1.0)
    assert (np.abs(score) < 4.0).all()
    assert len(score) or way == "to the left"


def wide(model, D, focal, size=(1000, 600)):
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2 - 60], [0, 0, 1.0]])
    return CameraModel(model, K, np.array(D), *size)


WIDE = {
    "plumb_bob": wide("plumb_bob", [-0.28, 0.1, 0.001, -0.001, -0.015], 560.0),
    "rational": wide("rational_polynomial", [0.5, 0.1, 0.0, 0.0, 0.01, 0.9, 0.3, 0.05], 450.0),
    # 2 x 500 / 430 rad: 133 deg from left to right.
    "fisheye": wide("equidistant", [0.02, -0.005, 0.001, 0.0], 430.0),
}


@pytest.mark.parametrize("lens", WIDE)
def test_a_wide_lens_from_end_to_end(lens):
    """A drift of half a limit an axis is told within its sigma; the lens bends lines by dozens of px."""
    drift = np.array([*np.radians([0.3, -0.25, 0.25]), 0.05, -0.06, 0.05])
    scores, rank = [], 0
    for seed in (5, 6):
        rig = Rig(seed=seed, camera=WIDE[lens], turn=(0.0, 4.0, 0.0))
        lines = rig.lines()
        score, sees, _ = rig.errors(lines, drift)
        scores += score.tolist()
        rank = max(rank, sees.rank)
    assert rank >= 5
    assert len(scores) >= 4
    assert np.abs(scores).max() < 4.0
    assert np.mean(np.square(scores)) < 3.0


@pytest.mark.parametrize("rings", [16, 32, 128])
def test_other_numbers_of_rings(rings):
    rig = Rig(rings=rings)
    lines = rig.lines()
    assert lines.cloud_lines
    score, _, solution = rig.errors(lines)
    assert (np.abs(score) < 4.0).all()
    assert np.isfinite(solution.estimate.information).all()
    found = rig.structure()
    assert all(np.isfinite(line.covariance).all() for line in found)


@pytest.mark.parametrize("lens", WIDE)
def test_rays_are_those_of_the_closed_form(lens):
    """Image lines are fitted to undistorted points: straight in space is straight there (FORMULAS E1)."""
    camera = WIDE[lens]
    share = np.linspace(-1, 1, 60)[:, None]
    for middle, along in (
        ((0, 1.6, 8.0), (4.5, 0, 0)),
        ((-4.0, 0, 8.0), (0, 3.0, 1.0)),
        ((1, 1.6, 9), (2, 0, 6)),
    ):
        cam = np.array(middle) + share * np.array(along)
        uv, seen = project(camera, cam)
        rays = undistort(camera, uv[seen])
        assert seen.sum() > 20
        assert rays == pytest.approx(cam[seen, :2] / cam[seen, 2:], abs=1e-9)
        ideal = ideal_pixels(camera, uv[seen])
        across = np.linalg.svd(ideal - ideal.mean(axis=0))[1][1]
        assert across < 1e-6 < np.linalg.svd(uv[seen] - uv[seen].mean(axis=0))[1][1]


def test_beyond_the_fold_nothing_projects_and_no_line_is_paired():
    """A polynomial lens would draw such a line again inside the image (FORMULAS E3)."""
    camera = WIDE["plumb_bob"]
    limit = limit_of(camera)
    x = np.linspace(1.01 * limit, 4.0 * limit, 300)
    beyond = 10.0 * np.column_stack([x, np.full(300, 0.05), np.ones(300)])
    folded = lens_of(camera).distort(beyond[:, :2] / 10.0, camera.D) @ camera.K[:2, :2].T + camera.K[:2, 2]
    assert ((folded > 0) & (folded < (camera.width, camera.height))).all(axis=1).any()
    uv, valid = project(camera, beyond)
    assert not valid.any()
    assert np.isnan(uv).all()
    cloud = CloudLine("lane", beyond[0], beyond[-1], np.arange(300), 0.02, 1e4)
    ends = np.array([[-limit, 0.05], [limit, 0.05]]) @ camera.K[:2, :2].T + camera.K[:2, 2]
    image = ImageLine("lane", ends[0], ends[1], 0.5)
    assert not associate([cloud], [image], camera, np.eye(4), np.eye(6)).matches
    within = CloudLine("lane", beyond[0] * (-0.5, 1, 1), beyond[0] * (0.5, 1, 1), np.arange(300), 0.02, 1e4)
    assert len(associate([within], [image], camera, np.eye(4), 1e-4 * np.eye(6)).matches) == 1


def test_a_point_cloud_of_nothing_keeps_the_rig_silent(front):
    rig, _ = front
    other = rig.moved(np.eye(4))
    other.cloud = PointCloud(np.zeros((0, 3), np.float32), np.zeros(0, np.float32))
    score, _, solution = other.errors(other.lines())
    assert len(score) == 0
    assert solution.estimate.features == 0
