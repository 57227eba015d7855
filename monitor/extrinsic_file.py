"""An extrinsic of another format made into a rig file (DESIGN 3)."""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from monitor.extrinsic_formats import Choice, Format, Reading, load_document, recognised
from monitor.outputs import write_whole
from monitor.rig import RigPair, parse_rig
from monitor.rig_document import NAME
from pipeline.errors import InputError, RigError

_CAMERA_KEYS = ("topic", "frame", "model", "width", "height", "K", "D")


@dataclass(frozen=True, slots=True, eq=False)
class Imported:
    """A rig file that was written.

    Attributes:
        path: The rig file.
        format: What the source was read as.
        reading: What it says.
        pair: What the rig file holds, as it will be read.
    """

    path: Path
    format: Format
    reading: Reading
    pair: RigPair


def import_extrinsic(
    source: Path, out: Path, choice: Choice, *, format_name: str | None, pair: str | None, force: bool
) -> Imported:
    """Reads an extrinsic and writes a rig file of one pair.

    Args:
        source: The file of another format.
        out: The rig file, ``.toml``.
        choice: What the user says of the source.
        format_name: Its format, or None: by its content.
        pair: Name of the pair, or None: what the source calls the camera.
        force: Replace a file that is there.

    Raises:
        InputError: The source can not be read, or leaves something open.
        RigError: The name or what the source says makes no rig, or ``out`` can not be written.
    """
    if out.suffix != ".toml":
        raise RigError(f"--out {out} is no .toml file", hint="a rig file is written as TOML")
    if out.exists() and not force:
        raise RigError(f"{out} exists already", hint="--force replaces it")
    document = load_document(source)
    chosen = recognised(document, format_name)
    reading = chosen.read(document, choice)
    text = rig_text(reading, pair or _pair_name(reading), f"{source.name} ({chosen.title})")
    written = parse_rig(tomllib.loads(text), where=str(source)).pairs[0]
    if written.T_cam_lidar is None or not np.allclose(written.T_cam_lidar, reading.T_cam_lidar, atol=1e-9):
        raise InputError(f"{source}: the extrinsic does not survive writing", hint="report this file")
    try:
        write_whole(out, text.encode())
    except OSError as error:
        raise RigError(
            f"{out} can not be written: {error.strerror}", hint="name a file with --out"
        ) from error
    return Imported(out, chosen, reading, written)


def rig_text(reading: Reading, pair: str, source: str) -> str:
    """The rig file as TOML: what the reading says, defaults left out.

    Args:
        reading: The extrinsic, and what goes with it.
        pair: Name of the pair.
        source: Where it comes from, for a comment.
    """
    if not NAME.fullmatch(pair):
        raise RigError(f"'{pair}' can not name a pair", hint=f"--pair NAME, of {NAME.pattern}")
    lines = [_comment(f"from {source}"), _comment(f"read as {reading.read_as}")]
    lines += [_comment(note) for note in reading.notes]
    lines += ["", "[[pairs]]", f"name = {_value(pair)}"]
    if reading.T_vehicle_lidar is not None:
        lines.append(f"T_vehicle_lidar = {_value(reading.T_vehicle_lidar.tolist())}")
    lines += _section("lidar", reading.lidar, ("topic", "frame"))
    lines += _section("camera", reading.camera, _CAMERA_KEYS)
    lines += ["", "[pairs.extrinsic]", f"T_cam_lidar = {_value(reading.T_cam_lidar.tolist())}", ""]
    return "\n".join(lines)


def _section(name: str, values: Mapping[str, object], keys: tuple[str, ...]) -> list[str]:
    present = [f"{key} = {_value(values[key])}" for key in keys if values.get(key) not in (None, [])]
    return ["", f"[pairs.{name}]", *present] if present else []


def _value(value: object) -> str:
    """A TOML value: text, numbers, or lists of numbers; a matrix row by row."""
    if isinstance(value, list):
        if value and isinstance(value[0], list):
            return "[\n" + "".join(f"  {_value(row)},\n" for row in value) + "]"
        return f"[{', '.join(_value(item) for item in value)}]"
    if isinstance(value, str):
        if not value.isprintable():
            raise InputError(f"{value[:40]!r} can not stand in a rig file")
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{str(value)[:40]!r} is no number")
    return repr(value)


def _comment(text: str) -> str:
    return "# " + "".join(letter if letter.isprintable() else "?" for letter in text)


def _pair_name(reading: Reading) -> str:
    """The source's name for the camera as one chunk of a key."""
    name = "".join(letter if NAME.fullmatch(letter) else "_" for letter in reading.name or "camera")
    return name[:64]
