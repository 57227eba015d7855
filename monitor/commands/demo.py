"""``calibwatch demo``: a drift that is known, and how it is told."""

import sys
from pathlib import Path

import click

from monitor import commands


@click.command(epilog="Examples: calibwatch demo; calibwatch demo --out out/other --seed 7")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("out/demo"),
    show_default=True,
    help="Folder for the recording, the report and the rest.",
)
@click.option(
    "--seed", type=click.IntRange(0, 2**32 - 1), default=1, show_default=True, help="Of street and noise."
)
def command(*, out: Path, seed: int) -> int:
    """Simulate a drive in which the camera mount slips, and watch it being told.

    The drive is written to MCAP as a vehicle sends it and replayed over zenoh into the daemon.
    Exit code 0: the drift was told, and not before it was there; else 1.
    """
    from monitor.demo import demo  # noqa: PLC0415 - numpy and OpenCV are not needed for --help

    with commands.stop_on_signal() as stop:
        told = demo(out, seed, stop, _progress)
    _progress("")
    for line in told.lines:
        click.echo(line)
    click.echo(f"report:    {out / 'report.html'} (open in a browser)")
    click.echo(f"recording: {out / 'recording.rrd'} (open with: {commands.viewer()} {out / 'recording.rrd'})")
    drive, rig = out / "drive.mcap", out / "rig.toml"
    click.echo(f"drive:     {drive} (judge it again: calibwatch replay {drive} --rig {rig})")
    if not told.summary.complete:
        return commands.INTERRUPTED
    return 0 if told.success else 1


def _progress(text: str) -> None:
    if sys.stderr.isatty():
        click.echo(f"\r\x1b[K{text}", nl=False, err=True)
