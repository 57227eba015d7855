"""The demo: what it shows is what was told, and a drift that was told too early or never is a failure."""

import dataclasses
import threading

import pytest

from monitor import demo
from monitor.outputs.summary import Summary
from monitor.replaying import replay
from pipeline.errors import InputError
from pipeline.simulation.drive import START_NS
from tests import drives


@pytest.fixture
def summary(cut, tmp_path):
    """Of a real run, its only pair called as the demo calls it."""
    options = {"model": None, "images_hz": 1.0, "over_zenoh": False, "progress": None}
    told = replay(str(cut(5)), None, None, tmp_path, stop=threading.Event(), **options)
    return told.model_copy(update={"pairs": {"front": told.pairs["camera"]}})


def at(summary, *changes):
    """The summary with another timeline: (seconds, state) each."""
    pair = summary.pairs["front"]
    timeline = tuple(
        pair.timeline[0].model_copy(update={"stamp_ns": START_NS + round(s * 1e9), "state": state})
        for s, state in changes
    )
    return summary.model_copy(update={"pairs": {"front": pair.model_copy(update={"timeline": timeline})}})


@pytest.mark.parametrize(
    ("changes", "success", "last"),
    [
        ([(0, "starting"), (4, "healthy"), (7.5, "drifted")], True, "told 1.50 s after it happened"),
        ([(0, "starting"), (5.9, "drifted")], False, "told -0.10 s after it happened"),
        ([(0, "starting"), (7, "suspect")], False, "The drift was not told."),
    ],
)
def test_success_is_a_drift_that_is_told_and_not_before_it_was_there(summary, changes, success, last):
    assert isinstance(summary, Summary)
    lines, succeeded = demo.timeline(at(summary, *changes))
    assert succeeded is success
    assert lines[-1].startswith(last)
    seconds = [float(line.split()[0]) for line in lines[:-1]]
    assert seconds == sorted(seconds)
    assert sum("TRUTH" in line for line in lines) == 1


def test_a_place_that_can_not_be_used_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="can not be used"):
        demo.demo(tmp_path / "file" / "below", 1, threading.Event(), print)


def test_a_stop_while_it_simulates_leaves_no_drive(tmp_path, monkeypatch):
    short = dataclasses.replace(drives.PARAMETERS, duration=0.2)
    monkeypatch.setattr(demo, "demo_drive", lambda _: short)
    stop = threading.Event()
    stop.set()
    with pytest.raises(KeyboardInterrupt):
        demo.demo(tmp_path, 1, stop, print)
    assert [path.name for path in tmp_path.iterdir()] == ["rig.toml"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_demo_shows_what_it_promises(calibwatch, tmp_path, seed):
    code, out, err = calibwatch("demo", "--out", tmp_path, "--seed", seed)
    assert code == 0, out + err
    assert f"{demo.DRIFT_S:6.2f} s  TRUTH" in out
    for name in ("report.html", "recording.rrd", "drive.mcap"):
        assert (tmp_path / name).exists()
