"""Simulated streets: what is found without a prior is right, from any attitude, or said not to be there."""

import dataclasses

import numpy as np
import pytest

from pipeline import labels, se3
from pipeline.candidate_edges import CandidateParameters, Scene, distinct, judge_candidates
from pipeline.edges import CELLS
from pipeline.errors import InputError
from pipeline.gradients import gradient_pyramid
from pipeline.ground import fit_ground
from pipeline.no_prior import (
    Answer,
    FoundExtrinsic,
    NoExtrinsic,
    NoPriorParameters,
    Prior,
    find_extrinsic,
    lead,
)
from pipeline.records import CameraImage, Masks, PointCloud

UP = np.array([0.0, 0.0, 1.0])
TURNS = {
    "quarter turn": se3.exp_so3(np.pi / 2 * UP),
    "upside down": np.diag([1.0, -1.0, -1.0]),
}


def masks_of(frame):
    lane, pole = frame.labels == labels.LANE, frame.labels == labels.POLE
    return Masks(lane, pole, lane.astype(np.float32), pole.astype(np.float32), 1.0, 1.0)


@pytest.fixture(scope="module")
def camera(drive):
    return drive.parameters.camera


def find(frame, camera, *, R=None, seed=1, **given):
    """The outcome of a frame whose LiDAR is turned by R, and the true extrinsic then."""
    R = np.eye(3) if R is None else R
    cloud = dataclasses.replace(frame.cloud, xyz=(frame.cloud.xyz @ R.T).astype(np.float32))
    cloud, image, masks = (
        given.pop(name, own)
        for name, own in (("cloud", cloud), ("image", frame.image), ("masks", masks_of(frame)))
    )
    found = find_extrinsic(cloud, image, masks, camera, np.random.default_rng(seed), **given)
    return found, frame.T_cam_lidar @ se3.inverse(se3.transform(R, np.zeros(3)))


def miss(T, truth):
    """Turn in deg, and distance of the camera's centres in m."""
    centres = [-one[:3, :3].T @ one[:3, 3] for one in (T, truth)]
    return np.degrees(se3.rotation_angle(T[:3, :3], truth[:3, :3])), np.linalg.norm(np.subtract(*centres))


@pytest.fixture(scope="module")
def plain(street, camera):
    """What is found in the street as it is."""
    return find(street, camera)[0]


@pytest.mark.parametrize("turn", TURNS)
def test_a_street_is_found_whatever_the_frame_of_the_lidar(street, camera, turn):
    found, truth = find(street, camera, R=TURNS[turn])
    assert isinstance(found, FoundExtrinsic)
    turned, shifted = miss(found.T_cam_lidar, truth)
    assert turned < 0.3
    assert shifted < 0.15


def test_a_street_is_found_and_its_rivals_are_told(street, plain):
    found = plain
    assert isinstance(found, FoundExtrinsic)
    turned, shifted = miss(found.T_cam_lidar, street.T_cam_lidar)
    assert turned < 0.3
    assert shifted < 0.15
    assert found.lead > NoPriorParameters().least_lead
    np.testing.assert_array_equal(found.answers[0].T_cam_lidar, found.T_cam_lidar)
    scores = [answer.score for answer in found.answers]
    assert scores == sorted(scores, reverse=True)


def test_answers_differ_from_each_other_and_keep_near_the_lidar(plain):
    p = CandidateParameters()
    T = np.stack([answer.T_cam_lidar for answer in plain.answers])
    assert len(distinct(T, p.distinct_rad, p.distinct_m)) == len(T) > 1
    assert np.linalg.norm(T[:, :3, 3], axis=1).max() <= p.baseline_m


def test_a_wide_prior_is_searched_and_kept_to(street, camera):
    rng = np.random.default_rng(5)
    off = np.concatenate([np.radians(rng.uniform(-6, 6, 3)), rng.uniform(-1, 1, 3)])
    prior = Prior(se3.retract(street.T_cam_lidar, off), np.radians(4.0), 0.7)
    found, truth = find(street, camera, prior=prior)
    assert isinstance(found, FoundExtrinsic)
    turned, shifted = miss(found.T_cam_lidar, truth)
    assert turned < 0.3
    assert shifted < 0.15
    assert all(prior.within(answer.T_cam_lidar[None]).all() for answer in found.answers)


def test_a_wide_prior_needs_no_lines(street, camera):
    """Bare edges draw a start in that no line helps: far off for them alone, but within the prior."""
    none = np.zeros((10, 10), dtype=bool)
    empty = Masks(none, none, none.astype(np.float32), none.astype(np.float32), 10 / 960, 10 / 304)
    off = np.concatenate([np.radians([2.5, -2.0, 3.0]), [0.3, -0.2, 0.3]])
    prior = Prior(se3.retract(street.T_cam_lidar, off), np.radians(3.0), 0.4)
    found, truth = find(street, camera, masks=empty, prior=prior)
    turned, shifted = miss(found.answers[0].T_cam_lidar, truth)
    assert turned < 0.5
    assert shifted < 0.25


def test_a_picture_of_another_street_is_not_calibrated(street, camera):
    """Lines of one place, edges of another: nothing is claimed."""
    shifted = CameraImage(np.ascontiguousarray(street.image.pixels[:, ::-1]))
    lane, pole = (
        np.ascontiguousarray(mask[:, ::-1]) for mask in (masks_of(street).lane, masks_of(street).pole)
    )
    mirrored = Masks(lane, pole, lane.astype(np.float32), pole.astype(np.float32), 1.0, 1.0)
    found, _ = find(street, camera, image=shifted, masks=mirrored)
    assert isinstance(found, NoExtrinsic)
    assert found.reason in (
        "another extrinsic fits as well",
        "image and cloud show hardly more in common than by chance",
    )


def test_reasons_are_told(street, camera):
    empty = np.zeros_like(street.labels, dtype=bool)
    some = masks_of(street)
    no_lanes = Masks(empty, some.pole, empty.astype(np.float32), some.pole_probability, 1.0, 1.0)
    assert find(street, camera, masks=no_lanes)[0].reason == "fewer than two lanes in the image"
    dark = dataclasses.replace(street.cloud, intensity=np.zeros(len(street.cloud), np.float32))
    assert find(street, camera, cloud=dark)[0].reason == "fewer than two lanes in the cloud"
    ball = PointCloud(np.random.default_rng(1).normal(0, 8, (5000, 3)).astype(np.float32))
    assert find(street, camera, cloud=ball)[0].reason == "no ground plane in the cloud"
    grey = CameraImage(np.full_like(street.image.pixels, 90))
    found, _ = find(street, camera, image=grey)
    # Not one stroke has edges in a grey image.
    assert found.reason == "fewer than two lanes in the image"
    # Two rings of the ground: lanes are lost, and with them all hope.
    ring = street.cloud.ring
    few = np.flatnonzero((ring == 5) | (ring == 9))
    two = PointCloud(street.cloud.xyz[few], street.cloud.intensity[few], ring[few], street.cloud.time[few])
    assert isinstance(find(street, camera, cloud=two)[0], NoExtrinsic)


def test_lead_counts_what_two_answers_share_once():
    rng = np.random.default_rng(2)
    common = rng.normal(0, 0.01, CELLS + 3)
    apart = np.zeros(CELLS + 3)
    apart[:4] = [0.02, -0.02, 0.01, -0.01]
    first, second = (
        Answer(np.eye(4), score, 5.0, common + shares)
        for score, shares in ((0.4, apart), (0.35, 0.0 * apart))
    )
    assert lead(first, second) == pytest.approx(0.05 / np.linalg.norm(apart))
    assert lead(second, first) == pytest.approx(-lead(first, second))
    # Answers of two grounds have lines of their own.
    longer = Answer(np.eye(4), 0.3, 5.0, np.append(common, 0.02))
    assert lead(second, longer) == pytest.approx(0.05 / 0.02)


def test_the_same_seed_gives_the_same_answer(street, camera, plain):
    again = find(street, camera)[0]
    np.testing.assert_array_equal(again.T_cam_lidar, plain.T_cam_lidar)
    assert again.lead == plain.lead


def test_candidates_are_drawn_in_along_the_road(street, camera):
    """One start 2 m behind the truth, one that looks back."""
    cloud = street.cloud
    ground = fit_ground(cloud, UP, np.random.default_rng(1))
    scene = Scene(cloud, ground, gradient_pyramid(street.image, camera), camera, np.zeros(3))
    behind = street.T_cam_lidar.copy()
    behind[:3, 3] += street.T_cam_lidar[:3, :3] @ np.array([2.0, 0.0, 0.0])
    back = street.T_cam_lidar @ se3.transform(se3.exp_so3(np.pi * UP), np.zeros(3))
    starts = np.stack([back, behind])
    judged = judge_candidates(starts, scene, CandidateParameters(), np.random.default_rng(2), along_road=True)
    turned, shifted = miss(judged[0].T_cam_lidar, street.T_cam_lidar)
    assert turned < 0.3
    assert shifted < 0.15
    assert judged[0].peak > 5
    assert judged[0].score > 1.2 * judged[1].score
    assert abs(judged[0].cells.sum()) < 1e-9
    fixed = judge_candidates(
        starts[1:], scene, CandidateParameters(), np.random.default_rng(2), along_road=False
    )
    assert miss(fixed[0].T_cam_lidar, street.T_cam_lidar)[1] > 1.0
    nothing = judge_candidates(
        np.zeros((0, 4, 4)), scene, CandidateParameters(), np.random.default_rng(2), along_road=True
    )
    assert nothing == ()


def test_distinct_extrinsics_differ_by_turn_or_by_place():
    turn = se3.transform(se3.exp_so3(np.radians(2.0) * UP), np.zeros(3))
    shift = se3.transform(np.eye(3), np.array([0.0, 0.4, 0.0]))
    T = np.stack([np.eye(4), turn, np.eye(4), shift, turn @ shift])
    assert distinct(T, np.radians(1.0), 0.3).tolist() == [0, 1, 3, 4]
    assert distinct(T, np.radians(3.0), 0.3).tolist() == [0, 3]
    assert distinct(T, np.radians(1.0), 0.5).tolist() == [0, 1]
    assert distinct(T, np.radians(1.0), 0.3, 2).tolist() == [0, 1]
    assert distinct(T[:0], 1.0, 1.0).tolist() == []


@pytest.mark.parametrize(("sigma_rad", "sigma_m"), [(0.0, 1.0), (0.1, -1.0), (np.nan, 1.0), (0.1, np.inf)])
def test_a_prior_without_width_is_refused(sigma_rad, sigma_m):
    with pytest.raises(InputError, match="not positive"):
        Prior(np.eye(4), sigma_rad, sigma_m)
