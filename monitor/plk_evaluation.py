"""``calibwatch evaluate plk-table1|plk-fig5|plk-fig6``: PLK-Calib's experiments, run and put into values."""

import math
from collections.abc import Callable, Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict

from pipeline.plk_scenes import METHODS, SCENES, Method, errors, scene
from pipeline.plk_starts import OFFSETS, SUCCESS, SURROUNDINGS, Half, fig5_once, fig6_once
from pipeline.plk_table import Trial, against_chi_square, answered, checks, median_errors, run_once
from pipeline.records import Floats

Progress = Callable[[str, int, int], None]
"""Is told what is run, how many runs are done, and of how many."""

NOISES_PX = (0.3, 1.0)
"""px; the noises of FORMULAS H."""


class _Values(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Median(_Values):
    """What one method gave in one row; null where it never gave an answer."""

    answers: int
    rotation_rad: float | None
    translation_m: float | None


class Demand(_Values):
    """One demand on a row, and whether it was met."""

    demand: str
    met: bool


class Row(_Values):
    """One scene of Table I at one noise."""

    scene: str
    sigma_px: float
    methods: dict[Method, Median]
    gap: float | None
    """Largest difference between the elements (rad, m) of I and II over all runs; null where II gave none."""
    rank_wanted: int
    ranks: dict[int, int]
    """How many runs found which rank."""
    held_deg: float | None
    """Largest angle between the direction that is held and the right one; null where none is to be held."""
    seen_rotation_rad: float
    seen_translation_m: float
    """Medians of ours in the directions that it sees."""
    chi_square_mean: float
    """Squared normalised error of ours over its degrees of freedom: 1 where the covariance is right."""
    chi_square_within: float
    """Share of runs below the 95 % point of chi-square."""
    chi_square_p: float
    """Kolmogorov-Smirnov probability of so large a difference from chi-square by chance."""
    demands: tuple[Demand, ...]

    @property
    def met(self) -> bool:
        """Whether every demand was met."""
        return all(demand.met for demand in self.demands)


class Table(_Values):
    """Table I."""

    runs: int
    seed: int
    rows: tuple[Row, ...]

    @property
    def met(self) -> bool:
        """Whether every demand of every row was met."""
        return all(row.met for row in self.rows)


def table(runs: int, seed: int, progress: Progress) -> Table:
    """Runs Table I; each row has a seed of its own."""
    rows = []
    for i, name in enumerate(SCENES):
        for j, sigma_px in enumerate(NOISES_PX):
            rng = np.random.default_rng([seed, i, j])
            trials = []
            for done in range(runs):
                trials.append(run_once(scene(name), sigma_px, rng))
                progress(f"scene {name}, {sigma_px:g} px", done + 1, runs)
            rows.append(_row(name, sigma_px, trials))
    return Table(runs=runs, seed=seed, rows=tuple(rows))


def _row(name: str, sigma_px: float, trials: Sequence[Trial]) -> Row:
    wanted = 6 if scene(name).meet is None else 5
    ranks = [trial.rank for trial in trials]
    fit = against_chi_square(np.array([trial.normalised for trial in trials]), wanted)
    seen = np.median([(trial.seen_rotation, trial.seen_translation) for trial in trials], axis=0)
    return Row(
        scene=name,
        sigma_px=sigma_px,
        methods={method: _median(trials, method) for method in METHODS},
        gap=max((trial.gap for trial in trials if math.isfinite(trial.gap)), default=None),
        rank_wanted=wanted,
        ranks={rank: ranks.count(rank) for rank in sorted(set(ranks))},
        held_deg=finite(math.degrees(max(trial.held_angle for trial in trials))),
        seen_rotation_rad=float(seen[0]),
        seen_translation_m=float(seen[1]),
        chi_square_mean=fit.mean,
        chi_square_within=fit.within,
        chi_square_p=fit.p,
        demands=tuple(
            Demand(demand=check.demand, met=check.held) for check in checks(name, sigma_px, trials)
        ),
    )


def _median(trials: Sequence[Trial], method: Method) -> Median:
    rotation, translation = median_errors(trials, method)
    return Median(
        answers=answered(trials, method), rotation_rad=finite(rotation), translation_m=finite(translation)
    )


def finite(value: float) -> float | None:
    """The value, or None where it is NaN or infinite."""
    return value if math.isfinite(value) else None


class Errors(_Values):
    """Errors of all runs of one method in one surrounding; runs without an answer are left out."""

    rotation_deg: tuple[float, ...]
    translation_m: tuple[float, ...]


class BoxPlots(_Values):
    """Fig. 5: surrounding -> method -> errors."""

    runs: int
    seed: int
    surroundings: dict[str, dict[Method, Errors]]


def box_plots(runs: int, seed: int, progress: Progress) -> BoxPlots:
    """Runs Fig. 5."""
    found = {}
    for i, where in enumerate(SURROUNDINGS):
        rng = np.random.default_rng([seed, i])
        answers = []
        for done in range(runs):
            answers.append(fig5_once(where, rng))
            progress(where.name, done + 1, runs)
        found[f"{where.name}, {where.near:g} to {where.far:g} m"] = {
            method: _errors(np.array([errors(answer[method]) for answer in answers])) for method in METHODS
        }
    return BoxPlots(runs=runs, seed=seed, surroundings=found)


def _errors(found: Floats) -> Errors:
    given = found[np.isfinite(found[:, 0])]
    return Errors(
        rotation_deg=tuple(np.degrees(given[:, 0]).tolist()), translation_m=tuple(given[:, 1].tolist())
    )


class Offset(_Values):
    """One initial error of Fig. 6 and one method."""

    offset: float
    answers: int
    success: float
    median: float | None
    """Of the runs that gave an answer; null where none did."""


class Sweep(_Values):
    """One half of Fig. 6: offsets and medians in deg or m."""

    unit: str
    success_below: float
    methods: dict[Method, tuple[Offset, ...]]


class Offsets(_Values):
    """Fig. 6."""

    runs: int
    seed: int
    halves: dict[Half, Sweep]


def offsets(runs: int, seed: int, progress: Progress) -> Offsets:
    """Runs Fig. 6; the same lines and noise at every offset, so that curves are smooth."""
    halves: dict[Half, Sweep] = {}
    for half, places in OFFSETS.items():
        methods: dict[Method, list[Offset]] = {method: [] for method in METHODS}
        unit, scale = ("deg", 180.0 / math.pi) if half == "rotation" else ("m", 1.0)
        for offset in places.tolist():
            rng = np.random.default_rng(seed)
            found = []
            for done in range(runs):
                found.append(fig6_once(half, offset, rng))
                progress(f"{half} {offset * scale:.3g} {unit}", done + 1, runs)
            for method in METHODS:
                values = np.array([one[method] for one in found])
                given = values[np.isfinite(values)]
                methods[method].append(
                    Offset(
                        offset=offset * scale,
                        answers=len(given),
                        success=float((given < SUCCESS[half]).sum()) / runs,
                        median=float(np.median(given)) * scale if len(given) else None,
                    )
                )
        halves[half] = Sweep(
            unit=unit,
            success_below=SUCCESS[half] * scale,
            methods={method: tuple(points) for method, points in methods.items()},
        )
    return Offsets(runs=runs, seed=seed, halves=halves)
