"""What the runs of ``evaluate drift`` show: told and not told, how soon, how honest the stated errors are."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict

from monitor.drift_rows import Header, Row, Said
from monitor.status import AXIS_NAMES, AxisName, State
from pipeline.drift_trials import KINDS, SINGLE_DEG, SINGLE_M, Kind, labels_of
from pipeline.error_statistics import balance, clopper_pearson, roc

RECORDED, SIMULATED = "recorded", "simulated"
"""Groups of all drives of a sort; each recorded drive is a group of its own beside them."""

FOUND_SHARE = 0.9
"""An amount counts as found from this share of its runs on."""

_TRUTHFUL: tuple[Kind, ...] = ("healthy", "combined", "single", "compensating", "offline")
"""Kinds whose truth holds from the first frame to the last, with nothing else wrong: estimates can be held
against it."""


class _Values(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Share(_Values):
    """A count out of a count, with its Clopper-Pearson interval at 95 %."""

    hits: int
    of: int
    low: float
    high: float


class Score(_Values):
    """A value with the interval that holds it at 95 %."""

    value: float
    low: float
    high: float


class Curve(_Values):
    """Share of healthy runs and of wrong ones above each threshold of the joint statistic T."""

    false: tuple[float, ...]
    found: tuple[float, ...]
    area: float
    best: float
    """Balanced accuracy at the best threshold, with hindsight."""


class Calling(_Values):
    """Healthy runs against wrong ones (turned and moved); called is 'healthy' or 'drifted' at the end."""

    group: str
    drives: int
    """Windows of one drive are not independent: so many are."""
    healthy: int
    wrong: int
    false_alarms: Share
    """Of healthy runs."""
    missed: Share
    """Wrong runs that were called healthy."""
    told: Share
    """Of wrong runs."""
    accuracy: Score | None
    """Balanced, over the runs that were called; null without called runs of both sorts."""
    not_called: Share
    """Of all runs of both sorts."""
    unobservable: Share
    delay_s: tuple[float, float] | None
    """Data until 'drifted' in wrong runs: median and longest, s."""
    called_s: tuple[float, float] | None
    """Data until the first 'healthy' or 'drifted' in both sorts, likewise."""
    seconds: float
    """Computing time of a run, median."""
    roc: Curve | None


class Cell(_Values):
    """Runs of one label."""

    group: str
    kind: Kind
    label: str
    runs: int
    states: dict[State, int]
    """At the end."""
    codes: dict[str, int]
    told: Share
    """Share that was told 'drifted' at any time from when on anything was wrong."""
    noticed: int
    """Runs that were ever 'suspect' or 'drifted'."""
    delay_s: float | None
    """Data from then until told, median."""
    statistic: float | None
    """Median of T."""


class Smallest(_Values):
    """Smallest drift along one axis from which on runs are told; deg or m, null where none is."""

    group: str
    axis: AxisName
    told: float | None
    noticed: float | None
    """Likewise for 'suspect' or 'drifted'."""
    shares: dict[str, Share]
    """Of told runs by amount, both signs together."""


class Honest(_Values):
    """Stated errors against true ones, axis by axis; the reference's own uncertainty is allowed for."""

    group: str
    kind: Kind
    axes: int
    """Axes of runs that were judged and called observable."""
    within_one: float | None
    within_two: float | None
    nominal: int
    unavailable: int
    """Protection level above the alert limit: no statement is made."""
    misleading: int
    """Error beyond the protection level."""
    hazardous: int
    """Of those, error beyond the alert limit while the protection level is within it."""


class Summary(_Values):
    """Everything that the runs show."""

    header: Header
    runs: int
    drives: tuple[str, ...]
    calling: tuple[Calling, ...]
    cells: tuple[Cell, ...]
    smallest: tuple[Smallest, ...]
    honest: tuple[Honest, ...]


def summary_of(header: Header, rows: Sequence[Row]) -> Summary:
    """The summary of any set of runs."""
    groups = groups_of(rows)
    return Summary(
        header=header,
        runs=len(rows),
        drives=tuple(dict.fromkeys(row.drive for row in rows)),
        calling=tuple(
            calling for name, those in groups.items() if (calling := _calling(name, those)) is not None
        ),
        cells=tuple(cell for name, those in groups.items() for cell in _cells(name, those)),
        smallest=tuple(one for name, those in groups.items() for one in _smallest(name, those)),
        honest=tuple(one for name, those in groups.items() for one in _honest(name, those)),
    )


def groups_of(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by recorded drive, all recorded drives where there are several, and all simulated drives."""
    recorded = [row for row in rows if not row.simulated]
    names = list(dict.fromkeys(row.drive for row in recorded))
    groups = {name: [row for row in recorded if row.drive == name] for name in names}
    if len(names) > 1:
        groups[RECORDED] = recorded
    simulated = [row for row in rows if row.simulated]
    return groups | ({SIMULATED: simulated} if simulated else {})


def share(hits: int, of: int) -> Share:
    """With its interval."""
    low, high = clopper_pearson(hits, of)
    return Share(hits=hits, of=of, low=low, high=high)


def _calling(group: str, rows: Sequence[Row]) -> Calling | None:
    healthy = [row for row in rows if row.kind == "healthy"]
    wrong = [row for row in rows if row.kind == "combined"]
    both = [*healthy, *wrong]
    if not both:
        return None
    quiet, alarms = (_count(healthy, state) for state in ("healthy", "drifted"))
    missed, told = (_count(wrong, state) for state in ("healthy", "drifted"))
    called = quiet + alarms + missed + told
    found = balance((told, told + missed), (quiet, quiet + alarms))
    return Calling(
        group=group,
        drives=len({row.drive for row in both}),
        healthy=len(healthy),
        wrong=len(wrong),
        false_alarms=share(alarms, len(healthy)),
        missed=share(missed, len(wrong)),
        told=share(told, len(wrong)),
        accuracy=None if found is None else Score(value=found.accuracy, low=found.low, high=found.high),
        not_called=share(len(both) - called, len(both)),
        unobservable=share(_count(both, "unobservable"), len(both)),
        delay_s=_middle_and_end(row.told_s for row in wrong),
        called_s=_middle_and_end(row.called_s for row in both),
        seconds=float(np.median([row.seconds for row in both])),
        roc=_roc(healthy, wrong),
    )


def _roc(healthy: Sequence[Row], wrong: Sequence[Row]) -> Curve | None:
    found = roc([_statistic(row) for row in healthy], [_statistic(row) for row in wrong])
    if found is None:
        return None
    return Curve(
        false=tuple(found.false.tolist()),
        found=tuple(found.found.tolist()),
        area=found.area,
        best=found.best,
    )


def _statistic(row: Row) -> float:
    """T of a run; one in which nothing was judged raises no alarm."""
    return 0.0 if row.said is None else row.said.statistic


def _count(rows: Iterable[Row], state: State) -> int:
    return sum(row.state == state for row in rows)


def _middle_and_end(values: Iterable[float | None]) -> tuple[float, float] | None:
    known = [value for value in values if value is not None]
    return (float(np.median(known)), max(known)) if known else None


def _cells(group: str, rows: Sequence[Row]) -> list[Cell]:
    cells = []
    for kind in KINDS:
        of_kind = [row for row in rows if row.kind == kind]
        for label in labels_of(kind):
            those = [row for row in of_kind if row.label == label]
            if those:
                cells.append(_cell(group, kind, label, those))
    return cells


def _cell(group: str, kind: Kind, label: str, rows: Sequence[Row]) -> Cell:
    delays = [_delay(row) for row in rows]
    delay = _middle_and_end(delays)
    judged = [row.said.statistic for row in rows if row.said is not None]
    return Cell(
        group=group,
        kind=kind,
        label=label,
        runs=len(rows),
        states=dict(Counter(row.state for row in rows)),
        codes=dict(Counter(row.code for row in rows)),
        told=share(sum(one is not None for one in delays), len(rows)),
        noticed=sum(row.suspected_s is not None for row in rows),
        delay_s=None if delay is None else delay[0],
        statistic=float(np.median(judged)) if judged else None,
    )


def _delay(row: Row) -> float | None:
    """Data from when on anything was wrong until it was told; what was told before that is a false alarm."""
    if row.told_s is None or row.told_s < row.since_s:
        return None
    return row.told_s - row.since_s


def _smallest(group: str, rows: Sequence[Row]) -> list[Smallest]:
    single = [row for row in rows if row.kind == "single"]
    found = []
    for axis, name in enumerate(AXIS_NAMES if single else ()):
        amounts = SINGLE_DEG if axis < 3 else SINGLE_M
        told, noticed = {}, {}
        for amount in amounts:
            those = [row for row in single if math.isclose(abs(row.drift[axis]), amount, rel_tol=1e-6)]
            if those:
                told[amount] = share(sum(row.told_s is not None for row in those), len(those))
                noticed[amount] = share(sum(row.suspected_s is not None for row in those), len(those))
        found.append(
            Smallest(
                group=group,
                axis=name,
                told=_from_where_on(told),
                noticed=_from_where_on(noticed),
                shares={f"{amount:g}": one for amount, one in told.items()},
            )
        )
    return found


def _from_where_on(shares: Mapping[float, Share]) -> float | None:
    """The smallest amount that is found, as all larger ones are."""
    smallest = None
    for amount in sorted(shares, reverse=True):
        if shares[amount].hits < FOUND_SHARE * shares[amount].of:
            break
        smallest = amount
    return smallest


def _honest(group: str, rows: Sequence[Row]) -> list[Honest]:
    found = []
    for kind in _TRUTHFUL:
        points = [point for row in rows if row.kind == kind for point in stanford_points(row)]
        if points:
            found.append(_honesty(group, kind, points))
    return found


class StanfordPoint(_Values):
    """One axis of one run; deg or m."""

    axis: AxisName
    error: float
    """Beyond what the reference itself may be off, never below 0."""
    sigmas: float
    """Error over the sigmas of answer and reference together."""
    protection_level: float
    alert_limit: float


def stanford_points(row: Row) -> list[StanfordPoint]:
    """The observable axes of a run, judged against a truth that held all the time."""
    if row.said is None or row.kind not in _TRUTHFUL:
        return []
    return [_point(row, row.said, axis) for axis in range(6) if row.said.observable[axis]]


def _point(row: Row, said: Said, axis: int) -> StanfordPoint:
    error = abs(said.drift[axis] - row.drift[axis])
    reference = row.reference_sigma[axis]
    return StanfordPoint(
        axis=AXIS_NAMES[axis],
        error=max(error - reference, 0.0),
        sigmas=error / math.hypot(said.sigma[axis], reference),
        protection_level=said.protection_level[axis],
        alert_limit=said.alert_limit[axis],
    )


def _honesty(group: str, kind: Kind, points: Sequence[StanfordPoint]) -> Honest:
    misleading = [p for p in points if p.error > p.protection_level]
    unavailable = [p for p in points if p.error <= p.protection_level and p.protection_level > p.alert_limit]
    return Honest(
        group=group,
        kind=kind,
        axes=len(points),
        within_one=float(np.mean([p.sigmas <= 1 for p in points])),
        within_two=float(np.mean([p.sigmas <= 2 for p in points])),
        nominal=len(points) - len(misleading) - len(unavailable),
        unavailable=len(unavailable),
        misleading=len(misleading),
        hazardous=sum(p.error > p.alert_limit >= p.protection_level for p in misleading),
    )
