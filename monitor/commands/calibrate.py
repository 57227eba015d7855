"""``calibwatch calibrate``: the extrinsic of a recording or a single frame."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from monitor import commands
from monitor.status import EXIT_CODES, unit_of

if TYPE_CHECKING:
    import threading
    from collections.abc import Mapping

    from monitor.calibrating import Calibration
    from pipeline.records import Floats

MASK_PRIOR = 2.0, 0.3
"""deg and m; how far off the stored extrinsic may be where masks are given without ``--prior-sigma``."""


@click.command(
    epilog="Examples: calibwatch calibrate frame/ ; "
    "calibwatch calibrate frame/ --inject yaw=1 --reference frame/calib.json (does it find back?) ; "
    "calibwatch calibrate frame/ --no-prior (only the intrinsics are known)"
)
@click.argument("recording")
@commands.rig_option
@commands.inject_option
@click.option(
    "--reference", type=click.Path(path_type=Path), help="Rig file or calib.json to compare the result with."
)
@click.option(
    "--no-prior",
    is_flag=True,
    help="Look at no stored extrinsic, which may be missing: find one from two lanes and edges of a frame.",
)
@click.option(
    "--prior-sigma",
    nargs=2,
    type=commands.Number(min=0, min_open=True, max=180),
    metavar="DEG M",
    help="The stored extrinsic may be off by so much (one sigma of each axis, degrees and metres): lines and "
    "edges are searched for the right one before it is refined. Default: it is right to 2 deg and 0.3 m.",
)
@click.option(
    "--mask",
    "masks",
    multiple=True,
    type=click.Path(path_type=Path),
    help="Lane and pole mask of the first frame, the next of the second, in place of the network: a PNG, "
    "JPEG or BMP of the image's shape, with values 1 lane and 2 pole, or with bright lines on black, of "
    "which those above the horizon, and upright ones across it, are poles.",
)
@commands.model_option
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
def command(
    *,
    recording: str,
    rig_file: Path | None,
    drift: "Floats | None",
    reference: Path | None,
    no_prior: bool,
    prior_sigma: tuple[float, float] | None,
    masks: tuple[Path, ...],
    model: Path | None,
    as_json: bool,
) -> int:
    """Estimate the extrinsic of RECORDING (one frame or a drive) from its stored one as first guess.

    The stored extrinsic is not changed. Exit code 4: not one axis is observable, or nothing was found.
    """
    from monitor.calibrating import calibrate  # noqa: PLC0415 - numpy and OpenCV are not needed for --help
    from pipeline.frame_modes import Prior  # noqa: PLC0415 - as above

    if no_prior and (prior_sigma is not None or drift is not None):
        other = "--inject" if prior_sigma is None else "--prior-sigma"
        raise click.UsageError(f"--no-prior looks at no stored extrinsic: {other} has no meaning with it")
    with commands.stop_on_signal() as stop:
        guesses, prior = None, None
        if no_prior or prior_sigma is not None or masks:
            sigma = None if no_prior else prior_sigma or MASK_PRIOR
            prior = None if sigma is None else Prior(math.radians(sigma[0]), sigma[1])
            guesses = _guesses(recording, rig_file, drift, sigma, masks, model, stop)
        results: tuple[Calibration, ...] = ()
        if (guesses is None or guesses) and not stop.is_set():
            results = calibrate(
                recording,
                rig_file,
                drift,
                reference=reference,
                model=model,
                stop=stop,
                progress=commands.progress_line("pairs read:"),
                tell=_warn,
                guesses=guesses,
                prior=prior,
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


def _guesses(
    recording: str,
    rig_file: Path | None,
    drift: "Floats | None",
    sigma: tuple[float, float] | None,
    masks: tuple[Path, ...],
    model: Path | None,
    stop: "threading.Event",
) -> "Mapping[str, Floats]":
    from monitor.first_guess import PriorSigma, first_guesses  # noqa: PLC0415 - as above

    return first_guesses(
        recording,
        rig_file,
        drift,
        sigma=None if sigma is None else PriorSigma(math.radians(sigma[0]), sigma[1]),
        masks=masks,
        model=model,
        stop=stop,
        tell=lambda note: click.echo(note, err=True),
    )


def _warn(note: str) -> None:
    click.echo(f"warning: {note}", err=True)


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
