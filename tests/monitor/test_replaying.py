"""Real recordings, end to end: what their own extrinsic says, and what a known error says."""

import math
import os
import threading
from pathlib import Path

import numpy as np
import pytest

from monitor.replaying import replay

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[3] / "shared" / "data"))
SHORT = "kitti_raw_0005_a"
LONGER = ("kitti_raw_sfnd", "kitti_raw_0009_a", "kitti_odom_03_a", "kitti_raw_0009_mcap/kitti_0009.mcap")


def judged(name, yaw_deg, out):
    location = DATA / name
    if not location.exists():
        pytest.skip(f"no recording {location} (CALIBWATCH_DATA)")
    drift = np.array([0.0, 0.0, math.radians(yaw_deg), 0.0, 0.0, 0.0]) if yaw_deg else None
    return replay(
        str(location),
        None,
        drift,
        out,
        model=None,
        images_hz=1.0,
        over_zenoh=False,
        stop=threading.Event(),
        progress=None,
    )


@pytest.mark.recordings
@pytest.mark.parametrize("name", [SHORT, *(pytest.param(name, marks=pytest.mark.slow) for name in LONGER)])
def test_a_recording_with_its_reference_calibration_is_not_drifted(name, tmp_path):
    summary = judged(name, 0.0, tmp_path)
    assert summary.complete
    assert summary.state != "drifted"
    for pair in summary.pairs.values():
        assert all(change.state != "drifted" for change in pair.timeline)
        frames = pair.frames
        assert frames.received == frames.used + sum(frames.dropped.values())


@pytest.mark.recordings
@pytest.mark.parametrize("yaw_deg", [1.0, -1.0])
@pytest.mark.parametrize("name", [SHORT, pytest.param(LONGER[0], marks=pytest.mark.slow)])
def test_one_degree_of_yaw_is_told(name, yaw_deg, tmp_path):
    summary = judged(name, yaw_deg, tmp_path)
    assert summary.state == "drifted"
    for pair in summary.pairs.values():
        assert pair.last.drift.yaw.value == pytest.approx(yaw_deg, abs=0.35)
