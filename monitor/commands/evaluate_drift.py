"""``calibwatch evaluate drift``: what the verdict is worth."""

import difflib
from pathlib import Path
from typing import TYPE_CHECKING

import click

from monitor import commands

if TYPE_CHECKING:
    from pipeline.drift_trials import Kind

_KINDS = (
    "healthy",
    "combined",
    "single",
    "compensating",
    "ramp",
    "vibration",
    "time-offset",
    "focal",
    "offline",
    "slip",
)
"""``pipeline.drift_trials.KINDS``, without loading numpy for --help."""


@click.command(
    name="drift",
    epilog="Examples: calibwatch evaluate drift --simulated 4 --runs 5 --out out/drift; "
    "calibwatch evaluate drift street_a.mcap street_b.mcap --kinds healthy,combined --limits 0.5 0.1",
)
@click.argument("places", metavar="[RECORDING]...", nargs=-1)
@commands.simulated_option("Drives")
@commands.runs_option(40, "each kind on each drive; more where a kind has more amounts than that")
@click.option(
    "--kinds",
    metavar="KIND,...",
    default=",".join(_KINDS),
    show_default=True,
    help="What is run.",
)
@click.option(
    "--limits",
    type=(commands.Number(0.0, 45.0, min_open=True), commands.Number(0.0, 5.0, min_open=True)),
    metavar="DEG M",
    help="Alert limits on every axis; default: each rig's own.",
)
@commands.reference_sigma_option
@click.option(
    "--baseline",
    type=click.Choice(["none", "other"]),
    default="none",
    show_default=True,
    help="Judge each recording with the baseline that the other recordings of its extrinsic give.",
)
@commands.model_option
@commands.output_options
def command(
    *,
    places: tuple[str, ...],
    simulated: int,
    runs: int,
    kinds: str,
    limits: tuple[float, float] | None,
    reference_sigma: tuple[float, float],
    baseline: str,
    seed: int,
    model: Path | None,
    as_json: bool,
    out: Path | None,
) -> int:
    """Watch drives as they are and with things made wrong; tell how often, how soon, how honestly it is said.

    RECORDING is anything that replay takes, with the extrinsic that it states as the truth. Kinds: healthy;
    combined (turned and moved at random); single (one axis); compensating (two axes that hide each other);
    ramp; vibration; time-offset; focal; offline (a published table); slip (one axis, during the drive).
    With --out each run is kept as it ends, and the same command goes on where it was stopped.
    """
    import numpy as np  # noqa: PLC0415 - not needed for --help

    from monitor import drift_drives, drift_plots, drift_tables  # noqa: PLC0415 - likewise
    from monitor.clock import SystemClock  # noqa: PLC0415 - likewise
    from monitor.daemon import software  # noqa: PLC0415 - likewise
    from monitor.drift_baselines import OtherDrives  # noqa: PLC0415 - likewise
    from monitor.drift_evaluation import Options, evaluate  # noqa: PLC0415 - likewise
    from monitor.drift_rows import Header, Rows  # noqa: PLC0415 - likewise
    from monitor.drift_summary import summary_of  # noqa: PLC0415 - likewise
    from monitor.model_file import open_segmenter  # noqa: PLC0415 - likewise
    from pipeline.parameters import Parameters  # noqa: PLC0415 - likewise

    if not places and not simulated:
        raise click.UsageError("nothing to watch: name a recording, or simulate some drives (--simulated N)")
    if baseline == "other" and simulated:
        raise click.UsageError("simulated drives are of one rig each: there is no other to learn from")
    chosen = _kinds_of(kinds)
    sigma, on_all = (
        None if known is None else np.array([np.radians(known[0])] * 3 + [known[1]] * 3)
        for known in (reference_sigma, limits)
    )
    assert sigma is not None  # noqa: S101 - it has a default
    drives = [*drift_drives.recorded(places, sigma), *drift_drives.simulated(simulated, seed)]
    folder = commands.made(out)
    segmenter = open_segmenter(model, 1)
    header = Header(
        seed=seed,
        limits=limits,
        baseline=baseline == "other",
        reference_sigma=reference_sigma,
        software=software(),
        network=segmenter.info.hash,
    )
    rows = Rows(folder, header)
    others = None
    if baseline == "other":
        others = OtherDrives(drives, segmenter, Parameters(), commands.progress)
    options = Options(runs, seed, chosen, on_all, others)
    evaluate(drives, segmenter, options, rows, SystemClock(), commands.progress)
    commands.clear()
    found = summary_of(header, rows.all)
    if folder is not None:
        drift_tables.write(folder, found, drift_plots.pictures(found, rows.all))
    click.echo(found.model_dump_json(indent=1) if as_json else drift_tables.drift_text(found))
    return 0


def _kinds_of(text: str) -> "tuple[Kind, ...]":
    """The kinds that are named, each once; one that does not exist is wrong usage."""
    from pipeline.drift_trials import KINDS  # noqa: PLC0415 - numpy is not needed for --help

    names = dict.fromkeys(name.strip() for name in text.split(","))
    for name in names:
        if name not in KINDS:
            near = difflib.get_close_matches(name, KINDS, n=1, cutoff=0.0)
            others = ", ".join(kind for kind in KINDS if kind not in near)
            raise click.BadParameter(
                f"'{name}' is none of {', '.join([*near, others])}", param_hint="--kinds"
            )
    return tuple(kind for kind in KINDS if kind in names)
