"""The rig file as a document (DESIGN 3): keys, units, defaults; :mod:`monitor.rig` makes values of it."""

import difflib
import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError, field_validator

from pipeline.errors import RigError

NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
"""What a vehicle or pair may be called: one chunk of a key."""

Axis: TypeAlias = Literal["roll", "pitch", "yaw", "forward", "left", "up"]
Pairing: TypeAlias = Literal["stamps", "sequence"]
SweepStamp: TypeAlias = Literal["start", "middle", "end"]
_Name = Annotated[str, StringConstraints(pattern=rf"^{NAME.pattern}$")]
_Row = Annotated[list[float], Field(min_length=4, max_length=4)]
_Matrix4 = Annotated[list[_Row], Field(min_length=4, max_length=4)]
_Matrix3 = Annotated[
    list[Annotated[list[float], Field(min_length=3, max_length=3)]], Field(min_length=3, max_length=3)
]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class LidarSection(_Section):
    """Where the sweeps come from."""

    topic: str | None = Field(
        default=None, description="topic, key expression or folder; absent: the only one of its kind"
    )
    frame: str = Field(default="", description="frame id of the points, as tf names it")
    type: str | None = Field(default=None, description="message type where the bus does not tell it")
    spin: Literal["cw", "ccw"] | None = Field(
        default=None, description="sense of rotation seen from above, for sweeps without times per point"
    )
    stamp: SweepStamp = Field(default="start", description="the instant of the sweep that its stamp means")


class CameraSection(_Section):
    """Where the images come from, and the intrinsics where no CameraInfo gives them."""

    topic: str | None = Field(
        default=None, description="topic, key expression or folder; absent: the only one of its kind"
    )
    info: str | None = Field(default=None, description="topic of its CameraInfo")
    frame: str = Field(default="", description="optical frame id, as tf names it")
    type: str | None = Field(default=None, description="message type where the bus does not tell it")
    rectified: bool | None = Field(
        default=None, description="whether P of CameraInfo holds (true) or K, D (false); absent: see spec"
    )
    model: str | None = Field(default=None, description="lens model, default plumb_bob, pinhole without D")
    K: _Matrix3 | None = Field(default=None, description="camera matrix, px")
    D: list[float] = Field(default=[], max_length=14, description="distortion in the order of OpenCV")
    width: int | None = Field(default=None, gt=0, le=65536, json_schema_extra={"unit": "px"})
    height: int | None = Field(default=None, gt=0, le=65536, json_schema_extra={"unit": "px"})


class ExtrinsicSection(_Section):
    """The stored extrinsic and how well it is known (C_ref of FORMULAS F2)."""

    store: _Name | None = Field(default=None, description="name in the extrinsic store, in place of a matrix")
    T_cam_lidar: _Matrix4 | None = Field(default=None, description="maps LiDAR points into the camera frame")
    sigma_deg: float = Field(
        default=0.1,
        gt=0,
        le=10,
        description="what a good target calibration reaches",
        json_schema_extra={"unit": "deg"},
    )
    sigma_m: float = Field(
        default=0.02,
        gt=0,
        le=1,
        description="what a good target calibration reaches",
        json_schema_extra={"unit": "m"},
    )


class BaselineSection(_Section):
    """What healthy drives taught about the mount."""

    file: str = Field(
        min_length=1,
        max_length=4096,
        description="written by `calibwatch baseline`; relative to the folder of the rig file",
    )


class LimitsSection(_Section):
    """Alert limits: what matters to this vehicle's perception (AL of FORMULAS D3, per axis)."""

    roll_deg: float = Field(default=0.75, gt=0, le=45, json_schema_extra={"unit": "deg"})
    pitch_deg: float = Field(default=0.5, gt=0, le=45, json_schema_extra={"unit": "deg"})
    yaw_deg: float = Field(default=0.5, gt=0, le=45, json_schema_extra={"unit": "deg"})
    forward_m: float = Field(default=0.20, gt=0, le=5, json_schema_extra={"unit": "m"})
    left_m: float = Field(default=0.15, gt=0, le=5, json_schema_extra={"unit": "m"})
    up_m: float = Field(default=0.15, gt=0, le=5, json_schema_extra={"unit": "m"})


class PairSection(_Section):
    """One LiDAR and one camera that watch the same scene."""

    name: _Name
    lidar: LidarSection = LidarSection()
    camera: CameraSection = CameraSection()
    max_gap_ms: float = Field(
        default=50.0,
        gt=0,
        le=1000,
        description="half a period of the usual 10 Hz: a nearer partner always exists when none is lost",
        json_schema_extra={"unit": "ms"},
    )
    pairing: Pairing = Field(
        default="stamps",
        description="'sequence': image n goes with cloud n whatever the stamps say (folders that list pairs)",
    )
    extrinsic: ExtrinsicSection | None = Field(default=None, description="absent: taken from tf_static")
    T_vehicle_lidar: _Matrix4 | None = Field(default=None, description="maps LiDAR points into base_link")
    baseline: BaselineSection | None = Field(
        default=None, description="absent: drift is told relative to the stored extrinsic"
    )
    limits: LimitsSection = LimitsSection()
    required: list[Axis] = Field(
        default=["pitch", "yaw"], min_length=1, description="axes that must be monitored for 'healthy'"
    )

    @field_validator("extrinsic", mode="before")
    @classmethod
    def _from_store(cls, value: object) -> object:
        if isinstance(value, str):
            kind, _, name = value.partition(":")
            if kind != "store":
                raise ValueError('as text it is "store:NAME"')
            return {"store": name}
        return value


class RigDocument(_Section):
    """The rig file."""

    vehicle: _Name = "vehicle"
    pairs: list[PairSection] = Field(min_length=1, max_length=64)


_SECTIONS: dict[str, type[_Section]] = {
    "pairs": PairSection,
    "lidar": LidarSection,
    "camera": CameraSection,
    "extrinsic": ExtrinsicSection,
    "baseline": BaselineSection,
    "limits": LimitsSection,
}


def validated(document: Mapping[str, object], *, where: str) -> RigDocument:
    """The document, checked; RigError names the key that is wrong, and the nearest valid one."""
    try:
        return RigDocument.model_validate(document)
    except ValidationError as error:
        raise _refusal(error, where) from error


def nearest(name: str, valid: Sequence[str] | Mapping[str, object]) -> str:
    """A hint: the valid name that is nearest to ``name``, then all of them."""
    close = difflib.get_close_matches(name, list(valid), n=1, cutoff=0.5)
    known = f"known: {', '.join(valid)}"
    return f"did you mean '{close[0]}'? {known}" if close else known


def _refusal(error: ValidationError, where: str) -> RigError:
    """The first complaint of pydantic in our words."""
    first = error.errors()[0]
    location = first["loc"]
    path = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    if first["type"] == "extra_forbidden":
        owner: type[_Section] = RigDocument
        for part in location[:-1]:
            owner = _SECTIONS.get(str(part), owner)
        return RigError(
            f"{where}: {path} is not a known key", hint=nearest(str(location[-1]), owner.model_fields)
        )
    if first["type"] == "literal_error":
        return RigError(f"{where}: {path} is {first['input']!r}", hint=f"wanted {first['ctx']['expected']}")
    return RigError(
        f"{where}: {path}: {first['msg']}", hint="monitor/spec.md lists the keys with their units"
    )
