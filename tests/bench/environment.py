"""What starting costs, and how large the installation is."""

import os
import subprocess
import sys
from pathlib import Path

_STARTS = {
    "calibwatch --help": "from monitor.cli import main; main(['--help'])",
    "calibwatch replay": "import monitor.replaying",
}
_LARGEST = 8
_REPEATS = 3
_MB = 1e6


def tables() -> str:
    """Import times and sizes."""
    return f"{_starts()}\n\n{_sizes()}"


def _starts() -> str:
    lines = [
        "| start | process time, s | modules | slowest imports, themselves, ms |",
        "|---|---|---|---|",
    ]
    for name, code in _STARTS.items():
        runs = [_started(code) for _ in range(_REPEATS)]
        seconds = min(run[0] for run in runs)
        own = runs[-1][1]
        slowest = sorted(own, key=lambda module: -own[module])[:5]
        told = ", ".join(f"{module} {own[module] / 1e3:.0f}" for module in slowest)
        lines.append(f"| {name} | {seconds:.2f} | {len(own)} | {told} |")
    return "\n".join(lines)


def _started(code: str) -> tuple[float, dict[str, int]]:
    """Process time of an interpreter that runs ``code``, s, and the own import time of each module, us."""
    before = os.times()
    done = subprocess.run(  # noqa: S603 - the two programs above
        [sys.executable, "-X", "importtime", "-c", code],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        check=True,
    )
    after = os.times()
    own: dict[str, int] = {}
    for line in done.stderr.splitlines():
        parts = line.removeprefix("import time:").split("|")
        if line.startswith("import time:") and parts[0].strip().isdigit():
            own[parts[2].strip()] = int(parts[0])
    seconds = after.children_user + after.children_system - before.children_user - before.children_system
    return seconds, own


def _sizes() -> str:
    """Sizes of the environment and of its largest packages."""
    site = next(Path(entry) for entry in sys.path if entry.endswith("site-packages"))
    sizes = {entry.name: _size(entry) for entry in site.iterdir()}
    largest = sorted(sizes, key=lambda name: -sizes[name])[:_LARGEST]
    rows = [f"| {name} | {sizes[name] / _MB:.0f} |" for name in largest]
    return "\n".join(
        ["| environment | MB |", "|---|---|", f"| all packages | {sum(sizes.values()) / _MB:.0f} |", *rows]
    )


def _size(path: Path) -> int:
    if not path.is_dir():
        return path.stat().st_size
    return sum((Path(folder) / file).lstat().st_size for folder, _, files in os.walk(path) for file in files)
