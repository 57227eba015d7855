"""Live sensors on a zenoh bus under watch: the daemon behind ``calibwatch run``."""

import logging
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import zenoh

from monitor import bus
from monitor.baseline_file import with_baselines
from monitor.clock import Clock
from monitor.command_bus import CommandBus
from monitor.daemon import watch, watching
from monitor.discovery import Survey, survey_in
from monitor.messages import Message
from monitor.model_file import open_segmenter
from monitor.outputs import Surroundings, open_outputs
from monitor.preparation import completed
from monitor.rig import CLOUD_TYPES, IMAGE_TYPES, Rig, load_rig
from monitor.sources import Tick, TopicInfo
from monitor.sources.zenoh_live import ZenohLive, subscriptions
from monitor.status import State
from pipeline.errors import InputError, RigError
from pipeline.parameters import Parameters

_log = logging.getLogger(__name__)

FILES = ("status_log", "summary", "recording", "report", "candidate")
"""What goes into ``--out``."""

SURVEY_NS = 10_000_000_000
"""ns that the bus is listened to for intrinsics and transforms that the rig file leaves open."""


def run(
    rig_file: Path,
    settings: bus.BusSettings,
    out: Path | None,
    *,
    model: Path | None,
    images_hz: float,
    stop: threading.Event,
    clock: Clock,
    ready: Callable[[], None] | None = None,
    allow_commands: bool = False,
) -> State:
    """Watches a rig until ``stop`` is set; tells its status on the bus and, with ``out``, in files.

    Args:
        rig_file: The rig; every pair names its topics.
        settings: How to reach the bus.
        out: Folder for files, or None.
        model: The network's file, or None: the one that ships.
        images_hz: Images kept in the recording.
        stop: Ends the watch.
        clock: Of the machine.
        ready: Called once when all topics are listened to.
        allow_commands: Whether whoever reaches the bus may command, also from other machines.

    Returns:
        The last state.

    Raises:
        CalibwatchError: Rig, model or bus can not be used.
    """
    segmenter = open_segmenter(model)
    rig = load_rig(rig_file)
    for pair in rig.pairs:
        if pair.lidar.topic is None or pair.camera.topic is None:
            raise RigError(
                f"{rig_file}: pair {pair.name} does not name its topics",
                hint="give lidar.topic and camera.topic",
            )
    begun = clock.wall_ns() - clock.monotonic_ns()

    def now_ns() -> int:
        # Wall time that never jumps: what arrives is stamped on one clock from start to end.
        return begun + clock.monotonic_ns()

    with bus.open_session(settings) as session:
        complete = _completed(rig, lambda: _survey(session, rig, now_ns, stop), stop)
        if complete is None:
            return "starting"
        rig = with_baselines(complete, None)
        if out is not None:
            _make(out)
        surroundings = Surroundings(rig.vehicle, folder=out, session=session, images_hz=images_hz)
        names = ("status_bus", "candidate_bus", *(FILES if out is not None else ()))
        outputs = open_outputs(names, surroundings)
        try:
            under_watch = watching(rig, segmenter, Parameters(), outputs, clock, _log.warning)
            pairs = tuple(under_watch.engines)
            refusal = bus.command_refusal(settings, allowed=allow_commands)
            with (
                CommandBus(session, rig.vehicle, pairs, under_watch.requests, refusal),
                ZenohLive(session, subscriptions(rig), now_ns=now_ns, stop=stop) as source,
            ):
                if ready is not None:
                    ready()
                return watch(under_watch, source, source.losses, stop)
        finally:
            outputs.close()


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"folder {folder} can not be made: {error.strerror}", hint="--out wants a folder"
        ) from error


def _completed(rig: Rig, survey: Callable[[], Survey], stop: threading.Event) -> Rig | None:
    """The rig with what its file leaves open, however late that comes; None where it was stopped before.

    Raises:
        RigError: The file wants something that the bus can not give.
    """
    if any(pair.store is not None for pair in rig.pairs):
        return completed(rig, survey)
    waiting = ""
    while not stop.is_set():
        if not waiting and any(pair.camera.model is None or pair.T_cam_lidar is None for pair in rig.pairs):
            _log.warning("listening for the intrinsics and transforms that the rig file leaves open")
        try:
            return completed(rig, survey)
        except RigError as error:
            if error.what != waiting:
                waiting = error.what
                _log.warning("still waiting: %s", waiting)
    return None


def _survey(session: zenoh.Session, rig: Rig, now_ns: Callable[[], int], stop: threading.Event) -> Survey:
    """Listens for what the rig file leaves open."""
    topics = [
        TopicInfo(topic, kind, None, None, understood=True)
        for pair in rig.pairs
        for topic, kind in (
            (pair.lidar.topic, pair.lidar.type or CLOUD_TYPES[0]),
            (pair.camera.topic, pair.camera.type or IMAGE_TYPES[0]),
        )
        if topic is not None
    ]
    with ZenohLive(session, subscriptions(rig), now_ns=now_ns, stop=stop) as source:
        return survey_in(_for_a_while(source, now_ns() + SURVEY_NS, now_ns), topics)


def _for_a_while(messages: ZenohLive, end_ns: int, now_ns: Callable[[], int]) -> Iterator[Message | Tick]:
    for message in messages:
        yield message
        if now_ns() > end_ns:
            return
