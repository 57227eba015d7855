"""The state machine: (memory, judgement, now) -> memory (DESIGN 4). Stamps are the data's; no clock here."""

import dataclasses
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from pipeline import reasons
from pipeline.drift_test import Judgement
from pipeline.onset import Onset
from pipeline.opinions import Doubt, Steady
from pipeline.records import AXES, Floats

State: TypeAlias = Literal["starting", "healthy", "suspect", "drifted", "unobservable", "stale", "fault"]

CODES = {
    "collecting": "starting",
    "within_limits": "healthy",
    "evidence_of_drift": "suspect",
    "within_stored_uncertainty": "suspect",
    "witnesses_disagree": "suspect",
    "time_offset": "suspect",
    "intrinsics_changed": "suspect",
    "forward_or_sync": "suspect",
    "cause_open": "suspect",
    "drift_confirmed": "drifted",
    "too_short": "unobservable",
    "axes_not_monitored": "unobservable",
    "nothing_in_common": "unobservable",
    "ambiguous": "unobservable",
    "no_scan_pattern": "unobservable",
    "no_pairs": "unobservable",
    "no_input": "stale",
    "cannot_work": "fault",
}
"""The closed list of reasons, each with the state it belongs to."""


@dataclass(frozen=True, slots=True)
class VerdictParameters:
    """Hysteresis and patience.

    Attributes:
        confirmations: Alarming judgements in a row, with estimates that agree, before 'drifted'.
        agreement_sigma: Estimates agree when they differ by at most so many sigma on every axis.
        patience_ns: A required axis may go unmonitored so long before 'unobservable' (DESIGN 10: a first
            verdict takes at most 10 s).
        silence_ns: No pair for so long is 'stale' (DESIGN 4).
    """

    confirmations: int = 3
    agreement_sigma: float = 2.0
    patience_ns: int = 10_000_000_000
    silence_ns: int = 2_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """What the machine knows between judgements.

    Attributes:
        state: Present state.
        code: Reason out of ``CODES``.
        reason: One sentence.
        since_ns: Stamp of the data at which the state was entered.
        onset: When the drift began, or None.
        severity: Of a drift, or None.
        alarms: Alarming judgements in a row that agree.
        alarm_drift: Estimate (6,) of the last of them, or None.
        stirred_ns: Stamp of the first judgement with suspicion since the last one without.
        quiet_ns: Stamp of the last judgement without suspicion (at first: of the first data).
        quiet_from_ns: Since when a drift would have shown in that judgement (likewise): what moved late in a
            window does not show in it.
        monitored_ns: Stamp at which every required axis was last monitored (at first: of the first data).
        last_seen_ns: Per axis the stamp at which it was last observable, or None.
        input_ns: Stamp of the last pair.
    """

    state: State
    code: str
    reason: str
    since_ns: int
    onset: Onset | None
    severity: Literal["minor", "major"] | None
    alarms: int
    alarm_drift: Floats | None
    stirred_ns: int
    quiet_ns: int
    quiet_from_ns: int
    monitored_ns: int
    last_seen_ns: tuple[int | None, ...]
    input_ns: int


def start(now_ns: int) -> Memory:
    """The memory before any evidence."""
    return Memory(
        state="starting",
        code="collecting",
        reason="Evidence is being collected.",
        since_ns=now_ns,
        onset=None,
        severity=None,
        alarms=0,
        alarm_drift=None,
        stirred_ns=now_ns,
        quiet_ns=now_ns,
        quiet_from_ns=now_ns,
        monitored_ns=now_ns,
        last_seen_ns=(None,) * len(AXES),
        input_ns=now_ns,
    )


def paired(memory: Memory, now_ns: int) -> Memory:
    """A pair came in: a stale state ends, with its evidence to be collected anew."""
    if now_ns < memory.input_ns:
        # The clock ran back (a recording in a loop): stamps of before would lie in the future.
        seen = tuple(None if stamp is None or stamp > now_ns else stamp for stamp in memory.last_seen_ns)
        memory = dataclasses.replace(
            _anew(memory, now_ns), since_ns=min(memory.since_ns, now_ns), last_seen_ns=seen
        )
    memory = dataclasses.replace(memory, input_ns=now_ns)
    if memory.state != "stale":
        return memory
    fresh = _anew(memory, now_ns)
    if memory.severity is not None:
        return _enter(fresh, "drift_confirmed", "The drift told before the inputs stopped stands.", now_ns)
    return _enter(fresh, "collecting", "Inputs are back; evidence is being collected.", now_ns)


def silent(memory: Memory, now_ns: int, parameters: VerdictParameters) -> Memory:
    """Nothing came until ``now_ns``: after ``silence_ns`` the state is stale."""
    if memory.state in ("stale", "fault") or now_ns - memory.input_ns < parameters.silence_ns:
        return memory
    seconds = parameters.silence_ns / 1e9
    return _enter(memory, "no_input", f"No pair of sweep and image for {seconds:.0f} s.", now_ns)


def unheard(memory: Memory, code: str, reason: str, now_ns: int, parameters: VerdictParameters) -> Memory:
    """A pair gave no evidence, for the reason given: what was known lasts no longer than patience does."""
    known_ns = memory.monitored_ns
    if memory.state == "suspect" and memory.severity is None:
        # What is suspected need not be monitored: the last that any axis was seen.
        known_ns = max(
            known_ns, *(stamp for stamp in memory.last_seen_ns if stamp is not None), memory.since_ns
        )
    elif memory.state not in ("starting", "healthy"):
        return memory
    if now_ns - known_ns < parameters.patience_ns:
        return memory
    return _enter(memory, code, reason, now_ns)


def faulted(memory: Memory, reason: str, now_ns: int) -> Memory:
    """Cannot work, for the reason given."""
    return memory if memory.reason == reason else _enter(memory, "cannot_work", reason, now_ns)


def advance(
    memory: Memory,
    judgement: Judgement,
    window_ns: tuple[int, int],
    required: tuple[str, ...],
    limits: Floats,
    parameters: VerdictParameters,
    steady: Steady | None = None,
    doubt: Doubt | None = None,
) -> Memory:
    """The state after one more judgement.

    Args:
        memory: Before it.
        judgement: Of the window that ends now.
        window_ns: Since when a drift would have shown in the window, and its newest frame, which is now.
        required: Axes that must be monitored for 'healthy'.
        limits: float64 (6,), alert limits.
        parameters: Hysteresis and patience.
        steady: What all scenes of the drive, or the newest frames, say beside the window, or None.
        doubt: What else than the mount may have changed, or None.
    """
    now_ns = window_ns[1]
    memory = _remembered(memory, judgement, window_ns, required, parameters)
    if memory.severity is not None:
        # Latched: only a new extrinsic or an acknowledgement ends a drift, whatever is seen later.
        if judgement.alarming:
            worse = _worse(memory.severity, _severity(judgement.drift, limits))
            memory = dataclasses.replace(memory, severity=worse)
        if memory.state == "drifted":
            return memory
        return _enter(memory, "drift_confirmed", "The drift told before the fault stands.", now_ns)
    if doubt is not None and not judgement.contradicted:
        memory = dataclasses.replace(memory, alarms=0, alarm_drift=None)
        return _enter(memory, doubt.code, doubt.reason, now_ns)
    told = _confirmed(memory, judgement, steady, limits, parameters)
    if told is not None:
        return told
    code, reason = _suspicion(judgement, steady, limits)
    if reason:
        return _enter(memory, code, reason, now_ns)
    return _quiet(memory, judgement, now_ns, required, limits, parameters)


def _confirmed(
    memory: Memory,
    judgement: Judgement,
    steady: Steady | None,
    limits: Floats,
    parameters: VerdictParameters,
) -> Memory | None:
    """The memory with a drift that is sure, by windows in a row or by all scenes; None where none is."""
    if memory.alarms >= parameters.confirmations:
        onset = Onset(memory.quiet_ns, memory.quiet_from_ns, memory.stirred_ns)
        drift, reason = judgement.drift, reasons.drift(judgement, limits)
    elif steady is not None and steady.alarming:
        # A sum over scenes is persistent by itself: none of them alone is heard for enough to alarm.
        onset, drift, reason = steady.onset, steady.drift, _over(steady, "has moved", limits)
    else:
        return None
    memory = dataclasses.replace(memory, onset=onset, severity=_severity(drift, limits))
    return _enter(memory, "drift_confirmed", reason, memory.input_ns)


def _over(steady: Steady, claim: str, limits: Floats) -> str:
    return reasons.over(steady.over, claim, (steady.drift, steady.sigma), limits)


def _suspicion(judgement: Judgement, steady: Steady | None, limits: Floats) -> tuple[str, str]:
    """Code and reason of what wants more evidence; no reason where nothing does."""
    if judgement.contradicted:
        reason = "Lines and edges contradict each other beyond their errors: nothing is claimed of the mount."
        return "witnesses_disagree", reason
    if judgement.suspicious or judgement.alarming:
        size = reasons.worst(judgement.drift, judgement.sigma, limits)
        return "evidence_of_drift", f"Evidence of drift is not yet sure: {size}."
    if steady is not None and steady.suspicious:
        return "evidence_of_drift", _over(steady, "may have moved", limits)
    return "evidence_of_drift", ""


def _quiet(
    memory: Memory,
    judgement: Judgement,
    now_ns: int,
    required: tuple[str, ...],
    limits: Floats,
    parameters: VerdictParameters,
) -> Memory:
    """The state after a judgement without suspicion."""
    wanted = [AXES.index(axis) for axis in required]
    patient = now_ns - memory.monitored_ns < parameters.patience_ns
    if judgement.blind:
        keep = patient and memory.state in ("starting", "healthy")
        return memory if keep else _enter(memory, *reasons.blindness(judgement), now_ns)
    monitored = [axis for axis in wanted if judgement.monitored[axis]]
    if len(monitored) < len(wanted) or not wanted:
        reason = reasons.unmonitored(judgement, [a for a in wanted if a not in monitored])
        keep = patient and memory.state in ("starting", "healthy")
        return memory if keep else _enter(memory, "axes_not_monitored", reason, now_ns)
    beyond = judgement.observable & (np.abs(judgement.drift) > limits)
    doubtful = [
        axis for axis in range(len(AXES)) if beyond[axis] or (axis in wanted and not judgement.excluded[axis])
    ]
    if doubtful:
        names = " and ".join(
            reasons.size(axis, float(judgement.drift[axis]), float(judgement.sigma[axis]))
            for axis in doubtful
        )
        reason = f"{names} may exceed its limit, but lies within the stored extrinsic's own uncertainty."
        return _enter(memory, "within_stored_uncertainty", reason, now_ns)
    named = ", ".join(AXES[a] for a in range(len(AXES)) if judgement.monitored[a] and judgement.excluded[a])
    return _enter(memory, "within_limits", f"Drift beyond the alert limits is excluded in {named}.", now_ns)


def acknowledge(memory: Memory, now_ns: int, by: str, why: str) -> Memory:
    """A person has taken note of a drift: the latch opens and evidence is collected anew.

    Args:
        memory: Before it.
        now_ns: Stamp of the data.
        by: Who, as they call themselves.
        why: What they say of it.
    """
    opened = dataclasses.replace(_anew(memory, now_ns), severity=None, onset=None)
    if memory.state in ("stale", "fault"):
        # Inputs are not back, and nothing is mended, because a drift was noted.
        return opened
    reason = f"The drift was acknowledged by {by} ({why}); evidence is being collected."
    return _enter(opened, "collecting", reason, now_ns)


def finish(
    memory: Memory,
    judgement: Judgement | None,
    frames: int,
    required: tuple[str, ...],
    unheard: tuple[str, str],
) -> Memory:
    """The state at the end of a recording: one still starting says why it can say nothing (DESIGN 4).

    Args:
        memory: Before it.
        judgement: The last one, or None.
        frames: Pairs that were looked at.
        required: Axes that must be monitored for 'healthy'.
        unheard: Code and reason where pairs gave nothing to judge.
    """
    if memory.state != "starting":
        return memory
    now_ns = memory.input_ns
    if frames == 0:
        return _enter(memory, "no_pairs", "No pair of sweep and image could be used.", now_ns)
    if judgement is None:
        return _enter(memory, *unheard, now_ns)
    few = f"{frames} frame{'s are' if frames != 1 else ' is'} too few for a verdict"
    if judgement.blind:
        return _enter(memory, *reasons.blindness(judgement), now_ns)
    missing = [AXES.index(axis) for axis in required if not judgement.monitored[AXES.index(axis)]]
    detail = reasons.unmonitored(judgement, missing) if missing else "no judgement was repeated often enough."
    return _enter(memory, "too_short", f"Too short: {few}; {detail}", now_ns)


def _remembered(
    memory: Memory,
    judgement: Judgement,
    window_ns: tuple[int, int],
    required: tuple[str, ...],
    parameters: VerdictParameters,
) -> Memory:
    """Counts of alarms and last sightings brought up to date."""
    oldest_ns, now_ns = window_ns
    agree = memory.alarm_drift is None or bool(
        np.all(
            np.abs(judgement.drift - memory.alarm_drift)
            <= parameters.agreement_sigma * np.sqrt(2.0) * judgement.sigma
        )
    )
    alarms = (memory.alarms + 1 if agree else 1) if judgement.alarming else 0
    calm = not (judgement.alarming or judgement.suspicious or judgement.blind)
    stirs = memory.stirred_ns <= memory.quiet_ns and (judgement.alarming or judgement.suspicious)
    all_monitored = all(judgement.monitored[AXES.index(axis)] for axis in required)
    seen = tuple(
        now_ns if judgement.observable[axis] else memory.last_seen_ns[axis] for axis in range(len(AXES))
    )
    return dataclasses.replace(
        memory,
        alarms=alarms,
        alarm_drift=judgement.drift if judgement.alarming else None,
        stirred_ns=now_ns if stirs else memory.stirred_ns,
        quiet_ns=now_ns if calm else memory.quiet_ns,
        quiet_from_ns=oldest_ns if calm else memory.quiet_from_ns,
        monitored_ns=now_ns if all_monitored else memory.monitored_ns,
        last_seen_ns=seen,
    )


def _anew(memory: Memory, now_ns: int) -> Memory:
    """The memory with its evidence forgotten."""
    return dataclasses.replace(
        memory,
        alarms=0,
        alarm_drift=None,
        stirred_ns=now_ns,
        quiet_ns=now_ns,
        quiet_from_ns=now_ns,
        monitored_ns=now_ns,
    )


def _enter(memory: Memory, code: str, reason: str, now_ns: int) -> Memory:
    state: State = CODES[code]  # type: ignore[assignment]  # values of CODES are states, a test holds it
    since = memory.since_ns if state == memory.state else now_ns
    return dataclasses.replace(memory, state=state, code=code, reason=reason, since_ns=since)


def _severity(drift: Floats, limits: Floats) -> Literal["minor", "major"]:
    return "major" if bool(np.any(np.abs(drift) > limits)) else "minor"


def _worse(a: Literal["minor", "major"], b: Literal["minor", "major"]) -> Literal["minor", "major"]:
    return "major" if "major" in (a, b) else "minor"
