"""``calibwatch evaluate dataset``: frames calibrated one by one from starts that are off by known amounts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from monitor.clock import Clock
from monitor.coarse_evaluation import Coarse, CoarseSummary, coarse_of, coarse_summary
from monitor.evaluated_frames import EvaluatedFrame, EvaluatedFrames
from monitor.first_guess import PriorSigma
from monitor.frame_calibration import Stopwatch, calibrated, drawn_start, errors_of
from monitor.statements import TO_PEOPLE
from monitor.status import AXIS_NAMES, AxisName
from pipeline import se3
from pipeline.calibration import Calibrated
from pipeline.error_statistics import CONFIDENT_SIGMAS, beyond, honesty, mean_absolute
from pipeline.records import Floats
from pipeline.segmentation import Segmenter

Progress = Callable[[str, int, int], None]
"""Is told what is calibrated, how many are done, and of how many."""

STARTS, ROTATION_DEG, TRANSLATION_M, SEED = 3, 2.0, 0.3, 0
"""What is run unless asked otherwise: starts a frame, their widest error on each axis."""


@dataclass(frozen=True, slots=True)
class Options:
    """How frames are calibrated.

    Attributes:
        starts: For each frame.
        rotation_deg: Starts are off by up to so much about each axis, deg.
        translation_m: Likewise along each axis, m.
        seed: Of the starts.
        prior_sigma: As calibrate takes it with ``--prior-sigma``, or None: starts are first guesses.
    """

    starts: int = STARTS
    rotation_deg: float = ROTATION_DEG
    translation_m: float = TRANSLATION_M
    seed: int = SEED
    prior_sigma: PriorSigma | None = None

    @property
    def widest(self) -> Floats:
        """Largest error of a start, float64 (6,), rad and m."""
        return np.array([np.radians(self.rotation_deg)] * 3 + [self.translation_m] * 3)


class _Values(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class AxisError(_Values):
    """One axis of one answer; deg for roll, pitch, yaw, m for forward, left, up."""

    start: float
    error: float
    sigma: float
    observable: bool


class Answer(_Values):
    """What one frame gave from one start."""

    frame: str
    group: str
    start: int
    axes: dict[AxisName, AxisError]
    start_rotation_deg: float
    start_translation_m: float
    rotation_deg: float
    """CRLF (16)."""
    translation_m: float
    """CRLF (15)."""
    wrong: tuple[AxisName, ...]
    """Observable axes whose error is beyond four sigmas of answer and reference together."""
    held: tuple[str, ...]
    reason: str
    ms: dict[str, float]
    """Time of each stage, and of all together."""


class Trust(_Values):
    """What the answers say of themselves, against their errors (``pipeline.error_statistics.Honesty``)."""

    axes: int
    within_one: float
    within_two: float
    confident_wrong: int
    mean_square: float
    below_95: float
    p: float


class Summary(_Values):
    """One set: mean absolute errors in the order of ``AXIS_NAMES``, null without any; shares of answers."""

    group: str
    frames: int
    answers: int
    start: tuple[float | None, ...]
    observable: tuple[float | None, ...]
    """Over the answers that call the axis observable."""
    everything: tuple[float | None, ...]
    """Over all answers, those that hold the axis too."""
    median_observable_deg: float | None
    """Median error of one observable angle."""
    median_observable_m: float | None
    start_rotation_deg: float
    start_translation_m: float
    rotation_deg: float
    """Median of CRLF (16)."""
    translation_m: float
    """Median of CRLF (15)."""
    yaw_and_pitch: float
    all_six: float
    nothing: float
    trust: Trust | None
    ms: dict[str, float]
    """Medians."""


class Dataset(_Values):
    """Every answer and its sets; the last summary is that of all."""

    starts: int
    rotation_deg: float
    translation_m: float
    seed: int
    prior_sigma: tuple[float, float] | None
    """Deg and m, as calibrate was told; null: it was not."""
    summaries: tuple[Summary, ...]
    coarse_summaries: tuple[CoarseSummary, ...]
    answers: tuple[Answer, ...]
    coarse: tuple[Coarse, ...]
    """Of each frame, without a prior."""


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """One calibration, rad and m."""

    answer: Answer
    off: Floats
    error: Floats
    covariance: Floats
    observable: NDArray[np.bool_]
    reference_sigma: Floats


def evaluate(
    frames: EvaluatedFrames, segmenter: Segmenter, options: Options, clock: Clock, progress: Progress
) -> Dataset:
    """Calibrates every frame from every start by what ``calibwatch calibrate`` runs, and without a prior.

    Args:
        frames: With their true extrinsics.
        segmenter: The network.
        options: How.
        clock: For the times.
        progress: Told each answer.
    """
    runs: list[_Run] = []
    coarse: list[Coarse] = []
    for frame in frames:
        coarse.append(coarse_of(frame, segmenter, options.seed, clock))
        for start in range(options.starts):
            runs.append(_run(frame, start, segmenter, options, clock))
            progress(frame.name, len(runs), len(frames) * options.starts)
    groups = list(dict.fromkeys(run.answer.group for run in runs))
    sets = {group: {group} for group in groups} | ({"all": set(groups)} if len(groups) > 1 else {})
    return Dataset(
        starts=options.starts,
        rotation_deg=options.rotation_deg,
        translation_m=options.translation_m,
        seed=options.seed,
        prior_sigma=None
        if options.prior_sigma is None
        else (float(np.degrees(options.prior_sigma.sigma_rad)), options.prior_sigma.sigma_m),
        summaries=tuple(
            _summary(name, [run for run in runs if run.answer.group in those]) for name, those in sets.items()
        ),
        coarse_summaries=tuple(
            coarse_summary(name, [one for one in coarse if one.group in those])
            for name, those in sets.items()
        ),
        answers=tuple(run.answer for run in runs),
        coarse=tuple(coarse),
    )


def _run(frame: EvaluatedFrame, start: int, segmenter: Segmenter, options: Options, clock: Clock) -> _Run:
    mount = frame.off_by(drawn_start(frame, start, options.widest, options.seed))
    times = Stopwatch(clock)
    with times.stage("all"):
        found = calibrated(frame, mount, segmenter, times, options.prior_sigma)
    off, error = errors_of(frame, mount.T_cam_lidar), errors_of(frame, found.T_estimated)
    answer = _answer(frame, start, found, (mount.T_cam_lidar, off, error)).model_copy(
        update={"ms": dict(times.ms)}
    )
    return _Run(answer, off, error, found.covariance, found.observable, frame.reference_sigma)


def _answer(
    frame: EvaluatedFrame, start: int, found: Calibrated, against: tuple[Floats, Floats, Floats]
) -> Answer:
    T_start, off, error = against
    sigma = np.sqrt(np.diag(found.covariance))
    ratio = beyond(error, sigma, frame.reference_sigma, found.observable)
    truth = frame.mount.T_cam_lidar
    start_m, start_rad = se3.pose_error(truth, T_start)
    end_m, end_rad = se3.pose_error(truth, found.T_estimated)
    axes = {
        name: AxisError(
            start=float(off[i] * TO_PEOPLE[i]),
            error=float(error[i] * TO_PEOPLE[i]),
            sigma=float(sigma[i] * TO_PEOPLE[i]),
            observable=bool(found.observable[i]),
        )
        for i, name in enumerate(AXIS_NAMES)
    }
    return Answer(
        frame=frame.name,
        group=frame.group,
        start=start,
        axes=axes,
        start_rotation_deg=float(np.degrees(start_rad)),
        start_translation_m=start_m,
        rotation_deg=float(np.degrees(end_rad)),
        translation_m=end_m,
        wrong=tuple(name for name, r in zip(AXIS_NAMES, ratio, strict=True) if r > CONFIDENT_SIGMAS),
        held=found.held,
        reason=found.reason,
        ms={},
    )


def _summary(group: str, runs: Sequence[_Run]) -> Summary:
    answers = [run.answer for run in runs]
    errors, seen = [run.error for run in runs], [run.observable for run in runs]
    trust = honesty(errors, [run.covariance for run in runs], seen, [run.reference_sigma for run in runs])
    stacked, mask = np.abs(np.stack(errors)), np.stack(seen)
    return Summary(
        group=group,
        frames=len({answer.frame for answer in answers}),
        answers=len(answers),
        start=_to_people(mean_absolute([run.off for run in runs])),
        observable=_to_people(mean_absolute(errors, seen)),
        everything=_to_people(mean_absolute(errors)),
        median_observable_deg=_median(np.degrees(stacked[:, :3][mask[:, :3]])),
        median_observable_m=_median(stacked[:, 3:][mask[:, 3:]]),
        start_rotation_deg=float(np.median([answer.start_rotation_deg for answer in answers])),
        start_translation_m=float(np.median([answer.start_translation_m for answer in answers])),
        rotation_deg=float(np.median([answer.rotation_deg for answer in answers])),
        translation_m=float(np.median([answer.translation_m for answer in answers])),
        yaw_and_pitch=float(mask[:, [AXIS_NAMES.index("yaw"), AXIS_NAMES.index("pitch")]].all(axis=1).mean()),
        all_six=float(mask.all(axis=1).mean()),
        nothing=float((~mask.any(axis=1)).mean()),
        trust=None
        if trust is None
        else Trust(
            axes=trust.axes,
            within_one=trust.within_one,
            within_two=trust.within_two,
            confident_wrong=trust.confident_wrong,
            mean_square=trust.mean_square,
            below_95=trust.below_95,
            p=trust.p,
        ),
        ms={
            stage: float(np.median([answer.ms[stage] for answer in answers if stage in answer.ms]))
            for stage in dict.fromkeys(name for answer in answers for name in answer.ms)
        },
    )


def _to_people(values: Sequence[float | None]) -> tuple[float | None, ...]:
    """Deg and m of rad and m."""
    return tuple(
        None if value is None else value * float(scale)
        for value, scale in zip(values, TO_PEOPLE, strict=True)
    )


def _median(values: Floats) -> float | None:
    return float(np.median(values)) if len(values) else None
