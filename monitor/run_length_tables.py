"""Run length and delays as Markdown, for people."""

from monitor.run_length_evaluation import Fitted, Healthy, RunLength, Told, Tracked
from pipeline.records import AXES

_YEAR_H = 2920.0
"""h; a year of 8 h days."""

_ANGLES = 3


def run_length_text(found: RunLength) -> str:
    """All tables."""
    lines = [*_healthy_lines(found.healthy), "", *_told_lines(found.told), "", *_tracked_lines(found.tracked)]
    if found.fitted is not None:
        lines = [*_fitted_lines(found.fitted), "", *lines]
    return "\n".join([*lines, "", f"Seed {found.seed}."])


def _fitted_lines(found: Fitted) -> list[str]:
    sigma = " ".join(f"{value:.3f}" for value in found.sigma)
    ridden = f"of which {found.ridden} lie in false modes (ratio {found.ridden_ratio:.1f})"
    lines = [
        f"Image-level streets: {found.streets}, {ridden}; {found.scenes} scenes of the others.",
        "",
        "| quantity | fitted | 90 % interval |",
        "|---|---|---|",
    ]
    for sigmas, (middle, low, high) in enumerate(found.within, 1):
        name = f"errors within {sigmas} stated sigma, all streets"
        lines.append(f"| {name} | {middle:.0%} | {low:.0%} to {high:.0%} |")
    for name, (middle, low, high) in (
        ("random error over the stated one (ratio)", found.ratio),
        ("difference of streets over the floor (share)", found.share),
        ("random error common to neighbours (common)", found.common),
        ("over so many m (common_m)", found.common_m),
    ):
        lines.append(f"| {name} | {middle:.2f} | {low:.2f} to {high:.2f} |")
    lines += [
        f"| degrees of freedom of the tails | {found.freedom:g} | |",
        f"| spread of the logarithm of stated sigmas | {found.worth_spread:.2f} | |",
        f"| middling stated sigmas, deg and m | {sigma} | |",
        "",
        "| quantile | squared error in fitted sigmas | chi-square, 6 |",
        "|---|---|---|",
    ]
    return lines + [f"| {level:g} | {square:.1f} | {chi:.1f} |" for level, square, chi in found.quantiles]


def _healthy_lines(found: Healthy) -> list[str]:
    counted = f"{found.hours:.0f} h in {found.drives} drives, {found.scenes} scenes"
    highest = f"{found.highest:.1f} (whole drives {found.highest_since_start:.1f})"
    lines = [
        f"Unmoved mounts: {counted}, {found.alarms} false alarms of the sum.",
        f"Highest statistic {highest}, level {found.level:.1f}.",
        f"{found.windows_above} single scenes exceed their level: the gates of a window are to stop those.",
        "",
        "| lowered level | alarms counted | allowed by the level's run length |",
        "|---|---|---|",
    ]
    lines += [f"| {one.level:g} | {one.counted} | {one.allowed:.1f} |" for one in found.lowered]
    if found.extrapolated_hourly is None:
        return [*lines, "", "Hardly a peak is left beyond what one scene may weigh: nothing to extrapolate."]
    middle, low, high = (_YEAR_H * value for value in found.extrapolated_hourly)
    rate = f"{middle:.2g} false alarms in a vehicle-year of {_YEAR_H:.0f} h"
    interval = f"90 % interval {low:.2g} to {high:.2g}"
    tail = f"Extrapolated, not counted, from peaks above {found.extrapolated_from:.1f} to the level"
    return [*lines, "", f"{tail}: {rate}, {interval}."]


def _told_lines(told: tuple[Told, ...]) -> list[str]:
    lines = [
        "| world | drift | told | alarms before it | median delay | median way |",
        "|---|---|---|---|---|---|",
    ]
    for one in told:
        unit = "deg" if AXES.index(one.axis) < _ANGLES else "m"
        size = f"{one.axis} {one.size:g} {unit}" + (" a minute" if one.ramp else "")
        delay = "" if one.seconds is None or one.way_m is None else f"{one.seconds:.0f} s | {one.way_m:.0f} m"
        lines.append(f"| {one.world} | {size} | {one.told} of {one.runs} | {one.early} | {delay or ' | '} |")
    return lines


def _tracked_lines(tracked: tuple[Tracked, ...]) -> list[str]:
    lines = [
        "| world | followed | " + " | ".join(f"{axis} rms (sigma)" for axis in AXES) + " | within 2 sigma |",
        "|---|---|" + "---|" * len(AXES) + "---|",
    ]
    for one in tracked:
        cells = " | ".join(
            f"{rms:.3f} ({sigma:.3f}) {'deg' if axis < _ANGLES else 'm'}"
            for axis, (rms, sigma) in enumerate(zip(one.rms, one.sigma, strict=True))
        )
        lines.append(f"| {one.world} | {one.hours:g} h | {cells} | {100 * one.within_two:.0f} % |")
    return lines
