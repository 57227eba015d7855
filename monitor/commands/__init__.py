"""One file per command: options -> call -> print. Every module offers ``command``."""

import math
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pipeline.errors import CalibwatchError

if TYPE_CHECKING:
    from pipeline.records import Floats


class NamingGroup(click.Group):
    """Commands below a command; one that is misspelt names the nearest."""

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that is named; wrong usage where there is none."""
        known = self.list_commands(ctx)
        if args and not args[0].startswith("-") and args[0] not in known:
            from monitor.rig_document import nearest  # noqa: PLC0415 - pydantic is not needed for --help

            ctx.fail(f"no command '{args[0]}' ({nearest(args[0], sorted(known))})")
        return super().resolve_command(ctx, args)


class Number(click.FloatRange):
    """A number within a range; neither NaN, which lies within any, nor without end."""

    def convert(self, value: float, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """The number; anything else is wrong usage."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number} is no number that can be worked with.", param, ctx)
        return number


class DriftParameter(click.ParamType["Floats"]):
    """``yaw=0.5,up=0.05``: degrees and metres by the six names."""

    name = "AXIS=VALUE,..."

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> "Floats":
        """Drift (6,), rad and m; a misspelt axis is wrong usage."""
        from monitor.injection import parse_inject  # noqa: PLC0415 - numpy is not needed for --help

        try:
            return parse_inject(str(value))
        except CalibwatchError as error:
            self.fail(str(error), param, ctx)


def rig_option(function: Callable[..., object]) -> Callable[..., object]:
    """``--rig FILE``."""
    return click.option(
        "--rig",
        "rig_file",
        type=click.Path(path_type=Path),
        help="Rig file (TOML or JSON) or calib.json; default: what the recording says itself.",
    )(function)


def baseline_option(function: Callable[..., object]) -> Callable[..., object]:
    """``--baseline FILE``."""
    return click.option(
        "--baseline",
        type=click.Path(path_type=Path),
        help="What `calibwatch baseline` learned of this rig; default: the file that the rig names, if any.",
    )(function)


def inject_option(function: Callable[..., object]) -> Callable[..., object]:
    """``--inject AXIS=VALUE,...``."""
    return click.option(
        "--inject",
        "drift",
        type=DriftParameter(),
        help="Alter the stored extrinsic so that this drift is true: yaw=0.5,up=0.05 (degrees, metres; "
        "roll pitch yaw forward left up).",
    )(function)


def model_option(function: Callable[..., object]) -> Callable[..., object]:
    """``--model FILE``."""
    return click.option(
        "--model",
        type=click.Path(path_type=Path),
        help="Segmentation network (.onnx), or 'free': the one that ships whose data allow commercial use; "
        "default: the other one that ships.",
    )(function)


def verdict_options(function: Callable[..., object]) -> Callable[..., object]:
    """``--json`` and ``--exit-zero``."""
    function = click.option("--json", "as_json", is_flag=True, help="Print the summary as JSON.")(function)
    return click.option(
        "--exit-zero", is_flag=True, help="Exit with 0 for 'drifted' and 'no statement' too (else 3 and 4)."
    )(function)


INTERRUPTED = 130
"""Exit code of a run that SIGINT or SIGTERM ended."""


@contextmanager
def stop_on_signal() -> Iterator[threading.Event]:
    """An event that SIGINT and SIGTERM set; the second signal interrupts at once."""
    stop = threading.Event()

    def handle(number: int, frame: object) -> None:
        del number, frame
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def viewer() -> str:
    """The command that opens a recording: of this environment where it is not on the path."""
    beside = Path(sys.executable).parent / "rerun"
    return "rerun" if shutil.which("rerun") or not beside.exists() else str(beside)


def progress_line(what: str) -> Callable[[int], None] | None:
    """Rewrites one line on stderr with a count; None where stderr is no terminal."""
    if not sys.stderr.isatty():
        return None

    def show(count: int) -> None:
        click.echo(f"\r{what} {count}", nl=False, err=True)

    return show


def output_options(function: Callable[..., object]) -> Callable[..., object]:
    """``--seed``, ``--json`` and ``--out`` of experiments."""
    function = click.option(
        "--out",
        type=click.Path(path_type=Path, file_okay=False),
        help="Folder for the tables (.md), the figures (.json) and the picture (.png).",
    )(function)
    function = click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")(function)
    return click.option(
        "--seed",
        type=click.IntRange(0, 2**32 - 1),
        default=0,
        show_default=True,
        help="Seed of whatever is drawn.",
    )(function)


def runs_option(runs: int, of: str) -> Callable[[Callable[..., object]], Callable[..., object]]:
    """``--runs`` of experiments: so many by default, of what ``of`` says."""
    return click.option(
        "--runs", type=click.IntRange(1, 100_000), default=runs, show_default=True, help=f"Runs of {of}."
    )


def simulated_option(what: str) -> Callable[[Callable[..., object]], Callable[..., object]]:
    """``--simulated N`` of experiments: ``what`` of simulated streets."""
    return click.option(
        "--simulated",
        metavar="N",
        type=click.IntRange(0, 100_000),
        default=0,
        help=f"{what} of simulated streets and rigs, whose truth is exactly known.",
    )


def reference_sigma_option(function: Callable[..., object]) -> Callable[..., object]:
    """``--reference-sigma DEG M``."""
    return click.option(
        "--reference-sigma",
        type=(Number(0.0, 10.0), Number(0.0, 1.0)),
        metavar="DEG M",
        default=(0.2, 0.05),
        show_default=True,
        help="How well the recordings know their own extrinsic, per axis.",
    )(function)


def made(out: Path | None) -> Path | None:
    """The folder of ``--out``, made before anything is measured for it."""
    from monitor.mask_tables import made  # noqa: PLC0415 - loaded with the rest

    return None if out is None else made(out)


def deliver(
    folder: Path | None, name: str, text: str, document: str, picture: bytes | None, *, as_json: bool
) -> None:
    """Writes what an experiment gave into its folder, if any, and prints it."""
    from monitor.plk_tables import write  # noqa: PLC0415 - loaded with the rest

    if folder is not None:
        write(folder, name, text, document, picture)
    click.echo(document if as_json else text)


def progress(name: str, done: int, of: int) -> None:
    """Rewrites one line on stderr, on a terminal only."""
    if sys.stderr.isatty():
        click.echo(f"\r\x1b[K{name}: {done} of {of}", nl=False, err=True)


def clear() -> None:
    """Takes that line away."""
    if sys.stderr.isatty():
        click.echo("\r\x1b[K", nl=False, err=True)
