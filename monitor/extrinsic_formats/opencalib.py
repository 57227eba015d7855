"""OpenCalib (SensorsCalibration): JSON with ``sensor_calib``, and text with rows K, D, T.

The JSON names the sensor whose points the matrix takes and the target into whose frame it maps them; the
intrinsics stand in a file of their own, ``<camera>-intrinsic.json``, which is read if it lies beside. The
text is what its automatic calibration reads: T maps LiDAR points into the camera.
"""

from collections.abc import Mapping

from monitor.extrinsic_formats import (
    Choice,
    Document,
    Format,
    Reading,
    defined,
    directed,
    frame,
    keyed_rows,
    load_document,
    names_camera,
    numbers_of,
    rigid,
    table,
    told,
)
from pipeline.errors import InputError

_KDT = {"K", "D", "T"}


class OpenCalib:
    """OpenCalib's files."""

    name = "opencalib"
    title = "OpenCalib sensor-to-sensor JSON, or text with rows K, D, T"

    def matches(self, document: Document) -> bool:
        """An entry with ``sensor_name``, ``target_sensor_name``, ``param``; or exactly the rows K, D, T."""
        rows = keyed_rows(document.text)
        return _entry(document) is not None or (rows.keys() == _KDT and rows["K"].size == 9)

    def read(self, document: Document, choice: Choice) -> Reading:
        """The extrinsic with the intrinsics of its camera."""
        entry = _entry(document)
        if entry is None:
            return _text(document, choice)
        if entry.get("param_type") != "extrinsic":
            raise InputError(
                f"{document.path} holds {entry.get('param_type')}s, no extrinsic",
                hint="name the file <lidar>-to-<camera>-extrinsic.json; the intrinsics beside it are found",
            )
        sensor, target = frame(entry.get("sensor_name")), frame(entry.get("target_sensor_name"))
        matrix = table(table(entry.get("param")).get("sensor_calib")).get("data")
        why = f"{sensor} to {target}"
        cameras = [name for name in (sensor, target) if name == choice.camera or names_camera(name)]
        if len(cameras) == 1:
            direction = defined(choice, "T_cam_lidar" if cameras == [target] else "T_lidar_cam", why)
        else:
            direction = told(choice, f"'{why}' (neither or both are called a camera)")
        T, read_as = directed(rigid(matrix, "sensor_calib"), direction, why)
        camera, lidar = (target, sensor) if direction == "T_cam_lidar" else (sensor, target)
        intrinsics, notes = _intrinsics(document, camera)
        return Reading(
            T,
            read_as,
            camera={**intrinsics, "frame": camera},
            lidar={"frame": lidar},
            name=camera,
            notes=notes,
        )


def _entry(document: Document) -> Mapping[str, object] | None:
    """The only entry of the JSON, or None where it is none of OpenCalib's."""
    values = list(table(document.data).values())
    entry = table(values[0]) if len(values) == 1 else {}
    return entry if {"sensor_name", "target_sensor_name", "param"} <= entry.keys() else None


def _intrinsics(document: Document, camera: str) -> tuple[dict[str, object], tuple[str, ...]]:
    """Keys of the camera's section from ``<camera>-intrinsic.json``, and a note on where they come from."""
    path = document.path.parent / f"{camera.replace('/', '_')}-intrinsic.json"
    if not path.is_file():
        return {}, (f"no intrinsics: {path.name} does not lie beside it",)
    param = table((_entry(load_document(path)) or {}).get("param"))
    K = numbers_of(table(param.get("cam_K")).get("data"), f"{path}: cam_K")
    D = numbers_of(table(param.get("cam_dist")).get("data"), f"{path}: cam_dist").reshape(-1)
    section = {
        "K": K.tolist(),
        "D": D.tolist(),
        "width": param.get("img_dist_w"),
        "height": param.get("img_dist_h"),
    }
    return section, (f"intrinsics from {path.name}, for {section['width']}x{section['height']} px",)


def _text(document: Document, choice: Choice) -> Reading:
    rows = keyed_rows(document.text)
    if rows["T"].size not in (12, 16):
        raise InputError(f"{document.path}: T has {rows['T'].size} numbers, not 12 or 16")
    why = "OpenCalib's text maps LiDAR points into the camera"
    direction = defined(choice, "T_cam_lidar", why)
    T, read_as = directed(rigid(rows["T"].reshape(-1, 4), "T"), direction, why)
    if choice.size is None:
        note = "K and D are left out, for it does not tell the size of the images: give --size WIDTHxHEIGHT"
        return Reading(T, read_as, notes=(note,))
    width, height = choice.size
    K, D = rows["K"].reshape(3, 3).tolist(), rows["D"].tolist()
    return Reading(T, read_as, camera={"K": K, "D": D, "width": width, "height": height})


FORMAT: Format = OpenCalib()
