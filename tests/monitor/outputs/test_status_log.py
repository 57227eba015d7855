import json

import pytest

from monitor.events import EndEvent, StatusEvent
from monitor.outputs import Outputs
from monitor.outputs.status_log import StatusLog
from monitor.status import Status


def lines(path):
    return [Status.model_validate_json(line) for line in path.read_text().splitlines()]


def test_a_whole_run_leaves_every_status_under_the_final_name(tmp_path, drive):
    log = StatusLog(tmp_path)
    for event in drive().events():
        log.handle(event)
    log.close()
    written = lines(tmp_path / "status.jsonl")
    assert [status.seq for status in written] == list(range(61))
    assert written[40] == drive().status(40, seq=40)
    assert [path.name for path in tmp_path.iterdir()] == ["status.jsonl"]


def test_each_line_is_on_the_file_before_the_next_event(tmp_path, drive):
    log = StatusLog(tmp_path)
    for seq in range(3):
        log.handle(StatusEvent(drive().status(seq, seq=seq)))
        assert [status.seq for status in lines(tmp_path / "status.jsonl.partial")] == list(range(seq + 1))
    log.close()


@pytest.mark.parametrize("end", [EndEvent(complete=False, note="interrupted"), None], ids=["told", "killed"])
def test_an_interrupted_run_keeps_the_partial_name(tmp_path, drive, end):
    log = StatusLog(tmp_path)
    log.handle(StatusEvent(drive().status(5)))
    if end is not None:
        log.handle(end)
    log.close()
    assert [path.name for path in tmp_path.iterdir()] == ["status.jsonl.partial"]
    assert len(lines(tmp_path / "status.jsonl.partial")) == 1


def test_a_run_that_fails_leaves_the_result_of_the_one_before(tmp_path, drive):
    (tmp_path / "status.jsonl").write_text("before\n")
    log = StatusLog(tmp_path)
    log.handle(StatusEvent(drive().status(5)))
    log.close()
    assert (tmp_path / "status.jsonl").read_text() == "before\n"


def test_a_disk_that_fills_loses_the_log_and_tears_no_line(tmp_path, drive, small_files):
    outputs = Outputs([("status_log", StatusLog(tmp_path))])
    size = len(drive().status(5).to_json()) + 1
    with small_files(int(size * 2.5)):
        for seq in range(4):
            outputs.handle(StatusEvent(drive().status(5, seq=seq)))
    assert list(outputs.losses) == ["status_log"]
    assert [status.seq for status in lines(tmp_path / "status.jsonl.partial")] == [0, 1]


def test_no_number_is_other_than_finite_or_null(tmp_path, drive):
    log = StatusLog(tmp_path)
    log.handle(StatusEvent(drive().status(5)))
    log.close()

    def refuse(word):
        raise AssertionError(word)

    text = (tmp_path / "status.jsonl.partial").read_text()
    assert json.loads(text, parse_constant=refuse)["drift"]["forward"]["sigma"] is None
