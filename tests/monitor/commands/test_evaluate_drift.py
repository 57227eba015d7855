"""``calibwatch evaluate drift`` from recordings to tables; what it says is what a watch says."""

import dataclasses
import json

import numpy as np
import pytest

from monitor.commands.evaluate_drift import _KINDS
from monitor.drift_baselines import OtherDrives
from monitor.drift_drives import drive_of, recorded, simulated
from monitor.drift_evaluation import Options, run
from monitor.drift_rows import FILE_NAME
from monitor.model_file import open_segmenter
from monitor.statements import TO_PEOPLE
from pipeline import se3, staging
from pipeline.drift_trials import KINDS
from pipeline.errors import InputError
from pipeline.parameters import Parameters
from pipeline.simulation.drive import START_NS
from pipeline.watch import Watch


class Clock:
    """Each look takes a second."""

    def __init__(self):
        self.now_ns = 0

    def monotonic_ns(self):
        self.now_ns += 10**9
        return self.now_ns

    def wall_ns(self):
        return 0


@pytest.fixture(scope="module")
def segmenter():
    return open_segmenter(None, 1)


def test_the_command_line_knows_all_kinds():
    assert _KINDS == KINDS


def test_an_evaluation_is_kept_run_by_run_and_resumed(calibwatch, cut, tmp_path):
    def evaluated(*options):
        given = ("--limits", 0.5, 0.1, "--out", tmp_path, *options)
        return calibwatch("evaluate", "drift", cut(7), "--runs", 1, *given)

    code, out, err = evaluated("--kinds", "healthy")
    assert (code, err) == (0, "")
    assert "| first7.mcap | 1 | 1 | 0 |" in out
    lines = (tmp_path / FILE_NAME).read_bytes().splitlines()
    first = json.loads(lines[1])
    assert len(lines) == 2
    assert (first["drive"], first["frames"], first["kind"]) == ("first7.mcap", 7, "healthy")
    assert first["span_s"] == pytest.approx(0.6)
    assert first["said"]["alert_limit"] == pytest.approx([0.5] * 3 + [0.1] * 3)
    code, out, _ = evaluated("--kinds", "healthy,combined", "--json")
    assert code == 0
    found = json.loads(out)
    again = (tmp_path / FILE_NAME).read_bytes().splitlines()
    assert again[:2] == lines  # not run again
    assert [json.loads(line)["kind"] for line in again[1:]] == ["healthy", "combined"]
    assert found["runs"] == 2
    assert found["calling"][0]["told"]["of"] == 1
    assert {path.name for path in tmp_path.iterdir()} >= {"drift.md", "drift.csv", "drift.json"}
    code, _, err = evaluated("--seed", 3)
    assert code == 1
    assert "other settings" in err


def test_a_row_says_what_a_watch_says(cut, segmenter):
    (place,) = recorded([str(cut(7))], np.full(6, 0.01))
    (drive,) = place.read()
    row = run(drive, "combined", 3, segmenter, Options(runs=4, seed=9), Clock())
    assert row == run(drive, "combined", 3, segmenter, Options(runs=40, seed=9), Clock())
    other = run(drive, "combined", 2, segmenter, Options(runs=4, seed=9), Clock())
    assert other.drift != row.drift
    assert row.seconds == 1.0
    angle = np.linalg.norm(row.drift[:3])
    assert 0.45 < angle < 1.3
    assert (row.told_s is not None) == (row.state == "drifted")


def test_undisguised_a_drive_is_judged_as_by_replay(cut, segmenter, monkeypatch):
    """With nothing told in other words, what is said is what a watch over the frames says."""
    (place,) = recorded([str(cut(7))], np.zeros(6))
    (drive,) = place.read()
    monkeypatch.setattr(staging, "TURNED_DEG", 0.0)
    monkeypatch.setattr(staging, "MOVED_M", 0.0)
    monkeypatch.setattr(staging, "CROPPED_PX", 0)
    row = run(drive, "healthy", 0, segmenter, Options(), Clock())
    watch = Watch(drive.mount, Parameters(), segmenter)
    for frame in drive.frames:
        watch.step(frame)
    watch.finish(drive.frames[-1].image_stamp_ns)
    assert (row.state, row.code) == (watch.memory.state, watch.memory.code)
    assert row.said.statistic == pytest.approx(watch.belief.judgement.statistic, rel=1e-6)
    assert np.radians(row.said.sigma[:3]) == pytest.approx(watch.belief.judgement.sigma[:3], rel=1e-6)


def test_simulated_drives_are_drawn_and_true(monkeypatch):
    monkeypatch.setattr("monitor.drift_drives.SIMULATED_S", 0.2)
    (place,) = simulated(1, seed=4)
    (drive,) = place.read()
    parameters = drive_of(4, 0)
    assert (drive.name, drive.simulated, len(drive.frames)) == ("simulated 4/0", True, parameters.frames)
    assert drive.frames[0].cloud_stamp_ns == START_NS
    assert drive.mount.T_cam_lidar == pytest.approx(parameters.T_stored, abs=1e-12)
    assert not drive.reference_sigma.any()
    assert se3.rotation_angle(drive_of(4, 1).T_stored[:3, :3], parameters.T_stored[:3, :3]) > 0.0


@pytest.mark.parametrize(
    ("arguments", "code", "what"),
    [
        ((), 2, "nothing to watch"),
        (("--simulated", 1, "--kinds", "helthy"), 2, "'helthy' is none of healthy"),
        (("--simulated", 1, "--limits", 0, 1), 2, "--limits"),
        (("--simulated", 2, "--baseline", "other"), 2, "no other to learn from"),
        (("absent.mcap",), 1, "absent.mcap"),
    ],
)
def test_bad_usage_is_one_line(calibwatch, arguments, code, what):
    got, _, err = calibwatch("evaluate", "drift", *arguments)
    assert got == code
    assert what in err


def test_a_drive_is_judged_with_what_the_others_taught(cut, segmenter):
    places = recorded([str(cut(7)), str(cut(9))], np.zeros(6))
    taught = OtherDrives(places, segmenter, Parameters(), lambda *_: None)
    (first,), (second,) = (place.read() for place in places)
    for place, drive, other in ((places[0], first, second), (places[1], second, first)):
        baseline = taught.baseline(place.name, drive)
        assert {sample.recording for sample in baseline.stretches} == {other.name}
    moved = dataclasses.replace(
        first.mount, T_cam_lidar=se3.retract(first.mount.T_cam_lidar, np.full(6, 1e-3))
    )
    with pytest.raises(InputError, match="no other drive has the extrinsic of first7"):
        taught.baseline(places[0].name, dataclasses.replace(first, mount=moved))
    plain = run(first, "healthy", 0, segmenter, Options(), Clock())
    mount = dataclasses.replace(first.mount, baseline=taught.baseline(places[0].name, first))
    judged = run(dataclasses.replace(first, mount=mount), "healthy", 0, segmenter, Options(), Clock())
    # The same frames; only what is expected of them differs.
    assert judged.said.drift != pytest.approx(plain.said.drift, abs=1e-6)
    shift = (np.array(plain.said.drift) - judged.said.drift) / TO_PEOPLE
    assert shift == pytest.approx(mount.baseline.bias, abs=3e-3)
