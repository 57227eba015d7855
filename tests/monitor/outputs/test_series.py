from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from monitor.outputs._series import Series


def test_all_samples_are_kept_while_there_is_room(drive):
    series = Series(10)
    for second in range(10):
        series.note(drive().status(second))
    assert [sample.stamp_ns for sample in series.samples] == [drive().stamp(second) for second in range(10)]


@given(number=st.integers(1, 300), most=st.integers(2, 40), thinner=st.integers(2, 40))
def test_memory_is_bounded_and_first_and_newest_stay(drive, number, most, thinner):
    series = Series(most)
    for n in range(number):
        series.note(drive().status(4, stamp_ns=n))
    stamps = [sample.stamp_ns for sample in series.samples]
    assert len(stamps) <= most + 1
    assert (stamps[0], stamps[-1]) == (0, number - 1)
    assert stamps == sorted(set(stamps))
    gaps = [b - a for a, b in pairwise(stamps[:-1])]
    assert len(set(gaps)) <= 1
    few = [sample.stamp_ns for sample in series.thinned(thinner)]
    assert len(few) <= max(thinner, 2)
    assert (few[0], few[-1]) == (stamps[0], stamps[-1])
    assert set(few) <= set(stamps)


def test_an_axis_that_is_held_is_a_gap(drive):
    series = Series(4)
    series.note(drive().status(9))
    (sample,) = series.samples
    held = drive().status(9).drift
    assert sample.values[3] is sample.sigmas[3] is None
    assert sample.values[2] == held.yaw.value
    assert sample.sigmas[2] == held.yaw.sigma
