import json

import pytest

from monitor.events import EndEvent, StatusEvent
from monitor.outputs.summary import Summary, SummaryFile


def summed(tmp_path, *runs, end=None):
    output = SummaryFile(tmp_path, "van-17")
    for run in runs:
        for event in run:
            if isinstance(event, StatusEvent):
                output.handle(event)
    output.handle(end or EndEvent(complete=True))
    output.close()
    return json.loads((tmp_path / "summary.json").read_text())


def test_one_pair(tmp_path, drive):
    summary = summed(tmp_path, drive().events())
    front = summary["pairs"]["front"]
    assert summary["schema"] == "calibwatch.summary/1"
    assert summary["state"] == front["state"] == "drifted"
    assert summary["complete"] is True
    assert [change["state"] for change in front["timeline"]] == ["starting", "healthy", "suspect", "drifted"]
    assert [change["stamp_ns"] for change in front["timeline"]] == [drive().stamp(s) for s in (0, 3, 26, 30)]
    assert front["frames"] == {"received": 123, "used": 120, "dropped": {"no_partner": 2, "too_dark": 1}}
    assert front["last"] == json.loads(drive().status(60, seq=60).to_json())
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]


@pytest.mark.parametrize(
    ("first", "second", "told"),
    [
        ("healthy", "drifted", "drifted"),
        ("drifted", "stale", "stale"),
        ("fault", "stale", "fault"),
        ("healthy", "unobservable", "unobservable"),
        ("starting", "healthy", "healthy"),
        ("suspect", "unobservable", "suspect"),
    ],
)
def test_the_first_in_precedence_speaks_for_all_pairs(tmp_path, drive, first, second, told):
    runs = [
        [StatusEvent(drive(pair=name).status(5, state=state))]
        for name, state in (("a", first), ("b", second))
    ]
    summary = summed(tmp_path, *runs)
    assert summary["state"] == told
    assert {name: pair["state"] for name, pair in summary["pairs"].items()} == {"a": first, "b": second}


def test_a_new_reason_within_a_state_is_a_change_at_its_own_stamp(tmp_path, drive):
    later = StatusEvent(drive().status(9, code="other_reason"))
    timeline = summed(tmp_path, [StatusEvent(drive().status(5)), later, later])["pairs"]["front"]["timeline"]
    assert [(change["code"], change["stamp_ns"]) for change in timeline] == [
        ("excluded", drive().stamp(3)),
        ("other_reason", drive().stamp(9)),
    ]


def test_a_state_counts_from_the_stamp_at_which_it_was_entered(tmp_path, drive):
    # Statuses that came between were lost: the first that tells of the state is younger than it.
    run = [StatusEvent(drive().status(5)), StatusEvent(drive().status(40))]
    timeline = summed(tmp_path, run)["pairs"]["front"]["timeline"]
    assert [change["stamp_ns"] for change in timeline] == [drive().stamp(3), drive().stamp(30)]


def test_an_interrupted_run_says_so(tmp_path, drive):
    end = EndEvent(complete=False, note="interrupted by the user", warnings=("12 messages were refused",))
    summary = summed(tmp_path, [StatusEvent(drive().status(5))], end=end)
    assert (summary["complete"], summary["note"]) == (False, "interrupted by the user")
    assert summary["warnings"] == ["12 messages were refused"]


def test_a_run_without_a_pair_makes_no_statement(tmp_path):
    assert summed(tmp_path)["state"] == "starting"


def test_without_an_end_nothing_is_written(tmp_path, drive):
    output = SummaryFile(tmp_path, "van-17")
    output.handle(StatusEvent(drive().status(5)))
    output.close()
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_leaves_the_file_of_before(tmp_path, drive, small_files):
    (tmp_path / "summary.json").write_text("before")
    output = SummaryFile(tmp_path, "van-17")
    output.handle(StatusEvent(drive().status(5)))
    with small_files(100), pytest.raises(OSError, match="File too large"):
        output.handle(EndEvent(complete=True))
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("summary.json", "before")]


def test_what_is_written_reads_back(tmp_path, drive):
    summed(tmp_path, drive().events())
    summary = Summary.model_validate_json((tmp_path / "summary.json").read_text())
    assert summary.pairs["front"].last == drive().status(60, seq=60)
