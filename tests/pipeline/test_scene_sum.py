"""The sum over scenes against dense linear algebra, its own promises, and simulated streets."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.drift_test import DriftTestParameters, Expectation, expectation_of_stored
from pipeline.records import Floats
from pipeline.run_length import AlarmBudget
from pipeline.scene_filter import Scene
from pipeline.scene_sum import (
    NEW_SCENE_M,
    SceneSum,
    SceneSumParameters,
    advance,
    alarming,
    begin,
    is_new,
    suspicious,
)

STORED = expectation_of_stored(math.radians(0.1), 0.02, DriftTestParameters())
NOISE = np.diag([math.radians(0.06) ** 2] * 3 + [0.015**2] * 3)
FEIGNED = np.array([0.0, 0.0, 1e-4, 0.03, 0.0, 0.0])
UNCAPPED = SceneSumParameters(most_square=1e9)
YAW = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def scene(drift: Floats, index: int, covariance: Floats = NOISE, feigned: Floats = FEIGNED) -> Scene:
    return Scene(drift, covariance, feigned, NEW_SCENE_M * index, index)


def summed(
    drifts: Floats, parameters: SceneSumParameters = UNCAPPED, expectation: Expectation = STORED
) -> SceneSum:
    total = begin(expectation)
    for index, drift in enumerate(drifts):
        total = advance(total, scene(drift, index), expectation, parameters)
    return total


def drawn(
    rng: np.random.Generator, scenes: int, *, corner: int = 10**9, correlation_m: float = 300.0
) -> Floats:
    """Estimates (n,6) of an unmoved mount: bias, streets, time, noise; a street each ``corner`` scenes."""
    root, street_root = np.linalg.cholesky(NOISE), np.linalg.cholesky(STORED.floor)
    bias = np.linalg.cholesky(STORED.covariance) @ rng.normal(size=6)
    tau, kept = rng.normal(), math.exp(-NEW_SCENE_M / correlation_m)
    street, drifts = street_root @ rng.normal(size=6), []
    for index in range(scenes):
        if index % corner == corner - 1:
            street = street_root @ rng.normal(size=6)
        drifts.append(bias + street + tau * FEIGNED + root @ rng.normal(size=6))
        street = kept * street + math.sqrt(1.0 - kept**2) * street_root @ rng.normal(size=6)
    return np.array(drifts)


def least_squares(drifts: Floats, prior: Floats | None) -> tuple[Floats, Floats]:
    """The mount and its covariance from the dense covariance of all scenes together, with Birge's ratio."""
    n, floor = len(drifts), STORED.floor
    way = NEW_SCENE_M * np.arange(n)
    streets = np.kron(np.exp(-np.abs(way[:, None] - way[None, :]) / UNCAPPED.correlation_m), floor)
    feigned = np.tile(FEIGNED, n)
    inverse = np.linalg.inv(streets + np.outer(feigned, feigned) + np.kron(np.eye(n), NOISE))
    design = np.tile(np.eye(6), (n, 1))
    information = design.T @ inverse @ design
    if prior is not None:
        information = information + np.linalg.inv(prior)
    covariance: Floats = np.asarray(np.linalg.inv(information), dtype=np.float64)
    mount = covariance @ design.T @ inverse @ drifts.ravel()
    left = drifts.ravel() - design @ mount
    square = float(left @ inverse @ left)
    if prior is not None:
        square += float(mount @ np.linalg.solve(prior, mount))
    scenes = n if prior is not None else n - 1
    return mount, covariance * max(1.0, square / (6.0 * max(scenes, 1)))


def test_statistic_is_that_of_dense_least_squares_for_every_beginning() -> None:
    rng = np.random.default_rng(1)
    drifts = drawn(rng, 7) + np.outer(np.arange(7) > 3, math.radians(0.4) * YAW)
    expected = []
    for first in range(7):
        since, error = least_squares(drifts[first:], None)
        before, known = np.zeros(6), STORED.covariance
        if first:
            before, known = least_squares(drifts[:first], STORED.covariance)
        off = since - before
        expected.append(off @ np.linalg.solve(error + known, off))
    total = summed(drifts)
    # The diffuse prior of a stretch is 10 deg and 3 m, not infinite.
    assert total.statistics[1:] == pytest.approx(expected, rel=5e-3)
    assert total.since_ns == int(np.argmax(expected))


def test_without_floor_it_is_the_likelihood_ratio_of_white_sums() -> None:
    rng = np.random.default_rng(2)
    white = Expectation(np.zeros(6), 1e-14 * np.eye(6), 1e-14 * np.eye(6), np.zeros(6))
    drifts = rng.normal(size=(12, 6)) @ np.linalg.cholesky(NOISE).T
    total = begin(white)
    for index, drift in enumerate(drifts):
        total = advance(total, scene(drift, index, feigned=np.zeros(6)), white, UNCAPPED)
    z = np.linalg.solve(np.linalg.cholesky(NOISE), drifts.T).T
    expected = max(float(np.sum(z[first:].sum(axis=0) ** 2)) / (12 - first) for first in range(12))
    assert total.statistic == pytest.approx(expected, rel=2e-3)


def test_a_steady_drift_below_the_floor_of_one_street_is_told_over_several() -> None:
    rng = np.random.default_rng(4)
    drifts = drawn(rng, 400)
    drifts[200:] += math.radians(0.3) * YAW
    total, told = begin(STORED), None
    for index, drift in enumerate(drifts):
        total = advance(total, scene(drift, index), STORED, SceneSumParameters())
        if told is None and alarming(total, SceneSumParameters()):
            told = index
            since = total.since_ns
    assert told is not None
    assert 200 <= told < 280
    assert since is not None
    assert abs(since - 200) < 15
    sigma = math.sqrt(total.moved_covariance[2, 2])
    assert abs(total.moved[2] - math.radians(0.3)) < 4 * (sigma + math.radians(0.1))


def test_one_scene_far_off_is_no_alarm_and_the_same_again_and_again_is() -> None:
    rng, parameters = np.random.default_rng(5), SceneSumParameters()
    drifts = drawn(rng, 70)
    drifts[60] += 3.0 * math.radians(1.0) * YAW
    total = begin(STORED)
    for index, drift in enumerate(drifts):
        total = advance(total, scene(drift, index), STORED, parameters)
        assert not alarming(total, parameters)
    for index in range(70, 75):
        moved = drifts[index - 70] + math.radians(3.0) * YAW
        total = advance(total, scene(moved, index), STORED, parameters)
    assert alarming(total, parameters)
    assert suspicious(total, parameters)


def test_a_direction_that_is_not_seen_says_nothing() -> None:
    rng = np.random.default_rng(6)
    blind = NOISE.copy()
    blind[3, 3] = 1e6
    drifts = drawn(rng, 20)
    totals = []
    for offset in (0.0, 5.0):
        total = begin(STORED)
        for index, drift in enumerate(drifts + offset * np.eye(6)[3]):
            total = advance(total, scene(drift, index, blind), STORED, SceneSumParameters())
        totals.append(total)
    assert totals[1].statistic == pytest.approx(totals[0].statistic, abs=0.05)


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_unmoved_mounts_are_chi_square_or_less_around_corners_too(seed: int) -> None:
    rng = np.random.default_rng(seed)
    total = summed(drawn(rng, 40, corner=int(rng.integers(2, 15))), SceneSumParameters())
    # Forty beginnings, strongly dependent: a thousandth of what one alone would exceed a hundredth of.
    assert total.statistic < 46.0


def test_alarms_are_no_more_frequent_than_the_budget_allows() -> None:
    # At a budget of one alarm in 200 scenes, where there is something to count.
    parameters = SceneSumParameters(
        budget=AlarmBudget(first_chance=5e-3, yearly_alarms=5e-3, yearly_scenes=1)
    )
    rng = np.random.default_rng(8)
    for corner, correlation_m in ((10**9, 300.0), (8, 1e9), (10**9, 60.0)):
        alarms, runs = 0, 40
        for _ in range(runs):
            drifts = drawn(rng, 50, corner=corner, correlation_m=correlation_m)
            total = begin(STORED)
            for index, drift in enumerate(drifts):
                total = advance(total, scene(drift, index), STORED, parameters)
                if alarming(total, parameters):
                    alarms += 1
                    break
        # 2000 scenes allow 10; Poisson of mean 10 exceeds 20 once in 600.
        assert alarms <= 20


def test_scenes_that_contradict_each_other_are_no_drift() -> None:
    # False modes: four times as far off as stated, another way each time.
    rng, parameters, alarms = np.random.default_rng(10), SceneSumParameters(), 0
    for _ in range(10):
        total, root = begin(STORED), 4.0 * np.linalg.cholesky(9.0 * NOISE)
        for index in range(60):
            total = advance(total, scene(root @ rng.normal(size=6), index, 9.0 * NOISE), STORED, parameters)
            if alarming(total, parameters):
                alarms += 1
                break
    assert alarms <= 1


def test_beginnings_get_sparse_and_the_first_stays() -> None:
    rng = np.random.default_rng(9)
    total = begin(STORED)
    for index in range(700):
        total = advance(total, scene(0.1 * NOISE @ rng.normal(size=6), index), STORED, UNCAPPED)
    ages = 699 - total.first[1:]
    assert set(range(16)) <= set(ages.tolist())
    assert total.first[1] == 0
    assert len(total.first) < 70


def test_standing_still_makes_no_new_scene_and_shared_frames_neither() -> None:
    total = begin(STORED)
    assert is_new(total, 0.0, 0.0)
    total = advance(total, Scene(np.zeros(6), NOISE, FEIGNED, 30.0, 1), STORED, UNCAPPED)
    assert not is_new(total, 30.0, 30.0)
    assert not is_new(total, 25.0, 60.0)
    assert is_new(total, 30.0, 50.0)


def test_a_sum_never_changes() -> None:
    total = summed(np.zeros((3, 6)))
    with pytest.raises(ValueError, match="read-only"):
        total.mean[0, 0] = 1.0
