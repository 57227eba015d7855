"""A replay that is interrupted, killed or runs out of disk: nothing it leaves behind looks whole."""

import json
import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest

PATIENCE_S = 120


@contextmanager
def replaying(recording, out, *options, file_bytes=None):
    """``calibwatch replay`` as a process, with a limit of the size of files where one is given."""

    def limited():
        if file_bytes is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_bytes, file_bytes))

    program = "from monitor.cli import main; main()"
    with subprocess.Popen(  # noqa: S603 - our own program
        [sys.executable, "-c", program, "replay", str(recording), "--out", str(out), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        preexec_fn=limited,  # noqa: PLW1509 - only sets a limit
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def judging(process, out):
    """Returns when the first status is written: the replay is under way."""
    partial = out / "status.jsonl.partial"
    while not (partial.exists() and partial.stat().st_size):
        assert process.poll() is None, process.stderr.read()


def test_an_interrupted_replay_says_so_in_its_files(drive, tmp_path):
    with replaying(drive, tmp_path) as process:
        judging(process, tmp_path)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 130
    assert "Traceback" not in err
    summary = json.loads((tmp_path / "summary.json").read_bytes())
    assert summary["complete"] is False
    assert summary["note"].startswith("interrupted")
    assert "interrupted" in (tmp_path / "report.html").read_text()
    assert not (tmp_path / "status.jsonl").exists()
    lines = (tmp_path / "status.jsonl.partial").read_bytes().splitlines()
    assert all(json.loads(line)["schema"] == "calibwatch.status/1" for line in lines)


def test_a_killed_replay_leaves_partial_names_only(drive, tmp_path):
    with replaying(drive, tmp_path) as process:
        judging(process, tmp_path)
        process.kill()
        process.communicate(timeout=PATIENCE_S)
        assert process.returncode == -signal.SIGKILL
    assert {path.name for path in tmp_path.iterdir()} == {"recording.partial.rrd", "status.jsonl.partial"}
    lines = (tmp_path / "status.jsonl.partial").read_bytes().splitlines()
    assert all(json.loads(line)["schema"] == "calibwatch.status/1" for line in lines)


@pytest.mark.parametrize("file_bytes", [0, 1_000, 50_000])
def test_a_full_disk_is_told_in_one_line(cut, tmp_path, file_bytes):
    with replaying(cut(5), tmp_path, file_bytes=file_bytes) as process:
        _, err = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 1
    lines = err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"calibwatch: not everything could be written to {tmp_path}")
    assert "make room" in lines[0]
    assert not (tmp_path / "report.html").exists()
    assert not (tmp_path / "recording.rrd").exists()
    summary = tmp_path / "summary.json"
    assert summary.exists() == (file_bytes == 50_000)
    if summary.exists():
        told = json.loads(summary.read_bytes())
        assert told["complete"] is False
        assert told["note"].startswith("not everything could be written: ")
