"""Honesty of covariances: answers drawn from known distributions get the figures that belong to them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from pipeline.error_statistics import beyond, honesty, mean_absolute, normalised_square

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
