"""What people read: a verdict in one sentence, stamps, sizes with their unit, and what to do next."""

from datetime import UTC, datetime, timedelta

from monitor.status import AxisDrift, AxisName, State, Status, unit_of
from pipeline.spin_sense import ToldSpin

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

_FIRST_DATE_NS = 946_684_800_000_000_000
"""ns; 2000-01-01. A stamp before it counts from the start of something, not from 1970."""

_LAST_DATE_NS = 253_402_300_799_000_000_000
"""ns; the end of the year 9999, beyond which there is no date to tell."""

_SURE_SIGMAS = 3.0
"""An axis without a limit crossed is named as moved when its drift exceeds this many sigma."""

NEXT_STEPS: dict[State, str] = {
    "healthy": "Nothing to do. The axes that were not checked need other roads, where they are seen better.",
    "drifted": "Look at the places below. If the points under the estimated extrinsic lie on the edges of "
    "the image and those under the stored one do not, check the mount (bracket, windscreen, bolts), run "
    "`calibwatch calibrate` on a recording made after that, and put the extrinsic that it prints into the "
    "rig file, or the one proposed here, where there is one and the mount was left as it is. Until then do "
    "not rely on the projection between this LiDAR and this camera.",
    "suspect": "Keep driving: more evidence settles it. If it stays suspect on several drives, inspect the "
    "mount and measure the extrinsic anew: what is known better can be tested closer.",
    "unobservable": "No statement is possible from these scenes. Drive longer, where there are poles, kerbs "
    "and lane markings in good light; `calibwatch inspect` tells whether the inputs are what the rig file "
    "says.",
    "stale": "Pairs of sweep and image stopped coming. Check drivers, cables and clocks; `calibwatch "
    "inspect` lists topics, rates and gaps between the stamps.",
    "fault": "The watch can not work until this is mended: the reason names it.",
    "starting": "Give it more data: a first verdict takes some ten seconds on a road with lanes and poles.",
}
"""What to do next, by state; words between backticks are commands."""


OTHER_CAUSES: dict[str, str] = {
    "time_offset": "Sweeps and images do not belong together in time. Check how their stamps come about "
    "(trigger, exposure, driver, clock synchronisation); `calibwatch inspect` lists rates and gaps. What the "
    "watch says of the mount holds once they agree.",
    "intrinsics_changed": "Check that the intrinsics are those of this camera, lens and image size (another "
    "crop, scale, focus or zoom), or measure them anew. What the watch says of the mount holds once they "
    "agree.",
    "forward_or_sync": "Drive at other speeds, or stop for some seconds: what stays when the vehicle stands "
    "is the mount, what goes is time. `calibwatch inspect` lists the gaps between the stamps.",
    "cause_open": "Check the stamps of both sensors, the intrinsics and the mount; driving at other speeds "
    "and past things near and far tells them apart. `calibwatch inspect` shows what the inputs say.",
}
"""Codes of a suspicion that something else than the mount has changed, and what to do next."""


def next_step(status: Status) -> str:
    """What to do next; words between backticks are commands."""
    return OTHER_CAUSES.get(status.code, NEXT_STEPS[status.state])


def stamp_text(stamp_ns: int) -> str:
    """A stamp as UTC to the second's tenth, or as seconds where the clock did not start in 1970."""
    if not _FIRST_DATE_NS <= stamp_ns <= _LAST_DATE_NS:
        return f"{stamp_ns / 1e9:.1f} s"
    moment = _EPOCH + timedelta(microseconds=stamp_ns // 1000)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{moment.microsecond // 100_000} UTC"


def span_text(from_ns: int, to_ns: int) -> str:
    """Two stamps joined by 'and'; what they share of the date and the zone stands once."""
    first, last = stamp_text(from_ns), stamp_text(to_ns)
    day = first[: len("2000-01-01 ")]
    shared = first.endswith(" UTC") and last.startswith(day)
    return f"{first.removesuffix(' UTC')} and {last.removeprefix(day)}" if shared else f"{first} and {last}"


def size_text(axis: AxisName, value: float | None, *, sign: bool = False) -> str:
    """A size with its unit (``0.52 deg``, ``+0.123 m``), or 'unknown'."""
    if value is None:
        return "unknown"
    unit = unit_of(axis)
    digits = 2 if unit == "deg" else 3
    rounded = round(value, digits) + 0.0  # no minus before a nought
    return f"{rounded:{'+' if sign else ''}.{digits}f} {unit}"


def axis_text(name: AxisName, axis: AxisDrift) -> str:
    """Size, sigma and limit of one axis."""
    return (
        f"{name} {size_text(name, axis.value, sign=True)} "
        f"(sigma {size_text(name, axis.sigma)}, limit {size_text(name, axis.alert_limit)})"
    )


def moved_axes(status: Status) -> tuple[AxisName, ...]:
    """The axes that make the drift, worst first: those beyond their limit, else those that surely moved."""
    seen = [
        (name, abs(axis.value), axis.sigma, axis.alert_limit)
        for name, axis in status.drift.items()
        if axis.observable and axis.value is not None and axis.sigma
    ]
    ranked = sorted(seen, key=lambda row: row[1] / row[3], reverse=True)
    beyond = tuple(name for name, size, _, limit in ranked if size > limit)
    if beyond:
        return beyond
    by_sigma = sorted(seen, key=lambda row: row[1] / row[2], reverse=True)
    sure = tuple(name for name, size, sigma, _ in by_sigma if size > _SURE_SIGMAS * sigma)
    return sure or tuple(name for name, *_ in by_sigma[:1])


def unchecked_text(status: Status) -> str:
    """Which axes were not checked and why, or that all were; those said to have moved were."""
    moved = moved_axes(status) if status.state in ("drifted", "suspect") else ()
    rest = [(name, axis) for name, axis in status.drift.items() if name not in moved]
    held = [name for name, axis in rest if not axis.observable]
    blunt = [name for name, axis in rest if axis.observable and not axis.monitored]
    parts = [f"{', '.join(held)} (not observable)"] if held else []
    if blunt:
        parts.append(f"{', '.join(blunt)} (too uncertain to exclude a drift of the limit)")
    return f"not checked: {'; '.join(parts)}" if parts else "all six axes were checked"


def verdict_sentence(status: Status) -> str:
    """The verdict in one sentence: state, axis, size, sigma, limit, since when, and what was not checked."""
    moved = " and ".join(axis_text(name, status.drift[name]) for name in moved_axes(status))
    axes = [axis_text(name, axis) for name, axis in status.drift.items() if axis.monitored]
    watched = ", ".join(axes) or "no axis"
    since = stamp_text(status.since_ns)
    suspected = f"{moved or 'the evidence'} is not yet sure"
    if status.code in OTHER_CAUSES:
        suspected = _clause(status.reason)
    bodies: dict[State, str] = {
        "healthy": f"healthy since {since}: a drift beyond the limits is excluded for {watched}",
        "drifted": f"drifted ({status.severity or 'minor'}): {moved}, {onset_text(status)}"
        f"{consequence_text(status)}",
        "suspect": f"suspect since {since}: {suspected}",
        "unobservable": f"without a statement since {since}: {_clause(status.reason)}",
        "stale": f"stale since {since}: {_clause(status.reason)}",
        "fault": f"not being watched since {since}: {_clause(status.reason)}",
        "starting": f"not judged yet: {_clause(status.reason)}",
    }
    checked = status.state in ("healthy", "drifted", "suspect", "unobservable")
    return f"{status.pair} is {bodies[status.state]}{'; ' + unchecked_text(status) if checked else ''}."


_NOTICED_M = 0.01
"""m; a misplacement below it is not worth a clause."""


def consequence_text(status: Status) -> str:
    """What the drift does at the middle one of the distances told, one clause; empty: nothing is known."""
    if not status.consequence:
        return ""
    at = status.consequence[len(status.consequence) // 2]
    far, sideways = max((abs(at.left_m), True), (abs(at.up_m), False))
    parts = []
    if at.worst_px is not None:
        parts.append(f"points lie up to {at.worst_px:.1f} px off")
    if far >= _NOTICED_M:
        way = ("to the left of" if at.left_m > 0 else "to the right of") if sideways else None
        way = way or ("above" if at.up_m > 0 else "below")
        parts.append(f"things stand {far:.2f} m {way} where they are put")
    return f"; {at.range_m:.0f} m away {' and '.join(parts)}" if parts else ""


def onset_text(status: Status) -> str:
    """Since when the drift is there, as far as that is known, one clause."""
    onset = status.onset
    if onset is None:
        return f"told since {stamp_text(status.since_ns)}"
    if onset.stamp_ns == onset.from_ns:
        return f"since {stamp_text(onset.from_ns)} or before, where the data begin"
    since = "growing since" if onset.gradual else "since"
    return f"{since} {stamp_text(onset.stamp_ns)} (between {span_text(onset.from_ns, onset.to_ns)})"


def _clause(sentence: str) -> str:
    """A sentence as part of another: no full stop, no leading capital but of an abbreviation."""
    clause = sentence.rstrip(". ")
    head, _, _ = clause.partition(" ")
    return clause if head[1:] != head[1:].lower() else clause[:1].lower() + clause[1:]


def spin_warning(told: ToldSpin) -> str:
    """What to tell where the sweeps contradict the sense of rotation that the rig states."""
    if told == "one instant":
        return (
            "the sweeps are not bent by the drive, as if they had been brought to one instant before, yet "
            "the rig states a sense of rotation: leave lidar.spin out"
        )
    return (
        f"the sweeps bend as those of a LiDAR that turns {told}, the rig states the other: set lidar.spin to "
        f"{told!r}"
    )
