"""Belief and memory as a status: units, names, and nulls where nothing is known."""

import dataclasses
import math
from collections import Counter

import numpy as np
import pytest

from monitor.statements import Identity, Measured, status_of
from monitor.status import AXIS_NAMES, Provenance, Rates
from pipeline import fusion, scene_track, verdict
from pipeline.belief import Belief
from pipeline.causes import Explanation
from pipeline.drift_test import DriftTestParameters, Evidence, Judgement, expectation_of_stored
from pipeline.mount import Mount
from pipeline.records import CameraModel
from pipeline.scene_filter import Scene
from pipeline.scene_track import TrackParameters

NONE = Provenance(hash=None, version=None)
LIMITS = np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.2, 0.15, 0.15])
DRIFT = np.array([math.radians(0.1), math.radians(-0.2), math.radians(0.3), 0.04, -0.05, 0.06])
MOUNT = Mount(
    camera=CameraModel("pinhole", np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]), np.empty(0), 160, 120),
    T_cam_lidar=np.eye(4),
    T_vehicle_lidar=None,
    sigma_rad=0.001,
    sigma_m=0.01,
    limits=LIMITS,
    required=("yaw",),
)


def said(belief=None, window_ns=(), lines_ns=(), mount=MOUNT, explanation=None, track=None, memory=None):
    rates = Rates(lidar_hz=None, camera_hz=None, gap_ms=None)
    measured = Measured(
        received=7,
        used=4,
        dropped=Counter(undecodable=3),
        window_ns=window_ns,
        lines_ns=lines_ns,
        rates=rates,
        timing={},
        outputs_lost={"report": "the disk is full"},
        explanation=explanation,
        track=track,
    )
    identity = Identity("van-1", "front", NONE, NONE, "calibwatch test")
    memory = verdict.start(5) if memory is None else memory
    return status_of(identity, mount, memory, belief, measured, 3, 9)


def judged():
    known = np.array([True, True, True, True, True, False])
    spread = np.where(known, 0.01, np.inf)
    judgement = Judgement(
        drift=DRIFT,
        sigma=spread,
        protection_level=spread,
        detectable=spread,
        observable=known,
        monitored=np.array([False, False, True, False, False, False]),
        excluded=known,
        statistic=1.0,
        alarming=False,
        suspicious=False,
        blind=False,
        ambiguous=False,
        contradicted=False,
    )
    testimony = fusion.Testimony(DRIFT, np.diag(np.full(6, 100.0)))
    evidence = Evidence(
        DRIFT, np.diag(np.where(known, 0.01, 10.0) ** 2), 0.1, 1.0, 9.0, 4.0, persistent=True, frames=9
    )
    return Belief(judgement, evidence, np.eye(4), None, None, testimony, None, ())


def test_without_a_belief_every_number_is_null_but_the_limits():
    status = said()
    assert (status.seq, status.stamp_ns, status.state) == (3, 9, "starting")
    assert status.frames.model_dump() == {"received": 7, "used": 4, "dropped": {"undecodable": 3}}
    for (_, axis), limit in zip(status.drift.items(), (0.75, 0.5, 0.5, 0.2, 0.15, 0.15), strict=True):
        assert axis.value is axis.sigma is axis.protection_level is axis.detectable is None
        assert not axis.observable
        assert axis.alert_limit == pytest.approx(limit)
    assert status.witnesses.lines is status.witnesses.edges is None
    assert (status.window.frames, status.window.span_s) == (0, 0.0)
    assert status.outputs_lost == {"report": "the disk is full"}


def test_angles_are_told_in_degrees_and_lengths_in_metres_and_what_is_held_has_no_bound():
    status = said(judged())
    values = [status.drift[name].value for name in AXIS_NAMES]
    assert values == pytest.approx([0.1, -0.2, 0.3, 0.04, -0.05, 0.06])
    assert status.drift.roll.sigma == pytest.approx(math.degrees(0.01))
    assert status.drift.forward.protection_level == pytest.approx(0.01)
    assert status.drift.up.sigma is status.drift.up.protection_level is status.drift.up.detectable is None
    assert [status.drift[name].monitored for name in AXIS_NAMES] == [False, False, True, False, False, False]


def test_the_axes_are_those_of_the_vehicle_only_where_it_is_known():
    assert said().drift.axes == "camera"
    vehicle = Mount(*(np.eye(4) if f == "T_vehicle_lidar" else getattr(MOUNT, f) for f in Mount.__slots__))
    assert said(mount=vehicle).drift.axes == "vehicle"


def test_the_window_is_that_of_the_edges_else_of_the_lines():
    second = 1_000_000_000
    assert said(window_ns=(second, 2 * second), lines_ns=(0,)).window.span_s == 1.0
    window = said(lines_ns=(0, second, 3 * second)).window
    assert (window.frames, window.span_s) == (3, 3.0)


def test_what_the_drift_does_is_told_at_every_distance_and_not_of_chance():
    near, middle, far = said(judged()).consequence
    assert (near.range_m, middle.range_m, far.range_m) == (10.0, 30.0, 80.0)
    # +yaw turns left and -0.05 m is to the right: sine of the angle times the range, less the shift.
    assert middle.left_m == pytest.approx(30.0 * math.sin(DRIFT[2]) - 0.05, abs=1e-3)
    assert middle.up_m == pytest.approx(-30.0 * math.sin(DRIFT[1]) + 0.06, abs=1e-3)
    assert far.sigma_left_m == pytest.approx(0.01 * math.hypot(80.0, 1.0), rel=1e-3)
    assert far.sigma_up_m == pytest.approx(math.hypot(0.8, 10.0), rel=1e-2)
    belief = judged()
    blind = dataclasses.replace(belief, judgement=dataclasses.replace(belief.judgement, blind=True))
    assert said().consequence == said(blind).consequence == ()


def test_a_time_offset_is_told_where_it_is_no_drift():
    explanation = Explanation(
        time_offset_s=0.0123,
        time_sigma_s=0.002,
        time_alone_s=0.01,
        separable=True,
        zoom=0.0,
        zoom_sigma=0.001,
        motion=np.zeros(6),
        needed=np.zeros(3),
        alone=np.zeros(3),
        unexplained=0.0,
        sections=4,
    )
    offset = said(explanation=explanation).time_offset
    assert offset.model_dump() == pytest.approx({"ms": 12.3, "sigma_ms": 2.0, "separable": True})
    hidden = said(explanation=dataclasses.replace(explanation, separable=False)).time_offset
    assert hidden.model_dump() == pytest.approx({"ms": None, "sigma_ms": 2.0, "separable": False})
    assert said().time_offset.sigma_ms is None


def test_where_the_mount_is_by_all_scenes_is_told_from_the_first_on():
    expectation = expectation_of_stored(math.radians(0.1), 0.02, DriftTestParameters())
    track = scene_track.begin(expectation)
    assert said(track=track).drive is None
    drift = np.array([0.0, 0.0, math.radians(0.2), 0.0, 0.0, -0.03])
    scene = Scene(drift, np.diag([1e-8] * 3 + [1e-6] * 3), np.zeros(6), 20.0, 1)
    track = scene_track.followed(track, scene, expectation, TrackParameters(most_square=1e9))
    told = said(track=track).drive
    assert told.scenes == 1
    assert 0.0 < told.drift.yaw < 0.2
    assert -0.03 < told.drift.up < 0.0
    assert told.sigma.yaw == pytest.approx(math.degrees(math.sqrt(track.drift_covariance[2, 2])))
    # A step is not followed: beside the size that is told it would name another.
    slipped = dataclasses.replace(verdict.start(5), state="drifted", severity="major")
    assert said(track=track, memory=slipped).drive is None
