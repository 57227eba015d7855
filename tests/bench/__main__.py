"""``python -m tests.bench [RECORDING...]``: tables in Markdown on stdout.

Without arguments a simulated drive is measured, and kitti_raw_0005_a where the recordings folder is there; a
longer simulated drive is replayed. ``--replay RECORDING...`` replays only.
Each number of threads has a process of its own: BLAS asks for it once, when it is loaded.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.bench import drive, environment, replay
from tests.bench.lines import TARGETS_MS
from tests.bench.stages import Measured, measure

THREADS = (1, 2)
_RECORDINGS = Path(os.environ.get("CALIBWATCH_DATA") or Path(__file__).parents[3] / "shared" / "data")
_REAL = _RECORDINGS / "kitti_raw_0005_a"
_WORKER, _REPLAY, _REPLAYER = "--worker", "--replay", "--replayer"
_LEGEND = (
    "Process time of all threads / wall time, ms; median of the calls, for motion (every third sweep is "
    "registered) the mean. A frame: at 10 Hz, with masks and lines at 2 Hz and a judgement a second."
)


def main(arguments: list[str]) -> None:
    """Prints all tables, or measures in one process where another asks for it."""
    if arguments[:1] == [_WORKER]:
        threads, location = arguments[1:]
        sys.stdout.write(json.dumps(measure(location, int(threads))))
        return
    if arguments[:1] == [_REPLAYER]:
        sys.stdout.write(json.dumps(replay.measure(arguments[1])))
        return
    if arguments[:1] == [_REPLAY]:
        _tell(_replays(arguments[1:]))
        return
    recordings = arguments or [str(drive.simulated()), *([str(_REAL)] if _REAL.is_dir() else [])]
    for location in recordings:
        runs = {threads: _run(location, threads) for threads in THREADS}
        _tell(_stages(Path(location).name, runs))
        _tell(_lines(runs[THREADS[0]]))
        _tell(_ratios(runs[THREADS[0]]))
    _tell(_replays(arguments or [str(drive.simulated(drive.LONG_S))]))
    _tell(environment.tables())


def _run(location: str, threads: int) -> Measured:
    """Measures in a process with so many threads."""
    sys.stderr.write(f"{location}, threads: {threads}\n")
    found: Measured = json.loads(_answer([_WORKER, str(threads), location], threads))
    return found


def _replays(locations: list[str]) -> str:
    """Replays recordings, each in a process of its own with one thread of BLAS, as the Makefile sets it."""
    found: dict[str, replay.Replayed] = {}
    for location in locations:
        sys.stderr.write(f"{location}, replay\n")
        found[Path(location).name] = json.loads(_answer([_REPLAYER, location], 1))
    return replay.table(found)


def _answer(arguments: list[str], threads: int) -> bytes:
    count = str(threads)
    told = subprocess.run(  # noqa: S603 - this file, by the interpreter that runs it
        [sys.executable, "-m", "tests.bench", *arguments],
        env=os.environ | {"OMP_NUM_THREADS": count, "OPENBLAS_NUM_THREADS": count},
        stdout=subprocess.PIPE,
        check=True,
    )
    return told.stdout


def _stages(name: str, runs: dict[int, Measured]) -> str:
    first = runs[THREADS[0]]
    lines = [
        f"### {name}",
        "",
        f"{first['frames']} frames of {first['image']} px and {first['points']} points. {_LEGEND}",
        "",
        "| stage | " + " | ".join(f"threads: {n}, a call | a frame" for n in runs) + " |",
        "|---|" + "---|---|" * len(runs),
    ]
    for stage in first["stages"]:
        cells = []
        for run in runs.values():
            cost = run["stages"][stage]
            rate = cost["calls_per_frame"]
            cells.append(f"{cost['process_ms']:.1f} / {cost['wall_ms']:.1f}")
            cells.append(f"{cost['process_ms'] * rate:.1f} / {cost['wall_ms'] * rate:.1f}")
        lines.append(f"| {stage} | " + " | ".join(cells) + " |")
    totals = []
    for run in runs.values():
        costs = run["stages"].values()
        process, wall = (
            sum(cost[kind] * cost["calls_per_frame"] for cost in costs) for kind in ("process_ms", "wall_ms")
        )
        totals.append(f" | {process:.0f} / {wall:.0f}")
    lines.append("| whole frame | " + " | ".join(totals) + " |")
    peaks = ", ".join(f"{run['peak_mb']:.0f} MB (threads: {n})" for n, run in runs.items())
    return "\n".join([*lines, "", f"Largest resident memory: {peaks}."])


def _lines(run: Measured) -> str:
    rows = [f"| {step} | {spent:.1f} | {TARGETS_MS.get(step, '')} |" for step, spent in run["lines"].items()]
    return "\n".join(
        ["| lines, one frame, one thread | process time, ms | target, ms |", "|---|---|---|", *rows]
    )


def _ratios(run: Measured) -> str:
    return "\n".join(
        ["| process times, their ratios and memory, one run, one thread | |", "|---|---|"]
        + [f"| {what} | {value:.2f} |" for what, value in run["ratios"].items()]
    )


def _tell(text: str) -> None:
    sys.stdout.write(text + "\n\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
