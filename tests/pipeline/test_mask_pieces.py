import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from pipeline.mask_pieces import pieces_of


def random_mask(seed, density):
    return np.random.default_rng(seed).random((17, 23)) < density


masks = st.builds(random_mask, st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))


@settings(max_examples=60, deadline=None)
@given(mask=masks, seed=st.integers(0, 1000))
def test_each_figure_piece_by_piece(mask, seed):
    rng = np.random.default_rng(seed)
    values, other = rng.random(mask.shape).astype(np.float32), rng.random(mask.shape) < 0.4
    pieces = pieces_of(mask)
    labelled, count = ndimage.label(mask, structure=np.ones((3, 3)))
    assert len(pieces.sizes) == count + 1
    peaks, shares = pieces.peaks(values), pieces.share(other)
    for number in range(1, count + 1):
        here = pieces.image == number
        assert len(np.unique(labelled[here])) == 1
        assert pieces.sizes[number] == here.sum() == (labelled == labelled[here][0]).sum()
        rows, columns = np.nonzero(here)
        assert pieces.boxes[number].tolist() == [np.ptp(columns) + 1, np.ptp(rows) + 1]
        assert peaks[number] == values[here].max()
        assert shares[number] == np.mean(other[here])
    np.testing.assert_array_equal(pieces.where(np.ones(count + 1, dtype=bool)), mask)
    assert not pieces.where(np.zeros(count + 1, dtype=bool)).any()


def test_around_is_the_mean_of_what_is_near_and_no_piece():
    mask = np.zeros((20, 40), dtype=bool)
    mask[5:9, 5:7] = True
    mask[5:9, 30:33] = True
    values = np.random.default_rng(0).random(mask.shape).astype(np.float32)
    got = pieces_of(mask).around(values, (3, 1))
    for piece, (left, right) in enumerate(((5, 7), (30, 33)), start=1):
        near = np.zeros_like(mask)
        near[4:10, left - 3 : right + 3] = True
        np.testing.assert_allclose(got[piece], values[near & ~mask].mean(), rtol=1e-6)


def test_nothing_is_around_what_fills_the_image():
    pieces = pieces_of(np.ones((6, 7), dtype=bool))
    assert np.isnan(pieces.around(np.ones((6, 7), np.float32), (2, 2))[1])


def test_an_empty_mask_has_no_pieces():
    pieces = pieces_of(np.zeros((5, 5), dtype=bool))
    assert len(pieces.sizes) == 1
    assert not pieces.where(np.ones(1, dtype=bool)).any()
