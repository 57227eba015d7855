import math

import numpy as np
import pytest

from pipeline.run_tail import stretches_needed, tail_of

BLOCK_S, WANTED_S = 20.0, 1e5


def tail(values, rng=None, wanted_s=WANTED_S):
    values = np.asarray(values, dtype=np.float64)
    return tail_of(values, np.full(len(values), BLOCK_S), wanted_s, rng or np.random.default_rng(0))


def test_a_run_length_known_to_a_factor_of_ten_needs_so_many_stretches():
    # 1e6 blocks: a tenth of them lies in the tail, so 11.5 e-folds are extrapolated; a factor of ten is 2.3.
    assert stretches_needed(1e6) == math.ceil((1.96 * math.log(1e5) / math.log(10)) ** 2 / 0.1)
    assert stretches_needed(1e6) > stretches_needed(1e3) > 0


@pytest.mark.parametrize("count", [1, 5, 100])
def test_too_few_stretches_give_no_threshold(count):
    found = tail(np.random.default_rng(count).exponential(2.0, count))
    assert found.threshold is None
    assert found.interval is None
    assert found.needed > count == found.stretches


def test_the_run_length_at_the_threshold_is_the_wanted_one_or_longer():
    """Of exponential tails with known slope; the upper end of a 95 % interval is too low in few of them."""
    blocks = WANTED_S / BLOCK_S
    wanted = 2.0 * math.log(blocks)  # P(value > h) = exp(-h / 2) = 1 / blocks
    low = covered = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        found = tail(rng.exponential(2.0, stretches_needed(blocks)), rng)
        if found.threshold is None:
            continue
        assert found.interval is not None
        low += found.threshold < wanted
        covered += found.interval[0] <= wanted <= found.interval[1]
        assert found.threshold < 2.0 * wanted
    assert low <= 6
    assert covered >= 48


def test_the_largest_of_many_chi_squares_is_continued_on_the_safe_side():
    """Twenty windows a stretch: chi-square falls faster than the exponential that touches its tail."""
    rng = np.random.default_rng(4)
    values = rng.chisquare(6, (3000, 20)).max(axis=1)
    found = tail(values, rng)
    truth = np.quantile(rng.chisquare(6, (200_000, 20)).max(axis=1), 1 - BLOCK_S / WANTED_S)
    assert found.threshold is not None
    assert truth - 1.0 < found.threshold < 1.5 * truth


def test_a_tail_that_falls_slower_than_an_exponential_is_not_continued():
    values = np.random.default_rng(5).pareto(1.5, 3000)
    assert tail(values).threshold is None


def test_the_order_of_stretches_does_not_matter():
    rng = np.random.default_rng(6)
    values = rng.exponential(2.0, 1000)
    assert tail(values) == tail(values[::-1])
    assert tail(values).threshold is not None


def test_a_longer_wanted_run_takes_a_higher_threshold():
    values = np.random.default_rng(7).exponential(2.0, 2000)
    short, long = tail(values), tail(values, wanted_s=10 * WANTED_S)
    assert short.threshold is not None
    assert long.threshold is not None
    assert long.threshold > short.threshold
