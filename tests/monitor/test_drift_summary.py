"""Counts, delays and errors of runs that are known one by one, and how they are shown."""

import csv
import io

import cv2
import numpy as np
import pytest

from monitor.drift_plots import pictures
from monitor.drift_summary import groups_of, stanford_points, summary_of
from monitor.drift_tables import drift_csv, drift_text, write
from pipeline.error_statistics import clopper_pearson
from pipeline.errors import CalibwatchError
from tests.monitor.test_drift_rows import HEADER, SAID, row


def wrong(number, **fields):
    given = {"kind": "combined", "label": "all axes", "drift": (0.5, 0.0, 0.5, 0.1, 0.0, 0.0)}
    told = {"state": "drifted", "code": "drift_confirmed", "told_s": 0.5, "suspected_s": 0.3, "called_s": 0.5}
    return row(number, **(given | told | fields))


def calling(rows):
    (found,) = summary_of(HEADER, rows).calling
    return found


def said(**fields):
    return SAID.model_copy(update=fields)


def test_runs_are_counted_by_what_they_end_with():
    rows = [
        *(row(k) for k in range(7)),
        row(7, state="drifted", called_s=0.4),
        row(8, state="suspect", called_s=None),
        row(9, state="unobservable", called_s=None),
        *(wrong(k, told_s=0.1 * k, called_s=0.1 * k) for k in range(1, 6)),
        wrong(6, state="healthy", told_s=None, called_s=0.9),
        wrong(7, state="suspect", told_s=None, called_s=None),
    ]
    found = calling(rows)
    assert (found.healthy, found.wrong, found.drives) == (10, 7, 1)
    assert (found.false_alarms.hits, found.told.hits, found.missed.hits) == (1, 5, 1)
    assert (found.not_called.hits, found.not_called.of, found.unobservable.hits) == (3, 17, 1)
    assert (found.not_called.low, found.not_called.high) == pytest.approx(clopper_pearson(3, 17))
    assert found.accuracy.value == pytest.approx(0.5 * (5 / 6 + 7 / 8))
    assert found.delay_s == pytest.approx((0.3, 0.5))
    assert found.called_s == pytest.approx((0.55, 0.9), abs=0.06)


def test_without_one_of_both_kinds_there_is_no_accuracy():
    assert calling([row(0)]).accuracy is None
    assert calling([row(0)]).roc is None
    assert calling([wrong(0)]).accuracy is None
    assert summary_of(HEADER, []).calling == ()


def test_the_curve_is_of_the_statistic_and_nothing_judged_raises_no_alarm():
    rows = [row(0, said=None), row(1, said=said(statistic=4.0)), wrong(2, said=said(statistic=9.0))]
    assert calling(rows).roc.area == 1.0
    assert calling([*rows, wrong(3, said=None)]).roc.area == pytest.approx((1 + 1 + 0.5 + 0) / 4)


def single(axis, amount, number, *, told, suspected=False):
    drift = [0.0] * 6
    drift[axis] = amount
    name = ("roll", "pitch", "yaw", "forward", "left", "up")[axis]
    label = f"{name} {amount:+g} {'deg' if axis < 3 else 'm'}"
    return row(
        number,
        kind="single",
        label=label,
        drift=tuple(drift),
        state="drifted" if told else "healthy",
        told_s=0.6 if told else None,
        suspected_s=0.5 if told or suspected else None,
    )


def test_the_smallest_drift_is_that_from_which_on_all_are_told():
    rows = []
    for amount, hits in ((0.1, 10), (0.25, 8), (0.5, 9), (1.0, 10), (2.0, 10)):
        rows += [
            single(2, amount * (-1) ** k, len(rows) + k, told=k < hits, suspected=True) for k in range(10)
        ]
    rows.append(single(4, 0.05, 99, told=False))
    found = {one.axis: one for one in summary_of(HEADER, rows).smallest}
    assert found["yaw"].told == 0.5  # not 0.1: a larger amount is missed
    assert found["yaw"].noticed == 0.1
    assert (found["yaw"].shares["0.25"].hits, found["yaw"].shares["0.25"].of) == (8, 10)
    assert found["left"].told is None
    assert found["up"].shares == {}


def test_a_slip_is_told_from_when_on_it_was_there():
    given = {"kind": "slip", "label": "yaw 0.25 deg", "since_s": 1.0, "state": "drifted"}
    rows = [
        row(0, **given, suspected_s=1.2, told_s=1.4),
        row(1, **given, suspected_s=1.0, told_s=1.0),
        row(2, **given, suspected_s=0.9, told_s=0.9),
        row(3, **(given | {"state": "suspect"}), suspected_s=1.5),
    ]
    found = summary_of(HEADER, rows)
    (cell,) = found.cells
    assert (cell.told.hits, cell.told.of, cell.noticed) == (2, 4, 4)
    assert cell.delay_s == pytest.approx(0.2)
    assert "| a | yaw 0.25 deg | 4 | 2/4 | 3 drifted, 1 suspect | 0.2 | 3 |" in drift_text(found)


def test_amounts_stand_in_their_order_and_those_that_were_not_run_nowhere():
    rows = [single(2, 1.0, 0, told=True), single(1, 0.25, 1, told=False), single(2, 0.5, 2, told=True)]
    text = drift_text(summary_of(HEADER, rows))
    assert "| drive | axis | 0.25 deg | 0.5 deg | 1 deg | found | suspected |" in text
    assert "| a | yaw | - | 1/1 | 1/1 | 0.5 deg | 0.5 deg |" in text
    assert "forward" not in text


def test_errors_fall_into_the_cells_of_the_stanford_diagram():
    """Reference of 0.2 deg and 5 cm is allowed; alert limits are 0.5 deg and 0.1 m."""
    cases = {
        # axis: (answer, truth, protection level, cell)
        0: (0.3, 0.0, 0.4, "nominal"),
        1: (0.0, 0.9, 0.8, "unavailable"),
        2: (1.2, 0.0, 0.7, "misleading"),
        3: (0.3, 0.0, 0.08, "hazardous"),
        4: (0.1, 0.0, 0.08, "nominal"),
    }
    answer, truth, level = [0.0] * 6, [0.0] * 6, [1.0] * 6
    for axis, (a, t, p, _) in cases.items():
        answer[axis], truth[axis], level[axis] = a, t, p
    one = wrong(0, drift=tuple(truth), said=said(drift=tuple(answer), protection_level=tuple(level)))
    (found,) = summary_of(HEADER, [one]).honest
    assert (found.axes, found.nominal, found.unavailable) == (5, 2, 1)
    assert (found.misleading, found.hazardous) == (2, 1)
    points = {point.axis: point for point in stanford_points(one)}
    assert "up" not in points  # not observable
    assert points["yaw"].error == pytest.approx(1.0)
    assert points["yaw"].sigmas == pytest.approx(1.2 / np.hypot(0.1, 0.2))
    assert points["left"].sigmas == pytest.approx(0.1 / np.hypot(0.01, 0.05))
    assert found.within_one == pytest.approx(0.0)
    assert found.within_two == pytest.approx(2 / 5)


@pytest.mark.parametrize("kind", ["ramp", "vibration", "time-offset", "focal", "slip"])
def test_estimates_are_not_held_against_a_truth_that_did_not_hold(kind):
    assert stanford_points(row(0, kind=kind)) == []


def several():
    return [
        row(0),
        row(0, drive="b"),
        row(0, drive="simulated 0/0", simulated=True),
        wrong(1, drive="simulated 0/1", simulated=True),
        wrong(1),
        wrong(2, kind="focal", label="+1 %", said=None),
        *(single(2, amount, 10 + k, told=k > 1) for k, amount in enumerate((0.1, 0.25, -0.5, 1.0))),
        *(single(5, amount, 20 + k, told=k > 1) for k, amount in enumerate((0.01, 0.05, -0.1, 0.2))),
    ]


def test_recorded_drives_stand_alone_and_together_simulated_ones_together():
    assert {name: len(rows) for name, rows in groups_of(several()).items()} == {
        "a": 11,
        "b": 1,
        "recorded": 12,
        "simulated": 2,
    }
    drives = {one.group: one.drives for one in summary_of(HEADER, several()).calling}
    assert drives == {"a": 1, "b": 1, "recorded": 2, "simulated": 2}


def test_everything_is_shown(tmp_path):
    rows = several()
    found = summary_of(HEADER, rows)
    text = drift_text(found)
    for line in (
        "| a | 1 | 1 | 1 | 0 (0 to 98 %) | 1 (3 to 100 %) | 0 (0 to 98 %) | 100.0 % (1 to 100) |",
        "| recorded | yaw | 0/1 | 0/1 | 1/1 | 1/1 | 0.5 deg | 0.5 deg |",
        "| a | up | 0/1 | 0/1 | 1/1 | 1/1 | 0.1 m | 0.1 m |",
        "| recorded | +1 % | 1 | 1/1 | 1 drift_confirmed | 0.5 | - |",
    ):
        assert line in text
    assert "nan" not in text.lower()
    table = list(csv.DictReader(io.StringIO(drift_csv(found))))
    assert {(one["group"], one["kind"]) for one in table} >= {("a", "focal"), ("simulated", "combined")}
    assert sum(int(one["runs"]) for one in table if one["group"] != "recorded") == len(rows)
    drawn = pictures(found, rows)
    assert drawn.keys() == {"calling", "stanford"}  # the last group has no single axes
    for data in drawn.values():
        assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) is not None
    write(tmp_path, found, drawn)
    assert {path.name for path in tmp_path.iterdir()} == {
        "drift.md",
        "drift.csv",
        "drift.json",
        "drift_calling.png",
        "drift_stanford.png",
    }
    with pytest.raises(CalibwatchError, match="absent"):
        write(tmp_path / "absent", found, drawn)


def test_pictures_show_points_where_they_belong():
    """An error twice the alert limit with a protection level at it lies right of the diagonal."""
    one = row(0, said=said(drift=(1.2, 0.0, 0.0, 0.0, 0.0, 0.0)))
    drawn = pictures(summary_of(HEADER, [one]), [one])
    assert drawn.keys() == {"stanford"}
    assert pictures(summary_of(HEADER, []), []) == {}
    axes = [single(2, 0.5, 0, told=True), single(5, 0.1, 1, told=False)]
    assert pictures(summary_of(HEADER, axes), axes).keys() == {"axes", "stanford"}
