import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.status import STATES, Status
from monitor.wording import (
    NEXT_STEPS,
    OTHER_CAUSES,
    moved_axes,
    next_step,
    size_text,
    span_text,
    stamp_text,
    unchecked_text,
    verdict_sentence,
)
from pipeline.verdict import CODES

NOON = 1_317_042_145_000_000_000


def status(state="healthy", axes=(), **changes):
    quiet = {
        "value": 0.01,
        "sigma": 0.02,
        "protection_level": 0.1,
        "alert_limit": 0.5,
        "detectable": 0.15,
        "observable": True,
        "monitored": True,
        "last_seen_ns": NOON,
    }
    names = ("roll", "pitch", "yaw", "forward", "left", "up")
    drift = {name: quiet | dict(axes).get(name, {}) for name in names}
    return Status.model_validate(
        {
            "vehicle": "van-17",
            "pair": "front",
            "seq": 0,
            "stamp_ns": NOON,
            "state": state,
            "code": "some_code",
            "reason": "No pair came for 2 s.",
            "since_ns": NOON,
            "onset": None,
            "severity": None,
            "drift": {"axes": "vehicle", "relative_to": "stored", **drift},
            "witnesses": {"lines": None, "edges": None},
            "window": {"frames": 0, "span_s": 0, "lines_lane": 0, "lines_pole": 0, "lines_structure": 0},
            "frames": {"received": 0, "used": 0, "dropped": {}},
            "rates": {"lidar_hz": None, "camera_hz": None, "gap_ms": None},
            "time_offset": {"ms": None, "sigma_ms": None, "separable": False},
            "timing_ms": {},
            "extrinsic": {"hash": None, "version": None},
            "model": {"hash": None, "version": None},
            "software": "calibwatch",
        }
        | changes
    )


HELD = {"value": 0.0, "sigma": None, "protection_level": None, "observable": False, "monitored": False}
BLUNT = {"protection_level": 0.6, "monitored": False}


def test_drifted_names_axis_size_sigma_limit_since_when_and_what_was_not_checked():
    said = verdict_sentence(
        status(
            "drifted",
            {"yaw": {"value": -0.81, "sigma": 0.04}, "forward": HELD, "left": BLUNT},
            severity="major",
            onset={"stamp_ns": NOON + 10**9, "from_ns": NOON, "to_ns": NOON + 3 * 10**9},
        )
    )
    assert said == (
        "front is drifted (major): yaw -0.81 deg (sigma 0.04 deg, limit 0.50 deg), since 2011-09-26 "
        "13:02:26.0 UTC (between 2011-09-26 13:02:25.0 and 13:02:28.0 UTC); not checked: "
        "forward (not observable); left (too uncertain to exclude a drift of the limit)."
    )


def test_a_drift_that_grew_is_told_to_grow():
    onset = {"stamp_ns": NOON + 10**9, "from_ns": NOON, "to_ns": NOON + 3 * 10**9, "gradual": True}
    said = verdict_sentence(status("drifted", {"yaw": {"value": -0.81}}, severity="major", onset=onset))
    assert "growing since 2011-09-26 13:02:26.0 UTC (between" in said


def test_healthy_names_the_axes_that_were_checked_and_no_other():
    said = verdict_sentence(status("healthy", {"forward": HELD, "up": BLUNT}))
    claim, rest = said.split("; not checked: ")
    assert all(f"{name} +0.01" in claim for name in ("roll", "pitch", "yaw", "left"))
    assert "forward" not in claim
    assert "up " not in claim
    assert rest == "forward (not observable); up (too uncertain to exclude a drift of the limit)."
    assert verdict_sentence(status()).endswith("; all six axes were checked.")


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ("stale", "front is stale since 2011-09-26 13:02:25.0 UTC: no pair came for 2 s."),
        ("fault", "front is not being watched since 2011-09-26 13:02:25.0 UTC: no pair came for 2 s."),
        ("starting", "front is not judged yet: no pair came for 2 s."),
    ],
)
def test_states_without_a_claim_give_their_reason_and_claim_nothing(state, said):
    assert verdict_sentence(status(state)) == said


def test_an_abbreviation_keeps_its_capitals():
    assert verdict_sentence(status("fault", reason="LiDAR is silent.")).endswith(": LiDAR is silent.")


@pytest.mark.parametrize("state", STATES)
def test_every_state_has_one_sentence_and_a_next_step(state):
    said = verdict_sentence(
        status(state, dict.fromkeys(("roll", "pitch", "yaw", "forward", "left", "up"), HELD))
    )
    assert said.startswith("front is ")
    assert said.endswith(".")
    assert ".." not in said
    assert NEXT_STEPS[state].count("`") % 2 == 0


def test_the_axes_beyond_their_limit_come_worst_first():
    axes = {"roll": {"value": 0.6}, "yaw": {"value": -0.9}, "up": {"value": 0.3, "sigma": 0.001}}
    assert moved_axes(status("drifted", axes)) == ("yaw", "roll")


def test_within_the_limits_the_axes_that_surely_moved_are_named():
    axes = {"pitch": {"value": 0.2, "sigma": 0.02}, "left": {"value": 0.3, "sigma": 0.09}}
    assert moved_axes(status("drifted", axes)) == ("pitch", "left")
    axes["left"] = {"value": 0.3, "sigma": 0.2}
    assert moved_axes(status("drifted", axes)) == ("pitch",)


def test_an_axis_that_is_held_is_never_said_to_have_moved():
    axes = {"yaw": HELD | {"value": 3.0, "sigma": 2.0}, "up": {"value": 0.1, "sigma": 0.01}}
    assert moved_axes(status("drifted", axes)) == ("up",)


def test_sizes_carry_sign_and_unit():
    assert size_text("yaw", 0.5, sign=True) == "+0.50 deg"
    assert size_text("up", -0.0412, sign=True) == "-0.041 m"
    assert size_text("up", 0.2) == "0.200 m"
    assert size_text("yaw", -0.001, sign=True) == "+0.00 deg"
    assert size_text("up", None) == "unknown"


@pytest.mark.parametrize(
    ("stamp_ns", "text"),
    [
        (NOON + 999_999_999, "2011-09-26 13:02:25.9 UTC"),
        (12_340_000_000, "12.3 s"),
        (0, "0.0 s"),
        (-1_500_000_000, "-1.5 s"),
    ],
)
def test_stamps(stamp_ns, text):
    assert stamp_text(stamp_ns) == text


@given(st.integers(-(2**70), 2**70), st.integers(-(2**70), 2**70))
def test_no_stamp_is_too_strange_to_tell(first, last):
    assert " and " in span_text(first, last)
    assert stamp_text(first)


def test_a_span_tells_what_both_share_once():
    assert span_text(NOON, NOON + 10**9) == "2011-09-26 13:02:25.0 and 13:02:26.0 UTC"
    assert span_text(10**9, 2 * 10**9) == "1.0 s and 2.0 s"
    day = 86_400 * 10**9
    assert span_text(NOON, NOON + day) == "2011-09-26 13:02:25.0 UTC and 2011-09-27 13:02:25.0 UTC"


@pytest.mark.parametrize("code", OTHER_CAUSES)
def test_another_cause_is_told_by_its_reason_and_has_a_step_of_its_own(code):
    assert CODES[code] == "suspect"
    doubted = status("suspect", {"forward": {"value": 0.4}}, code=code, reason="Images come 30 ms late.")
    assert ": images come 30 ms late" in verdict_sentence(doubted)
    assert "forward +0.4" not in verdict_sentence(doubted)
    assert next_step(doubted) == OTHER_CAUSES[code] != NEXT_STEPS["suspect"]


def test_any_other_suspicion_asks_for_more_evidence():
    doubted = status("suspect", {"forward": {"value": 0.4}}, code="evidence_of_drift")
    assert "forward +0.4" in verdict_sentence(doubted)
    assert next_step(doubted) == NEXT_STEPS["suspect"]


def test_commands_that_are_named_exist():
    known = {"baseline", "calibrate", "extrinsic", "inspect", "config"}
    named = [
        text for step in (*NEXT_STEPS.values(), *OTHER_CAUSES.values()) for text in step.split("`")[1::2]
    ]
    assert {text.split()[1] for text in named} <= known
    assert all(text.startswith("calibwatch ") for text in named)


def test_an_axis_that_moved_is_not_among_the_unchecked():
    axes = {"yaw": BLUNT | {"value": 0.8}, "roll": BLUNT}
    assert unchecked_text(status("drifted", axes)).startswith("not checked: roll (too")
    assert unchecked_text(status("unobservable", axes)).startswith("not checked: roll, yaw (too")


def test_all_checked_is_said_only_when_all_are_monitored():
    assert unchecked_text(status()) == "all six axes were checked"
    assert unchecked_text(status(axes={"roll": BLUNT})).startswith("not checked: roll")


def at_30_m(**values):
    at = {
        "range_m": 30.0,
        "shift_px": 4.0,
        "sigma_px": 0.5,
        "worst_px": 6.24,
        "left_m": 0.0,
        "sigma_left_m": 0.0,
        "up_m": 0.0,
        "sigma_up_m": 0.0,
    }
    return (at | values,)


@pytest.mark.parametrize(
    ("values", "clause"),
    [
        ({"left_m": 0.26}, "points lie up to 6.2 px off and things stand 0.26 m to the left of where"),
        ({"left_m": -0.26, "up_m": 0.1}, "and things stand 0.26 m to the right of where they are put"),
        ({"up_m": 0.3}, "and things stand 0.30 m above where they are put"),
        ({"up_m": -0.3, "worst_px": None}, "; 30 m away things stand 0.30 m below where they are put"),
        ({}, "; 30 m away points lie up to 6.2 px off; "),
    ],
)
def test_a_drift_says_what_it_does_30_m_away(values, clause):
    told = verdict_sentence(status("drifted", {"yaw": {"value": 0.8}}, consequence=at_30_m(**values)))
    assert clause in told
    assert "30 m" not in verdict_sentence(status("healthy", consequence=at_30_m(**values)))
    nothing = at_30_m(worst_px=None)
    assert "30 m" not in verdict_sentence(status("drifted", {"yaw": {"value": 0.8}}, consequence=nothing))
