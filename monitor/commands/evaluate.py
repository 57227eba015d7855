"""``calibwatch evaluate``: measured on data whose truth is known."""

import sys
from pathlib import Path

import click

from monitor import commands

LONGEST_SIDE = 1280
"""px; the network's input rule (pipeline.segmentation) reduces longer images anyway. Here for --help."""


@click.group(epilog="Examples: calibwatch evaluate masks training/; calibwatch evaluate masks my_set/ --json")
def command() -> None:
    """Measure calibwatch on data whose truth is known."""


@command.command(
    name="masks",
    epilog="Examples: calibwatch evaluate masks training/ --out out/masks; "
    "calibwatch evaluate masks my_set/ --model other.onnx --no-crf",
)
@click.argument(
    "folders", metavar="DIR...", nargs=-1, required=True, type=click.Path(path_type=Path, file_okay=False)
)
@click.option("--split", default="val", show_default=True, help="Split of the sets.")
@click.option("--no-crf", is_flag=True, help="Leave the CRF out: it takes as long as the network.")
@click.option(
    "--longest-side",
    type=click.IntRange(32, LONGEST_SIDE),
    help="Reduce images to this longer side first, px; default: as the watch does.",
)
@click.option(
    "--threads",
    type=click.IntRange(1, 256),
    default=2,
    show_default=True,
    help="Threads of network and OpenCV.",
)
@commands.model_option
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON, other thresholds too.")
@click.option(
    "--out",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder for masks.md (the tables) and masks.json (everything).",
)
def masks_command(
    *,
    folders: tuple[Path, ...],
    split: str,
    no_crf: bool,
    longest_side: int | None,
    threads: int,
    model: Path | None,
    as_json: bool,
    out: Path | None,
) -> int:
    """Hold lane and pole masks against labelled pictures: DIR holds sets with set.json, or is one.

    Masks by the likeliest class, by the shipped thresholds, and with the CRF as the watch makes them; for
    each IoU, precision, recall, F and share of the image, with intervals; the reliability of the stated
    probabilities; times. Labels that are not certain of a class are left out for it.
    """
    from monitor.clock import SystemClock  # noqa: PLC0415 - loaded with the rest
    from monitor.mask_evaluation import Options, evaluate  # noqa: PLC0415 - OpenCV is not needed for --help
    from monitor.mask_tables import made, tables, write  # noqa: PLC0415 - likewise

    sweep = as_json or out is not None
    options = Options(split, crf=not no_crf, sweep=sweep, longest_side=longest_side, threads=threads)
    folder = None if out is None else made(out)
    found = evaluate(folders, model, options, SystemClock(), _progress)
    _clear()
    if folder is not None:
        write(found, folder)
    click.echo(found.model_dump_json(indent=1) if as_json else tables(found))
    return 0


def _progress(name: str, done: int, of: int) -> None:
    if sys.stderr.isatty():
        click.echo(f"\r\x1b[K{name}: {done} of {of}", nl=False, err=True)


def _clear() -> None:
    if sys.stderr.isatty():
        click.echo("\r\x1b[K", nl=False, err=True)
