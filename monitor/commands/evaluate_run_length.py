"""``calibwatch evaluate run-length``: how seldom the sum over scenes is wrong, and how soon it is right."""

from pathlib import Path

import click

from monitor import commands


@click.command(
    name="run-length",
    epilog="Examples: calibwatch evaluate run-length --hours 10 --runs 2; "
    "calibwatch evaluate run-length --out out/run-length",
)
@click.option(
    "--hours",
    type=commands.Number(0.0, 100_000.0, min_open=True),
    default=100.0,
    show_default=True,
    help="Healthy driving, a few seconds of computing an hour.",
)
@commands.runs_option(10, "each drift")
@click.option(
    "--streets",
    metavar="N",
    type=click.IntRange(0, 10_000),
    default=0,
    show_default=True,
    help="Image-level streets, half a minute each, to hold the evidence model against.",
)
@commands.output_options
def command(*, hours: float, runs: int, streets: int, seed: int, as_json: bool, out: Path | None) -> int:
    """Count false alarms and delays of the sum over scenes on simulated evidence of varied roads.

    No images: estimates of scenes are drawn from a model fitted to image-level drives. False alarms at
    lowered levels are extrapolated to the true one. Exits with 1 if an unmoved mount was called moved.
    """
    from monitor.run_length_evaluation import evaluate  # noqa: PLC0415 - numpy is not needed for --help
    from monitor.run_length_tables import run_length_text  # noqa: PLC0415 - likewise

    folder = commands.made(out)
    found = evaluate(hours, runs, streets, seed, commands.progress)
    commands.clear()
    commands.deliver(
        folder, "run-length", run_length_text(found), found.model_dump_json(indent=1), None, as_json=as_json
    )
    return 0 if found.healthy.alarms == 0 else 1
