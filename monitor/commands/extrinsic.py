"""``calibwatch extrinsic``: extrinsics of other formats as rig files."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from monitor import commands

if TYPE_CHECKING:
    from monitor.extrinsic_file import Imported

FORMATS = ("autoware", "calib", "candidate", "kalibr", "kitti", "matrix", "opencalib", "ros")
"""Modules of monitor.extrinsic_formats by their names, here for ``--help``; a test holds them together."""


class SizeParameter(click.ParamType[tuple[int, int]]):
    """``1920x1200``."""

    name = "WIDTHxHEIGHT"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """Width and height, px."""
        width, _, height = str(value).lower().partition("x")
        digits = width.isdecimal() and height.isdecimal() and len(width + height) <= 10
        if not digits or int(width) * int(height) == 0:
            self.fail(f"'{value}' is no size, as in 1920x1200", param, ctx)
        return int(width), int(height)


@click.group(cls=commands.NamingGroup)
def command() -> None:
    """Extrinsics of other formats."""


@command.command(
    name="import",
    epilog="Examples: calibwatch extrinsic import calib_velo_to_cam.txt --out van.toml; "
    "calibwatch extrinsic import T.txt --direction T_lidar_cam --pair front --out van.toml; "
    "calibwatch extrinsic import out/front.candidate.json --out proposed.toml (what a watch proposes)",
)
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="The rig file to write, .toml.")
@click.option("--format", "format_name", type=click.Choice(FORMATS), help="Default: told by the content.")
@click.option("--pair", help="Name of the pair in the rig file; default: what FILE calls the camera.")
@click.option(
    "--direction",
    type=click.Choice(["T_cam_lidar", "T_lidar_cam"]),
    help="What FILE's matrix is, where it does not tell: T_cam_lidar maps LiDAR points into the camera.",
)
@click.option("--camera", help="Which of FILE's cameras, where it has several or names do not tell.")
@click.option("--lidar", help="Which of FILE's LiDARs, likewise.")
@click.option("--size", type=SizeParameter(), help="Size of the images in px, where FILE does not tell.")
@click.option("--force", is_flag=True, help="Replace a rig file that is there.")
def import_command(
    *,
    file: Path,
    out: Path,
    format_name: str | None,
    pair: str | None,
    direction: Literal["T_cam_lidar", "T_lidar_cam"] | None,
    camera: str | None,
    lidar: str | None,
    size: tuple[int, int] | None,
    force: bool,
) -> int:
    """Make a rig file of FILE: calib.json, KITTI, OpenCalib, ROS, Kalibr, Autoware, a matrix, or a candidate.

    Says in which direction the matrix was read and whether it was inverted. Intrinsics come along where
    FILE has them.
    """
    from monitor.extrinsic_file import import_extrinsic  # noqa: PLC0415 - numpy, YAML are not for --help
    from monitor.extrinsic_formats import Choice  # noqa: PLC0415 - likewise

    choice = Choice(camera=camera, lidar=lidar, direction=direction, size=size)
    tell(import_extrinsic(file, out, choice, format_name=format_name, pair=pair, force=force))
    return 0


def tell(imported: "Imported") -> None:
    """Prints what was read and how, and what the rig file says now."""
    from pipeline.se3 import inverse  # noqa: PLC0415 - loaded with the rest

    pair, reading = imported.pair, imported.reading
    click.echo(f"{imported.path}: pair {pair.name}, from {imported.format.title}")
    click.echo(f"read as {reading.read_as}")
    T_lidar_cam = inverse(reading.T_cam_lidar)
    at, along = (" ".join(f"{v:+.3f}" for v in T_lidar_cam[:3, column]) for column in (3, 2))
    click.echo(f"camera at {at} m, looking along {along} (LiDAR axes)")
    model = pair.camera.model
    if model is not None:
        click.echo(f"intrinsics: {model.model}, {model.width}x{model.height} px")
    for note in reading.notes:
        click.echo(f"note: {note}")
    if pair.lidar.topic is None or pair.camera.topic is None:
        click.echo(
            "topics are left open: lidar.topic and camera.topic are needed where a recording has several"
        )
