"""The past of a pair: three real frames over and over, with edges that move as the mount would move them."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from pipeline import se3, verdict
from pipeline.belief import Belief
from pipeline.dating import Dating
from pipeline.drift_test import DriftTestParameters, Evidence, Judgement, expectation_of_stored
from pipeline.edge_parameters import EdgeParameters
from pipeline.edge_witness import EdgeFrame
from pipeline.edges import find_edges
from pipeline.gradients import gradient_pyramid
from pipeline.ground import fit_ground
from pipeline.mount import Mount
from pipeline.onset import Onset
from pipeline.traces import TraceParameters, fractions, spread, thinned

S = 1_000_000_000
STEP = S // 10
P = TraceParameters()
EXPECTED = expectation_of_stored(math.radians(0.1), 0.02, DriftTestParameters())
UP = np.array([0.0, 0.0, 1.0])
DEG = math.radians(1.0)
WAYS = {
    "roll": 0.6 * DEG * np.eye(6)[2],
    "pitch": 0.3 * DEG * np.eye(6)[0],
    "yaw": 1.0 * DEG * np.eye(6)[1],
    "left": 0.2 * np.eye(6)[3],
    "all": np.array([0.2 * DEG, -0.3 * DEG, 0.3 * DEG, 0.05, 0.03, -0.1]),
}
WAY = WAYS["all"]


@pytest.fixture(scope="module")
def seen(drive, straight_frames):
    """Three frames as the edge witness keeps them, camera and true extrinsic."""
    p = drive.parameters
    frames = []
    for number, frame in enumerate(straight_frames):
        ground = fit_ground(frame.cloud, UP, np.random.default_rng(number))
        edges = find_edges(frame.cloud, ground, p.camera, p.T_stored, EdgeParameters())
        frames.append(EdgeFrame(frame.image_stamp_ns, edges, gradient_pyramid(frame.image, p.camera)))
    return frames, p.camera, p.T_stored


def at(frame, T, xi, stamp_ns):
    """The frame as it would be if the mount had moved from ``T`` by ``xi``."""
    back = se3.inverse(se3.retract(T, xi)) @ T
    edges = dataclasses.replace(
        frame.edges,
        position=se3.apply(back, frame.edges.position),
        direction=frame.edges.direction @ back[:3, :3].T,
    )
    return dataclasses.replace(frame, edges=edges, stamp_ns=stamp_ns)


def driven(seen, places, begin_ns=0):
    """Frames at 10 Hz; ``places``: how far on the way each stands, with the unrest of a real mount."""
    frames, _, T = seen
    rng = np.random.default_rng(2)
    units = np.array([0.03 * DEG] * 3 + [0.005] * 3)
    for number, place in enumerate(places):
        xi = place * WAY + units * rng.normal(size=6)
        yield at(frames[number % 3], T, xi, begin_ns + number * STEP)


class Pair:
    """What a watch does with a dating: frames in, judgements as told."""

    def __init__(self, seen):
        _, camera, T = seen
        self.dating = Dating(camera, P)
        self.T = T
        self.mount = Mount(camera, T, None, math.radians(0.1), 0.02, np.ones(6), ("yaw",))
        self.memory = verdict.start(0)

    def see(self, frames):
        for frame in frames:
            self.dating.see(frame)

    def judge(self, now_ns, place, *, alarming, severity=None, **marks):
        T_now = se3.retract(self.T, place * WAY)
        drift = se3.mount_drift(self.T, T_now, self.mount.R_vehicle_cam)
        sigma = np.array([0.05 * DEG] * 3 + [0.01] * 3)
        yes = np.ones(6, dtype=bool)
        told = {"alarming": alarming, "suspicious": alarming}
        told |= {"blind": False, "ambiguous": False, "contradicted": False} | marks
        judgement = Judgement(drift, sigma, sigma, sigma, yes, yes, yes, 50.0, **told)
        evidence = Evidence(drift, np.diag(sigma**2), 0.2, 1.0, 9.0, 4.0, persistent=True, frames=20)
        belief = Belief(judgement, evidence, T_now, None, None, None, None, ())
        self.memory = dataclasses.replace(self.memory, input_ns=now_ns, severity=severity)
        before = self.memory
        self.memory = self.dating.dated(before, self.mount, EXPECTED, belief, now_ns - S // 2)
        self.belief = belief
        return self.memory.onset

    def tell(self, now_ns):
        return self.judge(now_ns, 1.0, alarming=True, severity="minor")


@pytest.mark.parametrize("name", WAYS)
@pytest.mark.parametrize("place", [0.0, 0.35, 1.0])
def test_each_frame_tells_how_far_the_mount_has_gone(seen, name, place):
    frames, camera, T = seen
    way = WAYS[name]
    moved = [thinned(at(frame, T, place * way, 0), P) for frame in frames]
    assert fractions(moved, camera, T, se3.retract(T, way)) == pytest.approx([place] * 3, abs=0.25)


def test_a_frame_is_thinned_to_what_its_parameters_allow(seen):
    kept = thinned(seen[0][0], P)
    assert 0.5 * P.most_edges <= len(kept.edges) <= P.most_edges
    assert sum(level.nbytes for level in kept.gradients.levels) <= P.most_bytes
    small = thinned(seen[0][0], dataclasses.replace(P, most_bytes=1))
    assert small.gradients.levels[0] is seen[0][0].gradients.levels[-1]


def check(told, slip_ns):
    """The interval holds the slip, and is short: at such an age every other frame is kept."""
    assert told.from_ns <= slip_ns <= told.to_ns
    assert told.to_ns - told.from_ns <= 5 * STEP
    assert abs(told.stamp_ns - slip_ns) <= STEP


def test_a_slip_is_dated_between_two_frames_at_once_and_for_good(seen):
    pair, frames = Pair(seen), list(driven(seen, np.r_[np.zeros(24), np.ones(82)]))
    slip_ns = 24 * STEP - STEP // 2
    pair.see(frames[:36])
    assert pair.judge(36 * STEP, 0.0, alarming=False) is None
    told = pair.tell(36 * STEP)
    assert not told.gradual
    check(told, slip_ns)
    pair.see(frames[36:])
    assert pair.tell(40 * STEP) is told  # what is told is not told anew at every judgement
    settled = pair.tell(96 * STEP)
    check(settled, slip_ns)
    # Nothing is kept any more, and nothing changes it.
    assert pair.tell(105 * STEP) is settled
    pair.see(driven(seen, np.zeros(3)))
    assert pair.tell(106 * STEP) is settled


def test_at_the_end_all_that_came_is_asked(seen):
    pair = Pair(seen)
    frames = list(driven(seen, np.r_[np.zeros(9), np.ones(12)]))
    pair.see(frames[:11])
    pair.tell(11 * STEP)
    pair.see(frames[11:])
    last = pair.dating.redated(pair.memory, pair.mount, EXPECTED, pair.belief).onset
    assert last.from_ns <= 8 * STEP < 9 * STEP <= last.to_ns


def test_growth_is_dated_from_its_first_sign(seen):
    pair = Pair(seen)
    places = np.clip((np.arange(46) - 14.5) / 20.0, 0.0, 1.0)
    pair.see(driven(seen, places))
    told = pair.tell(46 * STEP)
    assert told.gradual
    assert told.from_ns <= 14.5 * STEP <= told.to_ns
    assert told.to_ns - told.from_ns < 15 * STEP


def test_what_was_there_from_the_first_frame_is_said_to_have_been_there(seen):
    pair = Pair(seen)
    pair.see(driven(seen, np.ones(12), begin_ns=5 * S))
    told = pair.tell(5 * S + 12 * STEP)
    assert told.stamp_ns == told.from_ns == 5 * S


def test_windows_date_what_is_older_than_the_frames(seen):
    pair = Pair(seen)
    for second in range(100):
        pair.judge(second * S, 0.0 if second < 40 else 1.0, alarming=second >= 40)
    pair.see(driven(seen, np.ones(12), begin_ns=100 * S))
    told = pair.tell(101 * S + STEP)
    # A window shows nothing younger than half a second here, and at such an age one in ten is kept.
    assert told.from_ns <= 40 * S <= told.to_ns
    assert told.from_ns % S == S // 2
    assert told.from_ns >= 25 * S
    assert told.to_ns <= 50 * S


def test_the_verdict_knows_better_when_all_that_is_kept_is_younger(seen):
    pair = Pair(seen)
    known = Onset(50 * S, 40 * S, 60 * S)
    pair.memory = dataclasses.replace(pair.memory, onset=known)
    pair.see(driven(seen, np.ones(12), begin_ns=100 * S))
    assert pair.tell(101 * S + STEP) is known


@pytest.mark.parametrize("mark", ["blind", "contradicted"])
def test_windows_that_say_nothing_are_not_asked(seen, mark):
    pair = Pair(seen)
    for second in range(20):
        said = {mark: second < 10}
        pair.judge(second * S, 0.0 if second < 10 else 1.0, alarming=second >= 10, **said)
    told = pair.tell(20 * S)
    assert told.from_ns >= 9 * S


def test_nothing_is_dated_while_nothing_is_told(seen):
    pair = Pair(seen)
    pair.see(driven(seen, np.r_[np.zeros(8), np.ones(8)]))
    assert pair.judge(16 * STEP, 1.0, alarming=True) is None
    assert pair.judge(17 * STEP, 1.0, alarming=False, severity="minor") is None


def test_a_clock_that_runs_back_begins_anew(seen):
    pair = Pair(seen)
    pair.see(driven(seen, np.zeros(8), begin_ns=50 * S))
    pair.see(driven(seen, np.r_[np.zeros(8), np.ones(8)]))
    told = pair.tell(16 * STEP)
    assert (told.from_ns, told.to_ns) == (7 * STEP, 8 * STEP)


@given(st.lists(st.integers(1, 10**10), min_size=1, max_size=300), st.integers(1, 80))
def test_what_is_kept_thins_with_age_and_is_bounded(gaps, most):
    stamps = [int(stamp) for stamp in np.cumsum(gaps)]
    kept = spread(stamps, most)
    assert kept == sorted(set(kept))
    assert kept[-1] == len(stamps) - 1
    assert len(kept) <= most
    oldest = stamps[kept[0]]
    for stamp in stamps:
        if stamp >= oldest:
            nearest = max(stamps[index] for index in kept if stamps[index] <= stamp)
            assert stamp - nearest <= max((stamps[-1] - nearest) // 4, 1)


@example([1, 1, 8192, 8191])
@given(st.lists(st.integers(1, 10**10), min_size=1, max_size=120))
def test_thinning_step_by_step_is_as_good_as_at_once(gaps):
    stamps, kept = [int(stamp) for stamp in np.cumsum(gaps)], []
    for stamp in stamps:
        kept.append(stamp)
        kept = [kept[index] for index in spread(kept, 10**6)]
    assert kept == [stamps[index] for index in spread(stamps, 10**6)]
