"""Honesty of covariances, intervals and curves: known distributions get the figures that belong to them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pipeline.error_statistics import (
    balance,
    beyond,
    clopper_pearson,
    honesty,
    mean_absolute,
    normalised_square,
    roc,
)

EXACT = np.zeros(6)


def drawn(count, seed, *, claimed=1.0):
    """Errors, covariances that are claimed (by this factor in sigma) and masks of different answers."""
    rng = np.random.default_rng(seed)
    errors, covariances, seen = [], [], []
    for _ in range(count):
        A = rng.normal(size=(6, 6)) * rng.uniform(0.1, 2.0, 6)
        covariance = A @ A.T + 0.01 * np.eye(6)
        errors.append(rng.multivariate_normal(np.zeros(6), covariance))
        covariances.append(claimed**2 * covariance)
        seen.append(rng.random(6) < 0.7)
    return errors, covariances, seen


def test_honest_answers_are_called_honest():
    errors, covariances, seen = drawn(3000, 1)
    found = honesty(errors, covariances, seen, [EXACT] * 3000)
    assert found.axes == sum(int(mask.sum()) for mask in seen)
    assert found.within_one == pytest.approx(0.6827, abs=0.02)
    assert found.within_two == pytest.approx(0.9545, abs=0.01)
    assert found.mean_square == pytest.approx(1.0, abs=0.04)
    assert found.below_95 == pytest.approx(0.95, abs=0.015)
    assert found.p > 0.01
    assert found.confident_wrong <= 4


@pytest.mark.parametrize("claimed", [0.5, 2.0])
def test_sigmas_that_are_wrong_by_a_factor_show_it(claimed):
    errors, covariances, seen = drawn(2000, 2, claimed=claimed)
    found = honesty(errors, covariances, seen, [EXACT] * 2000)
    assert found.mean_square == pytest.approx(claimed**-2.0, rel=0.05)
    assert found.within_one == pytest.approx(2 * stats.norm.cdf(claimed) - 1, abs=0.02)
    assert found.p < 1e-6
    beyond_four = 2 * stats.norm.sf(4.0 * claimed)
    assert found.confident_wrong == pytest.approx(beyond_four * found.axes, abs=60 * beyond_four**0.5 + 1)


def test_the_reference_takes_its_share_of_the_error():
    """Errors of half a sigma more variance are honest once the reference is known to that."""
    rng = np.random.default_rng(3)
    reference = np.array([0.3] * 6)
    covariance = np.eye(6) * 0.4**2
    errors = [rng.normal(0, 0.5, 6) for _ in range(1500)]
    seen = [np.ones(6, bool)] * 1500
    assert honesty(errors, [covariance] * 1500, seen, [reference] * 1500).mean_square == pytest.approx(
        1, abs=0.05
    )
    assert honesty(errors, [covariance] * 1500, seen, [EXACT] * 1500).mean_square == pytest.approx(
        (0.5 / 0.4) ** 2, rel=0.05
    )


def test_axes_that_are_not_seen_say_nothing():
    errors, covariances, _ = drawn(3, 4)
    nothing = [np.zeros(6, bool)] * 3
    assert honesty(errors, covariances, nothing, [EXACT] * 3) is None
    assert honesty([], [], [], []) is None
    assert mean_absolute(errors, nothing) == [None] * 6
    one = [np.arange(6) == 2, np.zeros(6, bool), np.arange(6) == 2]
    assert mean_absolute(errors, one)[2] == pytest.approx((abs(errors[0][2]) + abs(errors[2][2])) / 2)
    assert mean_absolute(errors)[2] == pytest.approx(np.mean([abs(error[2]) for error in errors]))
    assert honesty(errors, covariances, one, [EXACT] * 3).axes == 2


@given(st.integers(0, 2**32 - 1), st.lists(st.booleans(), min_size=6, max_size=6).filter(any))
def test_the_normalised_square_is_that_of_the_marginal(seed, mask):
    """Brute force: whitened by the Cholesky factor of what is left when the other axes are struck out."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6))
    covariance, error, seen = A @ A.T + 0.1 * np.eye(6), rng.normal(size=6), np.array(mask)
    kept = np.flatnonzero(seen)
    L = np.linalg.cholesky(covariance[kept][:, kept])
    assert normalised_square(error, covariance, seen) == pytest.approx(
        float((np.linalg.solve(L, error[kept]) ** 2).sum())
    )


def test_ratios_count_in_both_uncertainties():
    ratio = beyond(np.array([5.0] * 6), np.array([3.0] * 6), np.array([4.0] * 6), np.arange(6) < 3)
    assert ratio[:3] == pytest.approx(1.0)
    assert np.isnan(ratio[3:]).all()


@pytest.mark.parametrize(("hits", "of"), [(0, 40), (1, 40), (13, 40), (39, 40), (40, 40), (0, 1)])
def test_intervals_of_shares_leave_as_little_as_they_say(hits, of):
    """By the definition: at each end so many hits or more (fewer) have half of what is left."""
    low, high = clopper_pearson(hits, of)
    assert 0.0 <= low <= hits / of <= high <= 1.0
    if hits > 0:
        assert stats.binom.sf(hits - 1, of, low) == pytest.approx(0.025)
    else:
        assert low == 0.0
    if hits < of:
        assert stats.binom.cdf(hits, of, high) == pytest.approx(0.025)
    else:
        assert high == 1.0
    if hits == 0:
        assert high == pytest.approx(1.0 - 0.025 ** (1.0 / of))


def test_of_nothing_any_share_may_be():
    assert clopper_pearson(0, 0) == (0.0, 1.0)


def test_balanced_accuracy_weighs_both_kinds_alike():
    found = balance((9, 10), (100, 200))
    assert found.accuracy == pytest.approx(0.7)
    assert found.low == pytest.approx(
        0.5 * (clopper_pearson(9, 10, 0.975)[0] + clopper_pearson(100, 200, 0.975)[0])
    )
    assert found.low < 0.7 < found.high
    assert balance((0, 0), (5, 5)) is None
    assert balance((5, 5), (0, 0)) is None


_SCORES = st.lists(st.integers(0, 6).map(float), min_size=1, max_size=12)


@given(_SCORES, _SCORES)
def test_the_curve_is_that_of_all_thresholds(healthy, wrong):
    """Area by comparing every pair, best accuracy by trying every threshold."""
    found = roc(healthy, wrong)
    pairs = [(w > h) + 0.5 * (w == h) for w in wrong for h in healthy]
    assert found.area == pytest.approx(np.mean(pairs))
    tried = [
        0.5 * (np.mean([w >= t for w in wrong]) + np.mean([h < t for h in healthy]))
        for t in [*healthy, *wrong, np.inf]
    ]
    assert found.best == pytest.approx(max(tried))
    assert (found.false[0], found.found[0], found.false[-1], found.found[-1]) == (0, 0, 1, 1)
    assert (np.diff(found.false) >= 0).all()
    assert (np.diff(found.found) >= 0).all()


def test_a_curve_needs_both_kinds():
    assert roc([], [1.0]) is None
    assert roc([1.0], []) is None
