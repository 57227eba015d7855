import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.window import WindowParameters, judgement_due, retained

P = WindowParameters()
S = 1_000_000_000

ascending = st.lists(st.integers(0, 3 * S), min_size=1, max_size=60).map(
    lambda gaps: list(itertools.accumulate(gaps))
)
small = st.builds(
    WindowParameters,
    most_frames=st.integers(1, 12),
    dense_frames=st.integers(1, 12),
    spacing_ns=st.sampled_from([1, 100_000_000, 250_000_000, 2 * S]),
    longest_ns=st.sampled_from([0, 500_000_000, 6 * S, 1000 * S]),
)


def by_definition(stamps, p):
    """What stays, as the field docs say it: young, dense at the end, one a slot before, newest first."""
    young = [i for i, stamp in enumerate(stamps) if stamps[-1] - stamp <= p.longest_ns]
    dense = [i for i in young if i >= len(stamps) - p.dense_frames]
    slots = {}
    for i in young:
        if i not in dense:
            slots[stamps[i] // p.spacing_ns] = i  # the newest of the slot
    return sorted(sorted([*dense, *slots.values()])[-p.most_frames :])


@settings(max_examples=300, deadline=None)
@given(ascending, small)
def test_retained_is_its_definition(stamps, p):
    assert retained(stamps, p) == by_definition(stamps, p)


@settings(max_examples=200, deadline=None)
@given(ascending, small)
def test_bounded_ascending_and_the_newest_kept(stamps, p):
    kept = retained(stamps, p)
    assert kept[-1] == len(stamps) - 1
    assert len(kept) <= p.most_frames
    assert kept == sorted(set(kept))
    assert all(stamps[-1] - stamps[i] <= p.longest_ns for i in kept)


def driven(period_ns, frames, p, start=0):
    """The window frame by frame, as a watch keeps it: stamps that stay go into the next choice."""
    window = []
    for k in range(frames):
        window.append(start + k * period_ns)
        window = [window[i] for i in retained(window, p)]
        yield list(window)


def test_any_rate_gives_a_window_that_is_dense_at_its_end_and_long():
    for hertz in (1, 2, 5, 10, 20, 30):
        period = S // hertz
        *_, window = driven(period, 40 * hertz, P)
        gaps = np.diff(window)
        assert len(window) <= P.most_frames
        assert window[-1] == (40 * hertz - 1) * period
        assert window[-1] - window[0] <= P.longest_ns
        dense = min(P.dense_frames, len(window)) - 1
        assert (gaps[len(gaps) - dense :] == period).all()
        # Older frames are spread: the window spans more than as many dense frames would.
        wanted = min(P.longest_ns - period, max(0, len(window) - P.dense_frames - 2) * P.spacing_ns)
        assert window[-1] - window[0] >= wanted


def test_old_frames_that_were_chosen_stay_until_they_are_too_old():
    before = None
    for window in driven(S // 10, 200, P):
        if before is not None and len(before) == P.most_frames:
            old = [stamp for stamp in before if stamp < window[-1] - 2 * S]
            kept = [stamp for stamp in old if stamp in window]
            # Only from the far end does anything leave.
            assert kept == old[len(old) - len(kept) :]
        before = window


def test_a_window_kept_frame_by_frame_is_that_of_all_frames():
    every = list(range(0, 20 * S, S // 10))
    for k, window in enumerate(driven(S // 10, 200, P)):
        seen = every[: k + 1]
        assert window == [seen[i] for i in retained(seen, P)]


def test_a_jump_forward_leaves_only_what_came_after():
    stamps = [*range(0, S, S // 10), 100 * S, 100 * S + 1]
    assert retained(stamps, P) == [10, 11]
    assert retained([5], P) == [0]


def test_equal_stamps_are_kept_while_dense():
    assert retained([7, 7, 7], P) == [0, 1, 2]


@settings(max_examples=100, deadline=None)
@given(ascending, small, st.integers(0, 10**6))
def test_whole_slots_later_the_choice_is_the_same(stamps, p, slots):
    shifted = [stamp + slots * p.spacing_ns for stamp in stamps]
    assert retained(shifted, p) == retained(stamps, p)


def test_judgement_waits_for_frames_and_then_keeps_its_rhythm():
    def due(now, judged, frames=20, *, soon=False):
        return judgement_due(now, judged, frames, soon=soon, parameters=P)

    assert not due(0, None, P.least_frames - 1)
    assert due(0, None, P.least_frames)
    assert not due(10 * S, 0, P.least_frames - 1)
    assert not due(int(0.89 * S), 0)
    assert due(int(0.90 * S), 0)
    assert due(180_000_000, 0, soon=True)
    assert not due(179_999_999, 0, soon=True)


def test_jitter_of_a_10_hz_sensor_costs_no_frame_of_waiting():
    rng = np.random.default_rng(1)
    judged = [0]
    for k in range(1, 400):
        now = round(k * S / 10 + rng.normal(0, 3e6))
        if judgement_due(now, judged[-1], 20, soon=False, parameters=P):
            judged.append(now)
    assert max(np.diff(judged)) < 1.05 * S
    assert min(np.diff(judged)) > 0.85 * S
