"""``calibwatch masks``: lane paint and poles in image files, as the watch sees them."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from monitor import commands

if TYPE_CHECKING:
    from monitor.masking import MaskedImage, Refused

BAD_INPUT = 1
"""Exit code where an image was refused."""


@click.command(
    epilog="Examples: calibwatch masks front/*.jpg --out out/masks; "
    "calibwatch masks frame.png --no-crf --json (the network's thresholds alone)"
)
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("out/masks"),
    show_default=True,
    help="Folder for NAME.png (0 other, 1 lane, 2 pole, in the image's size) and NAME.overlay.jpg.",
)
@click.option("--no-crf", is_flag=True, help="Leave the CRF out: the network and its thresholds alone.")
@click.option(
    "--force", is_flag=True, help="Replace files of an earlier run; an image that is read never is."
)
@commands.model_option
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON (calibwatch.masks/1).")
def command(
    *, images: tuple[Path, ...], out: Path, no_crf: bool, force: bool, model: Path | None, as_json: bool
) -> int:
    """Find lane paint and poles in IMAGES (JPEG, PNG, BMP) with the network and CRF of the watch.

    Pixels are taken as stored: EXIF orientation is ignored, as calibration belongs to stored pixels. No
    camera is known here, so paint above the horizon stays. Exit code 1: some image was refused; the others
    are done.
    """
    from monitor.clock import SystemClock  # noqa: PLC0415 - loaded with the rest
    from monitor.masking import MaskedImage, mask_files  # noqa: PLC0415 - OpenCV is not needed for --help

    count = commands.progress_line("images done:")
    done = 0

    def tell(result: "MaskedImage | Refused") -> None:
        nonlocal done
        done += 1
        if not isinstance(result, MaskedImage):
            click.echo(f"calibwatch: {result.reason}", err=True)
            return
        if result.note:
            click.echo(f"warning: {result.file}: {result.note}", err=True)
        if not as_json:
            click.echo(_line(result))
        elif count is not None:
            count(done)

    with commands.stop_on_signal() as stop:
        run = mask_files(
            images, out, model=model, crf=not no_crf, replace=force, clock=SystemClock(), stop=stop, tell=tell
        )
    if as_json:
        click.echo(run.model_dump_json(indent=2))
    if not run.complete:
        click.echo("interrupted: the images that follow were not read", err=True)
        return commands.INTERRUPTED
    return BAD_INPUT if run.refused else 0


def _line(result: "MaskedImage") -> str:
    classes = "  ".join(
        f"{name} {100 * found.share:.2f} % in {found.components} piece{'' if found.components == 1 else 's'}"
        for name, found in (("lane", result.lane), ("pole", result.pole))
    )
    times = f"network {result.network_ms:.0f} ms  masks {result.masks_ms:.0f} ms"
    return f"{result.file}  {result.width}x{result.height} px  {classes}  {times}"
