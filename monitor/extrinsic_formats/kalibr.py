"""Camchain YAML in the manner of Kalibr: ``cam0: {T_cam_lidar: 4x4, intrinsics, distortion_model, ...}``."""

from collections.abc import Mapping

from monitor.extrinsic_formats import (
    Choice,
    Direction,
    Document,
    Format,
    Reading,
    defined,
    directed,
    frame,
    numbers_of,
    one_of,
    rigid,
    table,
)
from pipeline.errors import InputError

_DIRECTIONS: tuple[Direction, ...] = ("T_cam_lidar", "T_lidar_cam")
_LENSES = {"radtan": "plumb_bob", "equidistant": "equidistant", "none": "pinhole"}
"""Kalibr's names of the distortion models that are known here."""


class Kalibr:
    """Camchain."""

    name = "kalibr"
    title = "Kalibr-style camchain YAML with T_cam_lidar"

    def matches(self, document: Document) -> bool:
        """A camera with ``T_cam_lidar`` or ``T_lidar_cam`` beside it."""
        return bool(_cameras(document))

    def read(self, document: Document, choice: Choice) -> Reading:
        """The matrix by its key, and the intrinsics where the camera is a pinhole of a known distortion."""
        cameras = _cameras(document)
        name = one_of(list(cameras), choice.camera, "camera", "--camera")
        entry = cameras[name]
        keys = [key for key in _DIRECTIONS if key in entry]
        if len(keys) != 1:
            raise InputError(f"{document.path}: {name} has {' and '.join(keys)}", hint="keep one of them")
        T, read_as = directed(
            rigid(entry[keys[0]], f"{name}.{keys[0]}"), defined(choice, keys[0], "by its key"), "by its key"
        )
        camera = _intrinsics(entry, name)
        if "rostopic" in entry:
            camera["topic"] = f"/{frame(entry['rostopic'])}"
        return Reading(T, read_as, camera=camera, name=name)


def _cameras(document: Document) -> dict[str, Mapping[str, object]]:
    entries = {str(name): table(entry) for name, entry in table(document.data).items()}
    return {name: entry for name, entry in entries.items() if set(_DIRECTIONS) & entry.keys()}


def _intrinsics(entry: Mapping[str, object], name: str) -> dict[str, object]:
    """Keys of the camera's section; empty where the file has no intrinsics."""
    if "intrinsics" not in entry:
        return {}
    model, lens = entry.get("camera_model", "pinhole"), entry.get("distortion_model", "none")
    if model != "pinhole" or lens not in _LENSES:
        raise InputError(
            f"{name}: a {model} camera with {lens} distortion is not known",
            hint=f"known: pinhole with {', '.join(_LENSES)}",
        )
    focal = numbers_of(entry["intrinsics"], f"{name}.intrinsics").reshape(-1)
    size = numbers_of(entry.get("resolution"), f"{name}.resolution").reshape(-1)
    if focal.size != 4 or size.size != 2:
        raise InputError(
            f"{name}: intrinsics has {focal.size} numbers and resolution {size.size}, not 4 and 2"
        )
    fu, fv, cu, cv = focal.tolist()
    D = numbers_of(entry["distortion_coeffs"], f"{name}.distortion_coeffs") if lens != "none" else None
    return {
        "K": [[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]],
        "D": [] if D is None else D.reshape(-1).tolist(),
        "model": _LENSES[str(lens)],
        "width": int(size[0]),
        "height": int(size[1]),
    }


FORMAT: Format = Kalibr()
