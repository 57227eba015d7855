"""A whole replay: every stage and every output of a recording, as ``calibwatch replay`` does it."""

import os
import resource
import tempfile
import threading
import time
from pathlib import Path
from typing import TypedDict

from monitor.memory import keep_freed
from monitor.replaying import replay


class Replayed(TypedDict):
    """What one process found, and what it and the process beside it took that looks ahead.

    Memory is told as Pss: pages that several processes have in common count once.
    """

    frames: int
    state: str
    wall_s: float
    process_s: float
    beside_s: float
    memory_mb: float
    beside_mb: float
    together_mb: float


def measure(location: str) -> Replayed:
    """Replays a recording into a folder that is thrown away."""
    keep_freed()
    frames, held = 0, []

    def count(pairs: int) -> None:
        nonlocal frames
        frames = pairs
        if pairs % _LOOKED_EVERY == 1:
            held.append((_held_mb(os.getpid()), sum(_held_mb(child) for child in _children())))

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
        memory_mb=max(own for own, _ in held),
        beside_mb=max(other for _, other in held),
        together_mb=max(own + other for own, other in held),
    )


_LOOKED_EVERY = 10
"""Pairs between looks at the memory. What the kernel tells of a child that has ended counts the memory of its
parent, too, as it was when it was begun."""


def _held_mb(process: int) -> float:
    """Memory of a process, its share of what it has in common with others, MB."""
    lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    return next(float(line.split()[1]) / 1024.0 for line in lines if line.startswith("Pss:"))


def _children() -> list[int]:
    tasks = Path("/proc/self/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]


def table(runs: dict[str, Replayed]) -> str:
    """The replays as Markdown."""
    lines = [
        "### Replay, all stages and outputs; memory of each process, and of both at once",
        "",
        "| recording | frames | wall, s | process, s | beside, s | a frame, ms | memory, MB | verdict |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, run in runs.items():
        each = 1e3 * run["wall_s"] / run["frames"]
        memory = f"{run['memory_mb']:.0f} + {run['beside_mb']:.0f}, {run['together_mb']:.0f}"
        lines.append(
            f"| {name} | {run['frames']} | {run['wall_s']:.1f} | {run['process_s']:.1f} "
            f"| {run['beside_s']:.1f} | {each:.0f} | {memory} | {run['state']} |"
        )
    return "\n".join(lines)
