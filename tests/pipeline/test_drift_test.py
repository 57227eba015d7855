import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from pipeline.drift_test import DriftTestParameters, Evidence, at_chance, expectation_of_stored, judge
from pipeline.run_length import AlarmBudget

P = DriftTestParameters()
LIMITS = np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.20, 0.15, 0.15])
STORED = expectation_of_stored(math.radians(0.1), 0.02, P)
C_REF = STORED.covariance
SURE = np.diag([math.radians(0.02) ** 2] * 3 + [0.005**2] * 3)
"""Covariance of a good window."""


def evidence(drift=None, covariance=SURE, **changes):
    """Evidence of a good window that lost much of its score, unless told otherwise."""
    stated = {
        "loss": 0.2,
        "contrast": 0.8,
        "peak": 10.0,
        "preference": 4.0,
        "persistent": True,
        "frames": 20,
    } | changes
    return Evidence(np.zeros(6) if drift is None else np.asarray(drift, float), covariance, **stated)


def judged(drift=None, covariance=SURE, *, C_ref=C_REF, limits=LIMITS, parameters=P, **changes):
    expected = dataclasses.replace(STORED, covariance=C_ref)
    return judge(evidence(drift, covariance, **changes), expected, limits, parameters)


def unit(axis, size):
    return size * np.eye(6)[axis]


def test_thresholds_are_the_quantiles_they_claim():
    assert P.alarm == pytest.approx(stats.chi2.isf(1e-4, 6), abs=0.01)
    assert P.suspicion == pytest.approx(stats.chi2.isf(1e-3, 6), abs=0.01)
    assert P.K_fa == pytest.approx(stats.norm.isf(0.5e-5), abs=1e-3)
    assert P.K_md == pytest.approx(stats.norm.isf(1e-3), abs=1e-3)


def test_what_most_cells_of_the_image_deny_is_no_drift_but_ambiguous():
    far = unit(1, math.radians(3.0))
    denied = judged(far, preference=-0.3)
    assert denied.ambiguous
    assert denied.blind
    assert not denied.alarming
    assert not denied.suspicious
    assert not denied.observable.any()
    assert not judged(far, preference=0.3).ambiguous
    assert not judged(unit(1, math.radians(0.1)), preference=-0.3).ambiguous


def test_a_window_may_alarm_the_more_rarely_the_more_scenes_lie_behind():
    budget = AlarmBudget()
    first, second = (at_chance(P, budget, scene) for scene in (1, 2))
    assert (first.alarm, first.suspicion) == pytest.approx((P.alarm, P.suspicion), abs=0.01)
    assert stats.chi2.sf(second.alarm, 6) == pytest.approx(0.25e-4)
    settled = at_chance(P, budget, 10**6)
    assert stats.chi2.sf(settled.alarm, 6) * budget.yearly_scenes == pytest.approx(budget.yearly_alarms)
    assert first.suspicion < first.alarm < second.alarm < settled.alarm


@pytest.mark.parametrize("alarm", [P.alarm, 40.0])
def test_what_is_detectable_is_noticed_in_99_of_100_windows(alarm):
    judgement = judged(unit(2, 0.01), parameters=dataclasses.replace(P, alarm=alarm))
    inverse = np.linalg.inv(SURE + P.floor() + C_REF)
    noncentrality = judgement.detectable**2 * np.diag(inverse)
    np.testing.assert_allclose(stats.ncx2.sf(alarm, 6, noncentrality), 0.99, atol=2e-4)


def test_floor_knows_the_bearing_and_not_the_split():
    floor = P.floor()
    np.testing.assert_allclose(floor, floor.T, atol=1e-18)
    assert np.linalg.eigvalsh(floor).min() > 0
    pitch_up = np.array([0, 1, 0, 0, 0, -1 / P.bearing_range])
    yaw_left = np.array([0, 0, 1, 0, 1 / P.bearing_range, 0])
    for bearing in (pitch_up, yaw_left):
        assert math.sqrt(bearing @ floor @ bearing) == pytest.approx(P.floor_bearing)
    assert math.sqrt(floor[0, 0]) == pytest.approx(P.floor_roll)
    assert np.sqrt(np.diag(floor)[3:]) == pytest.approx(P.floor_m)
    # The single angle is as unsure as the shift at 20 m makes it: more than twice the bearing.
    assert math.sqrt(floor[2, 2]) == pytest.approx(math.hypot(P.floor_bearing, P.floor_m[1] / 20))
    assert math.sqrt(floor[1, 1]) == pytest.approx(math.hypot(P.floor_bearing, P.floor_m[2] / 20))
    # Yaw to the left and a shift to the right cancel at 20 m, so their errors go together.
    assert floor[2, 4] < 0 < floor[1, 5]


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [1, -1])
def test_a_pure_drift_by_its_closed_form(axis, sign):
    size = 5 * LIMITS[axis]
    judgement = judged(unit(axis, sign * size))
    inverse = np.linalg.inv(SURE + P.floor() + C_REF)
    assert judgement.statistic == pytest.approx(size**2 * inverse[axis, axis])
    assert judgement.alarming
    assert judgement.suspicious
    assert not judgement.excluded[axis]
    assert judgement.excluded[np.arange(6) != axis].all()
    assert judgement.drift[axis] == sign * size


def test_protection_level_is_that_of_the_formula_and_leaves_the_stored_extrinsic_out():
    sigma = np.sqrt(np.diag(SURE))
    bound = np.array([math.radians(0.13)] * 3 + [0.04] * 3)
    expected = (stats.norm.isf(0.5e-5) + stats.norm.isf(1e-3)) * sigma + bound
    for C_ref in (np.zeros((6, 6)), C_REF, 100 * C_REF):
        judgement = judged(C_ref=C_ref)
        np.testing.assert_allclose(judgement.protection_level, expected, rtol=1e-4)
        np.testing.assert_allclose(judgement.sigma, sigma)


def test_limits_decide_what_is_observable_monitored_excluded():
    level = judged().protection_level
    sigma = np.sqrt(np.diag(SURE))
    at, below = judged(limits=level * 1.0001), judged(limits=level * 0.9999)
    assert at.monitored.all()
    assert not below.monitored.any()
    assert judged(limits=sigma / 2 * 1.0001).observable.all()
    assert not judged(limits=sigma / 2 * 0.9999).observable.any()
    edge = LIMITS - stats.norm.isf(1e-3) * sigma - P.bound()
    assert judged(0.9999 * edge).excluded.all()
    assert not judged(-1.0001 * edge).excluded.any()


@pytest.mark.parametrize("axis", range(6))
def test_detectable_is_noticed_99_times_in_100(axis):
    judgement = judged()
    total = SURE + P.floor() + C_REF
    rng = np.random.default_rng(axis)
    drifts = rng.multivariate_normal(unit(axis, judgement.detectable[axis]), total, size=4000)
    statistics = np.einsum("ni,ij,nj->n", drifts, np.linalg.inv(total), drifts)
    assert np.mean(statistics > P.alarm) == pytest.approx(0.99, abs=0.006)
    assert judged(drifts[0]).statistic == pytest.approx(statistics[0])


def test_healthy_windows_alarm_at_the_stated_risk():
    total = SURE + P.floor() + C_REF
    drifts = np.random.default_rng(7).multivariate_normal(np.zeros(6), total, size=40_000)
    statistics = np.einsum("ni,ij,nj->n", drifts, np.linalg.inv(total), drifts)
    assert np.mean(statistics > P.suspicion) == pytest.approx(1e-3, abs=5e-4)
    # The joint statistic alone never alarms: the score must be lost too.
    worst = drifts[np.argmax(statistics)]
    assert not judged(worst, loss=P.least_loss).alarming


@pytest.mark.parametrize(
    ("changes", "alarming", "suspicious"),
    [
        ({}, True, True),
        ({"loss": 0.029}, False, True),
        ({"loss": 0.031}, True, True),
        ({"persistent": False}, False, True),
        ({"preference": 1.9}, False, True),
        ({"contrast": 0.14}, False, False),
        ({"contrast": 0.16}, True, True),
        ({"peak": 3.6}, False, False),
        ({"peak": 3.8}, True, True),
        ({"contradicted": True}, False, True),
        ({"loss": math.inf, "contrast": math.inf, "peak": math.inf}, True, True),
    ],
)
def test_an_alarm_needs_every_sign_of_a_drift(changes, alarming, suspicious):
    judgement = judged(unit(2, math.radians(2)), **changes)
    assert (judgement.alarming, judgement.suspicious) == (alarming, suspicious)
    assert judgement.contradicted == changes.get("contradicted", False)


@pytest.mark.parametrize(
    ("turn_deg", "peak", "alarming"), [(2.4, 5.9, True), (2.6, 5.9, False), (2.6, 6.1, True)]
)
def test_a_turn_so_wide_that_many_places_were_searched_needs_a_higher_peak(turn_deg, peak, alarming):
    judgement = judged(unit(2, math.radians(turn_deg)), peak=peak)
    assert (judgement.alarming, judgement.blind) == (alarming, not alarming)


@pytest.mark.parametrize(
    ("changes", "suspicious"),
    [({"loss": 0.0}, False), ({"loss": 0.099}, False), ({"loss": 0.101}, True)],
)
def test_without_drift_only_a_lost_score_is_suspicious(changes, suspicious):
    judgement = judged(**changes)
    assert judgement.suspicious == suspicious
    assert not judgement.alarming


def test_lines_alone_are_no_suspicion_by_themselves():
    # Where no edge was scored there is no loss; a drive of quiet lines must be able to be healthy.
    quiet = judged(loss=math.inf, contrast=math.inf, peak=math.inf)
    assert not quiet.suspicious
    assert not quiet.alarming
    assert not quiet.blind


def test_between_suspicion_and_alarm():
    inverse = np.linalg.inv(SURE + P.floor() + C_REF)
    middle = math.sqrt(0.5 * (P.alarm + P.suspicion) / inverse[2, 2])
    judgement = judged(unit(2, middle), loss=0.05)
    assert judgement.suspicious
    assert not judgement.alarming


@pytest.mark.parametrize("chance", [{"contrast": 0.05}, {"peak": 1.0}])
def test_blind_claims_nothing(chance):
    judgement = judged(unit(2, math.radians(2)), **chance)
    assert judgement.blind
    assert not judgement.observable.any()
    assert not judgement.monitored.any()
    assert not judgement.suspicious


@st.composite
def random_covariances(draw):
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    root = np.diag(np.sqrt(np.diag(SURE))) @ rng.normal(size=(6, 8)) / math.sqrt(8)
    return root @ root.T


@settings(max_examples=60, deadline=None)
@given(random_covariances(), random_covariances(), st.integers(0, 10_000))
def test_more_error_never_says_more(covariance, added, seed):
    drift = np.random.default_rng(seed).normal(size=6) * 2 * LIMITS
    before, after = judged(drift, covariance), judged(drift, covariance + added)
    assert after.statistic <= before.statistic * (1 + 1e-9)
    for name in ("protection_level", "detectable", "sigma"):
        assert (getattr(after, name) >= getattr(before, name) * (1 - 1e-9)).all()
    for name in ("observable", "monitored", "excluded"):
        assert not (getattr(after, name) & ~getattr(before, name)).any()
    # The stored extrinsic's own doubt takes nothing from what is monitored, only from the claim 'it moved'.
    doubted = judged(drift, covariance, C_ref=10 * C_REF)
    assert doubted.statistic <= before.statistic
    np.testing.assert_array_equal(doubted.monitored, before.monitored)
    np.testing.assert_array_equal(doubted.excluded, before.excluded)


@settings(max_examples=40, deadline=None)
@given(random_covariances(), st.integers(0, 10_000), st.floats(1.0, 10.0))
def test_a_larger_drift_is_never_less_sure(covariance, seed, factor):
    drift = np.random.default_rng(seed).normal(size=6) * LIMITS
    small, large = judged(drift, covariance), judged(factor * drift, covariance)
    assert large.statistic == pytest.approx(factor**2 * small.statistic)
    assert large.suspicious >= small.suspicious
    assert large.alarming >= small.alarming
    assert not (large.excluded & ~small.excluded).any()
    mirrored = judged(-drift, covariance)
    assert mirrored.statistic == pytest.approx(small.statistic)
    np.testing.assert_array_equal(mirrored.excluded, small.excluded)


def test_results_are_read_only():
    judgement = judged()
    for name in ("drift", "sigma", "protection_level", "detectable", "observable", "monitored", "excluded"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(judgement, name)[0] = 0
