"""``calibwatch evaluate run-length``: false alarms and delays of the sum over scenes, in weeks of it."""

import math
from collections.abc import Callable

import numpy as np
from pydantic import BaseModel, ConfigDict
from scipy.stats import chi2

from monitor.scene_evidence import SIGMA_M, SIGMA_RAD, image_level
from monitor.statements import TO_PEOPLE
from pipeline import drift_test
from pipeline.drift_test import DriftTestParameters, Expectation
from pipeline.records import AXES, Floats
from pipeline.run_length import AlarmBudget, alarm_level, chance_per_scene
from pipeline.scene_filter import Scene
from pipeline.scene_sum import SceneSumParameters
from pipeline.scene_track import TrackParameters
from pipeline.simulation.evidence import EvidenceModel
from pipeline.simulation.evidence_fit import fit
from pipeline.simulation.long_drives import (
    HealthyDrive,
    World,
    delay,
    healthy,
    peaks,
    tail,
    tracked,
)

DRIVE_S = 7200.0
"""s of one drive: a thousand starts share a vehicle-year unequally, some drives are long."""

_BEGINS_S, _ENDS_S = 600.0, 2400.0
"""s; when a drift begins, and when the drive ends that is to tell it."""

_TRACKED_S = 3600.0
_SETTLED = 200
"""Scenes until the tracker has forgotten where it began: 4 km."""

SIZES: tuple[tuple[float, ...], tuple[float, ...]] = ((0.1, 0.25, 0.5), (0.05, 0.1, 0.2))
"""deg of an angle, m of a shift."""

RAMP_DEG_PER_MINUTE = 0.05

STREET_SHARE = 0.4
"""Sigmas of what simulated streets differ by over those of the floor (``evidence_fit``)."""

_BASELINE_STREETS = 12
"""Streets that a baseline is learned on."""

_KINDS = 2 * (len(AXES) * len(SIZES[0]) + 1)
"""Of drift that are told, each in two worlds."""

_LEVELS = (16.0, 20.0, 24.0, 28.0, 32.0, 36.0)
_PEAKS = 20
_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9, 0.97)


class _Values(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Lowered(_Values):
    """Alarms of the settled sum at a lowered level."""

    level: float
    counted: int
    allowed: float
    """By the chance per scene that levels are set by, for white evidence."""


class Healthy(_Values):
    """Drives without drift."""

    hours: float
    drives: int
    scenes: int
    alarms: int
    highest: float
    """Statistic of the settled sum over all stretches but whole drives."""
    highest_since_start: float
    level: float
    """Of the settled sum."""
    windows_above: int
    """Scenes that by themselves exceed their level: what a window's own gates must stop."""
    lowered: tuple[Lowered, ...]
    extrapolated_hourly: tuple[float, float, float] | None
    """Alarms an hour at the true level and its 90 % interval; None where hardly any peak is left."""
    extrapolated_from: float | None


class Told(_Values):
    """A drift of one kind."""

    world: str
    axis: str
    size: float
    """deg or m; deg a minute for a ramp."""
    ramp: bool
    runs: int
    told: int
    early: int
    seconds: float | None
    """Median of those told."""
    way_m: float | None


class Tracked(_Values):
    """A mount on a random walk, followed."""

    world: str
    hours: float
    rms: tuple[float, ...]
    """Per axis, deg and m."""
    sigma: tuple[float, ...]
    """Mean stated."""
    within_two: float
    """Share of errors within two stated sigmas."""


class Fitted(_Values):
    """Image-level streets; each triple is a value and its 90 % interval (``evidence_fit``)."""

    streets: int
    ridden: int
    ridden_ratio: float
    within: tuple[tuple[float, float, float], tuple[float, float, float]]
    """Share of all errors within one stated sigma and within two."""
    scenes: int
    ratio: tuple[float, float, float]
    share: tuple[float, float, float]
    common: tuple[float, float, float]
    common_m: tuple[float, float, float]
    freedom: float
    worth_spread: float
    sigma: tuple[float, ...]
    """Stated for a scene of middling worth, deg and m."""
    quantiles: tuple[tuple[float, float, float], ...]
    """Level, squared errors at it in sigmas of the fitted model, and chi-square's."""


class RunLength(_Values):
    """Everything."""

    seed: int
    fitted: Fitted | None
    healthy: Healthy
    told: tuple[Told, ...]
    tracked: tuple[Tracked, ...]


def worlds() -> dict[str, World]:
    """What is simulated: a stored extrinsic on streets like real ones, a baseline on simulated ones."""
    test = DriftTestParameters()
    stored = drift_test.expectation_of_stored(SIGMA_RAD, SIGMA_M, test)
    street = STREET_SHARE**2 * stored.floor
    learned = Expectation(np.zeros(6), street / _BASELINE_STREETS, street, stored.bound)
    return {
        "stored": World(EvidenceModel(street=stored.floor), stored),
        "baseline": World(EvidenceModel(street=street, ridden=0.0), learned),
    }


def evaluate(
    hours: float, runs: int, streets: int, seed: int, progress: Callable[[str, int, int], None]
) -> RunLength:
    """Healthy hours, delays of drifts, a mount followed.

    Args:
        hours: Of healthy driving.
        runs: Drives for each drift.
        streets: Image-level streets to fit the evidence model to, for comparison; 0: none.
        seed: Of everything.
        progress: Told what is done: name, done, of how many.
    """
    parameters = SceneSumParameters()
    known = worlds()
    fitted = fitted_to(image_level(streets, seed, progress)) if streets else None
    drives = []
    count = max(1, round(hours * 3600.0 / DRIVE_S))
    for index in range(count):
        progress("healthy drive", index + 1, count)
        drives.append(healthy(known["stored"], DRIVE_S, parameters, np.random.default_rng([seed, 0, index])))
    summary = summarised(drives, parameters.budget, np.random.default_rng([seed, 1]))
    told: list[Told] = []
    for number, (name, world) in enumerate(known.items()):
        for axis, axis_name in enumerate(AXES):
            for size in SIZES[axis // 3]:
                progress(f"{name}, {axis_name}", len(told) + 1, _KINDS)
                told.append(_told(name, world, axis, size, runs, [seed, 2, number]))
        told.append(_told(name, world, 2, RAMP_DEG_PER_MINUTE, runs, [seed, 3, number], ramp=True))
    followed = [_tracked(name, world, [seed, 4, n]) for n, (name, world) in enumerate(known.items())]
    return RunLength(seed=seed, fitted=fitted, healthy=summary, told=tuple(told), tracked=tuple(followed))


def fitted_to(streets: list[list[Scene]]) -> Fitted:
    """The evidence model as image-level streets have it."""
    found = fit(streets, DriftTestParameters().floor())
    sigma = np.sqrt(np.diag(found.covariance)) * TO_PEOPLE
    return Fitted(
        streets=found.streets,
        ridden=found.ridden,
        ridden_ratio=found.ridden_ratio,
        within=found.within,
        scenes=found.scenes,
        ratio=found.ratio,
        share=found.share,
        common=found.common,
        common_m=found.correlation_m,
        freedom=found.freedom,
        worth_spread=found.worth_spread,
        sigma=tuple(sigma.tolist()),
        quantiles=tuple(
            (level, float(np.quantile(found.squares, level)), float(chi2.ppf(level, len(AXES))))
            for level in _QUANTILES
        ),
    )


def summarised(drives: list[HealthyDrive], budget: AlarmBudget, rng: np.random.Generator) -> Healthy:
    """What healthy drives tell of the rate of false alarms."""
    settled = [drive.statistics[budget.settled :] for drive in drives]
    scenes = sum(len(part) for part in settled)
    level = alarm_level(budget.settled, budget)
    least = SceneSumParameters().most_square + 0.5
    beyond = tail(drives, level, least, _PEAKS, rng)
    return Healthy(
        hours=sum(drive.seconds for drive in drives) / 3600.0,
        drives=len(drives),
        scenes=sum(len(drive.statistics) for drive in drives),
        alarms=sum(drive.alarms for drive in drives),
        highest=max(float(part.max(initial=0.0)) for part in settled),
        highest_since_start=max(float(drive.since_start.max(initial=0.0)) for drive in drives),
        level=level,
        windows_above=sum(int(np.sum(drive.windows > drive.levels)) for drive in drives),
        lowered=tuple(
            Lowered(
                level=lowered,
                counted=sum(len(peaks(part, lowered)) for part in settled),
                allowed=chance_per_scene(lowered, 6, 4096) * scenes,
            )
            for lowered in _LEVELS
        ),
        extrapolated_hourly=None if beyond is None else beyond.hourly,
        extrapolated_from=None if beyond is None else beyond.threshold,
    )


def _told(
    name: str, world: World, axis: int, size: float, runs: int, seed: list[int], *, ramp: bool = False
) -> Told:
    """Both signs in turn; a ramp goes on until the end of the drive."""
    found = []
    for run in range(runs):
        drift: Floats = np.zeros(6)
        drift[axis] = (math.radians(size) if axis < 3 else size) * (-1.0) ** run
        span = _ENDS_S - _BEGINS_S if ramp else 0.0
        if ramp:
            drift *= span / 60.0
        rng = np.random.default_rng([*seed, axis, round(1000 * size), run])
        found.append(delay(world, drift, span, (_BEGINS_S, _ENDS_S), SceneSumParameters(), rng))
    told = [one for one in found if not one.early and math.isfinite(one.seconds)]
    return Told(
        world=name,
        axis=AXES[axis],
        size=size,
        ramp=ramp,
        runs=runs,
        told=len(told),
        early=sum(one.early for one in found),
        seconds=float(np.median([one.seconds for one in told])) if told else None,
        way_m=float(np.median([one.way_m for one in told])) if told else None,
    )


def _tracked(name: str, world: World, seed: list[int]) -> Tracked:
    errors, sigmas = tracked(world, TrackParameters(), _TRACKED_S, np.random.default_rng(seed))
    errors, sigmas = errors[_SETTLED:], sigmas[_SETTLED:]
    return Tracked(
        world=name,
        hours=_TRACKED_S / 3600.0,
        rms=tuple((np.sqrt(np.mean(errors**2, axis=0)) * TO_PEOPLE).tolist()),
        sigma=tuple((sigmas.mean(axis=0) * TO_PEOPLE).tolist()),
        within_two=float(np.mean(np.abs(errors) <= 2.0 * sigmas)),
    )
