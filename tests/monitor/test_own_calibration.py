"""Recordings with their own calibration are never drifted: one frame alone, drives told in other words."""

import os
from pathlib import Path

import numpy as np
import pytest

from monitor import drift_drives
from monitor.model_file import open_segmenter
from pipeline import drift_trials, staging
from pipeline.parameters import Parameters
from pipeline.watch import Watch

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[3] / "shared" / "data"))
STREETS = ("kitti_raw_0009_a", "kitti_raw_sfnd", "kitti_raw_0005_a", "kitti_odom_03_a")
OFF_ROAD = "rellis_os1"

pytestmark = pytest.mark.slow


def locations():
    """Whatever ``replay`` takes below the folder, by its name there."""
    found = [file.parent for file in DATA.glob("**/calib.json")] + list(DATA.glob("**/*.mcap"))
    return sorted(str(place.relative_to(DATA)) for place in found) or [STREETS[0]]


def drives(location):
    if not (DATA / location).exists():
        pytest.skip(f"no recording {location} (CALIBWATCH_DATA)")
    (place,) = drift_drives.recorded([str(DATA / location)], np.zeros(6))
    return place.read()


@pytest.fixture(scope="module")
def segmenter():
    return open_segmenter(None, 1)


def watched(mount, frames, segmenter):
    watch = Watch(mount, Parameters(), segmenter)
    states = []
    for frame in frames:
        watch.step(frame)
        states.append(watch.memory.state)
        newest_ns = frame.image_stamp_ns
    watch.finish(newest_ns)
    return watch, [*states, watch.memory.state]


@pytest.mark.parametrize("location", locations())
def test_a_single_frame_is_never_drifted(location, segmenter):
    judged = 0
    for drive in drives(location):
        for frame in drive.frames:
            watch, states = watched(drive.mount, [frame], segmenter)
            assert "drifted" not in states
            assert not (OFF_ROAD in location and "healthy" in states)
            judged += watch.belief is not None
    assert judged > 0


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("street", STREETS)
def test_a_street_told_in_other_words_is_never_drifted(street, seed, segmenter):
    (drive,) = drives(street)
    rng = np.random.default_rng([seed, STREETS.index(street)])
    trial = drift_trials.draw("healthy", 0, drive.mount, rng)
    staged = staging.stage(trial, drive.mount, drive.frames, rng)
    watch, states = watched(staged.mount, staged.frames, segmenter)
    assert not {"drifted", "suspect"} & set(states)
    assert watch.belief is not None
