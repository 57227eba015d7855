"""Which part has moved, as it is said: who may speak, and in which words."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from monitor.parts import pair_drift, parts_of
from pipeline import drift_test, fusion, se3
from pipeline.belief import Belief
from pipeline.drift_test import Evidence
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import CameraModel

PARAMETERS = Parameters()
CAMERA = CameraModel("pinhole", np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]), np.empty(0), 160, 120)
C = np.diag([math.radians(0.05) ** 2] * 3 + [0.02**2] * 3)
LIDARS = {"front": "/top", "left": "/top", "rear": "/other"}


def mounted(heading_deg):
    turn = Rotation.from_euler("z", heading_deg, degrees=True)
    R = turn.as_matrix() @ se3.AXES_CAM_IN_VEHICLE
    return Mount(
        camera=CAMERA,
        T_cam_lidar=se3.inverse(se3.transform(R, turn.apply([0.8, 0.1, -0.2]))),
        T_vehicle_lidar=np.eye(4),
        sigma_rad=math.radians(0.1),
        sigma_m=0.02,
        limits=np.array([math.radians(0.5)] * 3 + [0.1] * 3),
        required=("yaw",),
    )


MOUNTS = {"front": mounted(0.0), "left": mounted(80.0), "rear": mounted(180.0)}


def believed(mount, T_estimated, **changes):
    expectation = mount.expectation(PARAMETERS.test)
    drift = se3.mount_drift(mount.T_cam_lidar, T_estimated, mount.R_vehicle_cam)
    evidence = Evidence(
        drift=drift,
        covariance=C,
        loss=0.2,
        contrast=1.0,
        peak=9.0,
        preference=9.0,
        persistent=True,
        frames=9,
    )
    judgement = drift_test.judge(evidence, expectation, mount.limits, PARAMETERS.test)
    judgement = dataclasses.replace(judgement, **changes)
    said = fusion.Testimony(drift, np.linalg.inv(C))
    return Belief(judgement, evidence, T_estimated, None, None, said, None, ())


def watched(lidar=None, camera=None, names=tuple(MOUNTS), **changes):
    """Pairs of which the LiDAR or the front camera has moved by a transform."""
    found = {}
    for name in names:
        mount = MOUNTS[name]
        T = mount.T_cam_lidar @ (np.eye(4) if lidar is None else lidar)
        if name == "front" and camera is not None:
            T = camera @ T
        found[name] = (mount, believed(mount, T, **changes))
    return found


MOVED = se3.transform(se3.exp_so3(np.array([0.0, 0.0, math.radians(1.5)])), np.array([0.0, 0.1, 0.0]))


@pytest.mark.parametrize(
    ("moved", "sentence"),
    [
        ({"lidar": MOVED}, "The LiDAR has moved ("),
        ({"camera": MOVED}, "The camera of pair front has moved ("),
        ({}, "Nothing has moved ("),
    ],
)
def test_the_part_is_said_with_odds(moved, sentence):
    (told,) = parts_of(watched(**moved), LIDARS, PARAMETERS)
    assert (told.lidar, told.pairs) == ("/top", ("front", "left"))
    assert told.sentence.startswith(sentence)
    assert ":1 against " in told.sentence
    assert 3.0 <= told.odds <= 1000.0
    assert sum(share.probability for share in told.hypotheses) == pytest.approx(1.0)


def test_only_pairs_that_have_something_to_say_and_share_a_lidar_speak():
    one = {"front": (MOUNTS["front"], None), "left": watched(lidar=MOVED)["left"]}
    assert parts_of(one, LIDARS, PARAMETERS) == ()
    assert parts_of(watched(lidar=MOVED, names=("front", "rear")), LIDARS, PARAMETERS) == ()
    assert parts_of(watched(lidar=MOVED, blind=True), LIDARS, PARAMETERS) == ()
    assert parts_of(watched(lidar=MOVED, contradicted=True), LIDARS, PARAMETERS) == ()
    assert parts_of({}, {}, PARAMETERS) == ()


def test_what_can_not_be_told_apart_is_said_so():
    pairs = watched(lidar=MOVED, names=("front", "left"))
    mount, belief = pairs["left"]
    vague = dataclasses.replace(belief.evidence, covariance=np.diag([1.0] * 3 + [100.0] * 3))
    pairs["left"] = (mount, dataclasses.replace(belief, evidence=vague))
    (told,) = parts_of(pairs, LIDARS, PARAMETERS)
    assert told.sentence.startswith("Which part has moved can not be told: the ")
    assert "the LiDAR" in told.sentence
    assert "the camera of pair front" in told.sentence


def test_a_pair_s_doubt_is_that_of_the_test_in_camera_axes():
    mount, belief = watched(lidar=MOVED)["left"]
    drift = pair_drift("left", mount, belief, PARAMETERS)
    x = belief.evidence.drift
    B = se3.vehicle_block(mount.R_vehicle_cam)
    xi = B.T @ x
    assert xi @ np.linalg.solve(drift.covariance, xi) == pytest.approx(belief.judgement.statistic)
