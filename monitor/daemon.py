"""Engines around one stream of messages: what `run` and `replay` share."""

import hashlib
import logging
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib import metadata

import numpy as np

from monitor.clock import Clock
from monitor.engine import Engine
from monitor.events import EndEvent, Event
from monitor.intake import Intake
from monitor.messages import Message
from monitor.outputs import Outputs
from monitor.rig import Rig, RigPair
from monitor.sources import Losses, Tick
from monitor.statements import Identity
from monitor.status import Provenance, State, first_in_precedence
from pipeline.errors import InputError, RigError
from pipeline.parameters import Parameters
from pipeline.segmentation import Segmenter
from pipeline.watch import Mount, Watch

_log = logging.getLogger(__name__)

SCENE_REASONS = frozenset({"no_scan_pattern", "no_edges", "empty_cloud"})
"""Drop reasons that speak of scene or sensor; the others speak of an input that is wrong."""


def software() -> str:
    """Name and version of this software."""
    try:
        return f"calibwatch {metadata.version('calibwatch')}"
    except metadata.PackageNotFoundError:
        return "calibwatch (not installed)"


def extrinsic_hash(T_cam_lidar: np.ndarray) -> str:
    """Content hash of an extrinsic: SHA-256 over its 16 numbers, float64, little-endian, row by row."""
    return hashlib.sha256(np.ascontiguousarray(T_cam_lidar, dtype="<f8").tobytes()).hexdigest()


@dataclass(frozen=True, slots=True, eq=False)
class Watching:
    """A rig under watch.

    Attributes:
        intake: Decodes and pairs.
        engines: One per pair, by name.
        outputs: Tell the world.
    """

    intake: Intake
    engines: dict[str, Engine]
    outputs: Outputs


def watching(
    rig: Rig, segmenter: Segmenter | None, parameters: Parameters, outputs: Outputs, clock: Clock
) -> Watching:
    """Sets up engines for every pair of a complete rig."""
    intake = Intake(rig)
    model = Provenance(hash=None, version=None)
    if segmenter is not None:
        model = Provenance(hash=segmenter.info.hash, version=segmenter.info.version)
    engines = {}
    for pair in rig.pairs:
        mount = mount_of(pair)
        identity = Identity(
            vehicle=rig.vehicle,
            pair=pair.name,
            extrinsic=Provenance(hash=extrinsic_hash(mount.T_cam_lidar), version=None),
            model=model,
            software=software(),
        )
        engines[pair.name] = Engine(identity, Watch(mount, parameters, segmenter), intake, clock)
    return Watching(intake, engines, outputs)


def mount_of(pair: RigPair) -> Mount:
    """What is stored of a pair; RigError where intrinsics or extrinsic are missing."""
    if pair.camera.model is None or pair.T_cam_lidar is None:
        what = "intrinsics" if pair.camera.model is None else "extrinsic"
        raise RigError(f"pair {pair.name} has no {what}", hint="complete the rig file")
    return Mount(
        camera=pair.camera.model,
        T_cam_lidar=pair.T_cam_lidar,
        T_vehicle_lidar=pair.T_vehicle_lidar,
        sigma_rad=pair.sigma_rad,
        sigma_m=pair.sigma_m,
        limits=pair.limits,
        required=pair.required,
        spin=pair.lidar.spin,
    )


def watch(
    watching_: Watching,
    messages: Iterable[Message | Tick],
    losses: Losses,
    stop: threading.Event,
    progress: Callable[[int], None] | None = None,
) -> State:
    """Drives a stream of messages through the engines until it ends or ``stop`` is set.

    Args:
        watching_: The rig under watch.
        messages: The source.
        losses: What the source could not give, told at the end.
        stop: Ends the run early: what was written says that it is not complete.
        progress: Told the number of pairs after each one.

    Returns:
        The state at the end, the first in precedence over the pairs.

    Raises:
        InputError: Not one frame could be used, for a reason that lies in the input.
    """
    for engine in watching_.engines.values():
        engine.attach(losses, lambda: watching_.outputs.losses)
    pairs, arrival_ns = 0, 0
    for item in messages:
        if stop.is_set():
            break
        arrival_ns = item.now_ns if isinstance(item, Tick) else item.log_ns
        for pair in watching_.intake.take(item) if isinstance(item, Message) else ():
            pairs += 1
            _tell(watching_.outputs, watching_.engines[pair.pair].step(pair, arrival_ns))
            if progress is not None:
                progress(pairs)
        for engine in watching_.engines.values():
            _tell(watching_.outputs, engine.tick(arrival_ns))
    interrupted = stop.is_set()
    if not interrupted:
        for pair in watching_.intake.flush():
            _tell(watching_.outputs, watching_.engines[pair.pair].step(pair, arrival_ns))
        _refuse_unusable(watching_, losses)
    for engine in watching_.engines.values():
        _tell(watching_.outputs, engine.finish())
    note = "interrupted: what came after is not judged" if interrupted else ""
    warnings = (*losses.notes, *watching_.intake.notes, *_drop_notes(watching_))
    watching_.outputs.handle(EndEvent(complete=not interrupted, note=note, warnings=warnings))
    memories = [engine.watch.memory for engine in watching_.engines.values()]
    return first_in_precedence(memory.state for memory in memories if memory is not None)


def _tell(outputs: Outputs, events: Sequence[Event]) -> None:
    before = set(outputs.losses)
    for event in events:
        outputs.handle(event)
    for name in set(outputs.losses) - before:
        _log.error("output lost: %s: %s", name, outputs.losses[name])


def _refuse_unusable(watching_: Watching, losses: Losses) -> None:
    """InputError where no frame of any pair was used although frames came, or none came at all."""
    if any(engine.used for engine in watching_.engines.values()):
        return
    for name, engine in watching_.engines.items():
        received, early = watching_.intake.account(name)
        dropped = early + engine.dropped
        if set(dropped) & SCENE_REASONS:
            return
        if received == 0:
            detail = "; ".join(losses.notes) or "no sweep and no image came"
            raise InputError(f"pair {name}: {detail}", hint="calibwatch inspect lists topics and pairs")
        raise InputError(_why_unusable(name, engine, watching_.intake, dropped), hint=_hint(dropped))


def _why_unusable(name: str, engine: Engine, intake: Intake, dropped: dict[str, int]) -> str:
    reason = max(dropped, key=lambda r: dropped[r]) if dropped else "no_partner"
    if reason == "undecodable" and intake.notes:
        return intake.notes[0]
    if reason == "wrong_type" and intake.notes:
        return intake.notes[0]
    if reason == "image_size" and engine.wrong_size is not None:
        camera = engine.watch.mount.camera
        have, want = engine.wrong_size, (camera.width, camera.height)
        return f"pair {name}: images are {have[0]}x{have[1]} px, the rig says {want[0]}x{want[1]}"
    offset = intake.offset_ns(name)
    if reason in ("no_partner", "gap_too_large") and offset is not None:
        return (
            f"pair {name}: no sweep and image belong together; camera stamps are {offset / 1e9:+.3f} s "
            "from LiDAR stamps"
        )
    counts = ", ".join(f"{r} {n}" for r, n in sorted(dropped.items()))
    return f"pair {name}: no frame could be used ({counts or 'nothing was paired'})"


def _hint(dropped: dict[str, int]) -> str:
    if "image_size" in dropped:
        return "give the intrinsics for this size"
    if set(dropped) & {"no_partner", "gap_too_large"}:
        return "synchronise the clocks, or set max_gap_ms in the rig file"
    return "calibwatch inspect tells what the recording holds"


def _drop_notes(watching_: Watching) -> list[str]:
    """One line per pair that lost frames."""
    notes = []
    for name, engine in watching_.engines.items():
        received, early = watching_.intake.account(name)
        dropped = early + engine.dropped
        if dropped:
            counts = ", ".join(f"{n} {reason}" for reason, n in sorted(dropped.items()))
            notes.append(f"pair {name}: {sum(dropped.values())} of {received} frames dropped ({counts})")
    return notes
