"""``calibwatch baseline``: a rig's own bias, learned from healthy recordings."""

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from monitor import commands
from monitor.status import AXIS_NAMES, unit_of

if TYPE_CHECKING:
    from monitor.baselining import Learned


@click.command(
    epilog="Examples: calibwatch baseline monday.mcap tuesday.mcap friday.mcap --out van-17.baseline.json ; "
    "calibwatch replay thursday.mcap --baseline van-17.baseline.json"
)
@click.argument("recordings", nargs=-1, required=True)
@commands.rig_option
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("baseline.json"),
    show_default=True,
    help="The file; name it in the rig file: [pairs.baseline] file = ...",
)
@click.option("--force", is_flag=True, help="Replace a file that is there.")
@commands.model_option
@click.option("--json", "as_json", is_flag=True, help="Print what was written.")
def command(
    *,
    recordings: tuple[str, ...],
    rig_file: Path | None,
    out: Path,
    force: bool,
    model: Path | None,
    as_json: bool,
) -> int:
    """Learn from healthy RECORDINGS of one rig what its unmoved mount looks like.

    Every street is one sample, however long it was driven: give recordings of several. One that has drifted,
    or differs from the others, is refused by name.
    """
    from monitor.baseline_file import document_of, write_baseline  # noqa: PLC0415 - not needed for --help
    from monitor.baselining import learn_baselines  # noqa: PLC0415 - as above
    from pipeline.errors import InputError  # noqa: PLC0415 - as above

    if out.exists() and not force:
        raise InputError(f"{out} exists already", hint="--force replaces it")
    if not out.parent.is_dir():
        raise InputError(f"{out.parent} is no folder to write {out.name} to", hint="make it, or name another")
    with commands.stop_on_signal() as stop:
        learned = learn_baselines(
            recordings, rig_file, model=model, stop=stop, progress=commands.progress_line("pairs watched:")
        )
    document = document_of({name: (one.mount, one.baseline) for name, one in learned.items()})
    write_baseline(document, out)
    for name, one in learned.items():
        for recording, reason in one.unused:
            click.echo(f"warning: {name}: {recording} taught nothing: {reason}", err=True)
        if not as_json:
            click.echo("\n".join(lines(name, one)))
    if as_json:
        click.echo(document.model_dump_json(indent=2))
    else:
        click.echo(
            f"baseline: {out} (use it: calibwatch replay RECORDING --baseline {shlex.quote(str(out))})"
        )
    return 0


def lines(name: str, learned: "Learned") -> Iterator[str]:
    """What was learned of one pair, for people."""
    from monitor.baselining import described  # noqa: PLC0415 - numpy is not needed for --help

    told = described(learned)
    yield f"{name}: {told.samples}: {told.bias}; {told.threshold}"
    yield f"  {told.noise}"
    for axis, row in zip(AXIS_NAMES, told.rows, strict=True):
        digits = 2 if unit_of(axis) == "deg" else 3
        bias, sigma, scene, bound = row
        yield (
            f"  {axis:<8}bias {bias:+.{digits}f} {unit_of(axis):<4}sigma {sigma:.{digits}f}  "
            f"between scenes {scene:.{digits}f}  bound {bound:.{digits}f}"
        )
    for other in told.others:
        yield f"  {other}"
