import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.errors import RigError
from pipeline.permutohedral import _corners, _elevation, _neighbours, _numbered, _Numbers, lattice


def corner_places(keys, strides, centre):
    """Coordinates (n,d+1,d) of corners by their keys (n,d+1), all but the last; (d,) lies amid all points."""
    d = len(strides)
    remainder = keys % (d + 1)
    middle = np.rint(centre / (d + 1)).astype(np.int64)
    # With digits round zero the mixed radix is undone from its largest stride down.
    rest = (keys - remainder) // (d + 1) - strides @ middle
    places = np.empty((*keys.shape, d))
    for i in range(d - 1, -1, -1):
        digit = np.rint(rest / strides[i]).astype(np.int64)
        places[..., i] = (d + 1) * (digit + middle[i]) + remainder
        rest = rest - digit * strides[i]
    return places


class TestCorners:
    @settings(max_examples=40, deadline=None)
    @given(seed=st.integers(0, 2**32 - 1), d=st.integers(2, 6), spread=st.floats(0.01, 40.0))
    def test_a_point_is_the_mean_of_its_corners_by_their_shares(self, seed, d, spread):
        features = np.random.default_rng(seed).normal(0.0, spread, (d, 50)).astype(np.float32)
        keys, shares, strides = _corners(features)
        assert shares.min() > -1e-6
        np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-6)
        elevated = (_elevation(d).astype(np.float64) @ features)[:d].T
        centre = (elevated.min(axis=0) + elevated.max(axis=0)) / 2
        means = (corner_places(keys, strides, centre) * shares[:, :, None]).sum(axis=1)
        np.testing.assert_allclose(means, elevated, atol=1e-5 * max(1.0, np.abs(elevated).max()))

    def test_corners_of_a_simplex_have_all_remainders(self):
        features = np.random.default_rng(1).uniform(-9, 9, (5, 500)).astype(np.float32)
        keys, _, _ = _corners(features)
        np.testing.assert_array_equal(np.sort(keys % 6, axis=1), np.tile(np.arange(6), (500, 1)))

    def test_chunks_join(self):
        features = np.random.default_rng(2).uniform(0, 5, (3, 40_000)).astype(np.float32)
        _, shares, _ = _corners(features)
        _, tail, _ = _corners(features[:, -100:])
        np.testing.assert_allclose(shares[-100:], tail, atol=1e-6)


class TestNumbering:
    @given(st.lists(st.integers(-(2**62), 2**62) | st.integers(0, 20), min_size=1, max_size=300))
    def test_as_numpy_unique(self, values):
        keys = np.array(values, dtype=np.int64)
        unique, place = _numbered(keys)
        expected, inverse = np.unique(keys, return_inverse=True)
        np.testing.assert_array_equal(unique, expected)
        np.testing.assert_array_equal(place, inverse)

    def test_full_buckets(self):
        # Far more different keys than buckets of the smallest table: most have to share.
        keys = np.random.default_rng(0).integers(0, 2**61, 4000).repeat(3)
        unique, place = _numbered(keys)
        np.testing.assert_array_equal(unique[place], keys)
        assert len(unique) == 4000

    @pytest.mark.parametrize("count", [1, 2, 50, 20_000])
    def test_places(self, count):
        rng = np.random.default_rng(count)
        keys = np.unique(rng.integers(-(2**61), 2**61, count))
        wanted = np.concatenate([rng.permutation(keys), rng.integers(-(2**61), 2**61, 500)])
        expected = {key: place for place, key in enumerate(keys.tolist())}
        found = _Numbers(keys).of(wanted)
        assert found.tolist() == [expected.get(key, len(keys)) for key in wanted.tolist()]


class TestBlur:
    def test_neighbours_are_one_step_apart_and_know_each_other(self):
        features = np.random.default_rng(3).uniform(0, 3, (4, 3000)).astype(np.float32)
        keys, _, strides = _corners(features)
        vertices, _ = _numbered(keys.ravel())
        beside = _neighbours(vertices, strides)
        own = np.arange(len(vertices))
        for ahead, behind in beside:
            known = ahead < len(vertices)
            assert known.sum() > 0.2 * len(vertices)
            np.testing.assert_array_equal(behind[ahead[known]], own[known])
            np.testing.assert_array_equal(np.sort(behind[behind < len(vertices)]), own[known])

    def test_sums_are_gaussian(self):
        # A dense cloud, so that every corner has its neighbours; one factor for all pairs.
        rng = np.random.default_rng(4)
        features = rng.uniform(0.0, 6.0, (2, 4000)).astype(np.float32)
        values = rng.uniform(0.5, 1.5, 4000).astype(np.float32)
        found = lattice(features)
        got = found.shares @ found.blurred(found.shares.T @ values)
        distance2 = ((features[:, :, None] - features[:, None]) ** 2).sum(axis=0)
        ratio = got / (np.exp(-0.5 * distance2) @ values)
        assert ratio.std() < 0.03 * ratio.mean()


def test_points_too_far_apart():
    with pytest.raises(RigError, match="too narrow"):
        lattice(np.array([[0.0, 1e7]] * 5, dtype=np.float32))


def test_one_point():
    found = lattice(np.ones((5, 1), dtype=np.float32))
    assert found.shares.shape == (1, 6)
    assert (found.shares @ found.blurred(found.shares.T @ np.ones(1, np.float32))).shape == (1,)
