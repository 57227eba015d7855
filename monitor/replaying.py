"""A recording from its file to the files that judge it."""

import threading
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

from monitor.baseline_file import with_baselines
from monitor.bus_replay import OverBus
from monitor.candidate_file import SUFFIX
from monitor.clock import SystemClock
from monitor.daemon import watch, watching
from monitor.injection import injected_text
from monitor.lookahead import Forerunner
from monitor.model_file import open_segmenter
from monitor.outputs import Outputs, Surroundings, open_outputs, write_whole
from monitor.outputs.summary import FILE_NAME, Summary
from monitor.preparation import prepare
from monitor.sources import open_source
from monitor.status import State
from pipeline.errors import InputError
from pipeline.parameters import Parameters
from pipeline.records import Floats

OUTPUTS = ("status_log", "summary", "recording", "report", "candidate")
"""What a replay writes (DESIGN 7)."""

_AHEAD = 6
"""Pairs read before the first of them is judged: a judgement takes as long as some others are looked at."""

FILE_NAMES = (FILE_NAME, "status.jsonl", "report.html", "recording.rrd")
"""Under which names."""


def replay(
    location: str,
    rig_file: Path | None,
    drift: Floats | None,
    out: Path,
    *,
    model: Path | None,
    images_hz: float,
    over_zenoh: bool,
    stop: threading.Event,
    progress: Callable[[int], None] | None,
    baseline: Path | None = None,
) -> Summary:
    """Judges a recording and writes its files into ``out``.

    Args:
        location: The recording.
        rig_file: Rig file or calib.json, or None: the recording speaks for itself.
        drift: float64 (6,), altered into the stored extrinsics, or None.
        out: Folder, made where it is absent.
        model: The network's file, or None: the one that ships.
        images_hz: Images kept in the recording.
        over_zenoh: Whether messages go through a zenoh session.
        stop: Ends the run early.
        progress: Told the number of pairs.
        baseline: File of a baseline, or None: those that the rig names.

    Raises:
        CalibwatchError: The recording, rig or model can not be used; no file then looks whole.
    """
    prepared = prepare(location, rig_file, drift, known=lambda rig: with_baselines(rig, baseline))
    with closing(Forerunner(_AHEAD, prepared.frames)) as ahead:
        segmenter = open_segmenter(model)
        outputs = _opened(out, prepared.rig.vehicle, images_hz)
        remark = "" if drift is None else injected_text(drift)
        try:
            under_watch = watching(prepared.rig, segmenter, Parameters(), outputs, SystemClock())
            source = open_source(location)
            with OverBus(source, "replay") if over_zenoh else source as messages:
                state = watch(under_watch, messages, messages.losses, stop, progress, ahead, remark)
        finally:
            outputs.close()
    if outputs.losses:
        raise _lost(out, outputs.losses, state)
    return Summary.model_validate_json((out / FILE_NAME).read_bytes())


def _opened(out: Path, vehicle: str, images_hz: float) -> Outputs:
    """The outputs, in a place where nothing of an earlier run can pass for this one's."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in FILE_NAMES:
            (out / name).unlink(missing_ok=True)
        for earlier in out.glob(f"*{SUFFIX}"):
            earlier.unlink()
        return open_outputs(OUTPUTS, Surroundings(vehicle, folder=out, images_hz=images_hz))
    except OSError as error:
        raise InputError(
            f"folder {out} can not be written to: {error.strerror}", hint="name another folder with --out"
        ) from error


def _lost(out: Path, losses: Mapping[str, str], state: State) -> InputError:
    """What to tell when files are missing; a summary that was written no longer says that all is there."""
    what = "; ".join(f"{name}: {why}" for name, why in losses.items())
    path = out / FILE_NAME
    try:
        written = Summary.model_validate_json(path.read_bytes())
        path.unlink()
        note = f"not everything could be written: {what}"
        marked = written.model_copy(update={"complete": False, "note": note})
        write_whole(path, marked.model_dump_json(indent=2).encode() + b"\n")
    except OSError:
        path.unlink(missing_ok=True)
    return InputError(
        f"not everything could be written to {out} (verdict: {state}): {what}",
        hint="is the disk full? make room, or name another folder with --out",
    )
