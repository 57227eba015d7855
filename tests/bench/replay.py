"""A whole replay: every stage and every output of a recording, as ``calibwatch replay`` does it."""

import resource
import tempfile
import threading
import time
from pathlib import Path
from typing import TypedDict

from monitor.memory import keep_freed
from monitor.replaying import replay


class Replayed(TypedDict):
    """What one process found."""

    frames: int
    state: str
    wall_s: float
    process_s: float
    peak_mb: float


def measure(location: str) -> Replayed:
    """Replays a recording into a folder that is thrown away."""
    keep_freed()
    frames = 0

    def count(pairs: int) -> None:
        nonlocal frames
        frames = pairs

    wall, process = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        summary = replay(
            location,
            None,
            None,
            Path(folder),
            model=None,
            images_hz=2.0,
            over_zenoh=False,
            stop=threading.Event(),
            progress=count,
        )
    return Replayed(
        frames=frames,
        state=summary.state,
        wall_s=time.perf_counter() - wall,
        process_s=time.process_time() - process,
        peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    )


def table(runs: dict[str, Replayed]) -> str:
    """The replays as Markdown."""
    lines = [
        "### Replay, all stages and outputs",
        "",
        "| recording | frames | wall, s | process, s | wall a frame, ms | largest memory, MB | verdict |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, run in runs.items():
        each = 1e3 * run["wall_s"] / run["frames"]
        lines.append(
            f"| {name} | {run['frames']} | {run['wall_s']:.1f} | {run['process_s']:.1f} | {each:.0f} "
            f"| {run['peak_mb']:.0f} | {run['state']} |"
        )
    return "\n".join(lines)
