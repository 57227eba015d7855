"""The extrinsic of a recording or a single frame against a first guess, and how good it is."""

import dataclasses
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, FiniteFloat

from monitor.daemon import extrinsic_hash, mount_of
from monitor.intake import Intake
from monitor.messages import Message
from monitor.model_file import model_bytes
from monitor.preparation import prepare
from monitor.refusal import Account, drop_notes, refuse_unusable
from monitor.rig import Rig, load_rig
from monitor.sources import Source, open_source
from monitor.statements import TO_PEOPLE
from monitor.status import AXIS_NAMES, AxisName, unit_of
from pipeline import se3
from pipeline.errors import RigError
from pipeline.parameters import Parameters
from pipeline.records import Floats, FramePair
from pipeline.segmentation import Segmenter
from pipeline.watch import Findings, Mount, Watch

_ALL_NS = 1 << 62
"""ns; a calibration looks at the whole recording."""

_SPACING_NS = 500_000_000
"""ns between frames of a long recording: other things are in view."""


class AxisResult(BaseModel):
    """One axis of the result; degrees for roll, pitch, yaw, metres for forward, left, up."""

    model_config = ConfigDict(frozen=True)

    value: FiniteFloat
    """Correction: motion of the mount from the first guess to the estimate."""
    sigma: FiniteFloat
    """Random error of these frames and the floor between scenes, together."""
    observable: bool
    error: FiniteFloat | None = None
    """Estimate against the reference, where one was given."""


class Calibration(BaseModel):
    """What was found for one pair."""

    model_config = ConfigDict(frozen=True)

    pair: str
    frames: int
    observable: tuple[str, ...]
    reason: str
    axes: dict[AxisName, AxisResult]
    T_cam_lidar: list[list[float]] | None
    hash: str | None
    relative_to: Literal["stored", "found"] = "stored"
    """What the corrections are against: the stored extrinsic, or a first guess that was found before."""


def calibrate(
    location: str,
    rig_file: Path | None,
    drift: Floats | None,
    *,
    reference: Path | None,
    model: Path | None,
    stop: threading.Event,
    progress: Callable[[int], None] | None,
    tell: Callable[[str], None] = lambda _: None,
    guesses: Mapping[str, Floats] | None = None,
) -> tuple[Calibration, ...]:
    """Estimates the extrinsic of every pair of a recording.

    Args:
        location: The recording.
        rig_file: Rig file or calib.json with the first guess, or None: what the recording says.
        drift: float64 (6,), altered into the first guess, or None.
        reference: Rig file or calib.json to compare the result with, or None.
        model: The network's file, or None: the one that ships.
        stop: Ends the reading early; what was read counts.
        progress: Told the number of pairs.
        tell: Told what of the recording was lost or dropped, one sentence each.
        guesses: First guesses float64 (4,4) by pair, in place of the stored extrinsics, which may be absent;
            pairs without one are left out. None: the stored ones.

    Raises:
        CalibwatchError: Recording, rig or model can not be used.
    """
    rig = prepare(location, rig_file, drift, needs_extrinsic=guesses is None).rig
    if guesses is not None:
        rig = _guessed(rig, guesses)
    truth = {} if reference is None else _truth(reference, rig)
    window = dataclasses.replace(
        Parameters().window, longest_ns=_ALL_NS, spacing_ns=_SPACING_NS, least_frames=_NEVER
    )
    parameters = dataclasses.replace(Parameters(), window=window)
    segmenter = Segmenter(model_bytes(model))
    watches = {pair.name: Watch(mount_of(pair), parameters, segmenter) for pair in rig.pairs}
    intake = Intake(rig)
    accounts = {
        name: Account(name, 0, Counter(), watch.mount.camera, None) for name, watch in watches.items()
    }
    count = 0
    with open_source(location) as source:
        for pair in _pairs(source, intake, stop):
            findings = watches[pair.pair].step(pair)
            accounts[pair.pair] = _counted(accounts[pair.pair], pair, findings)
            count += 1
            if progress is not None:
                progress(count)
        if not stop.is_set():
            refuse_unusable(tuple(accounts.values()), intake, source.losses)
        for note in (*source.losses.notes, *intake.notes, *drop_notes(tuple(accounts.values()), intake)):
            tell(note)
    results = (_result(name, watch, truth.get(name), parameters) for name, watch in watches.items())
    relative_to = "stored" if guesses is None else "found"
    return tuple(result.model_copy(update={"relative_to": relative_to}) for result in results)


def _guessed(rig: Rig, guesses: Mapping[str, Floats]) -> Rig:
    """The pairs of which there is a guess, with it in place of what is stored."""
    pairs = tuple(
        dataclasses.replace(pair, T_cam_lidar=guesses[pair.name], store=None)
        for pair in rig.pairs
        if pair.name in guesses
    )
    return dataclasses.replace(rig, pairs=pairs)


def _truth(reference: Path, rig: Rig) -> dict[str, Floats]:
    """The extrinsic to compare each pair with; a reference of one pair speaks for a rig of one."""
    known = {
        pair.name: pair.T_cam_lidar for pair in load_rig(reference).pairs if pair.T_cam_lidar is not None
    }
    if len(known) == len(rig.pairs) == 1:
        return {rig.pairs[0].name: next(iter(known.values()))}
    truth = {pair.name: known[pair.name] for pair in rig.pairs if pair.name in known}
    if not truth:
        raise RigError(
            f"{reference} has no T_cam_lidar for pair {' or '.join(pair.name for pair in rig.pairs)}",
            hint=f"it has: {', '.join(known)}" if known else "give a rig file that states the extrinsic",
        )
    return truth


def _pairs(source: Source, intake: Intake, stop: threading.Event) -> Iterator[FramePair]:
    for message in source:
        if stop.is_set():
            return
        yield from intake.take(message) if isinstance(message, Message) else ()
    yield from intake.flush()


def _counted(account: Account, pair: FramePair, findings: Findings) -> Account:
    if findings.dropped is None:
        return dataclasses.replace(account, used=account.used + 2)
    wrong_size = pair.image.size if findings.dropped == "image_size" else account.wrong_size
    dropped = account.dropped + Counter({findings.dropped: 2})
    return dataclasses.replace(account, dropped=dropped, wrong_size=wrong_size)


_NEVER = 1 << 30
"""Frames before a judgement in between: a calibration judges once, at the end."""


def _result(name: str, watch: Watch, truth: Floats | None, parameters: Parameters) -> Calibration:
    watch.finish()
    belief, mount = watch.belief, watch.mount
    if belief is None:
        return Calibration(
            pair=name,
            frames=watch.frames,
            observable=(),
            reason="no edges and no lines were found that image and cloud have in common",
            axes={},
            T_cam_lidar=None,
            hash=None,
        )
    judgement = belief.judgement
    total = np.sqrt(judgement.sigma**2 + np.diag(parameters.test.floor()))
    observable = (total <= parameters.test.most_sigma * mount.limits) & ~np.array(judgement.blind)
    errors = None if truth is None else _errors(mount, truth, belief.T_estimated)
    axes = {
        axis: AxisResult(
            value=float(judgement.drift[i] * TO_PEOPLE[i]),
            sigma=float(total[i] * TO_PEOPLE[i]),
            observable=bool(observable[i]),
            error=None if errors is None else float(errors[i] * TO_PEOPLE[i]),
        )
        for i, axis in enumerate(AXIS_NAMES)
    }
    seen = tuple(axis for axis, result in axes.items() if result.observable)
    return Calibration(
        pair=name,
        frames=watch.frames,
        observable=seen,
        reason=_reason(axes, blind=judgement.blind, contradicted=judgement.contradicted),
        axes=axes,
        T_cam_lidar=belief.T_estimated.tolist(),
        hash=extrinsic_hash(belief.T_estimated),
    )


def _errors(mount: Mount, truth: Floats, estimate: Floats) -> Floats:
    """Motion of the mount from the reference to the estimate, (6,): 0 where the estimate is right."""
    R_vehicle_cam = se3.vehicle_axes(truth, mount.T_vehicle_lidar)
    return se3.mount_drift(truth, estimate, R_vehicle_cam)


def _reason(axes: dict[AxisName, AxisResult], *, blind: bool, contradicted: bool) -> str:
    """Why something is not observable, or that all is; one clause."""
    if blind:
        return "image and cloud show nothing in common (dark, blocked, no edges, or a first guess far off)"
    if contradicted:
        return "lines and edges contradict each other beyond their errors; the edges' answer is given"
    weak = [
        f"{axis} is known to {result.sigma:.2g} {unit_of(axis)} only"
        for axis, result in ((axis, axes[axis]) for axis in AXIS_NAMES)
        if not result.observable
    ]
    return ", ".join(weak) if weak else "all six axes are observable"
