"""The runs of ``evaluate drift``, kept as they come: a long evaluation goes on where it stopped."""

import os
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from monitor.outputs import write_whole
from monitor.status import State
from pipeline.drift_trials import Kind
from pipeline.errors import InputError

FILE_NAME = "runs.jsonl"

Six = tuple[float, float, float, float, float, float]
"""Roll, pitch, yaw in deg, forward, left, up in m."""
SixFlags = tuple[bool, bool, bool, bool, bool, bool]


class _Values(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False, extra="forbid")


class Header(_Values):
    """What all rows of a file have in common; rows of other settings are not mixed with them."""

    schema_: Literal["calibwatch.drift-runs/1"] = "calibwatch.drift-runs/1"
    seed: int
    limits: tuple[float, float] | None
    """Alert limits in deg and m; null: each rig's own."""
    baseline: bool
    """Whether each drive was judged with a baseline learned on the others."""
    reference_sigma: tuple[float, float]
    """Deg and m; of recordings."""
    software: str
    network: str | None
    """Content hash of the network."""


class Said(_Values):
    """What the last judgement of a run said, axis by axis."""

    drift: Six
    sigma: Six
    protection_level: Six
    alert_limit: Six
    observable: SixFlags
    monitored: SixFlags
    statistic: float


class Row(_Values):
    """One run."""

    drive: str
    simulated: bool
    kind: Kind
    label: str
    number: int
    drift: Six
    """The truth at the end of the drive."""
    state: State
    code: str
    frames: int
    span_s: float
    since_s: float = 0.0
    """s of data from the first image to the first in which anything is wrong."""
    suspected_s: float | None
    """s of data from the first image to the first that was followed by 'suspect' or 'drifted'."""
    told_s: float | None
    """Likewise to the first 'drifted'."""
    told_frames: int | None
    """Frames up to then."""
    called_s: float | None
    """Likewise to the first 'healthy' or 'drifted'."""
    said: Said | None
    """Null where nothing was judged."""
    reference_sigma: Six
    seconds: float
    """Of computing."""

    @property
    def key(self) -> tuple[str, Kind, int]:
        """Which run it is."""
        return self.drive, self.kind, self.number


class Rows:
    """The rows of an evaluation, in memory and, where a folder is given, in a file that only grows.

    Args:
        folder: Where ``runs.jsonl`` lies or will lie, or None.
        header: Of this evaluation.

    Raises:
        InputError: The file is of other settings, or can not be read or written.
    """

    def __init__(self, folder: Path | None, header: Header) -> None:
        self._path = None if folder is None else folder / FILE_NAME
        self._rows: dict[tuple[str, Kind, int], Row] = {}
        if self._path is None:
            return
        try:
            if self._path.exists():
                self._resume(self._path, header)
            # Anew, so that a row that was cut off by a kill is gone before the next is appended.
            text = [header.model_dump_json(), *(row.model_dump_json() for row in self._rows.values())]
            write_whole(self._path, "".join(f"{line}\n" for line in text).encode())
        except OSError as error:
            raise _unwritable(self._path, error) from error

    def __contains__(self, key: tuple[str, Kind, int]) -> bool:
        return key in self._rows

    @property
    def all(self) -> tuple[Row, ...]:
        """Every row so far, those of earlier calls first."""
        return tuple(self._rows.values())

    def add(self, row: Row) -> None:
        """Keeps a row; it is on disk when this returns."""
        self._rows[row.key] = row
        if self._path is None:
            return
        try:
            with self._path.open("ab") as file:
                file.write(f"{row.model_dump_json()}\n".encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise _unwritable(self._path, error) from error

    def _resume(self, path: Path, header: Header) -> None:
        lines = path.read_bytes().splitlines(keepends=True)
        whole = [line for line in lines if line.endswith(b"\n")]
        try:
            if not whole or Header.model_validate_json(whole[0]) != header:
                raise InputError(
                    f"{path} holds runs of other settings",
                    hint="name another folder with --out, or give seed, limits, baseline as then",
                )
            for line in whole[1:]:
                row = Row.model_validate_json(line)
                self._rows[row.key] = row
        except ValidationError as error:
            raise InputError(
                f"{path} does not hold runs of this version", hint="name another folder with --out"
            ) from error


def _unwritable(path: Path, error: OSError) -> InputError:
    return InputError(f"{path} can not be used: {error.strerror}", hint="name another folder with --out")
