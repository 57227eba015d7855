"""A folder with ``calib.json``: the pairs that its ``frames[]`` lists, else the KITTI drive inside, else one.

Further cameras have their own ``calib_<CAMERA>.json`` with their own frames; the pair is then called like
the camera. Pairs are given, not searched: cloud n and image n of a pair carry the sequence number n, and the
rig of the folder says ``pairing = "sequence"``, so that stamps that differ by more than the gap limit part
nothing, nor do absent ones.
"""

import re
from collections.abc import Mapping
from pathlib import Path

from monitor.rig import CLOUD_SUFFIXES, IMAGE_SUFFIXES, calib_document
from monitor.rig_document import NAME
from monitor.sources import Losses
from monitor.sources.kitti_raw import (
    NOMINAL_PERIOD_NS,
    FolderSource,
    Frame,
    drives_in,
    image_type,
    read_json,
    sweep_s,
)
from monitor.sources.kitti_raw import (
    SOURCE as KITTI_RAW,
)
from pipeline.errors import InputError

_CAMERA_FILE = re.compile(rf"calib_({NAME.pattern})\.json")


class CalibFolder:
    """Kind of source: folders with ``calib.json``."""

    name = "calib_folder"

    def matches(self, location: str) -> bool:
        """A folder that holds ``calib.json``."""
        return (Path(location) / "calib.json").is_file()

    def open(self, location: str) -> FolderSource:
        """Opens the folder; InputError names the key or file that is wrong."""
        folder = Path(location)
        calib = read_json(folder / "calib.json")
        if "frames" not in calib and drives_in(folder):
            return KITTI_RAW.open(location)
        calibs = _calibs(folder, calib)
        frames: list[Frame] = []
        pairs: list[object] = []
        for name, (path, document) in calibs.items():
            prefix = f"{name}/" if len(calibs) > 1 else ""
            lidar, camera = f"{prefix}cloud", f"{prefix}image"
            frames += _frames(folder, path, document, lidar, camera)
            rig = calib_document(
                document, where=str(path), lidar=lidar, camera=camera, name=name, pairing="sequence"
            )
            listed = rig["pairs"]
            pairs += listed if isinstance(listed, list) else []
        return FolderSource(frames, {"pairs": pairs}, Losses())


SOURCE = CalibFolder()


def _calibs(folder: Path, calib: dict[str, object]) -> dict[str, tuple[Path, dict[str, object]]]:
    """Calib files by the name of the pair, less ``calib.json`` where a named file lists the same frames."""
    further: dict[str, tuple[Path, dict[str, object]]] = {}
    for path in sorted(folder.glob("calib_*.json")):
        match = _CAMERA_FILE.fullmatch(path.name)
        if match:
            further[match[1]] = (path, read_json(path))
    if any(document.get("frames") == calib.get("frames") for _, document in further.values()):
        return further
    name = calib.get("camera_name", "camera")
    if not isinstance(name, str) or not NAME.fullmatch(name):
        raise InputError(
            f"{folder / 'calib.json'}: camera_name is {name!r}", hint=f"it matches {NAME.pattern}"
        )
    return {name: (folder / "calib.json", calib), **further}


def _frames(folder: Path, path: Path, calib: Mapping[str, object], lidar: str, camera: str) -> list[Frame]:
    """Cloud and image of every pair that a calib file lists, or of the only pair."""
    listed = calib.get("frames")
    if listed is None:
        listed = [
            {"image": _only(folder, "image", IMAGE_SUFFIXES), "cloud": _only(folder, "cloud", CLOUD_SUFFIXES)}
        ]
    if not isinstance(listed, list) or not listed:
        raise InputError(
            f"{path}: 'frames' is no list of pairs", hint="leave it out, or list image and cloud"
        )
    frames = []
    for index, entry in enumerate(listed):
        where = f"{path}: frames[{index}]"
        if not isinstance(entry, Mapping):
            raise InputError(f"{where} is no object", hint="as in {'image': 'a.png', 'cloud': 'a.pcd'}")
        cloud = _file(folder, entry, "cloud", where)
        image = _file(folder, entry, "image", where)
        t_cloud, t_end = _time_ns(entry, "t_cloud", where), _time_ns(entry, "t_cloud_end", where)
        t_image = _time_ns(entry, "t_image", where)
        # A stamp that is absent is that of the partner; without both, the nominal period.
        stamp = next((t for t in (t_cloud, t_image) if t is not None), index * NOMINAL_PERIOD_NS)
        frames += [
            Frame(
                path=cloud,
                topic=lidar,
                type=_cloud_type(cloud, where),
                stamp_ns=stamp,
                sweep_s=sweep_s(t_cloud, t_end),
                sequence=index,
            ),
            Frame(
                path=image,
                topic=camera,
                type=_image_type(image, where),
                stamp_ns=stamp if t_image is None else t_image,
                sequence=index,
            ),
        ]
    return frames


def _only(folder: Path, stem: str, suffixes: tuple[str, ...]) -> str:
    """The file ``stem.*``; cloud.npz is preferred, for it holds what the original file does not."""
    wanted = (*suffixes, "jpeg") if stem == "image" else ("npz", *suffixes)
    for suffix in wanted:
        if (folder / f"{stem}.{suffix}").is_file():
            return f"{stem}.{suffix}"
    raise InputError(
        f"{folder} has calib.json but no frames[], no KITTI drive and no {stem}.*",
        hint=f"one of {', '.join(f'{stem}.{suffix}' for suffix in suffixes)}",
    )


def _file(folder: Path, entry: Mapping[str, object], key: str, where: str) -> Path:
    """A file inside the folder."""
    name = entry.get(key)
    if not isinstance(name, str) or not name:
        raise InputError(f"{where} names no {key}", hint="as in {'image': 'a.png', 'cloud': 'a.pcd'}")
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{where}: {key} {name} lies outside the folder")
    if not path.is_file():
        raise InputError(f"{where}: {key} {name} does not exist")
    return path


def _cloud_type(path: Path, where: str) -> str:
    name = path.name.lower()
    for suffix in sorted(CLOUD_SUFFIXES, key=len, reverse=True):
        if name.endswith(f".{suffix}"):
            return f"file/{suffix}"
    raise InputError(
        f"{where}: cloud {path.name} is of no known kind", hint=f"known: {', '.join(CLOUD_SUFFIXES)}"
    )


def _image_type(path: Path, where: str) -> str:
    kind = image_type(path)
    if kind.removeprefix("file/") not in IMAGE_SUFFIXES:
        raise InputError(
            f"{where}: image {path.name} is of no known kind", hint=f"known: {', '.join(IMAGE_SUFFIXES)}"
        )
    return kind


def _time_ns(entry: Mapping[str, object], key: str, where: str) -> int | None:
    """Seconds in a file as ns, to the microsecond: today's stamps have no finer digits in a double."""
    value = entry.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 2**33:
        raise InputError(f"{where}: {key} is {value!r}", hint="seconds, 0 or more")
    return round(value * 1e6) * 1000
