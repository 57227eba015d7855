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
    """What one process found, and what the process beside it took that looks ahead."""

    frames: int
    state: str
    wall_s: float
    process_s: float
    beside_s: float
    peak_mb: float
    beside_mb: float


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
    beside = resource.getrusage(resource.RUSAGE_CHILDREN)
    return Replayed(
        frames=frames,
        state=summary.state,
        wall_s=time.perf_counter() - wall,
        process_s=time.process_time() - process,
        beside_s=beside.ru_utime + beside.ru_stime,
        peak_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        beside_mb=beside.ru_maxrss / 1024.0,
    )


def table(runs: dict[str, Replayed]) -> str:
    """The replays as Markdown."""
    lines = [
        "### Replay, all stages and outputs",
        "",
        "| recording | frames | wall, s | process, s | beside, s | wall a frame, ms | memory, MB | verdict |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, run in runs.items():
        each = 1e3 * run["wall_s"] / run["frames"]
        memory = f"{run['peak_mb']:.0f} + {run['beside_mb']:.0f}"
        lines.append(
            f"| {name} | {run['frames']} | {run['wall_s']:.1f} | {run['process_s']:.1f} "
            f"| {run['beside_s']:.1f} | {each:.0f} | {memory} | {run['state']} |"
        )
    return "\n".join(lines)
