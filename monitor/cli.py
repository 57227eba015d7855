"""The command line: parser, dispatch, and the one place that maps errors to exit codes (DESIGN 7).

Commands are loaded when they are called, so that ``--help`` costs nothing.
"""

import contextlib
import importlib
import logging
import os
import sys
import traceback
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import NoReturn

import click

from monitor.commands import NamingGroup
from pipeline.errors import CalibwatchError

COMMANDS = {
    "acknowledge": "Take note of a drift that a running watch has told.",
    "baseline": "Learn a rig's own bias from healthy recordings, so that smaller drifts can be told.",
    "calibrate": "The extrinsic of a recording or a single frame, and how good it is.",
    "demo": "Simulate a drive in which the camera mount slips, and watch it being told.",
    "evaluate": "Measure calibwatch on data whose truth is known.",
    "extrinsic": "Read extrinsics of other formats into a rig file.",
    "inspect": "What a recording holds, which pairs could be watched, and what is missing.",
    "masks": "Find lane paint and poles in image files, as the watch sees them.",
    "replay": "Judge a recording: verdict, report, rerun recording.",
    "run": "Watch live sensors on a zenoh bus.",
}
"""Name -> what ``--help`` says; the module of a command is ``monitor.commands.<name>``."""

BAD_INPUT, INTERRUPTED = 1, 130
"""Exit codes; wrong usage is click's 2, those of verdicts stand in monitor.status."""


class _Commands(NamingGroup):
    """Commands by name, imported when called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All names, sorted."""
        del ctx
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The command, imported now."""
        del ctx
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = importlib.import_module(f"monitor.commands.{cmd_name}").command
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Lists the commands without importing them."""
        del ctx
        with formatter.section("Commands"):
            formatter.write_dl(sorted(COMMANDS.items()))

    def invoke(self, ctx: click.Context) -> object:
        """Runs the command; that a pipe between our own processes broke is not taken for a reader that left.

        click ends the program silently, with 1, wherever a pipe breaks.
        """
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            if not _while_telling(error):
                raise RuntimeError("a pipe between processes of calibwatch broke") from error
            raise


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Examples: calibwatch demo --out out/demo; calibwatch replay drive.mcap --out out/drive",
)
@click.version_option(package_name="calibwatch")
@click.option("-v", "--verbose", is_flag=True, help="Tell more on stderr.")
def calibwatch(*, verbose: bool) -> None:
    """Watches whether the extrinsic between LiDAR and camera still holds, while vehicles drive.

    Exit codes: 0 healthy or done, 1 bad input or failure, 2 wrong usage, 3 drifted, 4 no statement.
    """
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(levelname)s: %(message)s",
        stream=sys.stderr,
    )
    from monitor.memory import keep_freed  # noqa: PLC0415 - not needed for --help

    keep_freed()


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line and exits with its code."""
    # Read once, when numpy is loaded: the matrices here are small, and threads of BLAS that wait for each
    # other awake take a quarter of the time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        code = calibwatch.main(args=arguments, prog_name="calibwatch", standalone_mode=False)
    except click.ClickException as error:
        with contextlib.suppress(OSError):
            error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        _end(INTERRUPTED, "interrupted")
    except CalibwatchError as error:
        _end(BAD_INPUT, f"calibwatch: {_one_line(str(error))}")
    except Exception as error:  # noqa: BLE001 - the top of the program: reports and ends
        if isinstance(error, OSError) and _while_telling(error):
            _end(BAD_INPUT, f"calibwatch: the output can not be written: {error.strerror}")
        _end(BAD_INPUT, f"calibwatch: internal error: {_one_line(repr(error))} (trace in {_trace_file()})")
    sys.exit(code if isinstance(code, int) else 0)


def _end(code: int, why: str) -> NoReturn:
    """Says why on stderr, if anybody reads it, and ends."""
    with contextlib.suppress(OSError):
        click.echo(why, err=True)
    sys.exit(code)


def _while_telling(error: OSError) -> bool:
    """Whether stdout or stderr failed: all that is told there goes through ``click.echo``."""
    return any(frame.f_code is click.echo.__code__ for frame, _ in traceback.walk_tb(error.__traceback__))


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _trace_file() -> Path:
    """Writes the trace of the present error where it can be sent in."""
    with NamedTemporaryFile("w", prefix="calibwatch-", suffix=".trace", delete=False) as file:
        traceback.print_exc(file=file)
        return Path(file.name)
