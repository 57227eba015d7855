"""``calibwatch evaluate dataset`` and ``basin`` through the command line, on small simulated frames."""

import json
import math

import cv2
import numpy as np
import pytest

from monitor import charts
from monitor.basin_evaluation import WAYS
from monitor.cli import main
from monitor.evaluated_frames import recorded_frames
from monitor.frame_calibration import drawn_start
from monitor.status import AXIS_NAMES
from pipeline.basin import OFFSETS
from tests.monitor.frame_folders import calib, write_frames


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The files of an evaluation of two sets, one frame and a drive of two: name -> bytes."""
    top = tmp_path_factory.mktemp("sets")
    write_frames(top / "lone" / "000")
    write_frames(top / "drive", 2)
    out = top / "new" / "out"
    options = ["--starts", "1", "--rotation", "1", "--translation", "0.1", "--out", str(out)]
    with pytest.raises(SystemExit) as ended:
        main(["evaluate", "dataset", str(top), *options])
    assert ended.value.code == 0
    return {path.name: path.read_bytes() for path in out.iterdir()}


@pytest.fixture(scope="module")
def found(written):
    """The same as JSON."""
    return json.loads(written["dataset.json"])


def test_answers_are_held_against_what_the_folders_state(found):
    assert [(one["frame"], one["start"]) for one in found["answers"]] == [
        (name, 0) for name in ("drive #0", "drive #1", "000")
    ]
    for one in found["answers"]:
        off = [one["axes"][name]["start"] for name in AXIS_NAMES]
        # Starts turn and shift the stored mount; the way back mixes the axes by a degree's sine.
        assert max(map(abs, off[:3])) < 1.05
        assert 0.01 < max(map(abs, off[3:])) < 0.11
        assert one["start_rotation_deg"] == pytest.approx(np.linalg.norm(off[:3]), rel=0.02)
        assert one["ms"]["all"] > 0
        for name in one["wrong"]:
            axis = one["axes"][name]
            known = 0.2 if name in ("roll", "pitch", "yaw") else 0.05
            assert axis["observable"]
            assert abs(axis["error"]) > 4 * math.hypot(axis["sigma"], known)
        if all(one["axes"][name]["observable"] for name in AXIS_NAMES):
            turn = np.linalg.norm([one["axes"][name]["error"] for name in ("roll", "pitch", "yaw")])
            assert one["rotation_deg"] == pytest.approx(turn, abs=0.02 + 0.02 * turn)
    good = [one for one in found["answers"] if one["axes"]["yaw"]["observable"]]
    assert len(good) >= 2
    assert np.median([abs(one["axes"]["yaw"]["error"]) for one in good]) < 0.3
    summaries = {one["group"]: one for one in found["summaries"]}
    assert {name: (one["frames"], one["answers"]) for name, one in summaries.items()} == {
        "drive": (2, 2),
        "lone": (1, 1),
        "all": (3, 3),
    }
    for name, one in summaries.items():
        own = [a for a in found["answers"] if name in (a["group"], "all")]
        for k, axis in enumerate(AXIS_NAMES):
            errors = [abs(a["axes"][axis]["error"]) for a in own]
            seen = [error for error, a in zip(errors, own, strict=True) if a["axes"][axis]["observable"]]
            assert one["everything"][k] == pytest.approx(np.mean(errors))
            assert one["observable"][k] == (pytest.approx(np.mean(seen)) if seen else None)
        both = [a["axes"]["yaw"]["observable"] and a["axes"]["pitch"]["observable"] for a in own]
        assert one["yaw_and_pitch"] == pytest.approx(np.mean(both))
    assert [one["frame"] for one in found["coarse"]] == ["drive #0", "drive #1", "000"]
    for one in found["coarse"]:
        assert one["found"] is (one["reason"] == "") is (len(one["errors"]) == 6)
        assert one["found"] is (one["rotation_deg"] is not None)


def test_tables_and_curves_are_written_and_told(written, found):
    assert written.keys() == {"dataset.md", "dataset.json", "dataset.png"}
    text = written["dataset.md"].decode()
    for one in found["answers"]:
        name = one["frame"] if one["frame"].startswith(one["group"]) else f"{one['group']} {one['frame']}"
        row = next(line for line in text.splitlines() if line.startswith(f"| {name} | 0 |"))
        for axis in (one["axes"][axis] for axis in AXIS_NAMES):
            assert f"{axis['error']:+.2f}/{axis['sigma']:.2f}" in row
    image = cv2.imdecode(np.frombuffer(written["dataset.png"], np.uint8), cv2.IMREAD_COLOR)
    for colour in charts.COLOURS[:2]:
        assert (image == colour).all(axis=2).sum() > 300


def test_a_frame_has_the_same_starts_in_any_company(tmp_path):
    widest = np.array([0.02] * 3 + [0.1] * 3)
    write_frames(tmp_path / "a")
    write_frames(tmp_path / "b")
    together = {frame.name: frame for frame in recorded_frames([tmp_path], 3, np.zeros(6))}
    (alone,) = recorded_frames([tmp_path / "b"], 3, np.zeros(6))
    starts = [drawn_start(together["b"], k, widest, 4) for k in range(50)]
    assert np.array_equal(starts[3], drawn_start(alone, 3, widest, 4))
    assert not np.array_equal(starts[3], drawn_start(alone, 3, widest, 5))
    assert not np.array_equal(starts[3], drawn_start(together["a"], 3, widest, 4))
    assert np.abs(starts).max(axis=0) == pytest.approx(widest, rel=0.15)


@pytest.mark.slow
def test_simulated_frames_need_no_folder_and_are_known_exactly(calibwatch):
    options = ("--simulated", 1, "--starts", 1, "--rotation", 0, "--translation", 0, "--json")
    code, out, err = calibwatch("evaluate", "dataset", *options)
    assert (code, err) == (0, "")
    (answer,) = json.loads(out)["answers"]
    assert answer["group"] == "simulated"
    assert answer["start_rotation_deg"] == pytest.approx(0, abs=1e-6)
    assert answer["start_translation_m"] == pytest.approx(0, abs=1e-9)


def broken(folder, kind):
    """A folder that can not be evaluated, and what is said of it."""
    match kind:
        case "nothing":
            folder.mkdir()
            return "holds no frames"
        case "absent":
            return "does not exist"
        case "no reference":
            write_frames(folder, T_cam_lidar=None)
            return "T_cam_lidar"
        case "other size":
            write_frames(folder, camera=calib()["camera"] | {"width": 320})
            return "640x203 px, the intrinsics are for 320x203"
        case "image":
            write_frames(folder)
            (folder / "image.png").write_bytes(b"no picture")
            return "image"
        case "json":
            write_frames(folder)
            (folder / "calib.json").write_text("{")
            return "calib.json"
    raise AssertionError(kind)


@pytest.mark.parametrize("kind", ["nothing", "absent", "no reference", "other size", "image", "json"])
@pytest.mark.parametrize("name", ["dataset", "basin"])
def test_a_bad_folder_is_refused_in_one_line_and_nothing_is_written(calibwatch, tmp_path, name, kind):
    write_frames(tmp_path / "good")
    says = broken(tmp_path / "bad", kind)
    out = tmp_path / "out"
    code, told, err = calibwatch("evaluate", name, tmp_path / "good", tmp_path / "bad", "--out", out)
    assert (code, told) == (1, "")
    assert err.count("\n") == 1
    assert says in err
    assert str(tmp_path / "bad") in err
    assert not out.exists()


def test_a_set_that_is_not_there_has_no_sigma(calibwatch, tmp_path):
    write_frames(tmp_path / "a")
    code, out, err = calibwatch("evaluate", "dataset", tmp_path / "a", "--set-sigma", "b", 0.5, 0.1)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "no set 'b' (there are: a)" in err
    code, _, err = calibwatch("evaluate", "dataset", "--simulated", 1, "--set-sigma", "b", 0.5, 0.1)
    assert code == 2
    assert "--set-sigma" in err


@pytest.mark.parametrize("name", ["dataset", "basin"])
def test_wrong_usage_and_a_folder_that_can_not_be_made(calibwatch, tmp_path, name):
    code, out, err = calibwatch("evaluate", name)
    assert (code, out) == (2, "")
    assert "--simulated" in err
    assert calibwatch("evaluate", name, tmp_path, "--starts", 0)[0] == 2
    write_frames(tmp_path / "a")
    (tmp_path / "file").touch()
    code, out, err = calibwatch("evaluate", name, tmp_path / "a", "--out", tmp_path / "file" / "x")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "--out" in err
    model = tmp_path / "gone.onnx"
    code, out, err = calibwatch("evaluate", name, tmp_path / "a", "--model", model)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "gone.onnx" in err


@pytest.mark.slow
def test_basins_are_drawn_and_told(calibwatch, tmp_path):
    write_frames(tmp_path / "a")
    code, out, err = calibwatch("evaluate", "basin", tmp_path / "a", "--out", tmp_path)
    assert (code, err) == (0, "")
    found = json.loads((tmp_path / "basin.json").read_bytes())
    lines = found["matched"]["a"]
    for sweep, places in OFFSETS.items():
        curve = found["sweeps"][sweep]
        assert curve["ways"].keys() == set(WAYS)
        scale = 1.0 if curve["unit"] == "m" else 180.0 / math.pi
        for way, points in curve["ways"].items():
            assert [point["offset"] for point in points] == pytest.approx((places * scale).tolist())
            if way == "method I":
                assert all(point["answers"] == (1 if lines >= 3 else 0) for point in points)
            for point in points:
                assert (point["answers"] == 0) is (point["rotation_deg"] is None)
                assert point["success"] <= point["answers"]
        # From 0 to the farthest, one row each.
        assert out.count(f"\n| {places[-1] * scale:g} |") >= 1
    whole = found["sweeps"]["rotation"]["ways"]["calibrate"]
    assert whole[1]["success"] == 1.0
    # Masks alone do not lead back from the farthest turn; what needs no start at all may.
    assert found["sweeps"]["rotation"]["ways"]["evolution"][-1]["success"] == 0.0
    image = cv2.imdecode(np.frombuffer((tmp_path / "basin.png").read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (860, 1860, 3)
