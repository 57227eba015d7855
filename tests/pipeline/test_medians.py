import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.medians import group_medians, grouped, median

_VALUES = st.floats(-1e6, 1e6)


@given(arrays(np.float64, st.integers(1, 40), elements=_VALUES))
def test_the_median_is_that_of_numpy(values):
    assert median(values) == np.median(values)


@given(arrays(np.int64, st.integers(1, 60), elements=st.integers(0, 9)), st.randoms(use_true_random=False))
def test_each_group_has_its_own_median(group, random):
    values = np.array([random.uniform(-1.0, 1.0) for _ in group])
    order = grouped(group)
    found = group_medians(values[order], group[order], 11)
    for number, value in enumerate(found):
        own = values[group == number]
        assert np.isnan(value) if own.size == 0 else value == np.median(own)


def test_members_of_a_group_keep_their_order():
    group = np.array([65535, 0, 300, 65535, 0, 300])
    assert grouped(group).tolist() == [1, 4, 2, 5, 0, 3]
