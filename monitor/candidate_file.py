"""A proposed extrinsic as a document, ``calibwatch.candidate/1``: signed by its content, applied by nobody.

``candidate.schema.json`` beside this file is what :func:`json_schema` gives; a test holds them together.
"""

import hashlib
import json
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, FiniteFloat, NonNegativeInt, ValidationError

from monitor.document import DocumentPart
from monitor.statements import TO_PEOPLE, Identity
from monitor.status import AxisValues, Name, NonNegative, Provenance
from pipeline import se3
from pipeline.candidate import Candidate, WindowEstimate
from pipeline.errors import InputError
from pipeline.hold_out import HoldOut
from pipeline.mount import Mount
from pipeline.records import AXES, Floats

SCHEMA: Literal["calibwatch.candidate/1"] = "calibwatch.candidate/1"

SUFFIX = ".candidate.json"
"""A pair's candidate is the file of its name and this."""

_MOST_BYTES = 1 << 20
"""bytes; a document takes some ten thousand."""

Row4 = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
Row6 = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
Chance = Annotated[FiniteFloat, Field(ge=0, le=1)]


class CandidateWindow(DocumentPart):
    """One window that the candidate was made from; no two show the same objects."""

    from_ns: int
    to_ns: int
    from_m: NonNegative = Field(description="way driven at its oldest frame")
    to_m: NonNegative
    frames: NonNegativeInt


class HoldOutResult(DocumentPart):
    """The candidate against frames that it was not made from."""

    from_ns: int
    to_ns: int
    frames: NonNegativeInt
    apart_m: FiniteFloat = Field(
        description="way driven since the last frame it was made from; below 20 they show the same things"
    )
    cells: NonNegativeInt = Field(description="parts of the image, by stretch of road, that were compared")
    score_stored: FiniteFloat = Field(description="score of the edges under the stored extrinsic")
    score_candidate: FiniteFloat
    score_own: FiniteFloat = Field(description="under the best extrinsic for these very frames")
    p_better: Chance = Field(
        description="chance of scoring so much better than the stored one where neither is better"
    )
    p_agreed: Chance = Field(
        description="chance of differing so much from what these frames say where both mean the same mount"
    )
    p_lines: Chance | None = Field(description="the same against lines alone; null: none testified")
    lines_stored: NonNegative | None = Field(description="misfit of lines under the stored one, chi-square")
    lines_candidate: NonNegative | None


class CandidateDocument(DocumentPart):
    """A proposed extrinsic of one pair: for a person to accept, never applied by itself."""

    schema_: Literal["calibwatch.candidate/1"] = Field(default=SCHEMA, alias="schema")
    vehicle: Name
    pair: Name
    stamp_ns: int = Field(description="stamp of the data at which it was proposed")
    T_cam_lidar: tuple[Row4, Row4, Row4, Row4] = Field(description="maps LiDAR points into the camera frame")
    covariance: tuple[Row6, Row6, Row6, Row6, Row6, Row6] = Field(
        description="of (phi, rho), camera axes, rad and m: R <- Exp(phi) R, t <- Exp(phi) t + rho; "
        "random error and the floor between scenes"
    )
    replaces: Provenance = Field(description="the stored extrinsic that it was found against")
    drift: AxisValues = Field(description="motion of the mount from the stored extrinsic to this one, deg, m")
    sigma: AxisValues
    axes: Literal["vehicle", "camera"] = Field(description="of drift and sigma")
    windows: tuple[CandidateWindow, ...] = Field(min_length=1)
    agreed: bool = Field(description="three windows or more agree; false: one or two windows' word")
    hold_out: HoldOutResult
    model: Provenance
    software: str
    hash: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] = Field(
        description="SHA-256 over everything else as JSON: keys sorted, no spaces, ASCII"
    )

    def to_json(self) -> bytes:
        """The document as it is written."""
        return self.model_dump_json(indent=2).encode() + b"\n"


def document_of(identity: Identity, mount: Mount, candidate: Candidate) -> CandidateDocument:
    """The document of a candidate, signed."""
    R_vc = mount.R_vehicle_cam
    B = se3.vehicle_block(R_vc)
    drift = se3.mount_drift(mount.T_cam_lidar, candidate.T_cam_lidar, R_vc)
    sigma = np.sqrt(np.diag(B @ candidate.covariance @ B.T))
    content = {
        "schema": SCHEMA,
        "vehicle": identity.vehicle,
        "pair": identity.pair,
        "stamp_ns": candidate.stamp_ns,
        "T_cam_lidar": candidate.T_cam_lidar.tolist(),
        "covariance": candidate.covariance.tolist(),
        "replaces": identity.extrinsic.model_dump(),
        "drift": _values(drift),
        "sigma": _values(sigma),
        "axes": "camera" if mount.T_vehicle_lidar is None else "vehicle",
        "windows": [_window(window) for window in candidate.windows],
        "agreed": candidate.agreed,
        "hold_out": _hold_out(candidate.hold_out),
        "model": identity.model.model_dump(),
        "software": identity.software,
    }
    return CandidateDocument.model_validate(content | {"hash": content_hash(content)})


def content_hash(content: dict[str, Any]) -> str:
    """SHA-256 of a document without its ``hash``, over canonical JSON."""
    rest = {key: value for key, value in content.items() if key != "hash"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def verified(data: bytes, where: str) -> CandidateDocument:
    """Reads a candidate and holds it against its own hash.

    Args:
        data: The document.
        where: What to call it in an error.

    Raises:
        InputError: It is no candidate, holds no rigid transform, or was changed since it was signed.
    """
    if len(data) > _MOST_BYTES:
        raise InputError(f"{where} is too large for a candidate: {len(data)} bytes")
    try:
        document = CandidateDocument.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the document"
        raise InputError(f"{where} is no {SCHEMA}: {place}: {first['msg']}") from error
    if content_hash(json.loads(document.model_dump_json())) != document.hash:
        raise InputError(
            f"{where} does not match its hash: it was changed after it was signed",
            hint="take the file that the watch wrote",
        )
    T = np.array(document.T_cam_lidar)
    rigid = np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-6) and np.linalg.det(T[:3, :3]) > 0
    if not rigid or T[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise InputError(f"{where}: T_cam_lidar is no rigid transform")
    return document


def json_schema() -> dict[str, Any]:
    """JSON schema of a candidate as it is written."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | CandidateDocument.model_json_schema(
        mode="serialization"
    )


def _values(six: Floats) -> dict[str, float]:
    people = (six * TO_PEOPLE).tolist()
    return dict(zip(AXES, people, strict=True))


def _window(window: WindowEstimate) -> dict[str, Any]:
    return {
        "from_ns": window.from_ns,
        "to_ns": window.to_ns,
        "from_m": window.from_m,
        "to_m": window.to_m,
        "frames": window.frames,
    }


def _hold_out(check: HoldOut) -> dict[str, Any]:
    return {name: getattr(check, name) for name in HoldOutResult.model_fields}
