"""Runs are kept as they come, survive a kill, and are not mixed with those of other settings."""

import pytest

from monitor.drift_rows import FILE_NAME, Header, Row, Rows, Said
from pipeline.errors import InputError

HEADER = Header(
    seed=1,
    limits=(0.5, 0.1),
    baseline=False,
    reference_sigma=(0.2, 0.05),
    software="calibwatch 0",
    network=None,
)
SAID = Said(
    drift=(0.1, 0.0, 0.5, 0.0, 0.0, 0.0),
    sigma=(0.1, 0.1, 0.1, 0.01, 0.01, 0.01),
    protection_level=(0.4, 0.4, 0.4, 0.08, 0.08, 0.08),
    alert_limit=(0.5, 0.5, 0.5, 0.1, 0.1, 0.1),
    observable=(True, True, True, True, True, False),
    monitored=(True, True, True, True, True, False),
    statistic=3.0,
)


def row(number=0, **fields):
    given = {
        "drive": "a",
        "simulated": False,
        "kind": "healthy",
        "label": "nothing",
        "number": number,
        "drift": (0.0,) * 6,
        "state": "healthy",
        "code": "within_limits",
        "frames": 10,
        "span_s": 1.0,
        "suspected_s": None,
        "told_s": None,
        "told_frames": None,
        "called_s": 0.6,
        "said": SAID,
        "reference_sigma": (0.2, 0.2, 0.2, 0.05, 0.05, 0.05),
        "seconds": 2.0,
    }
    return Row(**(given | fields))


def test_rows_are_there_again(tmp_path):
    rows = Rows(tmp_path, HEADER)
    rows.add(row(0))
    rows.add(row(1, said=None))
    again = Rows(tmp_path, HEADER)
    assert again.all == rows.all
    assert ("a", "healthy", 1) in again
    assert ("a", "healthy", 2) not in again
    assert ("b", "healthy", 1) not in again


@pytest.mark.parametrize("cut", [1, 20, 200])
def test_a_row_that_a_kill_cut_off_is_run_again(tmp_path, cut):
    rows = Rows(tmp_path, HEADER)
    rows.add(row(0))
    rows.add(row(1))
    path = tmp_path / FILE_NAME
    path.write_bytes(path.read_bytes()[:-cut])
    again = Rows(tmp_path, HEADER)
    assert [one.number for one in again.all] == [0]
    again.add(row(1))
    assert Rows(tmp_path, HEADER).all == rows.all


def test_rows_of_other_settings_are_refused(tmp_path):
    Rows(tmp_path, HEADER).add(row(0))
    with pytest.raises(InputError, match="other settings"):
        Rows(tmp_path, HEADER.model_copy(update={"seed": 2}))


@pytest.mark.parametrize(
    "data", [b"", b"\n", b"{}\n", b"\xff\xfe\n", HEADER.model_dump_json().encode() + b"\n{}\n"]
)
def test_what_is_no_such_file_is_refused_in_one_line(tmp_path, data):
    (tmp_path / FILE_NAME).write_bytes(data)
    with pytest.raises(InputError, match=FILE_NAME) as caught:
        Rows(tmp_path, HEADER)
    assert caught.value.hint


def test_a_folder_that_can_not_be_written_is_refused(tmp_path):
    with pytest.raises(InputError, match="can not be used"):
        Rows(tmp_path / "absent", HEADER)


def test_without_a_folder_rows_are_only_remembered():
    rows = Rows(None, HEADER)
    rows.add(row(0))
    assert rows.all == (row(0),)
