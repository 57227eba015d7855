import dataclasses
import math
import typing

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import verdict
from pipeline.drift_test import Judgement
from pipeline.onset import Onset
from pipeline.opinions import Steady
from pipeline.records import AXES
from pipeline.verdict import CODES, State, VerdictParameters, acknowledge, advance, start

S = 1_000_000_000
P = VerdictParameters()
LIMITS = np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.20, 0.15, 0.15])
UNHEARD = ("no_scan_pattern", "The clouds show no rings.")
REQUIRED = ("pitch", "yaw")


def judgement(
    yaw_deg=0.0,
    *,
    alarming=False,
    suspicious=False,
    blind=False,
    ambiguous=False,
    contradicted=False,
    monitored=AXES,
    excluded=AXES,
    observable=AXES,
):
    """A judgement with the given signs; sigma 0.05 deg and 1 cm, yaw the only drift."""
    drift = np.zeros(6)
    drift[2] = math.radians(yaw_deg)
    sigma = np.array([math.radians(0.05)] * 3 + [0.01] * 3)
    marks = [np.array([axis in names for axis in AXES]) for names in (observable, monitored, excluded)]
    return Judgement(
        drift, sigma, 0.5 * LIMITS, LIMITS, *marks, 0.0, alarming, suspicious, blind, ambiguous, contradicted
    )


QUIET = judgement()
SUSPICIOUS = judgement(0.3, suspicious=True)
ALARM = judgement(0.9, alarming=True, suspicious=True)
BLIND = judgement(blind=True, monitored=(), observable=())
AMBIGUOUS = judgement(1.3, blind=True, ambiguous=True, monitored=(), observable=())
UNMONITORED = judgement(monitored=("pitch", "roll"))
DOUBTFUL = judgement(0.4, excluded=("pitch",))
CONTRADICTED = judgement(0.9, suspicious=True, contradicted=True)
EVERY = (QUIET, SUSPICIOUS, ALARM, BLIND, AMBIGUOUS, UNMONITORED, DOUBTFUL, CONTRADICTED)


def after(memory, judged, now_ns, window_ns=3 * S, required=REQUIRED):
    """The memory after one more pair and its judgement."""
    memory = verdict.paired(memory, now_ns)
    return advance(memory, judged, (now_ns - window_ns, now_ns), required, LIMITS, P)


def steady(yaw_deg, *, alarming=False, suspicious=True):
    drift = math.radians(yaw_deg) * np.eye(6)[2]
    return Steady(alarming, suspicious, drift, np.full(6, 1e-3), "12 scenes", Onset(5 * S, 4 * S, 6 * S))


def test_all_scenes_together_tell_what_no_window_does():
    memory = verdict.paired(walked(QUIET, QUIET), 3 * S)
    window_ns = 2 * S, 3 * S
    doubted = advance(memory, QUIET, window_ns, REQUIRED, LIMITS, P, steady(0.2))
    assert (doubted.state, doubted.code) == ("suspect", "evidence_of_drift")
    assert doubted.reason == "Over 12 scenes the mount may have moved: yaw +0.20 deg (sigma 0.06)."
    told = advance(memory, QUIET, window_ns, REQUIRED, LIMITS, P, steady(0.2, alarming=True))
    assert (told.state, told.severity, told.onset) == ("drifted", "minor", Onset(5 * S, 4 * S, 6 * S))
    major = advance(memory, QUIET, window_ns, REQUIRED, LIMITS, P, steady(0.6, alarming=True))
    assert major.severity == "major"
    calm = advance(memory, QUIET, window_ns, REQUIRED, LIMITS, P, steady(0.2, suspicious=False))
    assert calm.state == "healthy"


OTHER_CAUSES = ("time_offset", "intrinsics_changed", "forward_or_sync", "cause_open")


def doubted(memory, code, judged, sum_of_scenes=None):
    """The memory a second later, with a doubt whether it is the mount that moved."""
    now_ns = memory.input_ns + S
    window_ns = now_ns - 3 * S, now_ns
    doubt = verdict.Doubt(code, "Images come late.")
    memory = verdict.paired(memory, now_ns)
    return advance(memory, judged, window_ns, REQUIRED, LIMITS, P, sum_of_scenes, doubt)


@pytest.mark.parametrize("code", OTHER_CAUSES)
def test_no_drift_is_told_while_something_else_may_have_changed(code):
    memory = walked(QUIET, ALARM, ALARM)
    for _ in range(5):
        memory = doubted(memory, code, ALARM, steady(0.6, alarming=True))
        assert (memory.state, memory.code, memory.reason) == ("suspect", code, "Images come late.")
    assert memory.alarms == 0
    # Once the doubt is gone, alarms are counted from the start.
    assert [walked(*[ALARM] * n, begin=8 * S, memory=memory).state for n in (1, 2, 3)] == [
        "suspect",
        "suspect",
        "drifted",
    ]


def test_something_else_that_surely_changed_is_told_though_windows_are_quiet():
    assert told(doubted(walked(QUIET), "time_offset", QUIET)) == ("suspect", "time_offset")


def test_a_doubt_neither_opens_a_latch_nor_hides_a_contradiction():
    assert told(doubted(drifted(), "time_offset", ALARM)) == ("drifted", "drift_confirmed")
    assert told(doubted(walked(QUIET), "time_offset", CONTRADICTED)) == ("suspect", "witnesses_disagree")


def walked(*judgements, begin=0, memory=None):
    """The memory after judgements a second apart, the first a second after ``begin``."""
    memory = start(begin) if memory is None else memory
    for k, judged in enumerate(judgements, 1):
        memory = after(memory, judged, begin + k * S)
    return memory


def told(memory):
    return memory.state, memory.code


@pytest.mark.parametrize(
    ("judgements", "expected"),
    [
        ((), "collecting"),
        ((QUIET,), "within_limits"),
        ((SUSPICIOUS,), "evidence_of_drift"),
        ((ALARM,), "evidence_of_drift"),
        ((ALARM, ALARM), "evidence_of_drift"),
        ((ALARM, ALARM, ALARM), "drift_confirmed"),
        ((QUIET, ALARM, ALARM, ALARM), "drift_confirmed"),
        ((ALARM, ALARM, QUIET, ALARM, ALARM), "evidence_of_drift"),
        ((ALARM, ALARM, BLIND, ALARM, ALARM), "evidence_of_drift"),
        ((ALARM, ALARM, CONTRADICTED, ALARM), "evidence_of_drift"),
        ((ALARM, ALARM, SUSPICIOUS, ALARM), "evidence_of_drift"),
        ((SUSPICIOUS, QUIET), "within_limits"),
        ((CONTRADICTED,), "witnesses_disagree"),
        ((CONTRADICTED, QUIET), "within_limits"),
        ((DOUBTFUL,), "within_stored_uncertainty"),
        ((DOUBTFUL, QUIET), "within_limits"),
        ((BLIND,), "collecting"),
        ((UNMONITORED,), "collecting"),
        ((QUIET, BLIND), "within_limits"),
        ((QUIET, UNMONITORED), "within_limits"),
        ((SUSPICIOUS, BLIND), "nothing_in_common"),
        ((SUSPICIOUS, UNMONITORED), "axes_not_monitored"),
        ((UNMONITORED,) * 9, "collecting"),
        ((UNMONITORED,) * 10, "axes_not_monitored"),
        ((BLIND,) * 9, "collecting"),
        ((BLIND,) * 10, "nothing_in_common"),
        ((AMBIGUOUS,) * 10, "ambiguous"),
        ((QUIET, *(UNMONITORED,) * 9), "within_limits"),
        ((QUIET, *(UNMONITORED,) * 10), "axes_not_monitored"),
        ((QUIET, *(BLIND,) * 10), "nothing_in_common"),
        ((*(BLIND,) * 10, QUIET), "within_limits"),
        ((*(UNMONITORED,) * 10, SUSPICIOUS), "evidence_of_drift"),
        ((ALARM, ALARM, ALARM, QUIET, QUIET, QUIET), "drift_confirmed"),
        ((ALARM, ALARM, ALARM, *(BLIND,) * 20), "drift_confirmed"),
        ((ALARM, ALARM, ALARM, CONTRADICTED), "drift_confirmed"),
    ],
)
def test_walks(judgements, expected):
    assert told(walked(*judgements)) == (CODES[expected], expected)


def test_codes_belong_to_states_and_every_state_has_one():
    assert set(CODES.values()) == set(typing.get_args(State))


def drifted():
    return walked(QUIET, ALARM, ALARM, ALARM)


def test_every_code_can_be_told():
    no_pairs = verdict.finish(start(0), None, 0, REQUIRED, UNHEARD)
    memories = [
        walked(),
        walked(QUIET),
        walked(SUSPICIOUS),
        walked(DOUBTFUL),
        walked(CONTRADICTED),
        drifted(),
        verdict.finish(walked(UNMONITORED), UNMONITORED, 4, REQUIRED, UNHEARD),
        walked(*[UNMONITORED] * 10),
        walked(*[BLIND] * 10),
        walked(*[AMBIGUOUS] * 10),
        verdict.finish(start(0), None, 4, REQUIRED, UNHEARD),
        no_pairs,
        verdict.silent(walked(QUIET), 4 * S, P),
        verdict.faulted(walked(QUIET), "the disk is full", 4 * S),
        *(doubted(walked(QUIET), code, ALARM) for code in OTHER_CAUSES),
    ]
    assert {memory.code for memory in memories} == set(CODES)
    for memory in memories:
        assert memory.state == CODES[memory.code]
        assert memory.reason.endswith((".", "full"))


def test_state_keeps_its_since_and_a_new_code_inside_it_does_not_renew_it():
    memory = walked(QUIET, QUIET, SUSPICIOUS, DOUBTFUL, CONTRADICTED)
    assert (memory.state, memory.since_ns) == ("suspect", 3 * S)
    assert walked(QUIET, QUIET, QUIET).since_ns == S
    assert walked().since_ns == 0


def test_disagreeing_alarms_do_not_add_up():
    left, right = ALARM, judgement(-0.9, alarming=True, suspicious=True)
    assert walked(*[left, right] * 10).state == "suspect"
    assert walked(left, left, right, right, right).state == "drifted"
    # Two estimates agree within two sigma of their difference, 0.14 deg, on every axis.
    near, far = (judgement(0.9 + d, alarming=True, suspicious=True) for d in (0.14, 0.15))
    assert walked(left, near, near).state == "drifted"
    assert walked(left, far, far).state == "suspect"


def test_a_slowly_growing_drift_is_told():
    growing = [judgement(0.6 + 0.1 * k, alarming=True, suspicious=True) for k in range(6)]
    memory = walked(*growing)
    assert memory.state == "drifted"
    assert "yaw +0.80 deg" in memory.reason


@pytest.mark.parametrize(("yaw_deg", "severity"), [(0.4, "minor"), (0.6, "major")])
def test_severity_by_the_alert_limit_and_it_only_grows(yaw_deg, severity):
    alarm = judgement(yaw_deg, alarming=True, suspicious=True)
    memory = walked(alarm, alarm, alarm)
    assert memory.severity == severity
    assert walked(QUIET, alarm, begin=3 * S, memory=memory).severity == severity
    worse = judgement(-0.6, alarming=True, suspicious=True)
    assert walked(worse, alarm, begin=3 * S, memory=memory).severity == "major"


def test_what_is_blind_or_contradicted_makes_no_drift_worse():
    alarm = judgement(0.4, alarming=True, suspicious=True)
    memory = walked(alarm, alarm, alarm)
    blind = judgement(5.0, blind=True, monitored=(), observable=())
    wrong = judgement(5.0, suspicious=True, contradicted=True)
    assert walked(blind, wrong, begin=3 * S, memory=memory).severity == "minor"


def test_onset_lies_between_the_last_quiet_window_and_the_first_stir():
    memory = walked(QUIET, QUIET, SUSPICIOUS, ALARM, ALARM, ALARM)
    assert memory.onset == Onset(2 * S, -S, 3 * S)
    # A window of which half is older than the drift is quiet still: the interval holds its frames.
    late = after(after(walked(QUIET), QUIET, 5 * S, window_ns=S), ALARM, 6 * S)
    late = after(after(late, ALARM, 7 * S), ALARM, 8 * S)
    assert late.onset == Onset(5 * S, 4 * S, 6 * S)


def test_a_blind_stretch_before_the_first_alarm_is_inside_the_onset_interval():
    memory = walked(QUIET, BLIND, BLIND, BLIND, BLIND, ALARM, ALARM, ALARM)
    assert memory.onset.from_ns <= S
    assert memory.onset.to_ns == 6 * S


def test_a_drift_from_the_beginning_has_its_onset_there():
    memory = walked(ALARM, ALARM, ALARM)
    assert memory.onset.stamp_ns == memory.onset.from_ns == 0
    assert memory.onset.to_ns == S


def test_acknowledged_drift_starts_anew():
    memory = acknowledge(drifted(), 10 * S, "Ada", "bracket tightened")
    assert told(memory) == ("starting", "collecting")
    assert "Ada (bracket tightened)" in memory.reason
    assert (memory.severity, memory.onset, memory.since_ns) == (None, None, 10 * S)
    assert walked(QUIET, begin=10 * S, memory=memory).state == "healthy"
    again = walked(ALARM, ALARM, ALARM, begin=10 * S, memory=memory)
    assert again.state == "drifted"
    assert again.onset.from_ns == 10 * S
    # Unmonitored axes get their patience anew.
    assert walked(*[UNMONITORED] * 9, begin=10 * S, memory=memory).state == "starting"


@pytest.mark.parametrize("judged", [QUIET, SUSPICIOUS, CONTRADICTED, BLIND, DOUBTFUL])
def test_silence_makes_stale_and_pairs_bring_the_evidence_back(judged):
    memory = walked(judged)
    assert verdict.silent(memory, 3 * S - 1, P) is memory
    stale = verdict.silent(memory, 3 * S, P)
    assert told(stale) == ("stale", "no_input")
    assert stale.since_ns == 3 * S
    assert verdict.silent(stale, 9 * S, P) is stale
    back = verdict.paired(stale, 20 * S)
    assert told(back) == ("starting", "collecting")
    assert walked(*[UNMONITORED] * 9, begin=20 * S, memory=back).state == "starting"
    assert walked(*[UNMONITORED] * 10, begin=20 * S, memory=back).state == "unobservable"


def test_a_drift_outlives_silence_with_its_onset():
    stale = verdict.silent(drifted(), 60 * S, P)
    assert stale.state == "stale"
    back = verdict.paired(stale, 61 * S)
    assert told(back) == ("drifted", "drift_confirmed")
    assert back.onset is stale.onset
    assert back.severity == "major"
    # To note a drift brings no inputs back; when they come, nothing is left of it.
    noted = acknowledge(stale, 60 * S, "Ada", "bracket tightened")
    assert (noted.state, noted.severity, noted.onset) == ("stale", None, None)
    assert told(verdict.paired(noted, 61 * S)) == ("starting", "collecting")


def test_two_alarms_before_silence_and_one_after_are_not_three():
    stale = verdict.silent(walked(ALARM, ALARM), 20 * S, P)
    memory = walked(ALARM, begin=20 * S, memory=stale)
    assert memory.state == "suspect"


def test_fault_comes_first_and_ends_with_the_next_judgement():
    memory = verdict.faulted(walked(QUIET), "the model is missing", 2 * S)
    assert told(memory) == ("fault", "cannot_work")
    assert verdict.faulted(memory, "the model is missing", 3 * S) is memory
    other = verdict.faulted(memory, "the disk is full", 3 * S)
    assert (other.reason, other.since_ns) == ("the disk is full", 2 * S)
    assert verdict.silent(memory, 60 * S, P) is memory
    assert verdict.faulted(drifted(), "the disk is full", 9 * S).state == "fault"
    assert walked(QUIET, begin=5 * S, memory=memory).state == "healthy"


def test_a_drift_outlives_a_fault():
    memory = verdict.faulted(drifted(), "the disk is full", 9 * S)
    memory = walked(QUIET, begin=9 * S, memory=memory)
    assert told(memory) == ("drifted", "drift_confirmed")
    assert memory.onset == drifted().onset


@pytest.mark.parametrize(
    ("judged", "frames", "code"),
    [
        (None, 0, "no_pairs"),
        (None, 3, "no_scan_pattern"),
        (BLIND, 3, "nothing_in_common"),
        (AMBIGUOUS, 3, "ambiguous"),
        (UNMONITORED, 3, "too_short"),
        (QUIET, 1, "too_short"),
    ],
)
def test_a_recording_that_ends_in_starting_says_why(judged, frames, code):
    memory = verdict.finish(start(7), judged, frames, REQUIRED, UNHEARD)
    assert told(memory) == ("unobservable", code)
    if code == "too_short":
        assert f"{frames} frame" in memory.reason
        assert ("yaw is known to 0.25 deg only" in memory.reason) == (judged is UNMONITORED)


@pytest.mark.parametrize("judgements", [(), (QUIET,), (SUSPICIOUS,), (CONTRADICTED,)])
def test_without_evidence_what_was_known_lasts_as_long_as_patience(judgements):
    memory = walked(*judgements)
    begun_ns, patience = memory.input_ns, P.patience_ns // S
    for second in range(1, patience + 3):
        now_ns = begun_ns + second * S
        before, memory = memory, verdict.unheard(verdict.paired(memory, now_ns), *UNHEARD, now_ns, P)
        if second < patience - 2:
            assert told(memory) == told(before)
    assert told(memory) == ("unobservable", UNHEARD[0])


def test_without_evidence_a_drift_stands():
    memory = drifted()
    now_ns = memory.input_ns + 3600 * S
    assert verdict.unheard(verdict.paired(memory, now_ns), *UNHEARD, now_ns, P).state == "drifted"


@pytest.mark.parametrize("judgements", [(QUIET,), (SUSPICIOUS,), (ALARM,) * 3, (BLIND,) * 10])
def test_a_reached_verdict_stands_at_the_end(judgements):
    memory = walked(*judgements)
    assert verdict.finish(memory, judgements[-1], 20, REQUIRED, UNHEARD) is memory


def test_only_required_axes_are_asked_and_only_excluded_ones_named():
    memory = walked(judgement(monitored=("pitch", "yaw", "left"), excluded=("pitch", "yaw", "forward")))
    assert memory.reason == "Drift beyond the alert limits is excluded in pitch, yaw."
    assert walked(UNMONITORED).state == "starting"
    assert after(start(0), UNMONITORED, S, required=("pitch",)).state == "healthy"
    assert after(start(0), DOUBTFUL, S, required=("pitch",)).state == "healthy"
    assert after(start(0), QUIET, S, required=()).state != "healthy"


def test_an_axis_nobody_requires_is_not_healthy_with_an_estimate_beyond_its_limit():
    ahead = dataclasses.replace(QUIET, drift=0.24 * np.eye(6)[3])
    memory = walked(ahead)
    assert (memory.state, memory.code) == ("suspect", "within_stored_uncertainty")
    assert memory.reason.startswith("forward +0.240 m")
    unseen = dataclasses.replace(ahead, observable=np.array([a != "forward" for a in AXES]))
    assert walked(unseen).state == "healthy"


def test_axes_remember_when_they_were_last_seen():
    memory = walked(QUIET, judgement(observable=("yaw",)), BLIND)
    assert memory.last_seen_ns == (S, S, 2 * S, S, S, S)
    assert start(0).last_seen_ns == (None,) * 6


def test_a_clock_that_runs_back_leaves_no_stamp_in_the_future():
    memory = walked(QUIET, SUSPICIOUS, ALARM, begin=1000 * S)
    memory = verdict.paired(memory, 5 * S)
    stamps = (
        memory.since_ns,
        memory.stirred_ns,
        memory.quiet_ns,
        memory.quiet_from_ns,
        memory.monitored_ns,
        memory.input_ns,
    )
    assert max(stamps) <= 5 * S
    assert memory.last_seen_ns == (None,) * 6
    memory = walked(QUIET, ALARM, ALARM, ALARM, begin=5 * S, memory=memory)
    assert memory.onset.from_ns <= memory.onset.stamp_ns <= memory.onset.to_ns == 7 * S


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.sampled_from(range(len(EVERY))), st.integers(1, 4 * S)), max_size=25))
def test_any_walk_keeps_its_promises(steps):
    memory, now, run = start(0), 0, 0
    for kind, gap in steps:
        now += gap
        before = memory
        memory = verdict.silent(memory, now, P)
        stale = memory.state == "stale"
        memory = after(memory, EVERY[kind], now)
        run = (0 if stale else run) + 1 if EVERY[kind] is ALARM else 0
        assert memory.state == CODES[memory.code]
        assert memory.since_ns <= now
        assert (memory.severity is None) == (memory.onset is None)
        # 'drifted' is entered by three alarms in a row and never left.
        assert (memory.state == "drifted") == (before.severity is not None or run >= P.confirmations)
        if memory.onset is not None:
            assert isinstance(memory.onset, Onset)
            assert memory.onset.from_ns <= memory.onset.stamp_ns <= memory.onset.to_ns <= now
        if memory.state == "healthy":
            monitored = now - memory.monitored_ns
            assert monitored < P.patience_ns
