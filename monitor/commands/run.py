"""``calibwatch run``: live sensors under watch."""

from pathlib import Path

import click

from monitor import commands


@click.command(
    epilog="Examples: calibwatch run --rig van-17.toml --connect tcp/127.0.0.1:7447; "
    "calibwatch run --rig van-17.toml --listen tcp/127.0.0.1:7448 --out /var/lib/calibwatch"
)
@click.option(
    "--rig", "rig_file", type=click.Path(path_type=Path), required=True, help="Rig file (TOML or JSON)."
)
@click.option(
    "--connect", multiple=True, metavar="ENDPOINT", help="Router or peer, as in tcp/127.0.0.1:7447."
)
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help="Wait for peers there; loopback unless you say otherwise.",
)
@click.option(
    "--out", type=click.Path(path_type=Path, file_okay=False), help="Folder for files; default: bus only."
)
@click.option(
    "--images-hz",
    type=commands.Number(0.0, 2.0, min_open=True),
    default=0.2,
    show_default=True,
    help="Images kept in the recording per second and camera, some 0.5 MB each.",
)
@click.option(
    "--allow-commands",
    is_flag=True,
    help="Let whoever reaches the bus acknowledge drifts; default: only whoever is on this machine.",
)
@commands.model_option
def command(
    *,
    rig_file: Path,
    connect: tuple[str, ...],
    listen: tuple[str, ...],
    out: Path | None,
    images_hz: float,
    allow_commands: bool,
    model: Path | None,
) -> int:
    """Watch live sensors on a zenoh bus until interrupted.

    The status goes to calibwatch/VEHICLE/PAIR/status (publisher with history, and queryable).
    """
    from monitor import bus, live  # noqa: PLC0415 - zenoh and numpy are not needed for --help
    from monitor.clock import SystemClock  # noqa: PLC0415 - with them

    if not connect and not listen:
        raise click.UsageError("name a bus: --connect ENDPOINT or --listen ENDPOINT")
    settings = bus.BusSettings(mode="peer" if listen else "client", connect=connect, listen=listen)
    with commands.stop_on_signal() as stop:
        live.run(
            rig_file,
            settings,
            out,
            model=model,
            images_hz=images_hz,
            stop=stop,
            clock=SystemClock(),
            ready=lambda: click.echo("watching", err=True),
            allow_commands=allow_commands,
        )
    return 0
