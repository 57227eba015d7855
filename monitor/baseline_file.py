"""The file of a baseline, ``calibwatch.baseline/1``: what healthy drives taught about a rig's pairs.

It belongs to one extrinsic and one set of axes, and says so: with another it is refused, for a bias that was
learned under the old extrinsic would be taken for a drift of the new one.
"""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeInt, PositiveInt, ValidationError

from monitor.daemon import extrinsic_hash, mount_of, software
from monitor.outputs import write_whole
from monitor.rig import Rig, RigPair
from monitor.status import Name
from pipeline.baseline import Baseline
from pipeline.errors import InputError, RigError
from pipeline.mount import Mount
from pipeline.records import Floats
from pipeline.road_samples import Scatter, Street
from pipeline.run_tail import Tail

SCHEMA: Literal["calibwatch.baseline/1"] = "calibwatch.baseline/1"

_LARGEST_FILE = 64 << 20
"""bytes; a stretch takes 0.4 kB, so this is thirty thousand kilometres of road."""

_AXES_ALIKE = 1e-6
"""Largest difference of two rotations that passes as rounding of a file."""

_Six: TypeAlias = Annotated[list[FiniteFloat], Field(min_length=6, max_length=6)]
_Sigma: TypeAlias = Annotated[list[Annotated[FiniteFloat, Field(ge=0)]], Field(min_length=6, max_length=6)]
_Matrix: TypeAlias = Annotated[list[_Six], Field(min_length=6, max_length=6)]
_Row3: TypeAlias = Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]
_NonNegative: TypeAlias = Annotated[FiniteFloat, Field(ge=0)]
_Positive: TypeAlias = Annotated[FiniteFloat, Field(gt=0)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class StretchPart(_Part):
    """One stretch of road: one sample of the scene."""

    recording: str = Field(max_length=4096)
    mean: _Six = Field(description="mean estimate: roll pitch yaw rad, forward left up m")
    windows: PositiveInt = Field(description="windows that share no frame")
    samples: _Positive = Field(description="independent windows that all its windows are worth")
    way_m: _NonNegative
    seconds: _NonNegative


class TailPart(_Part):
    """The tail of the joint statistic over healthy stretches."""

    stretches: NonNegativeInt
    needed: PositiveInt = Field(description="stretches at which the wanted run length is known")
    wanted_s: _Positive = Field(description="wanted run length between two false alarms, s")
    threshold: _Positive | None = Field(description="null: the default threshold stays")
    interval: tuple[FiniteFloat, FiniteFloat] | None = Field(description="95 % interval of the threshold")


class PairPart(_Part):
    """What was learned of one pair; vehicle axes, roll pitch yaw in rad, forward left up in m."""

    extrinsic: str = Field(pattern=r"^[0-9a-f]{64}$", description="hash of the extrinsic that it belongs to")
    R_vehicle_cam: Annotated[list[_Row3], Field(min_length=3, max_length=3)]
    bias: _Six
    covariance: _Matrix = Field(description="of the bias")
    spread: _Matrix = Field(description="of what the scene adds")
    deviation: _Sigma = Field(description="root mean square of the windows from the bias")
    own: _Sigma = Field(description="root mean square of the windows' own sigma")
    noise: _Positive = Field(description="factor on the stated sigma of a window")
    correlation_m: _Positive
    stretches: list[StretchPart] = Field(min_length=1)
    tail: TailPart


class BaselineDocument(_Part):
    """The whole file."""

    schema_: Literal["calibwatch.baseline/1"] = Field(default=SCHEMA, alias="schema")
    software: str
    pairs: dict[Name, PairPart] = Field(min_length=1)

    model_config = ConfigDict(validate_by_name=True, serialize_by_alias=True)


def document_of(learned: dict[str, tuple[Mount, Baseline]]) -> BaselineDocument:
    """The file of some pairs by name."""
    return BaselineDocument(
        software=software(),
        pairs={name: _part(mount, baseline) for name, (mount, baseline) in learned.items()},
    )


def _part(mount: Mount, baseline: Baseline) -> PairPart:
    return PairPart(
        extrinsic=extrinsic_hash(mount.T_cam_lidar),
        R_vehicle_cam=mount.R_vehicle_cam.tolist(),
        bias=baseline.bias.tolist(),
        covariance=baseline.covariance.tolist(),
        spread=baseline.spread.tolist(),
        deviation=baseline.deviation.tolist(),
        own=baseline.own.tolist(),
        noise=baseline.scatter.noise,
        correlation_m=baseline.scatter.correlation_m,
        stretches=[
            StretchPart(
                recording=street.recording,
                mean=street.mean.tolist(),
                windows=street.windows,
                samples=street.samples,
                way_m=street.way_m,
                seconds=street.seconds,
            )
            for street in baseline.stretches
        ],
        tail=TailPart(**dataclasses.asdict(baseline.tail)),
    )


def write_baseline(document: BaselineDocument, path: Path) -> None:
    """Writes the file, whole or not at all.

    Raises:
        InputError: It can not be written.
    """
    try:
        write_whole(path, document.model_dump_json(indent=2).encode() + b"\n")
    except OSError as error:
        raise InputError(
            f"{path} can not be written: {error.strerror}", hint="name a file in a folder that is there"
        ) from error


def read_baseline(path: Path) -> BaselineDocument:
    """Reads the file.

    Raises:
        InputError: It can not be read, or is no baseline.
    """
    try:
        size = path.stat().st_size
        if size > _LARGEST_FILE:
            raise InputError(f"{path} has {size} bytes, too many for a baseline", hint=_HINT)
        return BaselineDocument.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(f"baseline {path} can not be read: {error.strerror}", hint=_HINT) from error
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise InputError(
            f"{path} is no baseline: {f'{place}: ' if place else ''}{first['msg']}", hint=_HINT
        ) from error


_HINT = "calibwatch baseline RECORDINGS... --out FILE writes one"


def with_baselines(rig: Rig, given: Path | None) -> Rig:
    """The rig with the baselines that its file names, or that of ``given`` for every pair.

    Args:
        rig: Every pair has its intrinsics and its extrinsic.
        given: File of a baseline, in place of those that the rig names, or None.

    Raises:
        InputError: A file can not be read or is no baseline.
        RigError: It was learned for another extrinsic, or holds nothing of a pair.
    """
    documents: dict[Path, BaselineDocument] = {}
    pairs = []
    for pair in rig.pairs:
        path = given or pair.baseline_file
        if path is None:
            pairs.append(pair)
            continue
        if path not in documents:
            documents[path] = read_baseline(path)
        pairs.append(dataclasses.replace(pair, baseline=_fitting(documents[path], pair, path)))
    return dataclasses.replace(rig, pairs=tuple(pairs))


def _fitting(document: BaselineDocument, pair: RigPair, path: Path) -> Baseline:
    """The baseline of a pair, if it belongs to its extrinsic and its axes."""
    part = document.pairs.get(pair.name)
    if part is None:
        known = ", ".join(document.pairs)
        raise RigError(f"{path} holds no baseline of pair {pair.name}", hint=f"it holds: {known}")
    mount = mount_of(pair)
    own = extrinsic_hash(mount.T_cam_lidar)
    if part.extrinsic != own:
        raise RigError(
            f"{path} was learned under extrinsic {part.extrinsic[:12]}, pair {pair.name} has {own[:12]}",
            hint="learn it anew with calibwatch baseline, or leave it out",
        )
    if np.abs(np.array(part.R_vehicle_cam) - mount.R_vehicle_cam).max() > _AXES_ALIKE:
        raise RigError(
            f"{path} was learned in other vehicle axes than pair {pair.name} has now (T_vehicle_lidar)",
            hint="learn it anew with calibwatch baseline, or leave it out",
        )
    return _baseline(part, f"{path}: pairs.{pair.name}")


def _baseline(part: PairPart, where: str) -> Baseline:
    return Baseline(
        bias=np.array(part.bias),
        covariance=_covariance(part.covariance, f"{where}.covariance"),
        spread=_covariance(part.spread, f"{where}.spread"),
        deviation=np.array(part.deviation),
        own=np.array(part.own),
        scatter=Scatter(noise=part.noise, correlation_m=part.correlation_m),
        stretches=tuple(
            Street(
                recording=stretch.recording,
                mean=np.array(stretch.mean),
                windows=stretch.windows,
                samples=stretch.samples,
                way_m=stretch.way_m,
                seconds=stretch.seconds,
            )
            for stretch in part.stretches
        ),
        tail=Tail(**part.tail.model_dump()),
    )


def _covariance(rows: list[list[float]], where: str) -> Floats:
    """A symmetric, positive definite matrix (6,6)."""
    C = np.array(rows, dtype=np.float64)
    # Compared in units of its own diagonal: rad^2 and m^2 differ by orders of magnitude.
    scale = np.sqrt(np.abs(np.diag(C)))
    if (scale == 0).any() or np.abs((C - C.T) / np.outer(scale, scale)).max() > _AXES_ALIKE:
        raise InputError(f"{where} is no covariance: it is not symmetric", hint=_HINT)
    try:
        np.linalg.cholesky(C / np.outer(scale, scale))
    except np.linalg.LinAlgError as error:
        raise InputError(f"{where} is no covariance: it is not positive definite", hint=_HINT) from error
    return 0.5 * (C + C.T)
