import os

import pytest

from monitor.outputs._pipe_to_file import PipeToFile

WAIT_S = 20


def test_what_is_written_to_the_source_is_in_the_file(tmp_path):
    pipe = PipeToFile(tmp_path / "x")
    data = os.urandom(3_000_000)
    with open(pipe.source, "wb") as library:  # noqa: PTH123 # as a library opens it
        pipe.opened()
        library.writelines([data[:5], data[5:2_000_001], data[2_000_001:]])
    assert pipe.join(WAIT_S)
    assert pipe.error is None
    assert (tmp_path / "x").read_bytes() == data


def test_a_disk_that_fills_is_remembered_and_the_library_never_waits(tmp_path, small_files):
    with small_files(100_000):
        pipe = PipeToFile(tmp_path / "x")
        with open(pipe.source, "wb", buffering=0) as library:  # noqa: PTH123 # as a library opens it
            pipe.opened()
            for _ in range(50):
                assert library.write(bytes(60_000)) == 60_000
        assert pipe.join(WAIT_S)
    assert "too large" in str(pipe.error)
    assert (tmp_path / "x").stat().st_size == 100_000


def test_the_file_is_not_done_while_the_library_has_it_open(tmp_path):
    pipe = PipeToFile(tmp_path / "x")
    with open(pipe.source, "wb", buffering=0):  # noqa: PTH123 # as a library opens it
        pipe.opened()
        assert not pipe.join(0.0)
    assert pipe.join(WAIT_S)


def test_nothing_stays_open(tmp_path):
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208 # a count of descriptors
    for _ in range(20):
        pipe = PipeToFile(tmp_path / "x")
        pipe.opened()
        assert pipe.join(WAIT_S)
    assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208


def test_a_folder_that_is_not_there_is_an_error_at_once(tmp_path):
    with pytest.raises(FileNotFoundError):
        PipeToFile(tmp_path / "missing" / "x")
