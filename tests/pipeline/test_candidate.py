"""Proposals: what windows agree on, and a simulated drive whose mount has moved."""

import dataclasses
import functools
import math

import numpy as np
import pytest

from pipeline import se3, verdict
from pipeline.belief import believe
from pipeline.candidate import (
    Candidate,
    CandidateParameters,
    NoCandidate,
    Proposer,
    WindowEstimate,
    agree,
    combined,
    moved_since,
)
from pipeline.edge_parameters import EdgeParameters
from pipeline.edge_witness import NEW_SCENE_M, EdgeFrame
from pipeline.edges import find_edges
from pipeline.ego import Ego
from pipeline.gradients import gradient_pyramid
from pipeline.ground import fit_ground
from pipeline.hold_out import HoldOutParameters
from pipeline.mount import Mount
from pipeline.onset import Onset
from pipeline.parameters import Parameters
from pipeline.records import CameraModel, FramePair
from pipeline.sensor_seat import sensor_origin
from pipeline.simulation.drive import Drive, DriveParameters
from pipeline.simulation.lidar import spinning
from pipeline.simulation.scene import SceneParameters

S = 1_000_000_000
FLOOR = np.diag([math.radians(0.05) ** 2] * 3 + [0.03**2] * 3)
RANDOM = np.diag([math.radians(0.04) ** 2] * 3 + [0.02**2] * 3)


def window(index, xi, covariance=RANDOM):
    return WindowEstimate(
        index * S, index * S + S // 2, 100.0 * index, 100.0 * index + 10.0, 9, xi, covariance
    )


def drawn(rng, count, spread, truth):
    return [window(i, truth + rng.multivariate_normal(np.zeros(6), spread)) for i in range(count)]


def test_windows_are_combined_by_their_information():
    rng = np.random.default_rng(1)
    L = rng.normal(size=(6, 6))
    windows = [window(0, rng.normal(size=6), L @ L.T + np.eye(6)), window(1, rng.normal(size=6), np.eye(6))]
    xi, covariance, scatter = combined(windows)
    # The same by least squares on both at once.
    A, W = (
        np.vstack([np.eye(6)] * 2),
        np.linalg.inv(np.block([[L @ L.T + np.eye(6), np.zeros((6, 6))], [np.zeros((6, 6)), np.eye(6)]])),
    )
    y = np.concatenate([w.xi for w in windows])
    own = np.linalg.inv(A.T @ W @ A)
    assert xi == pytest.approx(own @ A.T @ W @ y)
    assert scatter == pytest.approx((y - A @ xi) @ W @ (y - A @ xi) / 6.0)
    assert covariance == pytest.approx(max(1.0, scatter) * own)


def test_the_stated_covariance_holds_where_windows_scatter_as_they_say_and_where_more():
    rng = np.random.default_rng(2)
    truth = np.array([0.01, -0.02, 0.0, 0.1, 0.0, -0.1])
    for factor, low, high in ((1.0, 0.6, 1.1), (4.0, 0.6, 1.4)):
        squares = []
        for _ in range(300):
            xi, covariance, _ = combined(drawn(rng, 4, factor * RANDOM, truth))
            squares.append((xi - truth) @ np.linalg.solve(covariance, xi - truth) / 6.0)
        assert low < np.mean(squares) < high


def test_windows_that_differ_like_scenes_agree_and_a_mount_that_moved_on_does_not():
    rng = np.random.default_rng(3)
    truth = np.zeros(6)
    trials = [agree(drawn(rng, 4, RANDOM + FLOOR, truth), FLOOR, 1e-2) for _ in range(1000)]
    assert 1.0 - np.mean(trials) == pytest.approx(0.01, abs=0.012)
    moved = [*drawn(rng, 3, RANDOM, truth), window(9, np.array([0, math.radians(0.5), 0, 0, 0, 0.1]))]
    assert not agree(moved, FLOOR, 1e-3)
    assert agree(moved[:1], FLOOR, 1e-3)


CAMERA = CameraModel(
    "pinhole", np.array([[360.0, 0, 269.5], [0, 360, 89.5], [0, 0, 1]]), np.zeros(0), 540, 180
)
DRIFT = np.array([0.0, 0.0, math.radians(1.0), 0.0, 0.05, 0.0])
FRAMES = 8


@functools.cache
def street(seed):
    """A mount that believes in an extrinsic that has drifted by DRIFT, and frames with edges."""
    drive = DriveParameters(
        seed=seed,
        duration=0.1 * FRAMES,
        scene=SceneParameters(length=180.0),
        lidar=spinning(64, 900),
        camera=CAMERA,
    )
    R_vehicle_lidar = drive.T_vehicle_lidar[:3, :3]
    mount = Mount(
        camera=CAMERA,
        T_cam_lidar=se3.stored_before(drive.T_stored, DRIFT, R_vehicle_lidar),
        T_vehicle_lidar=drive.T_vehicle_lidar,
        sigma_rad=math.radians(0.1),
        sigma_m=0.02,
        limits=np.array([math.radians(0.5)] * 3 + [0.1] * 3),
        required=("pitch", "yaw"),
    )
    ego = Ego(mount.up, mount.T_cam_lidar[2, :3], None)
    pairs = [
        FramePair("front", f.cloud, f.image, f.cloud_stamp_ns, f.image_stamp_ns, 0.1) for f in Drive(drive)
    ]
    frames = []
    for number, pair in enumerate(pairs):
        straight = ego.straighten(pair)
        ground = fit_ground(straight.cloud, mount.up, np.random.default_rng(number))
        origin = sensor_origin(pairs[0].cloud)
        edges = find_edges(straight.cloud, ground, CAMERA, mount.T_cam_lidar, EdgeParameters(), origin)
        gradients = gradient_pyramid(pair.image, CAMERA)
        frames.append(EdgeFrame(pair.image_stamp_ns, edges, gradients, straight.distance_m))
    return drive, mount, tuple(frames)


def later(frames, seconds, metres):
    """The same frames as if seen later, further on."""
    return [
        dataclasses.replace(f, stamp_ns=f.stamp_ns + round(seconds * S), distance_m=f.distance_m + metres)
        for f in frames
    ]


def error(drive, candidate):
    """Of a candidate, deg and m."""
    R_vc = se3.vehicle_axes(drive.T_stored, drive.T_vehicle_lidar)
    e = se3.mount_drift(drive.T_stored, candidate.T_cam_lidar, R_vc)
    return np.degrees(e[:3]), e[3:]


def proposer(mount, **changes):
    return Proposer(mount, Parameters(), CandidateParameters(**changes))


def test_one_window_proposes_from_its_older_half_and_says_so():
    drive, mount, frames = street(13)
    proposal = proposer(mount).propose(frames, [], frames[-1].stamp_ns)
    assert isinstance(proposal, Candidate)
    assert [w.to_ns for w in proposal.windows] == [frames[FRAMES // 2 - 1].stamp_ns]
    assert not proposal.agreed
    check = proposal.hold_out
    assert (check.frames, check.from_ns, check.to_ns) == (4, frames[4].stamp_ns, frames[-1].stamp_ns)
    # The frames held out show what the others saw: it is told.
    assert 0.0 < check.apart_m < NEW_SCENE_M
    assert check.score_stored < check.score_candidate <= check.score_own * 1.001
    assert check.p_better < 0.01 < check.p_agreed
    angles, shifts = error(drive, proposal)
    assert np.abs(angles).max() < 0.15
    assert np.abs(shifts).max() < 0.06
    sigma = np.sqrt(np.diag(proposal.covariance))
    assert (
        np.concatenate([np.radians(angles), shifts])
        / np.tile([sigma[:3].min(), sigma[3:].min()], (3, 1)).T.ravel()
    ) == pytest.approx(0.0, abs=3.0)


def test_windows_of_other_scenes_propose_and_this_one_is_held_out_whole():
    drive, mount, frames = street(13)
    _, _, others = street(12)
    belief = believe(mount, Parameters(), others, [])
    maker = proposer(mount)
    for index in range(3):
        maker.note(belief, later(others, 2.0 * index, 100.0 * index))
        # The same scene a frame later is not another window.
        maker.note(belief, later(others, 2.0 * index + 0.1, 100.0 * index + 1.0))
    held = later(frames, 20.0, 400.0)
    assert maker.due(held)
    proposal = maker.propose(held, [], held[-1].stamp_ns)
    assert isinstance(proposal, Candidate)
    assert len(proposal.windows) == 3
    assert proposal.agreed
    assert proposal.hold_out.frames == FRAMES
    assert proposal.hold_out.apart_m > NEW_SCENE_M
    assert proposal.hold_out.p_better < 0.01
    angles, shifts = error(drive, proposal)
    assert np.abs(angles).max() < 0.15
    assert np.abs(shifts).max() < 0.06
    assert not maker.due(held)
    assert maker.due(later(held, 2.0, 30.0))


def test_a_window_of_another_mount_is_left_out():
    _, mount, frames = street(13)
    belief = believe(mount, Parameters(), frames, [])
    turn = np.array([0.0, math.radians(1.0), 0.0, 0.0, 0.0, 0.0])
    other = dataclasses.replace(belief, T_estimated=se3.retract(belief.T_estimated, turn))
    maker = proposer(mount)
    maker.note(other, frames)
    maker.note(belief, later(frames, 2.0, 100.0))
    held = later(frames, 20.0, 400.0)
    proposal = maker.propose(held, [], held[-1].stamp_ns)
    assert isinstance(proposal, Candidate)
    assert [w.from_m for w in proposal.windows] == [pytest.approx(frames[0].distance_m + 100.0)]
    # A candidate from the window of the other mount alone does not pass.
    maker = proposer(mount)
    maker.note(other, frames)
    refused = maker.propose(held, [], held[-1].stamp_ns)
    assert isinstance(refused, NoCandidate)
    assert refused.hold_out.reason == refused.reason


def test_a_true_extrinsic_is_not_replaced():
    drive, mount, frames = street(13)
    true = dataclasses.replace(mount, T_cam_lidar=drive.T_stored)
    refused = proposer(true).propose(frames, [], 7)
    assert isinstance(refused, NoCandidate)
    assert "not score significantly better" in refused.reason
    assert refused.stamp_ns == 7


def test_too_little_is_said_to_be_too_little():
    _, mount, frames = street(13)
    assert "3 frames" in proposer(mount).propose(frames[:3], [], 0).reason
    assert "0 frames" in proposer(mount).propose([], [], 0).reason
    strict = proposer(mount, hold_out=HoldOutParameters(least_cells=10_000))
    assert "parts of the image only" in strict.propose(frames, [], 0).reason
    maker = proposer(mount)
    maker.propose(frames, [], 0)
    maker.forget()
    assert maker.due(frames)
    assert maker.proposal is not None
    maker.follow(None, None, frames, [], 0)
    assert maker.proposal is None


def test_only_frames_that_show_the_moved_mount_take_part():
    _, mount, frames = street(13)
    maker = proposer(mount)
    maker.follow(frames[2].stamp_ns, None, frames, [], 1)
    assert maker.proposal is None
    maker.follow(frames[2].stamp_ns, None, frames, [], 2, ended=True)
    assert "6 frames" in maker.proposal.reason
    # Once something was found, silence at the end takes nothing back.
    maker.follow(0, None, frames, [], 3)
    found = maker.proposal
    assert isinstance(found, Candidate)
    maker.follow(0, None, frames[:2], [], 4, ended=True)
    assert maker.proposal is found
    memory = dataclasses.replace(verdict.start(0), severity="major", onset=Onset(5, 3, 9))
    assert moved_since(memory) == 9
    assert moved_since(dataclasses.replace(memory, onset=Onset(3, 3, 9))) == 3
    assert moved_since(verdict.start(0)) is None
