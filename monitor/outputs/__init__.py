"""Outputs: what tells the world. Every module here offers ``OUTPUT`` (an :class:`OutputKind`).

Modules whose names start with an underscore are parts of an output and offer none. An output that fails is
lost, not the run: :class:`Outputs` closes it, remembers why, and the engine tells it in the next status.
"""

import importlib
import os
import pkgutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from monitor.events import Event, Output
from pipeline.errors import CalibwatchError, InputError

if TYPE_CHECKING:  # the bus is loaded by those who use it
    import zenoh

PARTIAL = ".partial"
"""Suffix of a file that is not whole, or whose run was not."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What outputs are opened with.

    Attributes:
        vehicle: Name of the vehicle.
        folder: Where files go; must exist. None: no files.
        session: Open session of the bus, owned by the caller. None: no bus.
        images_hz: Images kept in the recording, per second of the data's clock and pair.
    """

    vehicle: str
    folder: Path | None = None
    session: "zenoh.Session | None" = None
    images_hz: float = field(default=2.0)


@dataclass(frozen=True, slots=True)
class OutputKind:
    """One kind of output.

    Attributes:
        name: Its name.
        needs: What it needs of the surroundings.
        open: Opens it; OSError or CalibwatchError where that can not be done.
    """

    name: str
    needs: Literal["folder", "bus"]
    open: Callable[[Surroundings], Output]


@cache
def kinds() -> dict[str, OutputKind]:
    """Every kind of output in this folder by name."""
    found: dict[str, OutputKind] = {}
    for module in pkgutil.iter_modules(__path__):
        if not module.name.startswith("_"):
            kind: OutputKind = importlib.import_module(f"{__name__}.{module.name}").OUTPUT
            found[kind.name] = kind
    return found


def folder_of(surroundings: Surroundings) -> Path:
    """The folder for files; InputError where there is none."""
    if surroundings.folder is None:
        raise InputError("this output writes files and was given no folder", hint="name one with --out")
    return surroundings.folder


def session_of(surroundings: Surroundings) -> "zenoh.Session":
    """The session of the bus; InputError where there is none."""
    if surroundings.session is None:
        raise InputError("this output speaks on the bus and was given no session")
    return surroundings.session


class Outputs:
    """Several outputs that stand and fall each for itself."""

    def __init__(self, outputs: Iterable[tuple[str, Output]]) -> None:
        self._open = dict(outputs)
        self._lost: dict[str, str] = {}

    @property
    def losses(self) -> dict[str, str]:
        """Name of each lost output -> what happened, one clause."""
        told = {name: output.lost for name, output in self._open.items()}
        return self._lost | {name: lost for name, lost in told.items() if lost is not None}

    @property
    def lost(self) -> str | None:
        """All losses in one line, or None."""
        return "; ".join(f"{name}: {what}" for name, what in self.losses.items()) or None

    def handle(self, event: Event) -> None:
        """Gives the event to every output that still stands."""
        for name, output in tuple(self._open.items()):
            self._guard(name, partial(output.handle, event))

    def close(self) -> None:
        """Closes every output; those that fail now are lost."""
        for name, output in tuple(self._open.items()):
            self._guard(name, output.close)

    def _guard(self, name: str, action: Callable[[], None]) -> None:
        try:
            action()
        except (OSError, CalibwatchError) as error:
            self._lost[name] = str(error)
            output = self._open.pop(name)
            try:
                output.close()
            except (OSError, CalibwatchError):
                return  # the first error is the one that tells


def open_outputs(names: Iterable[str], surroundings: Surroundings) -> Outputs:
    """Opens outputs by name; InputError names those that exist."""
    wanted = tuple(names)
    for name in wanted:
        if name not in kinds():
            raise InputError(f"output '{name}' is not known", hint=f"known: {', '.join(sorted(kinds()))}")
    opened: list[tuple[str, Output]] = []
    try:
        for name in wanted:
            opened.append((name, kinds()[name].open(surroundings)))  # noqa: PERF401 # those before a failure count
    except BaseException:
        Outputs(opened).close()
        raise
    return Outputs(opened)


def write_whole(path: Path, data: bytes) -> None:
    """Writes beside the final name, to the disk, and renames: a reader finds the old or the new, whole."""
    beside = path.with_name(path.name + PARTIAL)
    try:
        with beside.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
    except OSError:
        beside.unlink(missing_ok=True)
        raise
    rename_whole(beside, path)


def rename_whole(beside: Path, path: Path) -> None:
    """Gives a whole file its final name, for good."""
    beside.replace(path)
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
