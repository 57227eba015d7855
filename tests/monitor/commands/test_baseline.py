"""``calibwatch baseline`` from recordings to the file, and the verdicts that rest on it."""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest

from monitor.simulated_recording import write_drive
from pipeline.simulation.scene import SceneParameters
from tests import drives

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[4] / "shared" / "data"))
STREETS = ("kitti_raw_0009_a", "kitti_raw_sfnd", "kitti_raw_0005_a", "kitti_odom_03_a")


def test_a_drive_judged_with_its_own_baseline(calibwatch, replayed, cut, tmp_path):
    file = tmp_path / "van.baseline.json"
    code, out, err = calibwatch("baseline", cut(20), "--out", file)
    assert (code, err) == (0, "")
    first, noise, *rows = out.splitlines()
    assert first.startswith("camera: 1 recording, 1 stretch of road (")
    assert "one recording tells no run length: default thresholds stay" in first
    assert noise.startswith("  windows scatter by ")
    assert [row.split()[0] for row in rows[:6]] == ["roll", "pitch", "yaw", "forward", "left", "up"]
    assert rows[6].startswith(f"baseline: {file} (use it: calibwatch replay RECORDING --baseline ")
    part = json.loads(file.read_bytes())["pairs"]["camera"]
    bias = np.array(part["bias"])

    code, err, summary = replayed(cut(20), "--baseline", file)
    assert err == ""
    last = summary["pairs"]["camera"]["last"]
    assert last["drift"]["relative_to"] == "baseline"
    assert summary["state"] != "drifted"
    # The window's last estimate, told from the mean of all windows of the same road.
    assert abs(last["drift"]["yaw"]["value"]) < 0.05

    code, err, summary = replayed(cut(12), "--baseline", file, "--inject", "yaw=1")
    assert (code, err, summary["state"]) == (3, "", "drifted")
    told = summary["pairs"]["camera"]["last"]["drift"]["yaw"]["value"]
    assert told == pytest.approx(1.0, abs=0.15)
    assert np.degrees(np.abs(bias[:3])).max() < 0.3

    code, out, err = calibwatch("baseline", cut(20), "--out", file)
    assert (code, out) == (1, "")
    assert "exists already (--force replaces it)" in err


def test_a_baseline_of_another_extrinsic_is_one_line(calibwatch, replayed, cut, tmp_path):
    file = tmp_path / "van.baseline.json"
    assert calibwatch("baseline", cut(12), "--out", file, "--json")[0] == 0
    content = json.loads(file.read_bytes())
    content["pairs"]["camera"]["extrinsic"] = "0" * 64
    file.write_text(json.dumps(content))
    code, err, summary = replayed(cut(12), "--baseline", file)
    assert (code, summary) == (1, None)
    assert "was learned under extrinsic 000000000000, pair camera has" in err
    assert err.count("\n") == 1


def test_what_can_not_be_learned_from_is_one_line(calibwatch, cut, tmp_path):
    out = tmp_path / "van.baseline.json"
    for recordings, what in (
        ((cut(12), cut(12)), "is given twice"),
        ((cut(12), cut(20)), "are the same drive"),
        ((cut(2),), "nothing to learn from"),
        ((tmp_path / "none.mcap",), "none.mcap"),
    ):
        code, _, err = calibwatch("baseline", *recordings, "--out", out)
        assert code == 1
        assert what in err
        assert err.count("\n") == 1
    assert not out.exists()
    assert calibwatch("baseline")[0] == 2


def test_a_file_that_can_not_be_is_told_before_any_recording_is_watched(calibwatch, tmp_path):
    code, _, err = calibwatch("baseline", tmp_path / "absent.mcap", "--out", tmp_path / "none" / "b.json")
    assert code == 1
    assert "none is no folder to write b.json to" in err


@pytest.mark.slow
def test_a_drive_on_which_the_mount_slips_is_refused(calibwatch, drive, tmp_path):
    """It turns by a degree after two of six seconds."""
    out = tmp_path / "van.baseline.json"
    code, _, err = calibwatch("baseline", drive, "--out", out)
    assert code == 1
    assert "not healthy: slip.mcap" in err
    assert not out.exists()


@pytest.mark.slow
def test_streets_of_one_rig_agree_and_one_under_a_moved_mount_stands_out(calibwatch, tmp_path):
    healthy = dataclasses.replace(
        drives.PARAMETERS, duration=2.0, drift_time=np.inf, scene=SceneParameters(length=200.0)
    )
    paths = []
    for seed in (11, 12, 13):
        path = tmp_path / f"street{seed}.mcap"
        write_drive(dataclasses.replace(healthy, seed=seed), path)
        paths.append(path)
    moved = tmp_path / "moved.mcap"
    drift = np.array([0.0, 0.0, np.radians(0.45), 0.0, 0.0, 0.0])
    write_drive(dataclasses.replace(healthy, seed=14, drift=drift, drift_time=0.0), moved)

    file = tmp_path / "van.baseline.json"
    code, out, err = calibwatch("baseline", *paths, "--out", file)
    assert (code, err) == (0, "")
    assert "3 recordings, 3 stretches of road" in out
    bias = np.array(json.loads(file.read_bytes())["pairs"]["camera"]["bias"])
    assert np.degrees(np.abs(bias[1:3])).max() < 0.1
    code, out, err = calibwatch("baseline", *paths, moved, "--out", file, "--force")
    assert code == 1
    assert "moved.mcap" in err


@pytest.mark.slow
@pytest.mark.recordings
@pytest.mark.parametrize("left", STREETS)
def test_three_streets_of_a_real_rig_judge_the_fourth_healthy(calibwatch, replayed, left, tmp_path):
    if not all((DATA / name).exists() for name in STREETS):
        pytest.skip(f"no recordings in {DATA} (CALIBWATCH_DATA)")
    file = tmp_path / "kitti.baseline.json"
    others = [DATA / name for name in STREETS if name != left]
    code, out, _ = calibwatch("baseline", *others, "--out", file)
    assert code == 0
    assert "default thresholds stay" in out
    _, _, summary = replayed(DATA / left, "--baseline", file)
    assert summary["state"] != "drifted"
    assert all(pair["last"]["drift"]["relative_to"] == "baseline" for pair in summary["pairs"].values())
