import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from pipeline import fusion
from pipeline.fusion import CONTRADICTION, contradiction, intersected, with_floor

UNITS = np.array([0.004, 0.004, 0.004, 0.05, 0.05, 0.05])
"""rad, m: sizes at which drifts matter; information of random witnesses is of this scale."""


def informed(rng, rank, spread=2.0):
    """A random information matrix of the given rank, its sigmas within ``spread`` decades below UNITS."""
    V = np.linalg.qr(rng.normal(size=(6, 6)))[0][:, :rank]
    sigma = 10.0 ** -rng.uniform(0, spread, rank)
    scaled = (V / sigma**2) @ V.T
    information = scaled / np.outer(UNITS, UNITS)
    return 0.5 * (information + information.T)


def drawn(rng, information, mean=0.0):
    """What a witness says whose error has this information; arbitrary small values where it has none."""
    values, V = np.linalg.eigh(information * np.outer(UNITS, UNITS))
    known = values > 1e-9 * values.max()
    y = np.where(known, rng.normal(size=6) / np.sqrt(np.where(known, values, 1.0)), rng.normal(size=6))
    return mean + UNITS * (V @ y)


def statistic(a, b):
    """The difference under the sum of both covariances, with a very wide prior where held."""
    wide = np.diag(1e-8 / UNITS**2)
    total = np.linalg.inv(a.information + wide) + np.linalg.inv(b.information + wide)
    apart = (a.drift - b.drift) / UNITS
    return float(apart @ np.linalg.solve(total / np.outer(UNITS, UNITS), apart))


def test_thresholds_are_chi_square_at_one_in_a_thousand():
    np.testing.assert_allclose(CONTRADICTION, stats.chi2.isf(1e-3, np.arange(1, 7)), atol=0.01)


@pytest.mark.parametrize(("rank_a", "rank_b"), [(6, 6), (6, 3), (6, 5), (3, 6), (6, 1), (5, 4)])
def test_the_threshold_is_that_of_the_common_rank(rank_a, rank_b):
    # Two general subspaces of six dimensions share rank_a + rank_b - 6 of them.
    rng = np.random.default_rng(rank_a * 10 + rank_b)
    common = rank_a + rank_b - 6
    for _ in range(50):
        A, B = informed(rng, rank_a), informed(rng, rank_b)
        difference = drawn(rng, B)
        a = fusion.Testimony(np.zeros(6), A)
        unit = statistic(a, fusion.Testimony(difference, B))
        for factor, expected in ((0.98, False), (1.02, True)):
            scaled = difference * np.sqrt(factor * stats.chi2.isf(1e-3, common) / unit)
            assert contradiction(a, fusion.Testimony(scaled, B)) == expected


def test_honest_witnesses_with_held_directions_contradict_each_other_once_in_a_thousand():
    rng = np.random.default_rng(3)
    A, B = informed(rng, 6), informed(rng, 3)
    truth = UNITS * rng.normal(size=6)
    count = 6000
    told = [
        contradiction(fusion.Testimony(drawn(rng, A, truth), A), fusion.Testimony(drawn(rng, B, truth), B))
        for _ in range(count)
    ]
    assert stats.binomtest(sum(told), count, 1e-3).pvalue > 1e-4
    values = [
        statistic(fusion.Testimony(drawn(rng, A, truth), A), fusion.Testimony(drawn(rng, B, truth), B))
        for _ in range(1000)
    ]
    assert stats.kstest(values, stats.chi2(3).cdf).pvalue > 1e-3


def test_witnesses_that_share_no_direction_never_contradict_each_other():
    A, B = np.diag([1e8, 1e8, 0, 0, 0, 0.0]), np.diag([0, 0, 1e8, 1e6, 1e6, 1e6])
    assert not contradiction(fusion.Testimony(np.ones(6), A), fusion.Testimony(-np.ones(6), B))
    nothing = fusion.Testimony(np.zeros(6), np.zeros((6, 6)))
    assert not contradiction(nothing, fusion.Testimony(np.ones(6), B))
    assert not contradiction(nothing, nothing)


def test_a_common_direction_is_enough():
    A, B = np.diag([1e8, 0, 0, 0, 0, 0.0]), np.diag([1e8, 1e8, 0, 0, 0, 0.0])
    apart = np.array([0.0005, 1.0, 0, 0, 0, 0])
    # sigma of the difference is 1.41e-4: 3.5 sigma; one degree of freedom asks for 3.29.
    assert contradiction(fusion.Testimony(apart, A), fusion.Testimony(np.zeros(6), B))
    assert not contradiction(fusion.Testimony(0.9 * apart, A), fusion.Testimony(np.zeros(6), B))


seeds, ranks = st.integers(0, 100_000), st.integers(1, 6)


@settings(max_examples=60, deadline=None)
@given(seeds, ranks, ranks)
def test_contradiction_is_mutual_and_knows_no_origin(seed, rank_a, rank_b):
    rng = np.random.default_rng(seed)
    A, B, shift = informed(rng, rank_a), informed(rng, rank_b), UNITS * rng.normal(size=6)
    a, b = fusion.Testimony(drawn(rng, A), A), fusion.Testimony(3 * drawn(rng, B), B)
    said = contradiction(a, b)
    assert contradiction(b, a) == said
    assert contradiction(fusion.Testimony(a.drift + shift, A), fusion.Testimony(b.drift + shift, B)) == said


@settings(max_examples=60, deadline=None)
@given(seeds, ranks, ranks)
def test_intersection_is_never_surer_than_the_truth(seed, rank_a, rank_b):
    # Whatever the correlation of the two errors is, the stated covariance bounds the true one.
    rng = np.random.default_rng(seed)
    a = fusion.Testimony(np.zeros(6), informed(rng, rank_a, 1.0))
    b = fusion.Testimony(np.zeros(6), informed(rng, rank_b, 1.0))
    fused = intersected(a, b)
    stated = fused.covariance()
    np.testing.assert_allclose(stated, stated.T, rtol=1e-6, atol=1e-12)
    # The estimate is linear in both: gains by unit drifts.
    Ga = np.column_stack([intersected(fusion.Testimony(e, a.information), b).drift for e in np.eye(6)])
    Gb = np.column_stack([intersected(a, fusion.Testimony(e, b.information)).drift for e in np.eye(6)])
    root_a, root_b = np.linalg.cholesky(a.covariance()), np.linalg.cholesky(b.covariance())
    turn = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    for cross in (np.eye(6), -np.eye(6), turn, np.zeros((6, 6))):
        mixed = Ga @ root_a @ cross @ root_b.T @ Gb.T
        true = Ga @ a.covariance() @ Ga.T + Gb @ b.covariance() @ Gb.T + mixed + mixed.T
        spread = np.sqrt(np.diag(stated))
        slack = np.linalg.eigvalsh((stated - true) / np.outer(spread, spread))
        assert slack.min() > -1e-3


@settings(max_examples=60, deadline=None)
@given(seeds, ranks, ranks)
def test_intersection_is_no_worse_than_either_and_symmetric(seed, rank_a, rank_b):
    rng = np.random.default_rng(seed)
    A, B = informed(rng, rank_a), informed(rng, rank_b)
    a, b = fusion.Testimony(drawn(rng, A), A), fusion.Testimony(drawn(rng, B), B)
    fused = intersected(a, b)
    volume = np.linalg.slogdet(fused.covariance())[1]
    for one in (a, b):
        assert volume <= np.linalg.slogdet(one.covariance())[1] + 1e-6
    other = intersected(b, a)
    np.testing.assert_allclose(other.covariance(), fused.covariance(), rtol=1e-4, atol=1e-12)


def test_a_testimony_with_itself_is_itself():
    rng = np.random.default_rng(1)
    A = informed(rng, 6)
    a = fusion.Testimony(drawn(rng, A), A)
    fused = intersected(a, a)
    np.testing.assert_allclose(fused.information, A, rtol=1e-12)
    np.testing.assert_allclose(fused.drift, a.drift, rtol=1e-3, atol=1e-9)


def test_witnesses_of_different_directions_are_joined_by_both():
    a = fusion.Testimony(UNITS * [1, 1, 1, 0, 0, 0], np.diag([1e8, 1e8, 1e8, 0, 0, 0]))
    b = fusion.Testimony(UNITS * [0, 0, 0, 1, 1, 1], np.diag([0, 0, 0, 1e6, 1e6, 1e6]))
    fused = intersected(a, b)
    np.testing.assert_allclose(fused.drift, UNITS, rtol=1e-3)
    # Half of each: the price of an unknown correlation.
    np.testing.assert_allclose(np.diag(fused.information), [5e7] * 3 + [5e5] * 3, rtol=0.11)


def test_a_held_direction_stays_where_it_is_stored():
    a = fusion.Testimony(UNITS, np.diag([1e8, 1e8, 1e8, 1e6, 1e6, 0]))
    fused = intersected(a, a)
    assert fused.drift[5] == pytest.approx(0, abs=1e-9)
    assert np.sqrt(fused.covariance()[5, 5]) == pytest.approx(10)


@settings(max_examples=60, deadline=None)
@given(seeds, ranks)
def test_floor_adds_to_what_is_known_and_leaves_the_unknown(seed, rank):
    rng = np.random.default_rng(seed)
    A = informed(rng, rank)
    floor = np.linalg.inv(informed(rng, 6))
    floored = with_floor(fusion.Testimony(UNITS, A), floor)
    information = floored.information * np.outer(UNITS, UNITS)
    np.testing.assert_array_equal(floored.information, floored.information.T)
    assert np.linalg.eigvalsh(information).min() > -1e-9 * np.trace(information)
    if rank == 6:
        expected = np.linalg.inv(A) + floor
        np.testing.assert_allclose(np.linalg.inv(floored.information), expected, rtol=1e-6, atol=1e-12)
    null = np.linalg.svd(A * np.outer(UNITS, UNITS))[2][rank:]
    assert np.abs(information @ null.T).max(initial=0) < 1e-8 * np.trace(information) + 1e-9
    np.testing.assert_array_equal(floored.drift, UNITS)


@settings(max_examples=30, deadline=None)
@given(seeds, ranks, ranks)
def test_floors_only_silence_contradictions_of_honest_size(seed, rank_a, rank_b):
    rng = np.random.default_rng(seed)
    A, B = informed(rng, rank_a), informed(rng, rank_b)
    a, b = fusion.Testimony(drawn(rng, A), A), fusion.Testimony(drawn(rng, B), B)
    floor = np.diag((0.5 * UNITS) ** 2)
    bare = statistic(a, b)
    assert statistic(with_floor(a, floor), b) <= bare * (1 + 1e-4) + 1e-3
