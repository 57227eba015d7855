"""The sum over scenes on weeks of simulated evidence: false alarms, delays, the mount followed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import scene_sum, scene_track
from pipeline.drift_test import Expectation
from pipeline.records import Floats
from pipeline.run_length import alarm_level
from pipeline.scene_sum import SceneSumParameters
from pipeline.scene_track import TrackParameters
from pipeline.simulation.evidence import EvidenceModel, scenes

_APART = 50
"""Scenes (1 km) between two alarms that are two, not one that goes on."""

_FEWEST = 5
"""Peaks; fewer have no slope."""

_DRAWS = 4000
"""Draws of the rate and slope of a tail, for the interval of what is beyond it."""


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """How evidence scatters, and what the monitor expects.

    Attributes:
        model: Of the evidence.
        expectation: Of an unmoved mount. The true bias of each drive is drawn from it.
    """

    model: EvidenceModel
    expectation: Expectation

    def bias(self, rng: np.random.Generator) -> Floats:
        """What an unmoved mount of one vehicle shows against the expected mean, (6,)."""
        root = np.linalg.cholesky(self.expectation.covariance + 1e-18 * np.eye(6))
        return np.asarray(root @ rng.normal(size=6))


@dataclass(frozen=True, slots=True, eq=False)
class HealthyDrive:
    """One drive without drift.

    Attributes:
        seconds: Its duration.
        since_start: float64 (n,), of the sum after each scene, for the stretch that is the whole drive: the
            bias of the stored extrinsic is one draw for it, not one an hour.
        statistics: float64 (n,), the largest of all other stretches.
        levels: float64 (n,), above which it would have been an alarm.
        windows: float64 (n,), of each scene by itself against the expected mean.
    """

    seconds: float
    since_start: Floats
    statistics: Floats
    levels: Floats
    windows: Floats

    @property
    def alarms(self) -> int:
        """Alarms of the sum that are not one that goes on."""
        above = np.maximum(self.since_start, self.statistics) - self.levels
        return len(peaks(above, 0.0))


def healthy(
    world: World, seconds: float, parameters: SceneSumParameters, rng: np.random.Generator
) -> HealthyDrive:
    """One drive of an unmoved mount."""
    bias = world.bias(rng)
    expectation = world.expectation
    total = scene_sum.begin(expectation)
    since_start, statistics, levels, windows = [], [], [], []
    for scene in scenes(world.model, seconds, lambda _: bias, rng):
        total = scene_sum.advance(total, scene, expectation, parameters)
        doubt = scene.covariance + np.outer(scene.feigned, scene.feigned)
        doubt = doubt + expectation.floor + expectation.covariance
        since_start.append(float(total.statistics[1]))
        statistics.append(float(total.statistics[2:].max(initial=0.0)))
        levels.append(alarm_level(total.scenes, parameters.budget))
        windows.append(float(scene.drift @ np.linalg.solve(doubt, scene.drift)))
    return HealthyDrive(
        seconds, np.array(since_start), np.array(statistics), np.array(levels), np.array(windows)
    )


@dataclass(frozen=True, slots=True)
class Delay:
    """How a drift was told.

    Attributes:
        early: An alarm came before the drift began.
        seconds: From its beginning to the alarm; inf where none came.
        way_m: Driven in that time; inf likewise.
    """

    early: bool
    seconds: float
    way_m: float


def delay(
    world: World,
    drift: Floats,
    ramp_s: float,
    times_s: tuple[float, float],
    parameters: SceneSumParameters,
    rng: np.random.Generator,
) -> Delay:
    """How long until the sum tells a drift.

    Args:
        world: See there.
        drift: float64 (6,), rad and m.
        ramp_s: Time in which it grows to that, s; 0: at once.
        times_s: When it begins, and when the drive ends, s.
        parameters: Of the sum.
        rng: Source of the draw.
    """
    begins, ends = times_s
    bias = world.bias(rng)

    def mount(time: float) -> Floats:
        grown = float(time >= begins) if ramp_s <= 0.0 else min(max((time - begins) / ramp_s, 0.0), 1.0)
        return bias + grown * drift

    total = scene_sum.begin(world.expectation)
    way_m = 0.0
    for scene in scenes(world.model, ends, mount, rng):
        total = scene_sum.advance(total, scene, world.expectation, parameters)
        time = scene.stamp_ns / 1e9
        if time < begins:
            way_m = scene.way_m
        if scene_sum.alarming(total, parameters):
            return Delay(time < begins, time - begins, scene.way_m - way_m)
    return Delay(early=False, seconds=math.inf, way_m=math.inf)


def tracked(
    world: World, parameters: TrackParameters, seconds: float, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Follows a mount on a random walk as fast as the tracker expects.

    Returns:
        Errors, float64 (n,6), and their stated sigmas, (n,6), after each scene.
    """
    step_s = 10.0
    walk = np.array([parameters.walk_rad] * 3 + [parameters.walk_m] * 3) * math.sqrt(step_s / 3600.0)
    steps = rng.normal(size=(math.ceil(seconds / step_s) + 200, 6)) * walk
    mounts = world.bias(rng) + np.cumsum(steps, axis=0)

    def mount(time: float) -> Floats:
        return np.asarray(mounts[min(int(time / step_s), len(mounts) - 1)])

    track = scene_track.begin(world.expectation)
    errors, sigmas = [], []
    for scene in scenes(world.model, seconds, mount, rng):
        track = scene_track.followed(track, scene, world.expectation, parameters)
        errors.append(track.drift - mount(scene.stamp_ns / 1e9))
        sigmas.append(np.sqrt(np.diag(track.drift_covariance)))
    return np.array(errors), np.array(sigmas)


@dataclass(frozen=True, slots=True)
class Tail:
    """False alarms at lowered levels, extrapolated to the true one.

    Attributes:
        threshold: Level above which peaks were counted.
        peaks: How many there were.
        mean_excess: Mean height above it.
        level: The true one.
        hourly: Alarms an hour there by extrapolation, and its 90 % interval.
    """

    threshold: float
    peaks: int
    mean_excess: float
    level: float
    hourly: tuple[float, float, float]


def peaks(statistics: Floats, level: float) -> Floats:
    """Heights of the alarms that a level would give: the highest of each run above it."""
    above = np.flatnonzero(statistics > level)
    if len(above) == 0:
        return np.zeros(0)
    parts = np.split(above, np.flatnonzero(np.diff(above) > _APART) + 1)
    return np.array([statistics[part].max() for part in parts])


def tail(
    drives: Sequence[HealthyDrive], level: float, least: float, wanted_peaks: int, rng: np.random.Generator
) -> Tail | None:
    """Exponential tail of the peaks above the level that ``wanted_peaks`` of them exceed.

    Chi-square's tail falls faster the further out, so the extrapolated rate errs to the safe side.

    Args:
        drives: Healthy ones; the scenes near their starts, with their own levels, are left out.
        level: Where the rate is wanted.
        least: Peaks are counted above this at least: at the square for which one scene is heard at most
            single outliers pile up, whose peaks fall off faster than those that several scenes make.
        wanted_peaks: 20 or more tell the slope to a quarter.
        rng: For the interval.

    Returns:
        The tail, or None where there are hardly any peaks.
    """
    settled = [drive.statistics[drive.levels >= drive.levels.max()] for drive in drives if len(drive.levels)]
    hours = sum(
        drive.seconds / 3600.0 * len(part) / max(len(drive.statistics), 1)
        for drive, part in zip((d for d in drives if len(d.levels)), settled, strict=True)
    )
    found, threshold = np.zeros(0), level
    while threshold > least and len(found) < wanted_peaks:
        threshold = max(threshold - 0.5, least)
        found = np.concatenate([peaks(part, threshold) for part in settled]) if settled else found
    if len(found) < _FEWEST or hours <= 0.0:
        return None
    excess = float(np.mean(found - threshold))
    rates = rng.gamma(len(found), 1.0 / hours, _DRAWS)
    slopes = excess * len(found) / rng.gamma(len(found), 1.0, _DRAWS)
    beyond = rates * np.exp(-(level - threshold) / slopes)
    middle = len(found) / hours * math.exp(-(level - threshold) / excess)
    low, high = np.quantile(beyond, [0.05, 0.95])
    return Tail(threshold, len(found), excess, level, (middle, float(low), float(high)))
