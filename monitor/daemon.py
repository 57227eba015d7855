"""Engines around one stream of messages: what `run` and `replay` share."""

import hashlib
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from importlib import metadata

import numpy as np

from monitor.clock import Clock
from monitor.engine import Engine
from monitor.events import EndEvent, Event
from monitor.intake import Intake
from monitor.lookahead import Forerunner, arrivals
from monitor.messages import Message
from monitor.outputs import Outputs
from monitor.parts import Parts, parts_of
from monitor.refusal import Account, drop_notes, refuse_unusable
from monitor.requests import Requests
from monitor.rig import Rig, RigPair
from monitor.sources import Losses, Tick
from monitor.statements import Identity
from monitor.status import Provenance, State, first_in_precedence
from pipeline.errors import RigError
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import FramePair
from pipeline.segmentation import Segmenter
from pipeline.watch import Watch


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
        tell: Told at once, one sentence each, what people should know of the inputs and the outputs.
        clock: Measures what stages cost.
        lidars: Topic of each pair's LiDAR.
        requests: What people ask of it meanwhile.
    """

    intake: Intake
    engines: dict[str, Engine]
    outputs: Outputs
    tell: Callable[[str], None]
    clock: Clock
    lidars: dict[str, str]
    requests: Requests = field(default_factory=Requests)


def watching(
    rig: Rig,
    segmenter: Segmenter | None,
    parameters: Parameters,
    outputs: Outputs,
    clock: Clock,
    tell: Callable[[str], None] = lambda _: None,
) -> Watching:
    """Sets up engines for every pair of a complete rig.

    Without ``tell`` what people should know is told at the end only, in the warnings of the EndEvent.
    """
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
    lidars = {pair.name: pair.lidar.topic or "" for pair in rig.pairs}
    return Watching(intake, engines, outputs, tell, clock, lidars)


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
        baseline=pair.baseline,
    )


def watch(
    watching_: Watching,
    messages: Iterable[Message | Tick],
    losses: Losses,
    stop: threading.Event,
    progress: Callable[[int], None] | None = None,
    ahead: Forerunner | None = None,
    remark: str = "",
) -> State:
    """Drives a stream of messages through the engines until it ends or ``stop`` is set.

    Args:
        watching_: The rig under watch.
        messages: The source.
        losses: What the source could not give, told at the end.
        stop: Ends the run early: what was written says that it is not complete.
        progress: Told the number of pairs after each one.
        ahead: Has pairs looked at before their turn. None for a source that goes on by itself: what came is
            then judged at once.
        remark: What a reader of the files must know of this run, or empty.

    Returns:
        The state at the end, the first in precedence over the pairs.

    Raises:
        InputError: Not one frame could be used, for a reason that lies in the input.
    """
    for engine in watching_.engines.values():
        engine.attach(losses, lambda: watching_.outputs.losses)
    if ahead is not None:
        ahead.serve({name: engine.watch for name, engine in watching_.engines.items()})
    arrival_ns = _feed(watching_, messages, stop, progress, ahead)
    interrupted = stop.is_set()
    if not interrupted:
        for pair in watching_.intake.flush():
            _tell(watching_, watching_.engines[pair.pair].step(pair, arrival_ns))
        refuse_unusable(_accounts(watching_), watching_.intake, losses)
    for engine in watching_.engines.values():
        _tell(watching_, engine.finish())
    cut = "interrupted: what came after is not judged" if interrupted else ""
    note = "; ".join(part for part in (cut, remark) if part)
    lost = [f"output lost: {name}: {why}" for name, why in watching_.outputs.losses.items()]
    drops = drop_notes(_accounts(watching_), watching_.intake)
    told = [f"{name}: {one}" for name, engine in watching_.engines.items() for one in engine.warnings]
    warnings = (*losses.notes, *watching_.intake.notes, *drops, *told, *lost)
    parts = _parts(watching_)
    _tell(watching_, [EndEvent(complete=not interrupted, note=note, warnings=warnings, parts=parts)])
    memories = [engine.watch.memory for engine in watching_.engines.values()]
    return first_in_precedence(memory.state for memory in memories if memory is not None)


def _feed(
    watching_: Watching,
    messages: Iterable[Message | Tick],
    stop: threading.Event,
    progress: Callable[[int], None] | None,
    ahead: Forerunner | None,
) -> int:
    """Until the messages end or ``stop`` is set; gives the time of the last one, ns."""
    intake, engines = watching_.intake, watching_.engines
    most, see = (0, _unseen) if ahead is None else (ahead.most, ahead.see)
    pairs, arrival_ns, told = 0, 0, 0
    for arrival in arrivals(messages, intake, most, see):
        if stop.is_set():
            return arrival_ns
        intake.show(arrival.accounts)
        arrival_ns = arrival.arrival_ns
        for pair in arrival.pairs:
            pairs += 1
            found = None if ahead is None else ahead.take(pair)
            _tell(watching_, engines[pair.pair].step(pair, arrival_ns, found))
            if ahead is not None:
                ahead.settle(pair.pair)
            if progress is not None:
                progress(pairs)
        for engine in engines.values():
            _tell(watching_, engine.tick(arrival_ns))
        _heed(watching_)
        for note in intake.notes[told : arrival.notes]:
            watching_.tell(note)
        told = arrival.notes
    intake.show(None)
    return arrival_ns


def _unseen(pair: FramePair) -> FramePair:
    """Nobody looks ahead."""
    return pair


def _heed(watching_: Watching) -> None:
    """Does what people have asked for since the last message, in the thread that owns the engines."""
    for request in watching_.requests.take():
        note = request.note
        events = watching_.engines[request.pair].acknowledge(note.by, note.reason)
        if not events:
            request.answer("no drift is told that could be acknowledged")
            continue
        _tell(watching_, events)
        watching_.tell(f"{request.pair}: drift acknowledged by {note.by} ({note.reason})")
        request.answer(None)


def _tell(watching_: Watching, events: Sequence[Event]) -> None:
    """Hands events to the outputs; one that is lost meanwhile is told at once."""
    outputs = watching_.outputs
    before = set(outputs.losses)
    for event in events:
        outputs.handle(event)
    for name in set(outputs.losses) - before:
        watching_.tell(f"output lost: {name}: {outputs.losses[name]}")


def _parts(watching_: Watching) -> tuple[Parts, ...]:
    """Which part of the rig has moved, where some pair has drifted and others share its LiDAR."""
    watches = {name: engine.watch for name, engine in watching_.engines.items()}
    if not any(watch.memory is not None and watch.memory.severity is not None for watch in watches.values()):
        return ()
    watched = {name: (watch.mount, watch.belief) for name, watch in watches.items()}
    return parts_of(watched, watching_.lidars, next(iter(watches.values())).parameters)


def _accounts(watching_: Watching) -> list[Account]:
    return [
        Account(name, engine.used, engine.dropped, engine.watch.mount.camera, engine.wrong_size)
        for name, engine in watching_.engines.items()
    ]
