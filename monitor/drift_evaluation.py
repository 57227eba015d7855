"""``calibwatch evaluate drift``: known drives, watched as they are and with things made wrong."""

import dataclasses
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from monitor.clock import Clock
from monitor.drift_baselines import OtherDrives
from monitor.drift_drives import KnownDrive, Place
from monitor.drift_rows import Row, Rows, Said, Six, SixFlags
from monitor.statements import TO_PEOPLE
from monitor.status import State
from pipeline import drift_trials, staging
from pipeline.belief import Belief
from pipeline.drift_trials import KINDS, Kind, Trial
from pipeline.parameters import Parameters
from pipeline.records import Floats
from pipeline.segmentation import Segmenter
from pipeline.watch import Watch

Progress = Callable[[str, int, int], None]
"""Is told what is watched, how many runs of the drive are done, and of how many."""

RUNS = 40
"""Of each kind on each drive, unless asked otherwise."""


@dataclass(frozen=True, slots=True, eq=False)
class Options:
    """What is run.

    Attributes:
        runs: Of each kind on each drive, at least; of every label of a kind equally many.
        seed: Of whatever is drawn.
        kinds: Of trials.
        limits: float64 (6,), alert limits of every mount, rad and m, or None: each mount's own.
        baselines: Learned on the other drives, or None: there are none.
        parameters: Of the watch.
    """

    runs: int = RUNS
    seed: int = 0
    kinds: tuple[Kind, ...] = KINDS
    limits: Floats | None = None
    baselines: OtherDrives | None = None
    parameters: Parameters = field(default_factory=Parameters)


def evaluate(
    places: Sequence[Place],
    segmenter: Segmenter,
    options: Options,
    rows: Rows,
    clock: Clock,
    progress: Progress,
) -> None:
    """Watches every drive in every trial that ``rows`` does not hold yet.

    Args:
        places: Of the drives, each decoded once.
        segmenter: The network.
        options: What is run.
        rows: Takes each run as it ends.
        clock: For the times.
        progress: Told each run.
    """
    for place in places:
        for known in place.read():
            drive = _stored(known, place.name, options)
            wanted = [
                (kind, n) for kind in options.kinds for n in range(drift_trials.count(kind, options.runs))
            ]
            for done, (kind, number) in enumerate(wanted, 1):
                if (drive.name, kind, number) not in rows:
                    rows.add(run(drive, kind, number, segmenter, options, clock))
                progress(drive.name, done, len(wanted))


def _stored(drive: KnownDrive, place: str, options: Options) -> KnownDrive:
    """The drive with the alert limits and the baseline that it is judged with."""
    mount = drive.mount
    if options.limits is not None:
        mount = dataclasses.replace(mount, limits=options.limits)
    if options.baselines is not None:
        mount = dataclasses.replace(mount, baseline=options.baselines.baseline(place, drive))
    return dataclasses.replace(drive, mount=mount)


def run(
    drive: KnownDrive, kind: Kind, number: int, segmenter: Segmenter, options: Options, clock: Clock
) -> Row:
    """One run: the watch of ``replay``, without its outputs."""
    # By name, so that a run is the same whichever drives are evaluated beside it.
    rng = np.random.default_rng([options.seed, zlib.crc32(drive.name.encode()), KINDS.index(kind), number])
    trial = drift_trials.draw(kind, number, drive.mount, rng)
    staged = staging.stage(trial, drive.mount, drive.frames, rng)
    begun_ns = clock.monotonic_ns()
    watch = Watch(staged.mount, options.parameters, segmenter)
    states: list[tuple[State, float]] = []
    stamp_ns = first_ns = drive.frames[0].image_stamp_ns + trial.late_ns
    for frame in staged.frames:
        watch.step(frame)
        stamp_ns = frame.image_stamp_ns
        assert watch.memory is not None  # noqa: S101 - set by the first step
        states.append((watch.memory.state, (stamp_ns - first_ns) / 1e9))
    watch.finish(stamp_ns)
    return _row(drive, trial, watch, states, (clock.monotonic_ns() - begun_ns) / 1e9)


def _row(
    drive: KnownDrive, trial: Trial, watch: Watch, states: Sequence[tuple[State, float]], seconds: float
) -> Row:
    memory = watch.memory
    assert memory is not None  # noqa: S101 - set by finish
    told = next((k for k, (state, _) in enumerate(states) if state == "drifted"), None)
    return Row(
        drive=drive.name,
        simulated=drive.simulated,
        kind=trial.kind,
        label=trial.label,
        number=trial.number,
        drift=_six(trial.drift * TO_PEOPLE),
        state=memory.state,
        code=memory.code,
        frames=len(drive.frames),
        span_s=drive.span_s,
        since_s=_since_s(drive, trial),
        suspected_s=_first(states, ("suspect", "drifted")),
        told_s=_first(states, ("drifted",)),
        told_frames=None if told is None else told + 1,
        called_s=_first(states, ("healthy", "drifted")),
        said=None if watch.belief is None else _said(watch.belief, watch.mount.limits),
        reference_sigma=_six(drive.reference_sigma * TO_PEOPLE),
        seconds=seconds,
    )


def _since_s(drive: KnownDrive, trial: Trial) -> float:
    first = drive.frames[trial.first_wrong(len(drive.frames))]
    return (first.image_stamp_ns - drive.frames[0].image_stamp_ns) / 1e9


def _first(states: Sequence[tuple[State, float]], wanted: tuple[State, ...]) -> float | None:
    return next((seconds for state, seconds in states if state in wanted), None)


def _said(belief: Belief, limits: Floats) -> Said:
    judgement = belief.judgement
    return Said(
        drift=_six(judgement.drift * TO_PEOPLE),
        sigma=_six(judgement.sigma * TO_PEOPLE),
        protection_level=_six(judgement.protection_level * TO_PEOPLE),
        alert_limit=_six(limits * TO_PEOPLE),
        observable=_flags(judgement.observable),
        monitored=_flags(judgement.monitored),
        statistic=judgement.statistic,
    )


def _six(values: Floats) -> Six:
    a, b, c, d, e, f = (float(value) for value in values)
    return a, b, c, d, e, f


def _flags(values: np.ndarray) -> SixFlags:
    a, b, c, d, e, f = (bool(value) for value in values)
    return a, b, c, d, e, f
