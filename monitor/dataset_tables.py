"""An evaluation of single frames as Markdown and as a picture, for people."""

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from monitor.charts import Axis, Curve, Panel, decades, png, steps
from monitor.coarse_evaluation import NEAR_DEG, NEAR_M
from monitor.dataset_evaluation import Answer, Dataset
from monitor.status import AXIS_NAMES, AxisName
from pipeline.error_statistics import CONFIDENT_SIGMAS

_COLUMNS: tuple[AxisName, ...] = ("forward", "left", "up", "roll", "pitch", "yaw")
"""In the order of CRLF's Table II."""

LEGEND = ("start", "refined", "coarse, no prior")


def dataset_text(found: Dataset) -> str:
    """All tables."""
    return "\n".join(
        (
            *_head(found),
            "",
            *_errors(found),
            "",
            *_trust(found),
            "",
            *_coarse(found),
            "",
            *_frames(found),
            "",
            *_times(found),
        )
    )


def _head(found: Dataset) -> Iterator[str]:
    told = ""
    if found.prior_sigma is not None:
        deg, m = found.prior_sigma
        told = f"; calibrate was told that they are off by {deg:g} deg and {m:g} m (one sigma)"
    yield (
        f"{found.starts} starts a frame (seed {found.seed}), uniform within {found.rotation_deg:g} deg and "
        f"{found.translation_m:g} m of the reference on each axis{told}."
    )
    yield (
        "Mean absolute errors in vehicle axes (of the camera, where no vehicle frame is known); (15) and "
        "(16) of CRLF are medians over all answers, of T_cam_lidar."
    )


def _errors(found: Dataset) -> Iterator[str]:
    yield (
        "| set | frames | answers | | forward, m | left, m | up, m | roll, deg | pitch, deg | yaw, deg "
        "| (15), m | (16), deg |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|---|"
    for one, coarse in zip(found.summaries, found.coarse_summaries, strict=True):
        head = f"| {one.group} | {one.frames} | {coarse.found}"
        medians = f"{_number(coarse.translation_m)} | {_number(coarse.rotation_deg)}"
        yield f"{head} | coarse, no prior | {_means(coarse.mean_absolute)} | {medians} |"
        head = f"| {one.group} | {one.frames} | {one.answers}"
        medians = f"{one.start_translation_m:.3f} | {one.start_rotation_deg:.3f}"
        yield f"{head} | start | {_means(one.start)} | {medians} |"
        yield f"{head} | refined, observable axes | {_means(one.observable)} | | |"
        medians = f"{one.translation_m:.3f} | {one.rotation_deg:.3f}"
        yield f"{head} | refined, all axes | {_means(one.everything)} | {medians} |"


def _means(values: Sequence[float | None]) -> str:
    by_name = dict(zip(AXIS_NAMES, values, strict=True))
    return " | ".join(_number(by_name[name]) for name in _COLUMNS)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _trust(found: Dataset) -> Iterator[str]:
    yield (
        f"What answers say of themselves. *Wrong*: errors of observable axes beyond {CONFIDENT_SIGMAS:g} "
        "sigmas of answer and reference together. Squared normalised error: mean over freedom (1 where sigma "
        "is right), share below the 95 % point of chi-square, probability of the difference by chance."
    )
    yield ""
    yield (
        "| set | yaw and pitch observable | all six | nothing | median error of an observable angle, deg | "
        "of a shift, m | within 1 sigma | within 2 | mean square | below 95 % | p | wrong |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|---|"
    for one in found.summaries:
        trust = "- | - | - | - | - | 0"
        if one.trust is not None:
            t = one.trust
            trust = (
                f"{_percent(t.within_one)} | {_percent(t.within_two)} | {t.mean_square:.2f} | "
                f"{_percent(t.below_95)} | {t.p:.2g} | {t.confident_wrong} of {t.axes}"
            )
        yield (
            f"| {one.group} | {_percent(one.yaw_and_pitch)} | {_percent(one.all_six)} | "
            f"{_percent(one.nothing)} | {_number(one.median_observable_deg)} | "
            f"{_number(one.median_observable_m)} | {trust} |"
        )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _coarse(found: Dataset) -> Iterator[str]:
    yield (f"Coarse, by nothing but intrinsics. *Near*: within {NEAR_DEG:g} deg (16) and {NEAR_M:g} m (15).")
    yield ""
    yield "| set | frames | found | near | far | reasons of the others |"
    yield "|---|---|---|---|---|---|"
    for one in found.coarse_summaries:
        reasons = Counter(
            each.reason for each in found.coarse if not each.found and one.group in (each.group, "all")
        )
        said = ", ".join(f"{count}: {reason}" for reason, count in reasons.most_common()) or "-"
        yield (f"| {one.group} | {one.frames} | {one.found} | {one.near} | {one.found - one.near} | {said} |")
    far = [each for each in found.coarse if each.found and not each.near]
    if far:
        yield ""
        yield "Far: " + ", ".join(
            f"{_title(each.group, each.frame)} ({_number(each.rotation_deg)} deg, "
            f"{_number(each.translation_m)} m)"
            for each in far
        )


def _title(group: str, frame: str) -> str:
    return frame if frame.startswith(group) else f"{group} {frame}"


def _frames(found: Dataset) -> Iterator[str]:
    yield "Error / sigma of each answer; in brackets: not observable; **bold**: wrong with confidence."
    yield ""
    yield (
        "| frame | start | roll, deg | pitch, deg | yaw, deg | forward, m | left, m | up, m | held | reason |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for answer in found.answers:
        cells = " | ".join(_cell(answer, name) for name in AXIS_NAMES)
        name = _title(answer.group, answer.frame)
        held = ", ".join(answer.held) or "-"
        yield f"| {name} | {answer.start} | {cells} | {held} | {answer.reason} |"


def _cell(answer: Answer, name: AxisName) -> str:
    axis = answer.axes[name]
    text = f"{axis.error:+.2f}/{axis.sigma:.2f}"
    if name in answer.wrong:
        return f"**{text}**"
    return text if axis.observable else f"({text})"


def _times(found: Dataset) -> Iterator[str]:
    yield (
        "Median wall time, ms. A frame, in the rows of CRLF's Table I: masks (network and CRF), lanes and "
        "poles of image and cloud (the whole turn), coarse without a prior (its lines among it). An answer: "
        "the stages of calibrate, and all of it."
    )
    yield ""
    of_frame = list(dict.fromkeys(stage for one in found.coarse_summaries for stage in one.ms))
    of_answer = list(dict.fromkeys(stage for one in found.summaries for stage in one.ms))
    yield f"| set | {' | '.join([*of_frame, *of_answer])} |"
    yield "|---|" + "---|" * len([*of_frame, *of_answer])
    for one, coarse in zip(found.summaries, found.coarse_summaries, strict=True):
        cells = [
            f"{ms[stage]:.0f}" if stage in ms else "-"
            for ms, stages in ((coarse.ms, of_frame), (one.ms, of_answer))
            for stage in stages
        ]
        yield f"| {one.group} | {' | '.join(cells)} |"


def dataset_picture(found: Dataset) -> bytes:
    """Cumulative curves as in CRLF's Figs. 5 and 6; below, those of single observable axes."""
    answers, coarse = found.answers, [one for one in found.coarse if one.found]
    of = f"{len(answers)} answers, {len(coarse)} coarse"
    panels = [
        _cumulative(
            f"Rotation error, CRLF (16), {of}",
            "deg",
            (
                [a.start_rotation_deg for a in answers],
                [a.rotation_deg for a in answers],
                [one.rotation_deg for one in coarse if one.rotation_deg is not None],
            ),
        ),
        _cumulative(
            f"Translation error, CRLF (15), {of}",
            "m",
            (
                [a.start_translation_m for a in answers],
                [a.translation_m for a in answers],
                [one.translation_m for one in coarse if one.translation_m is not None],
            ),
        ),
        _axes_panel(found, "Observable angles", "deg", AXIS_NAMES[:3]),
        _axes_panel(found, "Observable shifts", "m", AXIS_NAMES[3:]),
    ]
    return png(panels, LEGEND, 2)


def _axes_panel(found: Dataset, title: str, unit: str, names: Sequence[AxisName]) -> Panel:
    seen = [answer.axes[name] for answer in found.answers for name in names if answer.axes[name].observable]
    values = ([abs(axis.start) for axis in seen], [abs(axis.error) for axis in seen])
    return _cumulative(f"{title}, {len(seen)} of {len(names) * len(found.answers)}", unit, values)


def _cumulative(title: str, unit: str, series: Sequence[Sequence[float]]) -> Panel:
    """Share of the errors below each value."""
    least = _LEAST[unit]
    x = decades([least, *(max(value, least) for values in series for value in values)], f"error, {unit}")
    curves = tuple(_share_below(index, values, x) for index, values in enumerate(series) if values)
    return Panel(title, x, steps(0.0, 1.05, 0.2, "share below"), curves)


_LEAST = {"deg": 0.01, "m": 0.001}
"""Where curves begin: a tenth of what one frame can tell."""
_POINTS = 40
"""Of one curve: beyond, marks run into each other."""


def _share_below(index: int, values: Sequence[float], x: Axis) -> Curve:
    ordered = np.sort(np.asarray(values))
    places = np.geomspace(x.low, x.high, _POINTS)
    shares = np.searchsorted(ordered, places, side="right") / len(ordered)
    return Curve(index, tuple(places.tolist()), tuple(shares.tolist()))
