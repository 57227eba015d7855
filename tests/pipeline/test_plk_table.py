"""The statistics of Table I: closed forms, and demands that are missed where they should be."""

import dataclasses
import math

import numpy as np
import pytest

from pipeline import plk, plk_table, se3
from pipeline import plk_scenes as scenes


def trials(name, sigma_px, runs, seed=0):
    rng = np.random.default_rng(seed)
    return [plk_table.run_once(scenes.scene(name), sigma_px, rng) for _ in range(runs)]


def held(name, sigma_px, found):
    return {check.demand: check.held for check in plk_table.checks(name, sigma_px, found)}


def shifted(trial, rotation=0.0, translation=0.0):
    """The trial with all answers moved away from the truth by this much."""
    answer = scenes.TRUTH.copy()
    answer[:3, :3] = se3.exp_so3(np.array([rotation, 0, 0])) @ answer[:3, :3]
    answer[0, 3] += translation
    return dataclasses.replace(trial, answers=dict.fromkeys(scenes.METHODS, answer))


def test_start_is_as_far_off_as_published():
    rotation, translation = scenes.errors(scenes.START)
    assert rotation == pytest.approx(0.149, abs=5e-4)
    assert translation == pytest.approx(0.866, abs=5e-4)


def test_every_start_is_as_far_off_on_each_axis():
    signs = np.array([1.0, -1.0, -1.0, 1.0, -1.0, 1.0])
    start = scenes.start_off(signs)
    E = start[:3, :3] @ scenes.TRUTH[:3, :3].T
    angles = [math.atan2(E[2, 1], E[2, 2]), -math.asin(E[2, 0]), math.atan2(E[1, 0], E[0, 0])]
    np.testing.assert_allclose(np.degrees(angles), 5 * signs[:3])
    np.testing.assert_allclose(start[:3, 3] - scenes.TRUTH[:3, 3], 0.5 * signs[3:])


@pytest.mark.parametrize("name", scenes.SCENES)
def test_lines_without_noise_have_no_residual_at_the_truth(name):
    pairs = scenes.observed(scenes.scene(name), 1e-12, np.random.default_rng(0))
    assert np.abs(plk.residuals(pairs, scenes.K, scenes.TRUTH)).max() < 1e-9


@pytest.mark.parametrize("name", ["c", "d", "corner"])
def test_a_camera_moved_along_the_held_direction_sees_the_same(name):
    lines = scenes.scene(name)
    pairs = scenes.observed(lines, 1.0, np.random.default_rng(1))
    there = se3.retract(scenes.TRUTH, np.array([0.01, -0.02, 0.03, 0.1, 0.2, -0.1]))
    moved = there.copy()
    moved[:3, 3] += 0.7 * lines.held(there)
    np.testing.assert_allclose(
        plk.residuals(pairs, scenes.K, moved), plk.residuals(pairs, scenes.K, there), atol=1e-9
    )


@pytest.mark.parametrize("name", ["c", "d", "corner"])
def test_what_is_not_seen_is_held_and_the_rest_is_honest(name):
    found = trials(name, 1.0, 30)
    assert {trial.rank for trial in found} == {5}
    assert max(trial.held_angle for trial in found) < 1e-6
    assert all(trial.answers["II"] is None for trial in found)
    left = np.median([scenes.errors(trial.answers["ours"])[1] for trial in found])
    seen = np.median([trial.seen_translation for trial in found])
    assert seen < 0.4 * left
    fit = plk_table.against_chi_square(np.array([trial.normalised for trial in found]), 5)
    assert fit.p > 0.001
    assert fit.mean == pytest.approx(1.0, abs=4 * math.sqrt(2 / (5 * 30)))


def test_ten_lines_hold_the_bar_and_worse_answers_miss_it():
    found = trials("e", 0.3, 20, seed=1)
    assert set(held("e", 0.3, found).values()) == {True}
    demand = "I and ours at most 0.0011 rad, 0.015 m"
    assert held("e", 0.3, [shifted(trial, rotation=0.0010) for trial in found])[demand]
    assert not held("e", 0.3, [shifted(trial, rotation=0.0012) for trial in found])[demand]
    assert not held("e", 0.3, [shifted(trial, translation=0.016) for trial in found])[demand]
    blind = [dataclasses.replace(trial, rank=5) for trial in found[:1]] + found[1:]
    assert not held("e", 0.3, blind)["rank 6 in every run"]


def test_three_lines_demand_medians_on_both_sides_and_methods_that_agree():
    found = trials("a", 0.3, 3)
    demand = "medians within 15 % of 0.0062 rad, 0.039 m"
    for factor, wanted in ((1.0, True), (0.8, False), (1.2, False)):
        moved = [shifted(trial, 0.0062 * factor, 0.039 * factor) for trial in found]
        assert held("a", 0.3, moved)[demand] is wanted
    assert held("a", 0.3, found)["I and II agree to 1e-9"]
    nudged = found[0].answers["II"] + 2e-9
    apart = [dataclasses.replace(found[0], answers={**found[0].answers, "II": nudged}), *found[1:]]
    assert not held("a", 0.3, apart)["I and II agree to 1e-9"]
    silent = [dataclasses.replace(found[0], answers={**found[0].answers, "II": None}), *found[1:]]
    assert not held("a", 0.3, silent)["I and II agree to 1e-9"]


def test_parallel_lines_miss_the_bar_by_a_turned_answer_or_a_wrong_held_direction():
    found = trials("c", 0.3, 12, seed=3)
    demand = "rotation of I and ours at most 0.004 rad"
    assert held("c", 0.3, found)[demand]
    assert not held("c", 0.3, [shifted(trial, rotation=0.0041) for trial in found])[demand]
    wrong = [dataclasses.replace(found[0], held_angle=math.radians(0.2)), *found[1:]]
    assert not held("c", 0.3, wrong)["the right direction held in every run"]


def test_median_leaves_out_what_gave_no_answer():
    one = trials("a", 0.3, 1)[0]
    silent = dataclasses.replace(one, answers=dict.fromkeys(scenes.METHODS))
    found = [shifted(one, 0.01, 0.0), silent, shifted(one, 0.03, 0.0), shifted(one, 0.02, 0.0)]
    assert plk_table.median_errors(found, "I")[0] == pytest.approx(0.02)
    assert plk_table.answered(found, "I") == 3
    assert all(math.isnan(value) for value in plk_table.median_errors([silent], "I"))


def test_chi_square_tells_a_right_covariance_from_one_of_half_the_sigma():
    rng = np.random.default_rng(4)
    values = (rng.normal(size=(2000, 5)) ** 2).sum(axis=1)
    right = plk_table.against_chi_square(values, 5)
    assert right.mean == pytest.approx(1.0, abs=0.06)
    assert right.within == pytest.approx(0.95, abs=0.02)
    assert right.p > 0.01
    wrong = plk_table.against_chi_square(4 * values, 5)
    assert wrong.mean == pytest.approx(4.0, rel=0.06)
    assert wrong.p < 1e-6
