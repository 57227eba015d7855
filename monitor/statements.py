"""Belief and memory of a watch -> the status that is told (DESIGN 5). Radians become degrees here alone."""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from monitor.status import (
    AXIS_NAMES,
    AxisDrift,
    AxisValues,
    Consequence,
    Drift,
    Drive,
    Frames,
    Onset,
    Provenance,
    Rates,
    Status,
    TimeOffset,
    Timing,
    Window,
    Witness,
    Witnesses,
    finite,
)
from pipeline import verdict
from pipeline.belief import Belief
from pipeline.causes import Explanation
from pipeline.consequence import consequences
from pipeline.fusion import Testimony
from pipeline.mount import Mount
from pipeline.records import Floats
from pipeline.scene_track import SceneTrack
from pipeline.window import Departure

TO_PEOPLE = np.array([180.0 / math.pi] * 3 + [1.0] * 3)
"""rad, m -> deg, m."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What every status of a pair repeats.

    Attributes:
        vehicle: Name.
        pair: Name.
        extrinsic: Of the stored extrinsic.
        model: Of the network.
        software: Name and version.
    """

    vehicle: str
    pair: str
    extrinsic: Provenance
    model: Provenance
    software: str


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """What the engine counted and timed.

    Attributes:
        received: Sweeps and images that came.
        used: Sweeps and images that took part.
        dropped: Reason -> number.
        window_ns: Stamps of the window's frames with edges.
        lines_ns: Stamps of the window's frames with lines.
        rates: Of the inputs.
        timing: Stage -> quantiles.
        outputs_lost: Output -> what happened.
        warnings: What the data say against the rig's settings.
        explanation: What the drive says of mount, clock and lens, or None.
        track: Where the mount is by all scenes of the drive, or None.
        left: Reason -> frames that left the window.
    """

    received: int
    used: int
    dropped: Counter[str]
    window_ns: tuple[int, ...]
    lines_ns: tuple[int, ...]
    rates: Rates
    timing: Mapping[str, Timing]
    outputs_lost: Mapping[str, str]
    warnings: tuple[str, ...] = ()
    explanation: Explanation | None = None
    track: SceneTrack | None = None
    left: Mapping[Departure, int] = field(default_factory=dict)


def status_of(
    identity: Identity,
    mount: Mount,
    memory: verdict.Memory,
    belief: Belief | None,
    measured: Measured,
    seq: int,
    stamp_ns: int,
) -> Status:
    """The status of a pair at ``stamp_ns``."""
    onset = memory.onset
    stamps = measured.window_ns or measured.lines_ns
    return Status(
        vehicle=identity.vehicle,
        pair=identity.pair,
        seq=seq,
        stamp_ns=stamp_ns,
        state=memory.state,
        code=memory.code,
        reason=memory.reason,
        since_ns=memory.since_ns,
        onset=None
        if onset is None
        else Onset(stamp_ns=onset.stamp_ns, from_ns=onset.from_ns, to_ns=onset.to_ns, gradual=onset.gradual),
        severity=memory.severity,
        drift=_drift(mount, memory, belief),
        consequence=_consequence(mount, belief),
        witnesses=_witnesses(belief),
        drive=None if memory.severity is not None else _drive(measured.track),
        window=Window(
            frames=len(stamps),
            span_s=(stamps[-1] - stamps[0]) / 1e9 if stamps else 0.0,
            lines_lane=_matched(belief, "lane"),
            lines_pole=_matched(belief, "pole"),
            lines_structure=_matched(belief, "structure"),
            left=dict(measured.left.items()),
        ),
        frames=Frames(received=measured.received, used=measured.used, dropped=dict(measured.dropped)),
        rates=measured.rates,
        time_offset=_time_offset(measured.explanation),
        timing_ms=dict(measured.timing),
        extrinsic=identity.extrinsic,
        model=identity.model,
        software=identity.software,
        outputs_lost=dict(measured.outputs_lost),
        warnings=measured.warnings,
    )


def _drift(mount: Mount, memory: verdict.Memory, belief: Belief | None) -> Drift:
    axes: dict[str, AxisDrift] = {}
    # Rounded: 0.75 deg is 0.75 again after its way through radians.
    limits = np.round(mount.limits * TO_PEOPLE, 9)
    for index, name in enumerate(AXIS_NAMES):
        if belief is None:
            axes[name] = AxisDrift(
                value=None,
                sigma=None,
                protection_level=None,
                alert_limit=float(limits[index]),
                detectable=None,
                observable=False,
                monitored=False,
                last_seen_ns=memory.last_seen_ns[index],
            )
            continue
        j, scale = belief.judgement, float(TO_PEOPLE[index])
        observable = bool(j.observable[index])
        axes[name] = AxisDrift(
            value=finite(j.drift[index] * scale),
            sigma=finite(j.sigma[index] * scale) if observable else None,
            protection_level=finite(j.protection_level[index] * scale) if observable else None,
            alert_limit=float(limits[index]),
            detectable=finite(j.detectable[index] * scale) if observable else None,
            observable=observable,
            monitored=bool(j.monitored[index]),
            last_seen_ns=memory.last_seen_ns[index],
        )
    return Drift(
        axes="camera" if mount.T_vehicle_lidar is None else "vehicle",
        relative_to="stored" if mount.baseline is None else "baseline",
        **axes,
    )


def _consequence(mount: Mount, belief: Belief | None) -> tuple[Consequence, ...]:
    """What the drift told does to perception; nothing of an estimate that is chance."""
    if belief is None or belief.judgement.blind:
        return ()
    drift, covariance = belief.judgement.drift, belief.evidence.covariance
    return tuple(
        Consequence(
            range_m=at.range_m,
            shift_px=finite(at.shift_px),
            sigma_px=finite(at.sigma_px),
            worst_px=finite(at.worst_px),
            left_m=at.left_m,
            sigma_left_m=at.sigma_left_m,
            up_m=at.up_m,
            sigma_up_m=at.sigma_up_m,
        )
        for at in consequences(mount.camera, mount.R_vehicle_cam, drift, covariance)
    )


def _witnesses(belief: Belief | None) -> Witnesses:
    if belief is None:
        return Witnesses(lines=None, edges=None)
    edges = lines = None
    if belief.edges is not None and belief.edges_drift is not None:
        edges = _witness(belief.edges_drift, belief.edges.frames, None)
    if belief.lines is not None and belief.lines_drift is not None:
        estimate = belief.lines.estimate
        lines = _witness(belief.lines_drift, estimate.frames, estimate.chi2)
    return Witnesses(lines=lines, edges=edges)


def _witness(testimony: Testimony, frames: int, chi2: float | None) -> Witness:
    sigma = np.sqrt(np.diag(testimony.covariance()))
    return Witness(
        drift=_values(testimony.drift),
        sigma=_values(sigma),
        chi2=None if chi2 is None else finite(chi2),
        frames=frames,
    )


def _drive(track: SceneTrack | None) -> Drive | None:
    if track is None or track.scenes == 0:
        return None
    sigma = np.sqrt(np.diag(track.drift_covariance))
    return Drive(scenes=track.scenes, drift=_values(track.drift), sigma=_values(sigma))


def _values(six: Floats) -> AxisValues:
    people = six * TO_PEOPLE
    return AxisValues(**{name: finite(people[index]) for index, name in enumerate(AXIS_NAMES)})


def _time_offset(explanation: Explanation | None) -> TimeOffset:
    if explanation is None:
        return TimeOffset(ms=None, sigma_ms=None, separable=False)
    if not explanation.separable:
        # What is not told from a moved mount is no offset; its sigma says how little is known.
        return TimeOffset(ms=None, sigma_ms=finite(1e3 * explanation.time_sigma_s), separable=False)
    return TimeOffset(
        ms=finite(1e3 * explanation.time_offset_s),
        sigma_ms=finite(1e3 * explanation.time_sigma_s),
        separable=True,
    )


def _matched(belief: Belief | None, label: str) -> int:
    if belief is None:
        return 0
    return sum(1 for frame in belief.matched for match in frame if match.cloud.label == label)
