"""The extrinsic of a recording or a single frame against a first guess, and how good it is."""

import dataclasses
import math
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, FiniteFloat

from monitor.daemon import extrinsic_hash, mount_of
from monitor.intake import Intake, pairs_of
from monitor.model_file import open_segmenter
from monitor.preparation import prepare
from monitor.refusal import Account, drop_notes, refuse_unusable
from monitor.rig import Rig, load_rig
from monitor.sources import open_source
from monitor.statements import TO_PEOPLE
from monitor.status import AXIS_NAMES, AxisName, unit_of
from pipeline import se3
from pipeline.calibration import Calibrated, CalibrationParameters, Calibrator
from pipeline.errors import RigError
from pipeline.frame_evidence import DropReason
from pipeline.frame_modes import Prior
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import Floats, FramePair

FOUND = Prior(sigma_rad=math.radians(1.5), sigma_m=0.25)
"""How far off a first guess is that was found with no stored extrinsic: 95 of 100 within 3 deg, 0.5 m."""


class AxisResult(BaseModel):
    """One axis of the result; degrees for roll, pitch, yaw, metres for forward, left, up."""

    model_config = ConfigDict(frozen=True)

    value: FiniteFloat
    """Correction: motion of the mount from the first guess to the estimate; held directions stay."""
    sigma: FiniteFloat
    """Random error of these frames, rival fits and the floor between scenes, together."""
    observable: bool
    error: FiniteFloat | None = None
    """Estimate against the reference, where one was given."""


class Calibration(BaseModel):
    """What was found for one pair."""

    model_config = ConfigDict(frozen=True)

    pair: str
    frames: int
    observable: tuple[str, ...]
    held: tuple[str, ...]
    """Directions that are not known, the weakest first, named after the axes that they lean on."""
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
    prior: Prior | None = None,
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
        prior: How far off stored extrinsics may be, guesses that equal them among them; None: as a mount that
            drifted.

    Raises:
        CalibwatchError: Recording, rig or model can not be used.
    """
    rig = prepare(location, rig_file, drift, needs_extrinsic=guesses is None).rig
    found = frozenset[str]() if guesses is None else _found(rig, guesses)
    if guesses is not None:
        rig = _guessed(rig, guesses)
    truth = {} if reference is None else _truth(reference, rig)
    segmenter = open_segmenter(model)
    calibrators = {
        pair.name: Calibrator(
            mount_of(pair), Parameters(), segmenter, settings(found=pair.name in found, stored=prior)
        )
        for pair in rig.pairs
    }
    intake = Intake(rig)
    accounts = {
        name: Account(name, 0, Counter(), one.mount.camera, None) for name, one in calibrators.items()
    }
    count = 0
    with open_source(location) as source:
        for pair in pairs_of(source, intake, stop):
            dropped = calibrators[pair.pair].step(pair)
            accounts[pair.pair] = _counted(accounts[pair.pair], pair, dropped)
            count += 1
            if progress is not None:
                progress(count)
        if not stop.is_set():
            refuse_unusable(tuple(accounts.values()), intake, source.losses)
        for note in (*source.losses.notes, *intake.notes, *drop_notes(tuple(accounts.values()), intake)):
            tell(note)
    results = (_result(name, one.mount, one.finish(), truth.get(name)) for name, one in calibrators.items())
    relative_to = "stored" if guesses is None else "found"
    return tuple(result.model_copy(update={"relative_to": relative_to}) for result in results)


def settings(*, found: bool, stored: Prior | None) -> CalibrationParameters:
    """What a calibration believes of the extrinsic that it begins with.

    Args:
        found: It was found in the recording, not stored.
        stored: How far off a stored one may be; None: as a mount that drifted.
    """
    return CalibrationParameters(prior=FOUND if found else stored or Prior())


def _found(rig: Rig, guesses: Mapping[str, Floats]) -> frozenset[str]:
    """The pairs whose guess was found; a guess that is the stored extrinsic is as far off as that may be."""
    return frozenset(
        pair.name
        for pair in rig.pairs
        if pair.name in guesses
        and (pair.T_cam_lidar is None or not np.array_equal(pair.T_cam_lidar, guesses[pair.name]))
    )


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


def _counted(account: Account, pair: FramePair, reason: DropReason | None) -> Account:
    if reason is None:
        return dataclasses.replace(account, used=account.used + 2)
    wrong_size = pair.image.size if reason == "image_size" else account.wrong_size
    dropped = account.dropped + Counter({reason: 2})
    return dataclasses.replace(account, dropped=dropped, wrong_size=wrong_size)


def _result(name: str, mount: Mount, found: Calibrated, truth: Floats | None) -> Calibration:
    errors = None if truth is None else _errors(mount, truth, found.T_estimated)
    axes: dict[AxisName, AxisResult] = {
        axis: AxisResult(
            value=float(found.drift[i] * TO_PEOPLE[i]),
            sigma=float(found.sigma[i] * TO_PEOPLE[i]),
            observable=bool(found.observable[i]),
            error=None if errors is None else float(errors[i] * TO_PEOPLE[i]),
        )
        for i, axis in enumerate(AXIS_NAMES)
    }
    # Without a single fit there is no answer, not even a bad one.
    answered = bool(found.modes)
    return Calibration(
        pair=name,
        frames=found.frames,
        observable=tuple(axis for axis, result in axes.items() if result.observable),
        held=found.held,
        reason=_reason(found, axes),
        axes=axes if answered else {},
        T_cam_lidar=found.T_estimated.tolist() if answered else None,
        hash=extrinsic_hash(found.T_estimated) if answered else None,
    )


def _errors(mount: Mount, truth: Floats, estimate: Floats) -> Floats:
    """Motion of the mount from the reference to the estimate, (6,): 0 where the estimate is right."""
    R_vehicle_cam = se3.vehicle_axes(truth, mount.T_vehicle_lidar)
    return se3.mount_drift(truth, estimate, R_vehicle_cam)


def _reason(found: Calibrated, axes: dict[AxisName, AxisResult]) -> str:
    """What the calibration says of itself, and how well the axes are known that are not observable."""
    weak = [
        f"{axis} is known to {result.sigma:.2g} {unit_of(axis)} only"
        for axis, result in axes.items()
        if not result.observable
    ]
    # Where nothing is observable the reason says it all.
    return "; ".join([found.reason, *weak]) if found.observable.any() else found.reason
