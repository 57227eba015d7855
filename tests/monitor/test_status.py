import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

import monitor.status as module
from monitor.status import (
    AXIS_NAMES,
    EXIT_CODES,
    PRECEDENCE,
    STATES,
    AxisDrift,
    Status,
    exit_code,
    finite,
    first_in_precedence,
    json_schema,
    unit_of,
)
from pipeline.records import AXES

AXIS = {
    "value": 0.1,
    "sigma": 0.02,
    "protection_level": None,
    "alert_limit": 0.5,
    "detectable": 0.2,
    "observable": True,
    "monitored": False,
    "last_seen_ns": 1,
}
VALUES = dict.fromkeys(AXES, 0.0)
STATUS = {
    "schema": "calibwatch.status/1",
    "vehicle": "van-17",
    "pair": "front",
    "seq": 4,
    "stamp_ns": 1_317_042_145_123_456_789,
    "state": "suspect",
    "code": "first_threshold",
    "reason": "Yaw moves.",
    "since_ns": 1,
    "onset": {"stamp_ns": 1, "from_ns": 0, "to_ns": 2, "gradual": True},
    "severity": None,
    "drift": {"axes": "vehicle", "relative_to": "stored"} | dict.fromkeys(AXES, AXIS),
    "consequence": [
        {
            "range_m": 30.0,
            "shift_px": 4.0,
            "sigma_px": 0.5,
            "worst_px": None,
            "left_m": -0.2,
            "sigma_left_m": 0.02,
            "up_m": 0.0,
            "sigma_up_m": 0.02,
        }
    ],
    "witnesses": {"lines": {"drift": VALUES, "sigma": VALUES, "chi2": 1.0, "frames": 3}, "edges": None},
    "drive": {"scenes": 4, "drift": VALUES, "sigma": VALUES},
    "window": {
        "frames": 3,
        "span_s": 1.0,
        "lines_lane": 1,
        "lines_pole": 2,
        "lines_structure": 0,
        "left": {"past": 4, "repeats": 1},
    },
    "frames": {"received": 9, "used": 3, "dropped": {"no_partner": 6}},
    "rates": {"lidar_hz": 10.0, "camera_hz": None, "gap_ms": -2.0, "lines_hz": None, "edges_hz": None},
    "time_offset": {"ms": None, "sigma_ms": None, "separable": False},
    "timing_ms": {"masks": {"p50": 1.0, "p95": 2.0}},
    "extrinsic": {"hash": "ab", "version": "1"},
    "model": {"hash": None, "version": None},
    "software": "calibwatch 0.1.0",
    "outputs_lost": {"recording": "No space left on device"},
    "warnings": ["the sweeps turn the other way"],
}


def test_a_status_survives_json_to_the_nanosecond():
    text = Status.model_validate(STATUS).to_json()
    assert "\n" not in text
    assert json.loads(text) == STATUS


def test_the_committed_schema_is_that_of_the_model():
    committed = Path(module.__file__).with_name("status.schema.json").read_text()
    assert json.loads(committed) == json_schema(), (
        "renew it: python -c 'import json, monitor.status as s; "
        "print(json.dumps(s.json_schema(), indent=2, sort_keys=True))' > monitor/status.schema.json"
    )


def test_the_schema_asks_for_every_field_and_allows_no_other():
    schema = json_schema()
    assert set(schema["required"]) == set(STATUS) == set(schema["properties"])
    assert schema["additionalProperties"] is False
    assert set(schema["$defs"]["Drift"]["required"]) == {"axes", "relative_to", *AXES}
    assert set(schema["$defs"]["AxisDrift"]["required"]) == set(AXIS)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["value", "sigma", "protection_level", "alert_limit", "detectable"])
def test_numbers_are_finite_or_null(field, bad):
    with pytest.raises(ValidationError):
        AxisDrift.model_validate(AXIS | {field: bad})


@pytest.mark.parametrize(
    "change",
    [
        {"vehicle": "a/b"},
        {"pair": ""},
        {"pair": "x" * 65},
        {"state": "fine"},
        {"code": "Two Words"},
        {"reason": ""},
        {"seq": -1},
        {"severity": "huge"},
        {"unknown": 1},
        {"schema": "calibwatch.status/2"},
        {"frames": {"received": -1, "used": 0, "dropped": {}}},
    ],
    ids=str,
)
def test_what_is_not_a_status_is_refused(change):
    with pytest.raises(ValidationError):
        Status.model_validate(STATUS | change)


def test_axes_are_those_of_the_pipeline_in_its_order():
    assert AXIS_NAMES == AXES
    assert tuple(name for name, _ in Status.model_validate(STATUS).drift.items()) == AXES
    assert [unit_of(name) for name in AXIS_NAMES] == ["deg"] * 3 + ["m"] * 3


def test_every_state_has_a_rank_and_an_exit_code():
    assert sorted(PRECEDENCE) == sorted(STATES)
    assert set(EXIT_CODES) == set(STATES)
    assert [state for state in STATES if exit_code(state) == 0] == ["healthy"]
    assert [state for state in STATES if exit_code(state) == 3] == ["drifted"]


@given(st.lists(st.sampled_from(STATES)))
def test_precedence_takes_the_first_present_and_nothing_else(states):
    told = first_in_precedence(states)
    if not states:
        assert told == "starting"
        return
    assert told in states
    assert all(PRECEDENCE.index(told) <= PRECEDENCE.index(state) for state in states)


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_finite_keeps_finite_numbers_only(value):
    assert finite(value) == (value if math.isfinite(value) else None)
