"""One short simulated drive per session, and what is cut out of it; more is derived by tests.drives."""

import json

import pytest

from monitor.cli import main
from tests import drives


@pytest.fixture(scope="session")
def drive(tmp_path_factory):
    """A drive of six seconds whose mount slips after two."""
    path = tmp_path_factory.mktemp("drive") / "slip.mcap"
    drives.simulate(path)
    return path


@pytest.fixture(scope="session")
def messages(drive):
    """Its messages."""
    return drives.read(drive)


@pytest.fixture(scope="session")
def cut(messages, tmp_path_factory):
    """Recordings of its first frames: ``cut(12)``; up to 20 are healthy. Read only."""
    folder = tmp_path_factory.mktemp("cut")

    def first(frames):
        path = folder / f"first{frames}.mcap"
        if not path.exists():
            drives.write(path, drives.first_frames(messages, frames))
        return path

    return first


@pytest.fixture
def calibwatch(capsys):
    """The command line in this process: exit code, stdout, stderr."""

    def run(*arguments):
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return ended.value.code, out, err

    return run


@pytest.fixture
def replayed(calibwatch, tmp_path):
    """A recording replayed into ``tmp_path/"out"``: exit code, stderr, summary.json (None where absent)."""

    def run(recording, *options):
        code, _, err = calibwatch("replay", recording, "--out", tmp_path / "out", *options)
        summary = tmp_path / "out" / "summary.json"
        return code, err, json.loads(summary.read_bytes()) if summary.exists() else None

    return run
