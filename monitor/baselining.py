"""Healthy recordings made into a baseline; what is not surely healthy is refused by name, never learned."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from monitor.daemon import extrinsic_hash, mount_of
from monitor.intake import Intake, pairs_of
from monitor.model_file import open_segmenter
from monitor.preparation import prepare
from monitor.sources import open_source
from monitor.statements import TO_PEOPLE
from monitor.status import AXIS_NAMES
from monitor.wording import size_text
from pipeline.baseline import Baseline, LeftOut, learn, left_out
from pipeline.drift_test import DriftTestParameters
from pipeline.drive_estimates import Drive, Driven
from pipeline.errors import InputError, RigError
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import Floats
from pipeline.road_samples import largest_change, mean_of
from pipeline.segmentation import Segmenter

WANTED_S = 365 * 8 * 3600.0
"""s of driving between two false alarms: a vehicle-year of days of eight hours (DESIGN 4)."""

_SURE_SIGMAS = 2.0
"""Sigma by which a mean must exceed an alert limit to be called beyond it."""


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """What was learned of one pair.

    Attributes:
        mount: What is stored of it.
        baseline: What was learned.
        others: Each recording against the baseline of all others.
        unused: Recordings that gave nothing to learn from, each with the reason.
    """

    mount: Mount
    baseline: Baseline
    others: tuple[LeftOut, ...]
    unused: tuple[tuple[str, str], ...]


def learn_baselines(
    recordings: Sequence[str],
    rig_file: Path | None,
    *,
    model: Path | None,
    stop: threading.Event,
    progress: Callable[[int], None] | None,
) -> dict[str, Learned]:
    """Learns the baselines of all pairs of a rig, by name.

    Args:
        recordings: Healthy drives of one rig under one extrinsic.
        rig_file: Rig file or calib.json, or None: the recordings speak for themselves.
        model: The network's file, or None: the one that ships.
        stop: Ends the reading early.
        progress: Told the number of pairs.

    Raises:
        CalibwatchError: A recording can not be read, is not healthy, or does not go with the others.
        KeyboardInterrupt: ``stop`` was set: half the recordings make another baseline.
    """
    segmenter = open_segmenter(model)
    names = _names(recordings)
    mounts: dict[str, Mount] = {}
    drives: dict[str, list[Drive]] = {}
    count = 0

    def counted() -> None:
        nonlocal count
        count += 1
        if progress is not None:
            progress(count)

    for location, name in zip(recordings, names, strict=True):
        own, driven = _driven(location, name, rig_file, segmenter, stop, counted)
        _same_rig(mounts, own, name)
        mounts |= own
        for pair, drive in driven.items():
            drives.setdefault(pair, []).append(drive)
    return {pair: learned_from(mount, drives[pair], pair) for pair, mount in mounts.items()}


def _names(recordings: Sequence[str]) -> list[str]:
    """A short name for each recording; the same one twice is refused."""
    places = [Path(location).resolve() for location in recordings]
    for place, location in zip(places, recordings, strict=True):
        if places.count(place) > 1:
            raise InputError(f"{location} is given twice", hint="one drive is one sample: name it once")
    short = [place.name for place in places]
    return [
        name if short.count(name) == 1 else location for name, location in zip(short, recordings, strict=True)
    ]


def _driven(
    location: str,
    name: str,
    rig_file: Path | None,
    segmenter: Segmenter,
    stop: threading.Event,
    counted: Callable[[], None],
) -> tuple[dict[str, Mount], dict[str, Drive]]:
    """Watches every pair of a recording."""
    rig = prepare(location, rig_file, None).rig
    mounts = {pair.name: mount_of(pair) for pair in rig.pairs}
    watched = {pair: Driven(name, mount, Parameters(), segmenter) for pair, mount in mounts.items()}
    intake = Intake(rig)
    with open_source(location) as source:
        for pair in pairs_of(source, intake, stop):
            watched[pair.pair].step(pair)
            counted()
    if stop.is_set():
        raise KeyboardInterrupt
    return mounts, {pair: driven.finish() for pair, driven in watched.items()}


def _same_rig(known: dict[str, Mount], own: dict[str, Mount], name: str) -> None:
    """RigError where a recording states another extrinsic, or other intrinsics, than those before it."""
    if known and known.keys() != own.keys():
        raise RigError(
            f"{name} has the pairs {', '.join(own)}, the recordings before it {', '.join(known)}",
            hint="give one rig file for all with --rig",
        )
    for pair, mount in own.items():
        before = known.get(pair, mount)
        hashes = [extrinsic_hash(m.T_cam_lidar) for m in (before, mount)]
        if hashes[0] != hashes[1]:
            raise RigError(
                f"{name} states extrinsic {hashes[1][:12]} of pair {pair}, the recordings before it "
                f"{hashes[0][:12]}",
                hint="learn from recordings of one extrinsic, or give one rig file for all with --rig",
            )
        if not np.array_equal(before.camera.K, mount.camera.K):
            raise RigError(
                f"{name} states other intrinsics of pair {pair} than the recordings before it",
                hint="learn from recordings of one camera, or give one rig file for all with --rig",
            )


def learned_from(mount: Mount, drives: Sequence[Drive], pair: str) -> Learned:
    """The baseline of one pair from its drives.

    Raises:
        InputError: A drive is not healthy, differs from all others, is there twice, or none gave a window.
    """
    unused = tuple((d.estimates.recording, d.memory.reason) for d in drives if len(d.estimates) == 0)
    usable = [drive for drive in drives if len(drive.estimates) > 0]
    if not usable:
        listed = "; ".join(f"{name}: {reason}" for name, reason in unused)
        raise InputError(
            f"pair {pair}: nothing to learn from: {listed}",
            hint="longer recordings in good light, with poles, kerbs and lane markings",
        )
    parameters = Parameters()
    _refuse_unhealthy(mount, usable, pair, parameters.test)
    _refuse_twins(usable, pair)
    rng = np.random.default_rng(parameters.seed)
    baseline = learn([drive.estimates for drive in usable], parameters.test, WANTED_S, rng)
    others = left_out([drive.estimates for drive in usable], parameters.test)
    _refuse_stranger(others, parameters.test.alarm, pair)
    return Learned(mount, baseline, others, unused)


def _refuse_unhealthy(mount: Mount, drives: Sequence[Drive], pair: str, test: DriftTestParameters) -> None:
    """InputError names every drive that is surely beyond an alert limit, or on which the mount moved.

    One that is told drifted, but by less and from its first window on, shows how far the stored extrinsic is
    off: that is the bias.
    """
    troubles = []
    for drive in drives:
        name = drive.estimates.recording
        mean, covariance = mean_of(drive.estimates)
        beyond = np.abs(mean) - _SURE_SIGMAS * np.sqrt(np.diag(covariance)) > mount.limits
        if beyond.any():
            troubles.append(f"{name} is off by {_sizes(mean, np.flatnonzero(beyond))}")
            continue
        change = largest_change(drive.estimates, test.floor())
        if change.statistic > test.alarm:
            axis = int(np.argmax(np.abs(change.difference) / mount.limits))
            troubles.append(f"{name} moved on the way by {_sizes(change.difference, [axis])}")
    if troubles:
        raise InputError(
            f"pair {pair}: not healthy: {'; '.join(troubles)}",
            hint="leave such recordings out; if all are off, calibrate first: calibwatch calibrate",
        )


def _refuse_twins(drives: Sequence[Drive], pair: str) -> None:
    """InputError where two recordings hold the same drive, or a part of it: no two windows are ever equal."""
    windows = [{row.tobytes() for row in drive.estimates.drift} for drive in drives]
    for index, drive in enumerate(drives):
        for before, other in enumerate(drives[:index]):
            if windows[index] & windows[before]:
                names = f"{other.estimates.recording} and {drive.estimates.recording}"
                raise InputError(
                    f"pair {pair}: {names} are the same drive", hint="one drive is one sample: name it once"
                )


def _refuse_stranger(others: Sequence[LeftOut], alarm: float, pair: str) -> None:
    """InputError names the recording that goes least with the others, where it is as far off as a drift."""
    if not others:
        return
    worst = max(others, key=lambda other: other.statistic)
    if worst.statistic > alarm:
        axis = int(np.argmax(np.abs(worst.difference) / worst.sigma))
        raise InputError(
            f"pair {pair}: {worst.recording} differs from the other recordings by "
            f"{_sizes(worst.difference, [axis])} (T {worst.statistic:.0f}, alarm {alarm:.0f})",
            hint="the mount moved before or after it: leave out what was recorded under another mount",
        )


def _sizes(six: Floats, axes: Sequence[int] | np.ndarray) -> str:
    """Some axes with their sizes, for people."""
    return " and ".join(
        f"{AXIS_NAMES[axis]} {size_text(AXIS_NAMES[axis], float(six[axis] * TO_PEOPLE[axis]), sign=True)}"
        for axis in axes
    )


@dataclass(frozen=True, slots=True)
class Description:
    """What was learned of one pair, in words and in degrees and metres.

    Attributes:
        samples: How much road it rests on.
        bias: How well the bias is known.
        noise: How far a window's stated sigma is honest.
        threshold: What became of the thresholds.
        rows: Per axis bias, its sigma, sigma between scenes, and bound as the test uses them.
        others: Each recording against the others, one clause each.
    """

    samples: str
    bias: str
    noise: str
    threshold: str
    rows: tuple[tuple[float, float, float, float], ...]
    others: tuple[str, ...]


def described(learned: Learned) -> Description:
    """Puts a baseline into words."""
    baseline, tail = learned.baseline, learned.baseline.tail
    expected = baseline.expectation(Parameters().test)
    sigma = np.sqrt(np.diag(expected.covariance)) * TO_PEOPLE
    scene = np.sqrt(np.diag(expected.floor)) * TO_PEOPLE
    count = len(baseline.stretches)
    recordings = len({stretch.recording for stretch in baseline.stretches})
    way_m = sum(stretch.way_m for stretch in baseline.stretches)
    samples = (
        f"{_counted(recordings, 'recording')}, {_counted(count, 'stretch of road', 'stretches of road')} "
        f"({way_m:.0f} m), {baseline.samples:.1f} effective samples"
    )
    bias = f"bias known to {sigma[:3].max():.2f} deg, {sigma[3:].max():.3f} m"
    if count == 1:
        bias += " (one street tells nothing of the spread between streets: that of any rig is taken)"
    if tail.threshold is not None and tail.interval is not None:
        low, high = tail.interval
        threshold = (
            f"alarm at T {tail.threshold:.1f} for one false alarm in a vehicle-year, extrapolated from "
            f"{tail.stretches} stretches (95 % interval {low:.1f} to {high:.1f})"
        )
    elif recordings == 1:
        threshold = "one recording tells no run length: default thresholds stay"
    elif tail.stretches < tail.needed:
        threshold = (
            f"too few for a run length ({tail.stretches} of some {tail.needed} stretches): "
            "default thresholds stay"
        )
    else:
        threshold = "the statistic has too heavy a tail to continue: default thresholds stay"
    values = (baseline.bias * TO_PEOPLE, sigma, scene, expected.bound * TO_PEOPLE)
    rows = tuple((float(b), float(s), float(q), float(limit)) for b, s, q, limit in zip(*values, strict=True))
    others = tuple(
        f"{other.recording} against the others: T {other.statistic:.1f}, "
        + ", ".join(_sizes(other.difference, [axis]) for axis in range(len(AXIS_NAMES)))
        for other in learned.others
    )
    scatter = baseline.scatter
    noise = f"windows scatter by {scatter.noise:.2f} of their sigma, alike over {scatter.correlation_m:.0f} m"
    return Description(samples, bias, noise, threshold, rows, others)


def _counted(count: int, one: str, many: str = "") -> str:
    return f"{count} {one}" if count == 1 else f"{count} {many or one + 's'}"
