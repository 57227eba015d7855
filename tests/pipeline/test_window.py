import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.window import Candidate, WindowParameters, judgement_due, lines_due, retained

P = WindowParameters()
S = 1_000_000_000
TENTH = S // 10


def telling(stamp_ns, way_m, information=None):
    return Candidate(stamp_ns, way_m, np.eye(6) if information is None else information)


@st.composite
def drives(draw):
    """Frames of a drive with stops and gaps, each saying something else."""
    count = draw(st.integers(1, 40))
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    stamps = np.cumsum(rng.choice([0, TENTH, TENTH, S, 4 * S], count))
    ways = np.cumsum(rng.choice([0.0, 0.0, 1.0, 5.0, 30.0], count))
    roots = rng.normal(size=(count, 6, 6)) * rng.uniform(0, 3, (count, 1, 1))
    return [telling(int(t), float(w), A @ A.T) for t, w, A in zip(stamps, ways, roots, strict=True)]


small = st.builds(
    WindowParameters,
    most_frames=st.integers(1, 12),
    dense_frames=st.integers(1, 12),
    aged_frames=st.integers(0, 6),
    brief_ns=st.sampled_from([0, S, 4 * S]),
    longest_ns=st.sampled_from([0, 2 * S, 6 * S]),
)


def told(frames, p):
    """log det of what the frames say together: each what the next newer one does not."""
    whole = np.eye(6)
    for a, b in itertools.zip_longest(frames, frames[1:]):
        share = 1.0
        if b is not None:
            way = abs(b.way_m - a.way_m) + p.creep_m_s * (b.stamp_ns - a.stamp_ns) / S
            share = 1.0 - math.exp(-way / p.overlap_m)
        whole = whole + share * a.information
    return np.linalg.slogdet(whole)[1]


@settings(max_examples=200, deadline=None)
@given(drives(), small)
def test_bounded_ascending_the_newest_kept_and_every_departure_told(frames, p):
    kept, left = retained(frames, p)
    assert kept[-1] == len(frames) - 1
    assert kept == sorted(set(kept))
    assert len(kept) <= p.most_frames
    assert len(kept) + len(left) == len(frames)
    ages = [frames[-1].stamp_ns - frames[k].stamp_ns for k in kept]
    assert sum(age > p.longest_ns for age in ages) <= p.aged_frames
    for k, age in zip(kept, ages, strict=True):
        near = frames[-1].way_m - frames[k].way_m <= p.near_m and age <= p.oldest_ns
        assert age <= p.brief_ns or near


@settings(max_examples=150, deadline=None)
@given(drives(), st.integers(0, 6))
def test_the_one_that_leaves_a_full_window_is_the_one_that_is_missed_least(frames, dense):
    lasting = WindowParameters(
        most_frames=max(1, len(frames) - 1),
        dense_frames=dense,
        brief_ns=10**15,
        longest_ns=10**15,
    )
    kept, left = retained(frames, lasting)
    if len(frames) == 1:
        assert (kept, left) == ([0], [])
        return
    assert len(left) == 1
    free = [k for k in range(len(frames)) if k < len(frames) - dense] or range(len(frames) - 1)
    best = max(told(frames[:k] + frames[k + 1 :], lasting) for k in free if k < len(frames) - 1)
    assert told([frames[k] for k in kept], lasting) == pytest.approx(best, abs=1e-5)


def driven(frames, p=P):
    """The window frame by frame, as a watch keeps it, with all departures so far."""
    window, gone = [], []
    for frame in frames:
        window = [*window, frame]
        kept, left = retained(window, p)
        window = [window[k] for k in kept]
        gone = [*gone, *left]
        yield window, gone


def steady(speed, seconds, start=(0, 0.0), information=None):
    """10 Hz at one speed."""
    return [
        telling(start[0] + k * TENTH, start[1] + speed * k / 10, information)
        for k in range(1, round(10 * seconds) + 1)
    ]


@pytest.mark.parametrize("speed", [1.0, 3.0, 10.0, 30.0])
def test_any_speed_gives_a_window_that_is_dense_at_its_end_and_spread_before(speed):
    *_, (window, _) = driven(steady(speed, 40))
    stamps = np.array([f.stamp_ns for f in window])
    assert len(window) == P.most_frames
    assert (np.diff(stamps)[-P.dense_frames + 1 :] == TENTH).all()
    older = np.diff(stamps)[: P.most_frames - P.dense_frames]
    assert older.max() <= 4 * np.median(older)
    # Two scenes where there is time for them, and at least as long as the brief time where there is not.
    way, age = window[-1].way_m - window[0].way_m, stamps[-1] - stamps[0]
    assert way > 0.5 * P.near_m or age > 2 * S
    assert way <= P.near_m or age <= P.brief_ns


def test_who_stands_keeps_what_was_seen_on_the_way_and_not_the_same_again():
    moving = steady(8.0, 10)
    last = (moving[-1].stamp_ns, moving[-1].way_m)
    standing = steady(0.0, 60, last)
    history = list(driven(moving + standing))
    window, gone = history[len(moving) + 200 - 1]
    stretches = {round(f.way_m) for f in window}
    assert len(stretches) == 1 + P.aged_frames
    assert max(stretches) - min(stretches) > 20
    # Those that left while it stood were told to be repetitions.
    before = history[len(moving) - 1][1]
    assert set(before) <= {"past", "adds_least"}
    assert "repeats" in gone[len(before) :]
    # A mount that moves while parked is outvoted by nobody.
    for w, _ in history[len(moving) + 60 :]:
        young = [f for f in w if f.stamp_ns >= w[-1].stamp_ns - P.longest_ns]
        assert len(young) >= 0.75 * len(w)
    window, _ = history[-1]
    assert {f.way_m for f in window} == {last[1]}
    assert window[-1].stamp_ns - window[0].stamp_ns <= P.oldest_ns


def test_a_frame_that_alone_shows_a_direction_outlasts_its_neighbours():
    common, rare = np.diag([9.0, 9, 9, 9, 9, 0]), np.diag([1.0, 1, 1, 1, 1, 50])
    frames = steady(5.0, 5, information=common)
    special = frames[12] = telling(frames[12].stamp_ns, frames[12].way_m, rare)
    for window, _ in itertools.islice(driven(frames), 13, None):
        assert special in window


def test_without_a_known_way_the_window_spreads_in_time():
    *_, (window, gone) = driven(steady(0.0, 20))
    gaps = np.diff([f.stamp_ns for f in window])[: P.most_frames - P.dense_frames]
    assert len(window) == P.most_frames
    assert gaps.min() >= TENTH
    assert window[-1].stamp_ns - window[0].stamp_ns > 5 * S
    assert set(gone) <= {"repeats", "past"}


def test_a_jump_forward_leaves_only_what_came_after():
    frames = [*steady(10.0, 1), telling(100 * S, 900.0), telling(100 * S + 1, 900.0)]
    assert retained(frames, P) == ([10, 11], ["past"] * 10)
    assert retained(frames[:1], P) == ([0], [])


def test_equal_stamps_are_kept_while_there_is_room():
    assert retained([telling(7, 0.0)] * 3, P) == ([0, 1, 2], [])


def test_frames_that_say_nothing_leave_the_oldest_first():
    nothing = [telling(k * TENTH, 1.0 * k, np.zeros((6, 6))) for k in range(P.most_frames + 2)]
    assert retained(nothing, P)[0] == list(range(2, P.most_frames + 2))


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


@pytest.mark.parametrize(
    ("waited_ns", "way_m", "due"),
    [
        (None, None, True),
        (None, 0.0, True),
        (TENTH, 50.0, False),
        (S // 2, 5.0, True),
        (S // 2, 0.2, False),
        (S // 2, None, True),
        (2 * S, 0.0, True),
        (int(1.7 * S), 0.0, False),
    ],
)
def test_lines_are_asked_of_what_is_new_within_the_budget(waited_ns, way_m, due):
    assert lines_due(waited_ns, way_m, S // 2, P, barren=False) == due


def test_a_budget_below_the_seldom_rhythm_is_kept_while_standing():
    assert not lines_due(4 * S, 0.0, 5 * S, P, barren=False)
    assert lines_due(5 * S, 0.0, 5 * S, P, barren=False)


def asked(shows, every_ns=S // 2, seconds=20, way_m=1.0):
    """Stamps at which frames of a 10 Hz drive get lines, where ``shows`` tells whether there are any."""
    stamps, barren = [], False
    for now in range(0, seconds * S, TENTH):
        waited, way = (now - stamps[-1], way_m * (now - stamps[-1]) / TENTH) if stamps else (None, None)
        if lines_due(waited, way, every_ns, P, barren=barren):
            stamps.append(now)
            barren = not shows(now)
    return stamps


def test_frames_that_show_lines_are_preferred():
    """Half of the road is bare: twice as many are taken of the other half, from its first second on."""
    town = asked(lambda now: now // (5 * S) % 2 == 1)
    gaps = [(now, later - now) for now, later in itertools.pairwise(town)]
    barren = 9 * TENTH
    assert {gap for now, gap in gaps if S <= now % (10 * S) < 4 * S} == {barren}
    assert {gap for now, gap in gaps if 6 * S <= now % (10 * S) < 9 * S} == {S // 2}
    where = [now // (5 * S) % 2 for now in town]
    assert where.count(1) > 1.5 * where.count(0)
    # Bounded both ways: the budget where all is paint, and never silent where nothing is.
    assert set(np.diff(asked(lambda _: True))) == {S // 2}
    assert set(np.diff(asked(lambda _: False))) == {barren}
    assert set(np.diff(asked(lambda _: False, way_m=0.0))) == {18 * TENTH}
    assert set(np.diff(asked(lambda _: False, every_ns=3 * S))) == {27 * TENTH}
