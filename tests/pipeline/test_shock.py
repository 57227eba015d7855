import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from pipeline import se3, shock
from pipeline.belief import believe
from pipeline.edge_search import EdgeWitnessParameters
from pipeline.edge_witness import far_extrinsics
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import FramePair
from pipeline.run_length import AlarmBudget
from pipeline.shock import Alertness, ShockParameters, believed, find_shock, heeded, weighed
from pipeline.step_seeker import StepSeeker
from pipeline.watch import Watch

P = ShockParameters()
BUDGET = AlarmBudget()
TENTH = 100_000_000
ZERO = np.zeros(6)


@pytest.fixture(scope="module")
def second(drive, limits):
    """The frames of a second of driving as a watch keeps them, and their mount."""
    p = drive.parameters
    mount = Mount(p.camera, p.T_stored, p.T_vehicle_lidar, math.radians(0.1), 0.02, limits, ("yaw", "pitch"))
    rhythm = dataclasses.replace(Parameters().window, least_frames=10**6)
    watch = Watch(mount, dataclasses.replace(Parameters(), window=rhythm), None)
    for frame in (drive.frame(k) for k in range(len(drive))):
        pair = FramePair("front", frame.cloud, frame.image, frame.cloud_stamp_ns, frame.image_stamp_ns, 0.1)
        watch.step(pair)
    # The street's own clock is known; what a step of it would feign has a test of its own.
    return [dataclasses.replace(frame, feigned=ZERO) for frame in watch.edge_frames], mount


def moved(frames, mount, step, first):
    """The frames as if the mount had moved by ``step`` (6,), vehicle axes, before number ``first``."""
    xi = se3.vehicle_block(mount.R_vehicle_cam).T @ step
    M = se3.inverse(mount.T_cam_lidar) @ se3.retract(mount.T_cam_lidar, -xi)

    def seen(frame):
        position = se3.apply(M, frame.edges.position)
        direction = frame.edges.direction @ M[:3, :3].T
        edges = dataclasses.replace(frame.edges, position=position, direction=direction)
        return dataclasses.replace(frame, edges=edges)

    return [*frames[:first], *(seen(frame) for frame in frames[first:])]


def chance_of(mount):
    """Extrinsics of chance."""
    return tuple(far_extrinsics(mount.T_cam_lidar, EdgeWitnessParameters(), np.random.default_rng(0)))


def found(frames, mount, step, first=5):
    alertness = Alertness((), frames[first].stamp_ns, 5, ZERO)
    B = se3.vehicle_block(mount.R_vehicle_cam)
    args = mount.camera, mount.T_cam_lidar, B, chance_of(mount), EdgeWitnessParameters(), P
    return find_shock(moved(frames, mount, step, first), alertness, *args)


def sure_step():
    """A step that is believed."""
    return shock.Shock(
        xi=ZERO,
        covariance=np.eye(6),
        statistic=46.0,
        apart=46.0,
        lost=0.1,
        preference=4.0,
        contrast=0.5,
        peak=8.0,
        before_ns=0,
        since_ns=1,
    )


def test_no_step_is_found_where_there_is_none(second):
    nothing = found(*second, ZERO)
    assert nothing.statistic < stats.chi2.isf(0.01, 6)
    assert nothing.lost < P.least_lost
    assert not believed(nothing, BUDGET, P)


@pytest.mark.parametrize(("axis", "size"), [(2, 0.25), (1, -0.5), (3, 0.2), (4, 0.1), (5, -0.1)])
def test_a_small_step_is_found_in_half_a_second_and_measured(second, axis, size):
    frames, mount = second
    step = (math.radians(size) if axis < 3 else size) * np.eye(6)[axis]
    told = found(frames, mount, step)
    assert believed(told, BUDGET, P)
    assert (told.before_ns, told.since_ns) == (frames[4].stamp_ns, frames[5].stamp_ns)
    B = se3.vehicle_block(mount.R_vehicle_cam)
    error = B @ told.xi - step
    assert np.abs(error[:3]).max() < math.radians(0.2)
    assert np.abs(error[3:]).max() < 0.05
    assert float(error @ np.linalg.solve(B @ told.covariance @ B.T, error)) < stats.chi2.isf(1e-3, 6)


def test_a_step_that_a_clock_may_feign_is_not_believed(second):
    frames, mount = second
    step = 0.2 * np.eye(6)[3]
    doubted = [dataclasses.replace(frame, feigned=0.2 * np.eye(6)[3]) for frame in frames]
    assert believed(found(frames, mount, step), BUDGET, P)
    assert not believed(found(doubted, mount, step), BUDGET, P)
    aside = found(doubted, mount, 0.1 * np.eye(6)[4])
    assert believed(aside, BUDGET, P)


def test_what_is_left_of_a_step_is_its_least_over_all_time_offsets(second):
    """Brute force over the offset, against the closed form."""
    frames, mount = second
    feigned = np.array([0.001, 0.0, 0.002, 0.05, 0.01, 0.0])
    told = found([dataclasses.replace(f, feigned=feigned) for f in frames], mount, 0.1 * np.eye(6)[4])
    B = se3.vehicle_block(mount.R_vehicle_cam)
    offsets = np.linspace(-10.0, 10.0, 20_001)
    left = (B @ told.xi)[:, None] - feigned[:, None] * offsets
    P_inverse = np.linalg.inv(B @ told.covariance @ B.T)
    least = np.einsum("in,ij,jn->n", left, P_inverse, left).min()
    assert told.apart == pytest.approx(least, rel=1e-4)
    assert told.apart < told.statistic


def test_at_standstill_no_clock_can_feign_a_step(second):
    told = found(*second, 0.1 * np.eye(6)[4])
    assert told.apart == told.statistic


def test_a_mount_that_lies_elsewhere_in_each_frame_is_known_the_less(second):
    frames, mount = second
    calm = found(frames, mount, ZERO)
    shaken = list(frames)
    for number, size in enumerate([0.2, -0.15, 0.1, -0.2, 0.05, 0.15, -0.1, 0.2, -0.2, -0.05]):
        shaken[number : number + 1] = moved([frames[number]], mount, math.radians(size) * np.eye(6)[1], 0)
    wild = found(shaken, mount, ZERO)
    assert not believed(wild, BUDGET, P)
    assert wild.covariance[0, 0] > 1.5 * calm.covariance[0, 0]


def test_a_side_with_too_few_frames_or_with_other_objects_says_nothing(second):
    frames, mount = second
    assert found(frames, mount, ZERO, first=4) is None
    assert found(frames, mount, ZERO, first=6) is None
    far = [dataclasses.replace(f, distance_m=f.distance_m - 50.0) for f in frames[:5]]
    assert found([*far, *frames[5:]], mount, ZERO) is None


@pytest.mark.parametrize(
    "change",
    [{"statistic": 45.0}, {"lost": 0.02}, {"preference": 1.9}, {"contrast": 0.14}, {"peak": 3.6}],
    ids=["chance", "score", "cells", "contrast", "peak"],
)
def test_each_doubt_alone_is_enough_not_to_believe_it(change):
    sure = sure_step()
    assert stats.chi2.sf(46.0, 6) * BUDGET.yearly_scenes < BUDGET.yearly_alarms
    assert believed(sure, BUDGET, P)
    assert not believed(dataclasses.replace(sure, **change), BUDGET, P)


def test_a_step_is_sought_until_it_is_far_from_any_belief():
    opened = Alertness((), 1, 5, ZERO)
    sure = sure_step()
    assert weighed(opened, None, BUDGET, P) is opened
    once = weighed(opened, sure, BUDGET, P)
    assert (once.found, once.since_ns) == (1, 1)
    assert weighed(once, sure, BUDGET, P).found == 2
    near = weighed(once, dataclasses.replace(sure, statistic=40.0), BUDGET, P)
    assert (near.found, near.since_ns) == (0, 1)
    assert weighed(once, dataclasses.replace(sure, statistic=20.0), BUDGET, P).since_ns is None


def heard(responses, alertness=None, begin=0):
    alertness = Alertness() if alertness is None else alertness
    for number, response in enumerate(responses):
        alertness = heeded(alertness, (begin + number) * TENTH, response, ZERO, P)
    return alertness


CALM = [0.30, 0.31, 0.29, 0.30, 0.32, 0.30, 0.29, 0.31]


def test_responses_that_fall_together_open_the_search_at_the_first_of_them():
    assert heard([*CALM, 0.30, 0.31, 0.29]).since_ns is None
    assert heard([*CALM, 0.31, 0.30, 0.22]).since_ns is None
    assert heard([*CALM, 0.25, 0.24, 0.25]).since_ns == len(CALM) * TENTH
    late = heard([*CALM, 0.31, 0.25, 0.24])
    assert (late.since_ns, late.after) == ((len(CALM) + 1) * TENTH, 2)
    assert heard([0.24] * 11).since_ns is None


def test_a_step_just_after_what_was_taken_for_one_is_sought_too():
    opened = heard([*CALM, 0.27, 0.27, 0.27, 0.30, 0.31])
    assert opened.since_ns == len(CALM) * TENTH
    far = dataclasses.replace(sure_step(), statistic=3.0, apart=3.0, lost=0.0, preference=0.0)
    let_go = weighed(opened, far, BUDGET, P)
    assert let_go.since_ns is None
    assert heard([0.22, 0.23, 0.22], let_go, begin=13).since_ns == 13 * TENTH


def test_a_step_soon_after_the_beginning_opens_the_search_too():
    assert heard([*CALM[:5], 0.25, 0.24, 0.25]).since_ns == 5 * TENTH
    assert heard([*CALM[:4], 0.25, 0.24, 0.25]).since_ns is None


def test_the_search_ends_and_is_opened_by_new_responses_only():
    opened = heard([*CALM, 0.25, 0.24, 0.25])
    still = heard([0.25] * 10, opened, begin=11)
    assert still.since_ns == opened.since_ns
    over = heard([0.25] * 12, still, begin=len(CALM) + 21)
    assert over.since_ns is None
    assert heard([*CALM, *CALM, 0.2, 0.2, 0.2], over, begin=60).since_ns == 76 * TENTH


def replayed(frames, seconds):
    """The frames in an order without a trend, as if a standing vehicle saw one after the other."""
    mixed = [frames[number] for number in (5, 2, 7, 0, 9, 4, 1, 8, 3, 6)]
    stamps = [seconds * 10 * TENTH + number * TENTH for number in range(10)]
    return [
        dataclasses.replace(f, stamp_ns=stamp, distance_m=0.0) for f, stamp in zip(mixed, stamps, strict=True)
    ]


def sought(second, step):
    """What a seeker says after each of two judgements, when the mount moves after a second."""
    frames, mount = second
    calm, after = replayed(frames, 0), moved(replayed(frames, 1), mount, step, 0)[:7]
    belief = believe(mount, Parameters(), calm, [])
    seeker = StepSeeker(mount, Parameters())
    for frame in [*calm, *after]:
        seeker.see(frame, belief)
    due = seeker.due
    said = [seeker.said([*calm, *after], belief, after[-1].stamp_ns) for _ in range(2)]
    return seeker, due, said


def test_a_seeker_tells_a_step_at_the_second_judgement_that_finds_it(second):
    seeker, due, (once, twice) = sought(second, math.radians(0.5) * np.eye(6)[2])
    assert due
    assert once is None
    assert twice.alarming
    assert twice.over == "the last 0.6 s"
    assert twice.drift[2] == pytest.approx(math.radians(0.5), abs=math.radians(0.1))
    assert twice.onset.from_ns < twice.onset.stamp_ns == twice.onset.to_ns
    seeker.forget()
    assert not seeker.due


def test_a_seeker_blames_the_mount_only_where_no_jump_of_the_clock_explains_the_step(second):
    frames, mount = second
    driven = [dataclasses.replace(frame, feigned=0.03 * np.eye(6)[3]) for frame in frames]
    _, _, (_, ahead) = sought((driven, mount), 0.4 * np.eye(6)[3])
    assert (ahead.alarming, ahead.suspicious, ahead.timed) == (False, True, True)
    _, _, (_, aside) = sought((driven, mount), 0.2 * np.eye(6)[4])
    assert (aside.alarming, aside.suspicious, aside.timed) == (True, True, False)


def test_a_seeker_has_nothing_to_look_for_where_frames_respond_as_before(second):
    _, due, said = sought(second, ZERO)
    assert not due
    assert said == [None, None]
