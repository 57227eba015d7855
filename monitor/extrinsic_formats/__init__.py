"""Extrinsics of other formats -> rig. Every module here offers ``FORMAT`` (a :class:`Format`).

Modules whose names start with an underscore are parts of formats. A format is recognised by what the file
says, not by its name. Which way a matrix maps is never guessed: the format defines it, the names of its
frames tell it, or the user says it (``--direction``); every :class:`Reading` says which, and whether it was
inverted.
"""

import importlib
import json
import pkgutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal, Protocol, TypeAlias

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from monitor.rig import rigid as checked_rigid
from pipeline.errors import InputError, RigError
from pipeline.records import Floats
from pipeline.se3 import inverse

Direction: TypeAlias = Literal["T_cam_lidar", "T_lidar_cam"]

_LARGEST_FILE = 1 << 20
"""bytes; a calibration is a few kB."""
_CAMERA_WORDS = ("cam", "optical", "image")
_MOST_NUMBERS = 64
"""Numbers of a matrix or of a lens; 16 and 14 are the largest."""
_LONGEST_NAME = 200
"""Characters of a frame's name."""


@dataclass(frozen=True, slots=True, eq=False)
class Document:
    """A file, read once for all formats.

    Attributes:
        path: Where it lies; some formats have a second file beside it.
        text: What it holds.
        data: The same as JSON or YAML; None where it is neither or holds no structure.
    """

    path: Path
    text: str
    data: object


@dataclass(frozen=True, slots=True)
class Choice:
    """What the user says of a file.

    Attributes:
        camera: Which of its cameras (a frame or name in the file), or None.
        lidar: Which of its LiDARs, or None.
        direction: What its matrix is, or None.
        size: Width and height of the images in px, for files that do not tell, or None.
    """

    camera: str | None = None
    lidar: str | None = None
    direction: Direction | None = None
    size: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What a file says of one pair.

    Attributes:
        T_cam_lidar: float64 (4,4), maps LiDAR points into the camera's optical frame.
        read_as: Which direction was read, and why, in one clause.
        camera: Keys of the camera's section in the rig file.
        lidar: Keys of the LiDAR's section in the rig file.
        name: What the file calls the pair, or None.
        T_vehicle_lidar: float64 (4,4), maps LiDAR points into base_link, or None.
        notes: What the user must know besides, one sentence each.
    """

    T_cam_lidar: Floats
    read_as: str
    camera: dict[str, object] = field(default_factory=dict)
    lidar: dict[str, object] = field(default_factory=dict)
    name: str | None = None
    T_vehicle_lidar: Floats | None = None
    notes: tuple[str, ...] = ()


class Format(Protocol):
    """One format."""

    name: str
    """What ``--format`` calls it."""
    title: str
    """What it is, for people."""

    def matches(self, document: Document) -> bool:
        """Whether the file is of this format, by its content."""

    def read(self, document: Document, choice: Choice) -> Reading:
        """The extrinsic; InputError or RigError name what is wrong or left open."""


@cache
def formats() -> dict[str, Format]:
    """Every format in this folder by its name."""
    modules = [
        importlib.import_module(f"{__name__}.{m.name}")
        for m in pkgutil.iter_modules(__path__)
        if m.name[0] != "_"
    ]
    return {module.FORMAT.name: module.FORMAT for module in modules}


def load_document(path: Path) -> Document:
    """Reads a file; InputError where it can not be read or is no text."""
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise InputError(f"{path} has {path.stat().st_size} bytes, too many for a calibration")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path} can not be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text", hint=_known()) from error
    return Document(path, text, _structure(text))


def recognised(document: Document, name: str | None) -> Format:
    """The format of a file: the one that is named, else the only one that matches.

    Raises:
        InputError: None or several match; says which.
    """
    if name is not None:
        return formats()[name]
    found = [candidate for candidate in formats().values() if candidate.matches(document)]
    if len(found) == 1:
        return found[0]
    if found:
        titles = " or ".join(f"{candidate.name} ({candidate.title})" for candidate in found)
        raise InputError(f"{document.path} may be {titles}", hint="say which with --format")
    raise InputError(f"{document.path} is of no format that is understood", hint=_known())


def directed(T: Floats, direction: Direction, why: str) -> tuple[Floats, str]:
    """A matrix as ``T_cam_lidar``, and how it was read in one clause."""
    if direction == "T_cam_lidar":
        return T, f"T_cam_lidar ({why}), kept as it is"
    return inverse(T), f"T_lidar_cam ({why}), inverted"


def defined(choice: Choice, direction: Direction, why: str) -> Direction:
    """The direction that a file defines; RigError where the user says another one."""
    if choice.direction not in (None, direction):
        raise RigError(
            f"the file states {direction} ({why}), --direction says {choice.direction}",
            hint="leave --direction out, or correct the file",
        )
    return direction


def told(choice: Choice, what: str) -> Direction:
    """The direction that the user must say; InputError where it is not said."""
    if choice.direction is None:
        raise InputError(
            f"{what} does not say which way it maps",
            hint="--direction T_cam_lidar (LiDAR points into the camera) or T_lidar_cam (the other way)",
        )
    return choice.direction


def rigid(rows: object, what: str) -> Floats:
    """A rigid motion (4,4) of 3x4 or 4x4 numbers; small rounding is taken out, anything else refused."""
    T = np.eye(4)
    numbers = numbers_of(rows, what)
    if numbers.shape not in ((3, 4), (4, 4)):
        raise InputError(f"{what} is {'x'.join(map(str, numbers.shape))}, not 4x4 or 3x4")
    T[: len(numbers)] = numbers
    checked = checked_rigid(T.tolist(), what)
    assert checked is not None  # noqa: S101 - None comes of None alone
    return checked


def numbers_of(value: object, what: str) -> Floats:
    """Finite numbers of a list or list of lists; InputError otherwise."""
    rows = value if isinstance(value, list) else [value]
    cells = [cell for row in rows for cell in (row if isinstance(row, list) else [row])][: _MOST_NUMBERS + 1]
    # Aliases let a small YAML file stand for any number of lists: nothing is expanded before it is counted.
    if len(cells) > _MOST_NUMBERS or any(isinstance(cell, list | dict) for cell in cells):
        raise InputError(f"{what} is no table of numbers")
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{what} is no table of numbers") from error
    if numbers.size == 0 or not np.isfinite(numbers).all():
        raise InputError(f"{what} has numbers that are missing or not finite")
    return numbers


def names_camera(name: str) -> bool:
    """Whether a frame's name says camera."""
    return any(word in name.lower() for word in _CAMERA_WORDS)


def one_of(names: Sequence[str], wanted: str | None, what: str, option: str) -> str:
    """The name that is wanted, else the only one; InputError lists what there is."""
    if wanted is None and len(names) == 1:
        return names[0]
    listed = ", ".join(names) or "none"
    if wanted is not None and wanted in names:
        return wanted
    if wanted is None:
        raise InputError(
            f"the file has {len(names)} {what}s: {listed}", hint=f"choose one with {option} NAME"
        )
    raise InputError(f"the file has no {what} {wanted}", hint=f"it has: {listed}")


def frame(name: object) -> str:
    """A frame's name; InputError where it is none."""
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= _LONGEST_NAME:
        raise InputError(f"{str(name)[:40]!r} is no name of a frame")
    return name.lstrip("/")


def keyed_rows(text: str) -> dict[str, Floats]:
    """Rows ``name: numbers`` of a text; rows that are no numbers (dates) are left out."""
    rows: dict[str, Floats] = {}
    for line in text.splitlines():
        name, colon, numbers = line.partition(":")
        try:
            row = np.array([float(number) for number in numbers.split()])
        except ValueError:
            continue
        if colon and row.size and np.isfinite(row).all():
            rows[name.strip()] = row
    return rows


def table(value: object) -> Mapping[str, object]:
    """A mapping as it is, anything else as an empty one: formats ask for keys only."""
    return value if isinstance(value, Mapping) else {}


def _structure(text: str) -> object:
    """JSON, else YAML (one document, or the list of several), else None."""
    try:
        return json.loads(text)
    except (json.JSONDecodeError, RecursionError):
        pass
    try:
        documents = [one for one in YAML(typ="safe", pure=True).load_all(text) if one is not None]
    except (YAMLError, ValueError, RecursionError, TypeError, AttributeError, LookupError):
        return None
    if len(documents) != 1:
        return documents or None
    return None if isinstance(documents[0], str) else documents[0]


def _known() -> str:
    return "understood: " + ", ".join(f"{one.name} ({one.title})" for one in formats().values())
