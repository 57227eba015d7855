import dataclasses
import math

import numpy as np
import pytest

from pipeline.belief import Belief
from pipeline.drift_test import Evidence, expectation_of_stored, judge
from pipeline.drive_scenes import DriveScenes
from pipeline.edge_parameters import EdgeParameters
from pipeline.edge_score import batch_of
from pipeline.edge_search import EdgeWitnessParameters
from pipeline.edge_witness import EdgeFrame, solve
from pipeline.edges import find_edges
from pipeline.gradients import gradient_pyramid
from pipeline.ground import fit_ground
from pipeline.mount import Mount
from pipeline.parameters import Parameters

P = Parameters()
S = 1_000_000_000
STORED = expectation_of_stored(math.radians(0.1), 0.02, P.test)
SURE = np.diag([math.radians(0.02) ** 2] * 3 + [0.004**2] * 3)


@pytest.fixture(scope="module")
def world(drive, straight_frames, limits):
    """A mount, and what the edges of one frame of it say."""
    p, frame = drive.parameters, straight_frames[0]
    mount = Mount(p.camera, p.T_stored, p.T_vehicle_lidar, math.radians(0.1), 0.02, limits, ("yaw", "pitch"))
    rng = np.random.default_rng(1)
    ground = fit_ground(frame.cloud, mount.up, rng)
    edges = find_edges(frame.cloud, ground, p.camera, p.T_stored, EdgeParameters())
    batch = batch_of([EdgeFrame(0, edges, gradient_pyramid(frame.image, p.camera))], p.camera, 600)
    return mount, solve(batch, p.T_stored, STORED.floor, EdgeWitnessParameters(), rng)


def belief(world, yaw_deg, **marks):
    """A window that says so much of yaw."""
    mount, edges = world
    drift = math.radians(yaw_deg) * np.eye(6)[2]
    stated = {"loss": 0.01, "contrast": 0.8, "peak": 9.0, "preference": 1.0, "persistent": True, "frames": 20}
    evidence = Evidence(drift, SURE, **stated)
    judgement = dataclasses.replace(judge(evidence, STORED, mount.limits, P.test), **marks)
    return Belief(judgement, evidence, mount.T_cam_lidar, edges, None, None, None, ())


def driven(world, yaws_deg, step_m=45.0, scenes=None):
    """The scenes of a drive whose windows of 40 m say so much of yaw, one each ``step_m``."""
    scenes = DriveScenes(world[0], P) if scenes is None else scenes
    for number, yaw in enumerate(yaws_deg):
        way = step_m * number
        scenes.hear(belief(world, yaw), (way, way + 40.0), number * 4 * S)
    return scenes


def test_nothing_is_said_before_the_first_scene(world):
    scenes = DriveScenes(world[0], P)
    assert scenes.said() is None
    scenes.hear(belief(world, 0.0), (0.0, 12.0), 0)
    assert scenes.said() is None
    scenes.hear(belief(world, 0.0), (0.0, 21.0), S)
    assert scenes.said().over == "one scene"


def test_windows_that_share_frames_are_one_scene(world):
    assert driven(world, [0.0] * 9, step_m=10.0).total.scenes == 3
    assert driven(world, [0.0] * 9).total.scenes == 9
    assert driven(world, [0.0] * 9, step_m=0.0).total.scenes == 1


@pytest.mark.parametrize("mark", ["blind", "contradicted"])
def test_a_window_that_sees_nothing_is_no_scene(world, mark):
    scenes = DriveScenes(world[0], P)
    scenes.hear(belief(world, 1.0, **{mark: True}), (0.0, 40.0), 0)
    assert scenes.total.scenes == 0
    assert scenes.track.scenes == 0


def test_a_small_steady_drift_is_told_by_all_scenes_with_its_beginning(world):
    calm = driven(world, [0.0] * 40)
    assert not calm.said().suspicious
    assert abs(calm.track.drift[2]) < math.radians(0.01)
    # Several streets: the floor is common to one of 300 m.
    told = driven(world, [0.0] * 30 + [0.5] * 40).said()
    assert told.alarming
    assert told.drift[2] == pytest.approx(math.radians(0.5), abs=math.radians(0.1))
    assert abs(told.onset.stamp_ns - 30 * 4 * S) <= 2 * 4 * S
    assert told.onset.from_ns == told.onset.stamp_ns - 4 * S


def test_a_forgotten_drive_starts_anew(world):
    scenes = driven(world, [0.5] * 40)
    scenes.forget()
    assert scenes.said() is None
    assert scenes.track.scenes == 0
    assert driven(world, [0.0] * 3, scenes=scenes).total.scenes == 3
