"""The rig: which LiDAR goes with which camera, by which extrinsic (DESIGN 3).

A rig comes from a rig file (TOML or JSON), from ``calib.json``, or from what a recording carries in itself
(:mod:`monitor.discovery`). Degrees and milliseconds stand in files only; the values here are SI.
"""

import dataclasses
import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from monitor.messages import CameraInfo
from monitor.rig_document import (
    Axis,
    CameraSection,
    ExtrinsicSection,
    Pairing,
    PairSection,
    SweepStamp,
    nearest,
    validated,
)
from monitor.sources import TopicInfo
from pipeline.baseline import Baseline
from pipeline.cameras import lens_of
from pipeline.errors import InputError, RigError
from pipeline.records import CameraModel, Floats
from pipeline.se3 import orthonormalised

CLOUD_TYPES = ("sensor_msgs/msg/PointCloud2", "foxglove.PointCloud")
"""Types that carry a sweep; folders give ``file/<suffix>``."""
IMAGE_TYPES = (
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "foxglove.RawImage",
    "foxglove.CompressedImage",
)
"""Types that carry an image; folders give ``file/<suffix>``."""
CLOUD_SUFFIXES = ("bin", "npz", "pcd", "ply", "pcd.bin")
IMAGE_SUFFIXES = ("png", "jpg")

_ROUNDING = 1e-3
"""Largest entry of ``R R^T - I`` that passes as rounding: six digits give 1e-5, a wrong matrix far more."""
_RECTIFIED = re.compile(r"(?:^|_)rect(?:ified)?(?:_|$)")
"""Chunks of topics that hold rectified images: image_rect, image_rect_color, image_rectified."""
_LARGEST_FILE = 8 << 20
"""bytes; a rig file is a few kB."""
_WANTED = "a rig file ends in .toml, or is JSON"


@dataclass(frozen=True, slots=True, eq=False)
class LidarInput:
    """Where sweeps come from.

    Attributes:
        topic: Topic, key expression or folder; None until :func:`bind` has chosen the only one.
        frame: Frame id, or empty.
        type: Message type where the bus does not tell it, or None.
        spin: Sense of rotation seen from above, or None.
        stamp: The instant of the sweep that its stamp means.
    """

    topic: str | None
    frame: str
    type: str | None
    spin: Literal["cw", "ccw"] | None
    stamp: SweepStamp


@dataclass(frozen=True, slots=True, eq=False)
class CameraInput:
    """Where images come from.

    Attributes:
        topic: Topic, key expression or folder; None until :func:`bind` has chosen the only one.
        info: Topic of CameraInfo, or None.
        frame: Optical frame id, or empty.
        type: Message type where the bus does not tell it, or None.
        rectified: Whether P of CameraInfo holds; None: :func:`camera_from_info` decides.
        model: Intrinsics, or None: CameraInfo gives them.
    """

    topic: str | None
    info: str | None
    frame: str
    type: str | None
    rectified: bool | None
    model: CameraModel | None


@dataclass(frozen=True, slots=True, eq=False)
class RigPair:
    """One LiDAR and one camera.

    Attributes:
        name: One chunk of a key.
        lidar: Where sweeps come from.
        camera: Where images come from.
        T_cam_lidar: float64 (4,4), the stored extrinsic; None: from the store or from tf.
        store: Name in the extrinsic store, or None.
        T_vehicle_lidar: float64 (4,4), maps LiDAR points into the vehicle frame, or None.
        sigma_rad: Uncertainty of the stored rotation, rad per axis.
        sigma_m: Uncertainty of the stored translation, m per axis.
        limits: float64 (6,), alert limits: roll, pitch, yaw rad, forward, left, up m.
        required: Axes that must be monitored for 'healthy'.
        max_gap_ns: Largest gap between a sweep's middle and its image, ns.
        pairing: Whether stamps or sequence numbers tell what belongs together.
        baseline_file: File of the pair's baseline, or None.
        baseline: What that file says, once it was read (:mod:`monitor.baseline_file`), or None.
    """

    name: str
    lidar: LidarInput
    camera: CameraInput
    T_cam_lidar: Floats | None
    store: str | None
    T_vehicle_lidar: Floats | None
    sigma_rad: float
    sigma_m: float
    limits: Floats
    required: tuple[Axis, ...]
    max_gap_ns: int
    pairing: Pairing
    baseline_file: Path | None = None
    baseline: Baseline | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """One vehicle.

    Attributes:
        vehicle: One chunk of a key.
        pairs: Its pairs, at least one, names unique.
    """

    vehicle: str
    pairs: tuple[RigPair, ...]


def load_rig(path: str | Path) -> Rig:
    """The rig in a TOML or JSON file, or in ``calib.json``.

    Raises:
        RigError: The file can not be read or says something that is not understood; names the key.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise RigError(f"{path} has {path.stat().st_size} bytes, too many for a rig file")
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise RigError(f"{path} can not be read: {error.strerror}", hint=_WANTED) from error
    except UnicodeDecodeError as error:
        raise RigError(f"{path} is not text", hint=_WANTED) from error
    try:
        document = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except (tomllib.TOMLDecodeError, json.JSONDecodeError, RecursionError) as error:
        kind = "TOML" if path.suffix == ".toml" else "JSON"
        raise RigError(f"{path} is not {kind}: {error}", hint=_WANTED) from error
    if not isinstance(document, dict):
        raise RigError(f"{path} holds no table", hint="a rig file has 'vehicle' and 'pairs'")
    rig = parse_rig(document, where=str(path))
    return dataclasses.replace(rig, pairs=tuple(_beside(pair, path.parent) for pair in rig.pairs))


def _beside(pair: RigPair, folder: Path) -> RigPair:
    """The pair, the file of its baseline sought from the folder of the rig file."""
    if pair.baseline_file is None:
        return pair
    return dataclasses.replace(pair, baseline_file=folder / pair.baseline_file)


def parse_rig(document: Mapping[str, object], *, where: str) -> Rig:
    """The rig that a document states: rig file or ``calib.json`` (DESIGN 3).

    Args:
        document: What the file holds.
        where: Name of the file or recording, for messages.

    Raises:
        RigError: Names the key, and the nearest valid one where it is unknown.
    """
    if "pairs" not in document and ("T_cam_lidar" in document or "camera" in document):
        document = calib_document(document, where=where)
    parsed = validated(document, where=where)
    names = [pair.name for pair in parsed.pairs]
    for name in names:
        if names.count(name) > 1:
            raise RigError(f"{where}: two pairs are called '{name}'", hint="names of pairs are unique")
    return Rig(
        vehicle=parsed.vehicle,
        pairs=tuple(_pair(pair, f"{where}: pairs[{i}]") for i, pair in enumerate(parsed.pairs)),
    )


def calib_document(
    calib: Mapping[str, object],
    *,
    where: str,
    lidar: str | None = None,
    camera: str | None = None,
    name: str | None = None,
    pairing: Pairing = "stamps",
    spin: Literal["cw", "ccw"] | None = None,
) -> dict[str, object]:
    """``calib.json`` (``camera``, ``T_cam_lidar``; other keys are notes) in the form of the rig file.

    ``T_cam_lidar`` may be absent where it is to be found out.

    Args:
        calib: What ``calib.json`` holds.
        where: Name of the file, for messages.
        lidar: Topic of the clouds, or None: the only one.
        camera: Topic of the images, or None: the only one.
        name: Name of the pair; default ``camera_name`` of the file, else "camera".
        pairing: Whether stamps or sequence numbers tell what belongs together.
        spin: Sense of rotation of the LiDAR where the kind of folder tells it.
    """
    lens = calib.get("camera")
    if not isinstance(lens, Mapping):
        raise RigError(
            f"{where} has no 'camera' and 'T_cam_lidar'",
            hint="calib.json needs both, but for calibrate --no-prior",
        )
    section = {key: lens[key] for key in ("width", "height", "K") if key in lens}
    coefficients = lens.get("D") or []
    model = lens.get("distortion_model") or "none"
    section |= {"D": coefficients, "model": "pinhole" if model == "none" else model}
    own_name = calib.get("camera_name", "camera")
    pair: dict[str, object] = {
        "name": name or own_name,
        "lidar": {"topic": lidar, "spin": spin},
        "camera": {**section, "topic": camera},
        "pairing": pairing,
    }
    if "T_cam_lidar" in calib:
        pair["extrinsic"] = {"T_cam_lidar": calib["T_cam_lidar"]}
    if "T_vehicle_lidar" in calib:
        pair["T_vehicle_lidar"] = calib["T_vehicle_lidar"]
    return {"pairs": [pair]}


def _pair(section: PairSection, where: str) -> RigPair:
    extrinsic = section.extrinsic or ExtrinsicSection()
    if extrinsic.store is not None and extrinsic.T_cam_lidar is not None:
        raise RigError(f"{where}.extrinsic has 'store' and 'T_cam_lidar'", hint="give one of them")
    limits = section.limits
    degrees = (limits.roll_deg, limits.pitch_deg, limits.yaw_deg)
    return RigPair(
        name=section.name,
        lidar=LidarInput(**section.lidar.model_dump()),
        camera=CameraInput(
            topic=section.camera.topic,
            info=section.camera.info,
            frame=section.camera.frame,
            type=section.camera.type,
            rectified=section.camera.rectified,
            model=_camera_model(section.camera, f"{where}.camera"),
        ),
        T_cam_lidar=rigid(extrinsic.T_cam_lidar, f"{where}.extrinsic.T_cam_lidar"),
        store=extrinsic.store,
        T_vehicle_lidar=rigid(section.T_vehicle_lidar, f"{where}.T_vehicle_lidar"),
        sigma_rad=math.radians(extrinsic.sigma_deg),
        sigma_m=extrinsic.sigma_m,
        limits=np.array([*map(math.radians, degrees), limits.forward_m, limits.left_m, limits.up_m]),
        required=tuple(section.required),
        max_gap_ns=round(section.max_gap_ms * 1e6),
        pairing=section.pairing,
        baseline_file=None if section.baseline is None else Path(section.baseline.file),
    )


def _camera_model(section: CameraSection, where: str) -> CameraModel | None:
    if section.K is None:
        return None
    if section.width is None or section.height is None:
        raise RigError(f"{where} has K but no width and height", hint="give the size of the images in px")
    try:
        camera = CameraModel(
            model=section.model or ("plumb_bob" if section.D else "pinhole"),
            K=np.array(section.K, dtype=np.float64),
            D=np.array(section.D, dtype=np.float64),
            width=section.width,
            height=section.height,
        )
        lens_of(camera)
    except InputError as error:
        raise RigError(f"{where}: {error.what}", hint=error.hint) from error
    return camera


def rigid(rows: list[list[float]] | None, where: str) -> Floats | None:
    """A rigid motion; small rounding is taken out, anything else refused."""
    if rows is None:
        return None
    T = np.array(rows, dtype=np.float64)
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise RigError(f"{where}: the last row is {T[3].tolist()}", hint="it must be [0, 0, 0, 1]")
    R = T[:3, :3]
    # Products of huge entries overflow; an entry beyond 1 is wrong by itself.
    largest = float(np.abs(R).max())
    error = largest - 1.0 if largest > 1.0 + _ROUNDING else float(np.abs(R @ R.T - np.eye(3)).max())
    if error > _ROUNDING:
        raise RigError(
            f"{where}: the rotation is not orthonormal (off by {error:.2g})",
            hint=f"rows must be perpendicular unit vectors to {_ROUNDING:g}",
        )
    if np.linalg.det(R) < 0:
        raise RigError(f"{where}: the rotation mirrors", hint="its determinant must be +1: check the axes")
    T[:3, :3] = orthonormalised(R)
    return T


def bind(rig: Rig, topics: Sequence[TopicInfo], *, where: str) -> Rig:
    """The rig with every topic named, each of which is in the recording.

    Raises:
        InputError: A topic is not there (lists those that are), or "the only one" is none or several.
    """
    clouds = [topic.name for topic in topics if is_cloud(topic.type)]
    images = [topic.name for topic in topics if is_image(topic.type)]
    known = [topic.name for topic in topics]
    pairs = []
    for pair in rig.pairs:
        lidar = pair.lidar.topic or _only(clouds, "point cloud", pair.name, where)
        camera = pair.camera.topic or _only(images, "image", pair.name, where)
        wanted = (lidar, camera, *([pair.camera.info] if pair.camera.info else []))
        for topic in wanted:
            if topic not in known:
                raise InputError(
                    f"{where} has no topic {topic} (pair {pair.name})", hint=nearest(topic, known)
                )
        pairs.append(
            dataclasses.replace(
                pair,
                lidar=dataclasses.replace(pair.lidar, topic=lidar),
                camera=dataclasses.replace(pair.camera, topic=camera),
            )
        )
    return dataclasses.replace(rig, pairs=tuple(pairs))


def _only(names: Sequence[str], kind: str, pair: str, where: str) -> str:
    if len(names) != 1:
        listed = f": {', '.join(names)}" if names else ""
        raise InputError(
            f"{where} has {len(names)} {kind} topics, and pair {pair} does not say which{listed}",
            hint="name lidar.topic and camera.topic in a rig file",
        )
    return names[0]


def is_cloud(type_name: str) -> bool:
    """Whether messages of this type carry a sweep."""
    return type_name in CLOUD_TYPES or type_name.removeprefix("file/") in CLOUD_SUFFIXES


def is_image(type_name: str) -> bool:
    """Whether messages of this type carry an image."""
    return type_name in IMAGE_TYPES or type_name.removeprefix("file/") in IMAGE_SUFFIXES


def camera_from_info(info: CameraInfo, *, rectified: bool | None, topic: str) -> tuple[CameraModel, str]:
    """Which reading of a CameraInfo holds for the images of ``topic``, and why in one clause.

    ``rectified`` of the rig wins. Else a topic whose last chunks say "rect" holds rectified images: P.
    Else K and D: where D is zero and P has the same K both readings agree (KITTI: the images were
    rectified before they were recorded, K is that of P). The fourth column of P and the rotation R are
    never used: they lead from one camera of a stereo rig to another, which the extrinsic already states.

    Raises:
        RigError: The rig says rectified but the message has no P.
    """
    said = rectified is not None
    by_name = any(_RECTIFIED.search(chunk) for chunk in topic.split("/"))
    if rectified if said else (by_name and info.rectified is not None):
        if info.rectified is None:
            raise RigError(
                f"topic {topic} is said to be rectified, but its CameraInfo has no P",
                hint="set camera.rectified = false, or give K, width and height in the rig file",
            )
        return info.rectified, "P: the rig says rectified" if said else "P: the topic's name says rectified"
    if said:
        return info.raw, "K and D: the rig says not rectified"
    if not info.raw.D.any() and info.rectified is not None and np.allclose(info.raw.K, info.rectified.K):
        return info.raw, "K without distortion: D is zero and P holds the same K"
    return info.raw, "K and D: nothing says that the images are rectified"
