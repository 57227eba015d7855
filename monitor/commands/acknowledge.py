"""``calibwatch acknowledge``: a person takes note of a drift that a running watch has told."""

import getpass

import click


class NameParameter(click.ParamType[str]):
    """What a rig file calls a vehicle or a pair."""

    name = "NAME"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """The name; one that can be no chunk of a key is wrong usage, before any watch is asked."""
        from monitor.rig_document import NAME  # noqa: PLC0415 - pydantic is not needed for --help

        name = str(value)
        if not NAME.fullmatch(name):
            self.fail(f"'{name}' is no name: 1 to 64 of A-Z a-z 0-9 _ . -, as in the rig file", param, ctx)
        return name


@click.command(
    epilog="Examples: calibwatch acknowledge van-17 front --connect tcp/127.0.0.1:7448 "
    '--reason "bracket tightened"; calibwatch acknowledge van-17 front --connect tcp/127.0.0.1:7448 '
    '--by "Ada, shift 2" --reason "known since Tuesday"'
)
@click.argument("vehicle", type=NameParameter())
@click.argument("pair", type=NameParameter())
@click.option("--reason", required=True, help="Why, in one line; it is told in the status.")
@click.option("--by", help="Who; default: the user of this machine.")
@click.option(
    "--connect",
    multiple=True,
    required=True,
    metavar="ENDPOINT",
    help="The watch or its router, as in tcp/127.0.0.1:7448.",
)
def command(*, vehicle: str, pair: str, reason: str, by: str | None, connect: tuple[str, ...]) -> int:
    """Take note of the drift of PAIR on VEHICLE: the watch collects evidence anew.

    A drift that is still there is told again within seconds.
    """
    from pydantic import ValidationError  # noqa: PLC0415 - not needed for --help

    from monitor import bus, command_bus  # noqa: PLC0415 - zenoh is not needed for --help
    from monitor.requests import Note  # noqa: PLC0415 - with them

    try:
        note = Note(by=by or getpass.getuser(), reason=reason)
    except ValidationError as error:
        raise click.UsageError("--by and --reason take one line of 1 to 200 characters each") from error
    with bus.open_session(bus.BusSettings(connect=connect)) as session:
        command_bus.acknowledge(session, vehicle, pair, note)
    click.echo(f"{vehicle}/{pair}: acknowledged")
    return 0
