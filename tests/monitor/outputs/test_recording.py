import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader

from monitor.events import EndEvent, FrameEvent, StatusEvent
from monitor.outputs.recording import Recording
from pipeline import se3
from pipeline.cameras import project

RERUN = shutil.which("rerun", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")


def rows(path):
    """entity -> table of its temporal rows."""
    found = {}
    for chunk in RrdReader(str(path)).stream():
        if not chunk.is_static:
            found.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())
    return found


def column(batches, name):
    """Values of a component over all rows, in order of the stamps."""
    pairs = [
        (stamp, value)
        for batch in batches
        if name in batch.schema.names
        for stamp, value in zip(
            batch.column("stamp").to_pylist(), batch.column(name).to_pylist(), strict=True
        )
    ]
    return [value for _, value in sorted(pairs, key=lambda pair: pair[0])]


def record(folder, events, images_hz=2.0):
    recording = Recording(folder, "van-17", images_hz)
    for event in events:
        recording.handle(event)
    recording.close()
    return recording


@pytest.fixture(scope="module")
def told(tmp_path_factory, drive):
    """Events of 12 s around the drift, and the file that was made of them."""
    events = []
    for second in range(20, 32):
        events += [drive().frame(second), StatusEvent(drive().status(second, seq=second))]
    folder = tmp_path_factory.mktemp("recording")
    recording = record(folder, [*events, EndEvent(complete=True)])
    assert (recording.lost, recording.dropped) == (None, 0)
    return events, folder / "recording.rrd"


def test_a_whole_run_leaves_the_final_name_only(told):
    _, path = told
    assert [file.name for file in path.parent.iterdir()] == ["recording.rrd"]


def test_drift_and_limits_read_back_as_they_were_said(told):
    events, path = told
    found = rows(path)
    statuses = [event.status for event in events if isinstance(event, StatusEvent)]
    yaw = np.array(column(found["/front/drift/yaw"], "Scalars:scalars"))
    said = np.array([[s.drift.yaw.value, s.drift.yaw.sigma, s.drift.yaw.alert_limit] for s in statuses])
    value, sigma, limit = said.T
    np.testing.assert_allclose(
        yaw, np.column_stack([value, value + 2 * sigma, value - 2 * sigma, limit, -limit])
    )
    forward = np.array(column(found["/front/drift/forward"], "Scalars:scalars"))
    assert np.isnan(forward[:, :3]).all()
    stamps = sorted(
        stamp for batch in found["/front/drift/yaw"] for stamp in batch.column("stamp").to_numpy()
    )
    assert [int(stamp) for stamp in np.array(stamps, dtype="datetime64[ns]").astype(np.int64)] == [
        status.stamp_ns for status in statuses
    ]


def test_the_state_is_told_when_it_changes(told):
    _, path = told
    states = [value[0] for value in column(rows(path)["/front/state"], "StateChange:state")]
    assert states == ["healthy", "suspect", "drifted"]


def test_points_lie_where_our_lens_model_puts_them(told):
    events, path = told
    frame = next(event for event in events if isinstance(event, FrameEvent))
    found = rows(path)
    for name, T in (("stored", frame.T_stored), ("estimated", frame.T_estimated)):
        for part, cloud in (("cloud", frame.points), ("edges", frame.edge_points)):
            uv, inside = project(frame.camera, se3.apply(T, cloud))
            seen = np.array(column(found[f"/front/image/{name}/{part}"], "Points2D:positions")[0])
            np.testing.assert_allclose(seen, uv[inside], atol=1e-3)


def test_every_entity_that_the_layout_shows_has_data(told):
    _, path = told
    found = rows(path)
    for name in ("image", "image/masks", "image/lines", "image/stored/lines", "image/estimated/lines"):
        assert f"/front/{name}" in found
    for name in ("points", "lines", "camera_stored", "camera_estimated"):
        assert f"/front/lidar/{name}" in found
    assert "/front/log" in found


@pytest.mark.skipif(RERUN is None, reason="the rerun command is not installed")
def test_the_file_verifies(told, tmp_path):
    _, path = told
    environment = os.environ | {"HOME": str(tmp_path), "CI": "1"}
    done = subprocess.run(  # noqa: S603 # our own file
        [RERUN, "rrd", "verify", str(path)], env=environment, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_images_are_kept_at_the_rate_asked_for(tmp_path, drive):
    frames = [drive().frame(10 + n / 10 + 0.004 * (n % 3)) for n in range(41)]
    record(tmp_path, [*frames, EndEvent(complete=True)])
    kept = column(rows(tmp_path / "recording.rrd")["/front/image"], "EncodedImage:blob")
    assert len(kept) == 9  # 4 s at 2 Hz, both ends


def test_a_clock_that_was_set_back_does_not_stop_the_images(tmp_path, drive):
    frames = [drive().frame(second) for second in (50, 51, 5, 6)]
    record(tmp_path, [*frames, EndEvent(complete=True)])
    assert len(column(rows(tmp_path / "recording.rrd")["/front/image"], "EncodedImage:blob")) == 4


def test_an_interrupted_run_says_so_in_its_log(tmp_path, drive):
    record(tmp_path, [StatusEvent(drive().status(5)), EndEvent(complete=False, note="stopped by the user")])
    lines = column(rows(tmp_path / "recording.rrd")["/front/log"], "TextLog:text")
    assert ["the run was interrupted: stopped by the user"] in lines


def test_without_an_end_the_file_keeps_its_partial_name(tmp_path, drive):
    record(tmp_path, [StatusEvent(drive().status(5)), drive().frame(5)])
    assert [file.name for file in tmp_path.iterdir()] == ["recording.partial.rrd"]
    assert "/front/image" in rows(tmp_path / "recording.partial.rrd")


def test_a_disk_that_fills_loses_the_recording_and_nothing_waits(tmp_path, drive, small_files):
    with small_files(60_000):
        recording = Recording(tmp_path, "van-17", 10.0)
        flushing = next(thread for thread in threading.enumerate() if thread.name == "recording-flush")
        for n in range(20):
            recording.handle(drive().frame(10 + n / 2))
        flushing.join(20)  # ends by itself when a flush has failed
        assert not flushing.is_alive()
        assert recording.lost.startswith("recording.partial.rrd is lost: ")
        recording.handle(drive().frame(30))
        recording.handle(EndEvent(complete=True))
        recording.close()
    assert [file.name for file in tmp_path.iterdir()] == ["recording.partial.rrd"]


def test_a_full_queue_drops_the_oldest_frames_and_counts_them(tmp_path, drive, monkeypatch):
    from monitor.outputs import _rerun_log  # noqa: PLC0415

    entered, gate = threading.Event(), threading.Event()
    written = []

    def slow(_, frame):
        written.append(frame.stamp_ns)
        entered.set()
        assert gate.wait(20)

    monkeypatch.setattr(_rerun_log.RerunLog, "frame", slow)
    recording = Recording(tmp_path, "van-17", 2.0)
    recording.handle(drive().frame(0))
    assert entered.wait(20)
    for second in range(1, 51):
        recording.handle(drive().frame(second))
        recording.handle(StatusEvent(drive().status(second, seq=second)))
    assert recording.dropped == 50 - 32
    gate.set()
    recording.handle(EndEvent(complete=True))
    assert written == [drive().stamp(second) for second in (0, *range(19, 51))]
    found = rows(tmp_path / "recording.rrd")
    assert len(column(found["/front/drift/yaw"], "Scalars:scalars")) == 50
    lines = [line for (line,) in column(found["/front/log"], "TextLog:text")]
    assert any(line.startswith("18 frames or statuses were dropped") for line in lines)


def test_pairs_with_odd_names_and_no_estimate_are_recorded(tmp_path, drive):
    odd = drive(pair="front.left-1")
    record(tmp_path, [odd.frame(0), StatusEvent(odd.status(0)), EndEvent(complete=True)])
    names = [name.split("/") for name in rows(tmp_path / "recording.rrd")]
    assert ["", "front.left-1", "image", "stored", "edges"] in [
        [part.replace("\\", "") for part in name] for name in names
    ]
    assert not any("estimated" in name for name in names)


def test_recording_reads_no_settings_of_others_and_leaves_none(tmp_path):
    # The analytics of rerun would write their settings into the home folder before they send.
    script = (
        "import sys, pathlib; from monitor.outputs.recording import Recording; "
        "from monitor.events import EndEvent; "
        "r = Recording(pathlib.Path(sys.argv[1]), 'van-17', 2.0); r.handle(EndEvent(complete=True))"
    )
    home, out = tmp_path / "home", tmp_path / "out"
    home.mkdir()
    out.mkdir()
    environment = {k: v for k, v in os.environ.items() if k not in ("CI", "XDG_CONFIG_HOME")} | {
        "HOME": str(home)
    }
    root = Path(__file__).parents[3]
    command = [sys.executable, "-c", script, str(out)]
    subprocess.run(command, env=environment | {"PYTHONPATH": str(root)}, check=True)  # noqa: S603
    assert (out / "recording.rrd").stat().st_size > 0
    assert list(home.rglob("*")) == []
