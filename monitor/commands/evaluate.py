"""``calibwatch evaluate``: measured on data whose truth is known."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from monitor import commands
from monitor.commands import evaluate_drift, evaluate_run_length

if TYPE_CHECKING:
    from monitor.evaluated_frames import EvaluatedFrames

LONGEST_SIDE = 1280
"""px; the network's input rule (pipeline.segmentation) reduces longer images anyway. Here for --help."""


@click.group(
    cls=commands.NamingGroup,
    epilog="Examples: calibwatch evaluate masks training/; calibwatch evaluate plk-table1 --out out/plk",
)
def command() -> None:
    """Measure calibwatch on data whose truth is known."""


command.add_command(evaluate_drift.command)
command.add_command(evaluate_run_length.command)


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
    found = evaluate(folders, model, options, SystemClock(), commands.progress)
    commands.clear()
    if folder is not None:
        write(found, folder)
    click.echo(found.model_dump_json(indent=1) if as_json else tables(found))
    return 0


def _plk_options(runs: int) -> Callable[[Callable[..., object]], Callable[..., object]]:
    """``--runs``, ``--seed``, ``--json`` and ``--out`` of the experiments of PLK-Calib."""

    def add(function: Callable[..., object]) -> Callable[..., object]:
        return commands.runs_option(runs, "each row, box or point")(commands.output_options(function))

    return add


def _frame_options(starts: int) -> Callable[[Callable[..., object]], Callable[..., object]]:
    """What chooses frames and starts: ``--simulated``, ``--frames``, ``--starts``, ``--seed`` and outputs."""

    def add(function: Callable[..., object]) -> Callable[..., object]:
        function = commands.output_options(function)
        function = commands.model_option(function)
        function = click.option(
            "--starts",
            type=click.IntRange(1, 1000),
            default=starts,
            show_default=True,
            help="Starts of each frame.",
        )(function)
        function = click.option(
            "--frames",
            type=click.IntRange(1, 100_000),
            default=3,
            show_default=True,
            help="Frames of each camera of a recording, spread evenly: first, middle, last.",
        )(function)
        return commands.simulated_option("Frames")(function)

    return add


@command.command(
    name="plk-table1",
    epilog="Examples: calibwatch evaluate plk-table1; calibwatch evaluate plk-table1 --runs 1000 --json",
)
@_plk_options(200)
def table_command(*, runs: int, seed: int, as_json: bool, out: Path | None) -> int:
    """Solve the scenes of PLK-Calib's Table I: methods I, II and ours, 0.3 and 1 px.

    Says for each row whether the bar is held, and exits with 1 if one is missed. Medians of 200 runs scatter
    by 6 %, so that another seed may miss one by chance; 1000 runs tell.
    """
    from monitor.plk_evaluation import table  # noqa: PLC0415 - numpy is not needed for --help
    from monitor.plk_tables import table_text  # noqa: PLC0415 - likewise

    folder = commands.made(out)
    found = table(runs, seed, commands.progress)
    commands.clear()
    commands.deliver(
        folder, "plk-table1", table_text(found), found.model_dump_json(indent=1), None, as_json=as_json
    )
    return 0 if found.met else 1


@command.command(
    name="plk-fig5",
    epilog="Examples: calibwatch evaluate plk-fig5 --out out/plk; calibwatch evaluate plk-fig5 --json",
)
@_plk_options(50)
def boxes_command(*, runs: int, seed: int, as_json: bool, out: Path | None) -> int:
    """Draw box plots of the errors from 5 deg about and 0.5 m along each axis off (PLK-Calib's Fig. 5).

    Near, middling and far simulated lines stand for the published recordings.
    """
    from monitor.plk_evaluation import box_plots  # noqa: PLC0415 - numpy is not needed for --help
    from monitor.plk_tables import box_picture, box_text  # noqa: PLC0415 - likewise

    folder = commands.made(out)
    found = box_plots(runs, seed, commands.progress)
    commands.clear()
    picture = None if folder is None else box_picture(found)
    commands.deliver(
        folder, "plk-fig5", box_text(found), found.model_dump_json(indent=1), picture, as_json=as_json
    )
    return 0


@command.command(
    name="plk-fig6",
    epilog="Examples: calibwatch evaluate plk-fig6 --out out/plk; calibwatch evaluate plk-fig6 --json",
)
@_plk_options(20)
def offsets_command(*, runs: int, seed: int, as_json: bool, out: Path | None) -> int:
    """Draw success by the initial error along one axis, the other half of the pose held (PLK-Calib's Fig. 6).

    Up to 5 m along the LiDAR's y axis with only the translation sought, up to 46 deg about its z axis with
    only the rotation sought.
    """
    from monitor.plk_evaluation import offsets  # noqa: PLC0415 - numpy is not needed for --help
    from monitor.plk_tables import offsets_picture, offsets_text  # noqa: PLC0415 - likewise

    folder = commands.made(out)
    found = offsets(runs, seed, commands.progress)
    commands.clear()
    picture = None if folder is None else offsets_picture(found)
    commands.deliver(
        folder, "plk-fig6", offsets_text(found), found.model_dump_json(indent=1), picture, as_json=as_json
    )
    return 0


@command.command(
    name="dataset",
    epilog="Examples: calibwatch evaluate dataset kitti/ rig_b/ --out out/crlf; "
    "calibwatch evaluate dataset --simulated 30 --rotation 6 --translation 1 --prior-sigma 3 0.5",
)
@click.argument("places", metavar="[DIR]...", nargs=-1, type=click.Path(path_type=Path))
@_frame_options(starts=3)
@click.option(
    "--rotation",
    type=commands.Number(0.0, 45.0),
    default=2.0,
    show_default=True,
    help="Starts are off by up to so many degrees about each axis.",
)
@click.option(
    "--translation",
    type=commands.Number(0.0, 5.0),
    default=0.3,
    show_default=True,
    help="Starts are off by up to so many metres along each axis.",
)
@click.option(
    "--prior-sigma",
    type=(commands.Number(0.0, 180.0, min_open=True), commands.Number(0.0, 180.0, min_open=True)),
    metavar="DEG M",
    help="Tell calibrate by how much starts may be off, as its option of this name does; default: it takes "
    "them for first guesses.",
)
@commands.reference_sigma_option
@click.option(
    "--set-sigma",
    "set_sigmas",
    multiple=True,
    type=(str, commands.Number(0.0, 180.0), commands.Number(0.0, 10.0)),
    metavar="SET DEG M",
    help="The same for one set where it is known better or worse; may be given again.",
)
def dataset_command(
    *,
    places: tuple[Path, ...],
    simulated: int,
    frames: int,
    starts: int,
    rotation: float,
    translation: float,
    prior_sigma: tuple[float, float] | None,
    reference_sigma: tuple[float, float],
    set_sigmas: tuple[tuple[str, float, float], ...],
    seed: int,
    model: Path | None,
    as_json: bool,
    out: Path | None,
) -> int:
    """Calibrate frames one by one from starts that are off, against the extrinsic that DIR states.

    DIR is a recording or holds some: folders with calib.json, KITTI drives, .mcap, .bag. Mean absolute errors
    as in CRLF's Table II, what is called observable, whether the stated sigmas are honest, times; with --out
    cumulative curves too.
    """
    from monitor.clock import SystemClock  # noqa: PLC0415 - loaded with the rest
    from monitor.dataset_evaluation import Options, evaluate  # noqa: PLC0415 - numpy is not needed for --help
    from monitor.dataset_tables import dataset_picture, dataset_text  # noqa: PLC0415 - likewise
    from monitor.first_guess import PriorSigma  # noqa: PLC0415 - likewise
    from monitor.model_file import open_segmenter  # noqa: PLC0415 - likewise

    chosen = _frames_of(places, simulated, frames, seed, reference_sigma, set_sigmas)
    folder = commands.made(out)
    segmenter = open_segmenter(model, 1)
    told = None if prior_sigma is None else PriorSigma(math.radians(prior_sigma[0]), prior_sigma[1])
    options = Options(starts, rotation, translation, seed, told)
    found = evaluate(chosen, segmenter, options, SystemClock(), commands.progress)
    commands.clear()
    picture = None if folder is None else dataset_picture(found)
    text, document = dataset_text(found), found.model_dump_json(indent=1)
    commands.deliver(folder, "dataset", text, document, picture, as_json=as_json)
    return 0


@command.command(
    name="basin",
    epilog="Examples: calibwatch evaluate basin --simulated 6 --out out/crlf; "
    "calibwatch evaluate basin opencalib/ --json",
)
@click.argument("places", metavar="[DIR]...", nargs=-1, type=click.Path(path_type=Path))
@_frame_options(starts=1)
def basin_command(
    *,
    places: tuple[Path, ...],
    simulated: int,
    frames: int,
    starts: int,
    seed: int,
    model: Path | None,
    as_json: bool,
    out: Path | None,
) -> int:
    """Draw how far off a start may be, by what it is calibrated with (PLK-Calib's Fig. 6, CRLF's Fig. 7).

    Up to 46 deg about the vehicle's up axis, 5 m along its left axis, 6 deg and 1 m on all axes together, for
    PLK-Calib's methods on lines whose matches are known, for the search for the best semantic cost by
    Algorithm 1 of CRLF and by evolution, and for the whole of calibwatch calibrate. DIR as for evaluate
    dataset. Takes some minutes a frame.
    """
    from monitor.basin_evaluation import evaluate  # noqa: PLC0415 - numpy is not needed for --help
    from monitor.basin_tables import basin_picture, basin_text  # noqa: PLC0415 - likewise
    from monitor.clock import SystemClock  # noqa: PLC0415 - likewise
    from monitor.model_file import open_segmenter  # noqa: PLC0415 - likewise

    chosen = _frames_of(places, simulated, frames, seed)
    folder = commands.made(out)
    found = evaluate(chosen, starts, seed, open_segmenter(model, 1), SystemClock(), commands.progress)
    commands.clear()
    picture = None if folder is None else basin_picture(found)
    commands.deliver(
        folder, "basin", basin_text(found), found.model_dump_json(indent=1), picture, as_json=as_json
    )
    return 0


def _frames_of(
    places: tuple[Path, ...],
    simulated: int,
    most: int,
    seed: int,
    reference_sigma: tuple[float, float] = (0.0, 0.0),
    set_sigmas: tuple[tuple[str, float, float], ...] = (),
) -> "EvaluatedFrames":
    """The frames of all places and simulated ones; none at all is wrong usage."""
    import numpy as np  # noqa: PLC0415 - not needed for --help

    from monitor.evaluated_frames import chained, recorded_frames, simulated_frames  # noqa: PLC0415 - likewise

    if not places and not simulated:
        raise click.UsageError("nothing to calibrate: name a folder, or simulate some frames (--simulated N)")
    if set_sigmas and not places:
        raise click.UsageError("--set-sigma speaks of a set of recordings: name their folder")
    sigma, of_sets = (
        {name: np.array([np.radians(deg)] * 3 + [m] * 3) for name, deg, m in known}
        for known in ([("", *reference_sigma)], set_sigmas)
    )
    parts = [recorded_frames(places, most, sigma[""], _warn, of_sets=of_sets)] if places else []
    return chained([*parts, *([simulated_frames(simulated, seed)] if simulated else [])])


def _warn(note: str) -> None:
    click.echo(f"warning: {note}", err=True)
