"""Healthy hours, delays and tails on simulated evidence."""

import math

import numpy as np
import pytest

from pipeline.drift_test import DriftTestParameters, expectation_of_stored
from pipeline.scene_sum import SceneSumParameters
from pipeline.scene_track import TrackParameters
from pipeline.simulation.evidence import EvidenceModel
from pipeline.simulation.long_drives import HealthyDrive, World, delay, healthy, peaks, tail, tracked

STORED = expectation_of_stored(math.radians(0.1), 0.02, DriftTestParameters())
WORLD = World(EvidenceModel(street=STORED.floor), STORED)


def test_an_hour_without_drift_is_an_hour_without_alarm() -> None:
    drive = healthy(WORLD, 1800.0, SceneSumParameters(), np.random.default_rng(1))
    assert drive.alarms == 0
    assert len(drive.statistics) == len(drive.levels) == len(drive.windows) == len(drive.since_start)
    assert np.all(np.diff(drive.levels) >= 0)


def test_half_a_degree_is_told_after_it_came_and_nothing_is_told_without() -> None:
    rng = np.random.default_rng(2)
    drift = np.array([0.0, 0.0, math.radians(0.5), 0.0, 0.0, 0.0])
    found = delay(WORLD, drift, 0.0, (600.0, 1800.0), SceneSumParameters(), rng)
    assert not found.early
    assert 0.0 < found.seconds < 600.0
    assert found.way_m > 0.0
    nothing = delay(WORLD, np.zeros(6), 0.0, (600.0, 1200.0), SceneSumParameters(), rng)
    assert math.isinf(nothing.seconds)


def test_a_mount_on_a_walk_is_followed_with_honest_sigmas() -> None:
    errors, sigmas = tracked(WORLD, TrackParameters(), 1800.0, np.random.default_rng(3))
    late = np.abs(errors[300:]) <= 2.0 * sigmas[300:]
    assert late.mean() > 0.85
    assert sigmas[-1][2] < sigmas[0][2]


def test_peaks_near_each_other_are_one() -> None:
    statistics = np.zeros(500)
    statistics[[10, 12, 40, 200, 201, 400]] = [3.0, 5.0, 4.0, 9.0, 8.0, 2.0]
    assert peaks(statistics, 2.5).tolist() == [5.0, 9.0]
    assert len(peaks(statistics, 10.0)) == 0


@pytest.mark.parametrize("level", [30.0, 40.0])
def test_an_exponential_tail_is_extrapolated_to_its_rate(level: float) -> None:
    rng = np.random.default_rng(4)
    drives = []
    for _ in range(40):
        statistics = np.zeros(60_000)
        # One peak an hour above 10, of mean excess 3, over a hundred hours.
        places = np.arange(100, 60_000, 200)
        statistics[places] = 10.0 + rng.exponential(3.0, len(places))
        levels = np.full(60_000, 50.0)
        drives.append(HealthyDrive(300 * 3600.0, np.zeros(60_000), statistics, levels, statistics))
    found = tail(drives, level, 10.0, 40, np.random.default_rng(5))
    assert found is not None
    truth = math.exp(-(level - 10.0) / 3.0)
    middle, low, high = found.hourly
    assert low < middle < high
    assert low / 2 < truth < high * 2
    assert found.peaks >= 40


def test_without_peaks_there_is_no_tail() -> None:
    quiet = HealthyDrive(3600.0, np.zeros(100), np.zeros(100), np.full(100, 50.0), np.zeros(100))
    assert tail([quiet], 50.0, 10.0, 20, np.random.default_rng(6)) is None
