"""The comparison of two extrinsics cell by cell, against closed forms and by simulation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import kstest, ttest_1samp

from pipeline.hold_out import chance_of_gain


@given(st.integers(0, 2**32 - 1), st.integers(20, 60))
def test_equal_cells_give_students_test(seed, cells):
    rng = np.random.default_rng(seed)
    gains = rng.normal(0.3, 1.0, cells)
    # By their fourth moment n normal residuals are worth n / 3 equal ones: fewer degrees of freedom.
    told = chance_of_gain(gains, np.ones(cells), 1.0)
    exact = ttest_1samp(gains, 0.0, alternative="greater").pvalue
    assert (told < 0.5) == (exact < 0.5)
    if 0.001 < exact < 0.5:
        assert exact <= told <= 8.0 * exact


def test_it_is_right_as_often_as_it_says_where_neither_is_better():
    rng = np.random.default_rng(1)
    weights = rng.gamma(1.0, size=60)
    chances = [chance_of_gain(rng.normal(0.0, np.sqrt(weights)), weights, 1.0) for _ in range(2000)]
    # Heavy cells make it careful, never bold.
    for level in (0.001, 0.01, 0.05):
        assert np.mean(np.array(chances) < level) <= level + 3.0 * np.sqrt(level / 2000)
    assert kstest(chances, "uniform").statistic < 0.08


def test_a_gain_in_one_cell_is_no_gain():
    gains, weights = np.full(40, 0.0), np.ones(40)
    gains[7] = 30.0
    assert chance_of_gain(gains, weights, 1.0) > 0.05
    assert chance_of_gain(np.full(40, 0.5) + np.linspace(-0.2, 0.2, 40), weights, 1.0) < 1e-9


def test_scale_and_sign():
    rng = np.random.default_rng(2)
    gains, weights = rng.normal(0.4, 1.0, 50), rng.uniform(0.5, 1.5, 50)
    told = chance_of_gain(gains, weights, 2.0)
    assert chance_of_gain(1e-3 * gains, 7.0 * weights, 2.0) == pytest.approx(told)
    assert chance_of_gain(-gains, weights, 2.0) == pytest.approx(1.0 - told)
    assert chance_of_gain(gains, weights, 1.0) < told
    assert chance_of_gain(np.zeros(9), np.ones(9), 1.0) == 0.5
    assert chance_of_gain(np.ones(1), np.ones(1), 1.0) == 0.5
