import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pipeline import line_hearing, se3
from pipeline.line_hearing import heard, match_lines
from pipeline.line_witness import LineFrame

_spec = importlib.util.spec_from_file_location(
    "line_scenes", Path(__file__).parents[1] / "oracles" / "line_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)

YAW = np.radians(4.0) * np.eye(6)[1]
"""About the camera's upright axis: more than matching reaches."""


def frames_of(count=4):
    rng = np.random.default_rng(6)
    drawn = [scenes.line_sets(rng, sigma_px=0.5) for _ in range(count)]
    aside = np.cross(scenes.UP, scenes.FORWARD)
    return [LineFrame(tuple(cloud), tuple(image), (), aside) for cloud, image in drawn]


def told(T_expected, edges_xi, frames=None):
    frames = frames_of() if frames is None else frames
    near = match_lines(frames, scenes.CAMERA, T_expected)
    return near, heard(near, frames, scenes.CAMERA, T_expected, edges_xi)


def test_no_lines_tell_nothing():
    assert match_lines([], scenes.CAMERA, scenes.TRUTH) is None
    assert told(scenes.TRUTH, YAW, [LineFrame((), (), (), np.zeros(3))]) == (None, None)


@pytest.mark.parametrize("edges_xi", [None, np.zeros(6)], ids=["lines alone", "edges too"])
def test_lines_around_the_expected_extrinsic_are_heard(edges_xi):
    near, lines = told(scenes.TRUTH, edges_xi)
    assert lines is near
    assert np.abs(lines.estimate.xi).max() < np.radians(0.5)


def test_of_a_wide_drift_that_is_right_lines_are_heard_where_the_edges_are():
    T_expected = se3.retract(scenes.TRUTH, -YAW)
    _, lines = told(T_expected, YAW)
    assert line_hearing.testifies(match_lines(frames_of(), scenes.CAMERA, scenes.TRUTH))
    angle = np.degrees(se3.local(scenes.TRUTH, se3.retract(T_expected, lines.estimate.xi)))[:3]
    assert np.abs(angle).max() < 0.3


def test_a_false_mode_of_the_edges_far_away_does_not_draw_lines_from_the_truth():
    near, lines = told(scenes.TRUTH, YAW)
    assert lines is near


def test_lines_that_fit_as_well_at_both_places_tell_neither():
    T_expected = se3.retract(scenes.TRUTH, -YAW)
    frames = frames_of()
    far = match_lines(frames, scenes.CAMERA, scenes.TRUTH)

    def near_with(features):
        estimate = dataclasses.replace(far.estimate, xi=np.zeros(6), features=features)
        near = dataclasses.replace(far, estimate=estimate)
        return near, heard(near, frames, scenes.CAMERA, T_expected, YAW)

    assert near_with(far.estimate.features)[1] is None
    near, lines = near_with(far.estimate.features + 1)
    assert lines is near
    near, lines = near_with(far.estimate.features - 1)
    assert lines.estimate.features == far.estimate.features


def test_lines_that_do_not_fit_each_other_are_not_heard():
    near = match_lines(frames_of(), scenes.CAMERA, scenes.TRUTH)
    assert not line_hearing.testifies(dataclasses.replace(near, fit=1e-4))
    off = dataclasses.replace(near.estimate, xi=YAW)
    assert not line_hearing.testifies(dataclasses.replace(near, estimate=off))
