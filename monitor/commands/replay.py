"""``calibwatch replay``: a recording through the engine, files out."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import click

from monitor import commands
from monitor.status import EXIT_CODES, State

if TYPE_CHECKING:
    from monitor.outputs.summary import Summary
    from pipeline.records import Floats


@click.command(
    epilog="Examples: calibwatch replay drive.mcap --out out/drive; "
    "calibwatch replay drive.mcap --inject yaw=1 --out out/check (does it tell a known error?)"
)
@click.argument("recording")
@commands.rig_option
@commands.baseline_option
@commands.inject_option
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("out"),
    show_default=True,
    help="Folder for summary.json, status.jsonl, report.html, recording.rrd.",
)
@click.option("--over-zenoh", is_flag=True, help="Send the recording through a real zenoh session.")
@click.option(
    "--images-hz",
    type=commands.Number(0.0, min_open=True),
    default=2.0,
    show_default=True,
    help="Images kept in the recording per second and camera, some 0.5 MB each.",
)
@commands.model_option
@commands.verdict_options
def command(
    *,
    recording: str,
    rig_file: Path | None,
    baseline: Path | None,
    drift: "Floats | None",
    out: Path,
    over_zenoh: bool,
    images_hz: float,
    model: Path | None,
    as_json: bool,
    exit_zero: bool,
) -> int:
    """Judge RECORDING (.mcap, .bag, rosbag2 folder, KITTI drive, folder with calib.json).

    Writes summary.json, status.jsonl, report.html and recording.rrd, and prints the verdict.
    """
    from monitor.replaying import replay  # noqa: PLC0415 - numpy, OpenCV and onnxruntime are not needed for --help

    with commands.stop_on_signal() as stop:
        summary = replay(
            recording,
            rig_file,
            drift,
            out,
            model=model,
            images_hz=images_hz,
            over_zenoh=over_zenoh,
            stop=stop,
            progress=commands.progress_line("pairs judged:"),
            baseline=baseline,
        )
    if as_json:
        click.echo(summary.model_dump_json(indent=2))
    else:
        tell(summary, out, images_hz)
    if not summary.complete:
        click.echo(f"warning: {summary.note or 'interrupted'}", err=True)
        return commands.INTERRUPTED
    return exit_code(summary.state, exit_zero=exit_zero)


def exit_code(state: State, *, exit_zero: bool) -> int:
    """Exit code of a verdict; ``exit_zero`` turns 3 and 4 off."""
    code = EXIT_CODES[state]
    return 0 if exit_zero and code in (3, 4) else code


def tell(summary: "Summary", out: Path, images_hz: float) -> None:
    """Prints the verdict of each pair, the warnings, and where the files are."""
    from monitor.wording import verdict_sentence  # noqa: PLC0415 - loaded with the rest

    for name, pair in summary.pairs.items():
        click.echo(f"{name}: {pair.state}: {verdict_sentence(pair.last)}")
    for warning in summary.warnings:
        click.echo(f"warning: {warning}", err=True)
    for pair in summary.pairs.values():
        if pair.candidate is not None and pair.candidate.file is not None:
            file = shlex.quote(str(out / pair.candidate.file))
            click.echo(f"proposed: {file} (once accepted: calibwatch extrinsic import {file} --out RIG.toml)")
    recording = out / "recording.rrd"
    click.echo(f"report: {out / 'report.html'}")
    opens = f"{commands.viewer()} {shlex.quote(str(recording))}"
    click.echo(f"recording: {recording} (images at {images_hz:g} Hz; open with: {opens})")
