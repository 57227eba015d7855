"""``calibwatch calibrate``: the extrinsic of a recording or a single frame."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from monitor import commands
from monitor.status import EXIT_CODES, unit_of

if TYPE_CHECKING:
    from monitor.calibrating import Calibration
    from pipeline.records import Floats


@click.command(
    epilog="Examples: calibwatch calibrate frame/ ; "
    "calibwatch calibrate frame/ --inject yaw=1 --reference frame/calib.json (does it find back?)"
)
@click.argument("recording")
@commands.rig_option
@commands.inject_option
@click.option(
    "--reference", type=click.Path(path_type=Path), help="Rig file or calib.json to compare the result with."
)
@commands.model_option
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def command(
    *,
    recording: str,
    rig_file: Path | None,
    drift: "Floats | None",
    reference: Path | None,
    model: Path | None,
    as_json: bool,
) -> int:
    """Estimate the extrinsic of RECORDING (one frame or a drive) from its stored one as first guess.

    The stored extrinsic is not changed. Exit code 4: not one axis is observable.
    """
    from monitor.calibrating import calibrate  # noqa: PLC0415 - numpy and OpenCV are not needed for --help

    with commands.stop_on_signal() as stop:
        results = calibrate(
            recording,
            rig_file,
            drift,
            reference=reference,
            model=model,
            stop=stop,
            progress=commands.progress_line("pairs read:"),
            tell=lambda note: click.echo(f"warning: {note}", err=True),
        )
    if as_json:
        click.echo(json.dumps([result.model_dump(mode="json") for result in results], indent=2))
    else:
        for result in results:
            _tell(result)
    if stop.is_set():
        click.echo("interrupted: what came after was not read", err=True)
        return commands.INTERRUPTED
    return 0 if any(result.observable for result in results) else EXIT_CODES["unobservable"]


def _tell(result: "Calibration") -> None:
    frames = f"{result.frames} frame{'s' if result.frames != 1 else ''}"
    click.echo(f"{result.pair}: {frames}: {result.reason}")
    for axis, found in result.axes.items():
        unit = unit_of(axis)
        mark = "" if found.observable else "  not observable"
        error = "" if found.error is None else f"  error {found.error:+.3f}"
        click.echo(f"  {axis:<8}{found.value:+9.3f} {unit:<4}sigma {found.sigma:.3f}{error}{mark}")
    if result.T_cam_lidar is not None and result.observable:
        click.echo("  T_cam_lidar")
        for row in result.T_cam_lidar:
            click.echo("    " + " ".join(f"{value:+.8f}" for value in row))
