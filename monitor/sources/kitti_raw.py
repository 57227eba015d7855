"""KITTI raw: a drive folder (``2011_09_26_drive_0009_sync``), or a folder that contains exactly one.

Stamps: where ``timestamps_start.txt`` and ``timestamps_end.txt`` exist, a cloud carries the instant of its
FIRST point and the duration of its sweep. Elsewhere it carries ``timestamps.txt``, which is the instant at
which the laser looks ahead, and no duration: image and cloud are then compared as they are. Without any
stamps the nominal 10 Hz stand in. KITTI's stamps have no time zone; they are read as UTC.
"""

import itertools
import json
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from monitor.messages import Message
from monitor.rig import calib_document
from monitor.sources import Losses, TopicInfo
from pipeline.errors import InputError
from pipeline.records import Floats
from pipeline.se3 import transform

CAMERA_TOPIC = "image_02"
LIDAR_TOPIC = "velodyne_points"

NOMINAL_PERIOD_NS = 100_000_000
"""ns; KITTI's LiDAR turns ten times a second and triggers the cameras."""
LARGEST_FILE = 256 << 20
"""bytes; a sweep of 120 k points has 2 MB, the densest sensors give some 50 MB."""
_LARGEST_TEXT = 16 << 20
"""bytes; stamps of a day at 10 Hz have 27 MB per sensor, of an hour 1 MB; calib files 3 kB."""

_STAMP = re.compile(r"(\d{4}-\d{2}-\d{2} \d{2}:\d{2}:\d{2})(?:\.(\d{1,9}))?\d*")


@dataclass(frozen=True, slots=True)
class Frame:
    """One file and when it was measured.

    Attributes:
        path: The file.
        topic: Its topic.
        type: ``file/<suffix>``.
        stamp_ns: Stamp, ns.
        sweep_s: Duration of the sweep in s, or None.
        sequence: Number that its partner shares, or None.
    """

    path: Path
    topic: str
    type: str
    stamp_ns: int
    sweep_s: float | None = None
    sequence: int | None = None


class FolderSource:
    """Files in a folder as messages, in the order of their stamps.

    Args:
        frames: The files.
        document: The rig that the folder carries, or None.
        losses: What the folder could not give.
    """

    def __init__(self, frames: Sequence[Frame], document: dict[str, object] | None, losses: Losses) -> None:
        self.losses = losses
        self._frames = sorted(frames, key=lambda frame: frame.stamp_ns)
        self._document = document

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing is held open."""

    def __iter__(self) -> Iterator[Message]:
        for frame in self._frames:
            data = self._read(frame.path)
            if data is not None:
                yield Message(
                    topic=frame.topic,
                    type=frame.type,
                    encoding="file",
                    data=data,
                    log_ns=frame.stamp_ns,
                    stamp_ns=frame.stamp_ns,
                    sequence=frame.sequence,
                    sweep_s=frame.sweep_s,
                )

    def describe(self) -> tuple[TopicInfo, ...]:
        """One topic per folder of files."""
        topics: dict[tuple[str, str], list[int]] = {}
        for frame in self._frames:
            topics.setdefault((frame.topic, frame.type), []).append(frame.stamp_ns)
        return tuple(
            TopicInfo(name, kind, len(stamps), _rate_hz(stamps), understood=True)
            for (name, kind), stamps in sorted(topics.items())
        )

    def rig_document(self) -> dict[str, object] | None:
        """Of ``calib.json`` or of KITTI's calib files, or None."""
        return self._document

    def _read(self, path: Path) -> bytes | None:
        """The bytes of a file; None, and a counted loss, where it can not be read."""
        try:
            status = path.stat()
            size = status.st_size
            if size <= LARGEST_FILE and stat.S_ISREG(status.st_mode):
                return path.read_bytes()
        except OSError as error:
            self.losses.add("unreadable")
            self.losses.notes.append(f"{path.name} can not be read: {error.strerror}")
            return None
        self.losses.add("too_large")
        self.losses.notes.append(f"{path.name} is no file of at most {LARGEST_FILE} bytes ({size})")
        return None


class KittiRaw:
    """Kind of source: KITTI raw drives."""

    name = "kitti_raw"

    def matches(self, location: str) -> bool:
        """A folder that contains at least one drive (:meth:`open` wants exactly one)."""
        return bool(drives_in(Path(location)))

    def open(self, location: str) -> FolderSource:
        """Opens the only drive in ``location``."""
        drives = drives_in(Path(location))
        if len(drives) != 1:
            listed = ", ".join(drive.name for drive in drives[:8])
            raise InputError(
                f"{location} contains {len(drives)} KITTI drives: {listed}", hint="name one of them"
            )
        drive = drives[0]
        losses = Losses()
        frames = [
            *_frames(drive / "velodyne_points", LIDAR_TOPIC),
            *_frames(drive / "image_02", CAMERA_TOPIC),
        ]
        for folder in ("velodyne_points", "image_02"):
            if not (drive / folder / "timestamps.txt").exists():
                losses.notes.append(f"{folder} has no timestamps.txt: nominal 10 Hz")
        return FolderSource(frames, _document(Path(location), drive, losses), losses)


SOURCE = KittiRaw()


def drives_in(folder: Path) -> list[Path]:
    """The drive folders at ``folder`` or at most two levels below it."""
    levels = ("", "*", "*/*")
    found = itertools.chain.from_iterable(
        folder.glob(f"{level}/velodyne_points/data".lstrip("/")) for level in levels
    )
    drives = (data.parent.parent for data in found)
    return sorted(drive for drive in drives if (drive / "image_02" / "data").is_dir())


def sweep_s(start_ns: int | None, end_ns: int | None) -> float | None:
    """Duration of a sweep in s, or None where its first or last point has no stamp or they are reversed."""
    if start_ns is None or end_ns is None or end_ns <= start_ns:
        return None
    return (end_ns - start_ns) * 1e-9


def image_type(path: Path) -> str:
    """``file/png`` or ``file/jpg``."""
    suffix = path.suffix.lower().lstrip(".")
    return f"file/{'jpg' if suffix == 'jpeg' else suffix}"


def _frames(folder: Path, topic: str) -> list[Frame]:
    """The files of one sensor with their stamps."""
    suffixes = {".bin"} if topic == LIDAR_TOPIC else {".png", ".jpg", ".jpeg"}
    files = sorted(path for path in (folder / "data").iterdir() if path.suffix.lower() in suffixes)
    starts = _stamps(folder / "timestamps_start.txt")
    ends = _stamps(folder / "timestamps_end.txt")
    middles = _stamps(folder / "timestamps.txt")
    frames = []
    for index, path in enumerate(files):
        start, end, middle = (_of(path, index, len(files), lines) for lines in (starts, ends, middles))
        duration = sweep_s(start, end)
        stamp = middle if duration is None else start
        frames.append(
            Frame(
                path=path,
                topic=topic,
                type=image_type(path) if topic == CAMERA_TOPIC else "file/bin",
                stamp_ns=_number(path, index) * NOMINAL_PERIOD_NS if stamp is None else stamp,
                sweep_s=duration,
            )
        )
    return frames


def _of(path: Path, index: int, files: int, lines: Sequence[int | None]) -> int | None:
    """The stamp of a file: line by line where the counts agree, else by the number in its name."""
    if len(lines) == files:
        return lines[index]
    number = _number(path, index)
    if lines and number >= len(lines):
        raise InputError(
            f"{path} is frame {number}, but its folder has stamps for {len(lines)} frames and {files} files",
            hint="timestamps*.txt has a line per frame number, or a line per file",
        )
    return lines[number] if lines else None


def _number(path: Path, index: int) -> int:
    return int(path.stem) if path.stem.isdecimal() and len(path.stem) <= 12 else index


def _stamps(path: Path) -> list[int | None]:
    """Stamps in ns, line by line (None for an empty line); empty where there is no such file."""
    if not path.exists():
        return []
    return [_stamp_ns(line, path, number) for number, line in enumerate(_text(path).splitlines(), start=1)]


def _stamp_ns(line: str, path: Path, number: int) -> int | None:
    line = line.strip()
    if not line:
        return None
    match = _STAMP.fullmatch(line)
    try:
        second = datetime.fromisoformat(match[1]).replace(tzinfo=UTC) if match else None
    except ValueError:
        second = None
    if match is None or second is None:
        raise InputError(
            f"{path}:{number}: {line[:40]!r} is no time stamp", hint="as in 2011-09-26 13:08:27.657852672"
        )
    return int(second.timestamp()) * 1_000_000_000 + int((match[2] or "").ljust(9, "0"))


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > _LARGEST_TEXT:
            raise InputError(f"{path} has {path.stat().st_size} bytes, too many for a text file")
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path} can not be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text") from error


def read_json(path: Path) -> dict[str, object]:
    """A JSON object; InputError names the file."""
    try:
        value = json.loads(_text(path))
    except (json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path} is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise InputError(f"{path} holds no JSON object")
    return value


def _document(location: Path, drive: Path, losses: Losses) -> dict[str, object] | None:
    """Of ``calib.json`` in the folder, else of the calib files beside the drive, else None with a note."""
    for folder in (location, drive):
        if (folder / "calib.json").is_file():
            calib = read_json(folder / "calib.json")
            return _of_drive(calib, where=str(folder / "calib.json"))
    for folder in (drive, drive.parent):
        paths = (folder / "calib_cam_to_cam.txt", folder / "calib_velo_to_cam.txt")
        if all(path.is_file() for path in paths):
            return kitti_document(*(_calib(path) for path in paths), where=str(folder))
    losses.notes.append(
        "no calib.json and no calib_cam_to_cam.txt, calib_velo_to_cam.txt: a rig file is needed"
    )
    return None


def kitti_document(
    cameras: Mapping[str, Floats], lidar: Mapping[str, Floats], *, where: str
) -> dict[str, object]:
    """The rig of the rectified left colour camera, in the form of the rig file.

    ``T_cam_lidar = [I | K^-1 P_rect_02(:,4)] R_rect_00 [R|T]``: points go into camera 00, are turned by
    its rectifying rotation, and move into camera 02 by the fourth column of its projection matrix.

    Args:
        cameras: Rows of ``calib_cam_to_cam.txt`` by name.
        lidar: Rows of ``calib_velo_to_cam.txt`` by name.
        where: Folder of both, for messages.
    """
    P = _row(cameras, "P_rect_02", 12, where).reshape(3, 4)
    R_rect = _row(cameras, "R_rect_00", 9, where).reshape(3, 3)
    width, height = _row(cameras, "S_rect_02", 2, where).astype(int).tolist()
    R, t = _row(lidar, "R", 9, where).reshape(3, 3), _row(lidar, "T", 3, where)
    K = P[:, :3]
    try:
        shift = np.linalg.solve(K, P[:, 3])
    except np.linalg.LinAlgError as error:
        raise InputError(f"{where}: P_rect_02 has no inverse") from error
    T_cam_lidar = (
        transform(np.eye(3), shift.astype(np.float64)) @ transform(R_rect, np.zeros(3)) @ transform(R, t)
    )
    calib = {
        "camera": {"K": K.tolist(), "D": [], "width": width, "height": height},
        "T_cam_lidar": T_cam_lidar.tolist(),
    }
    return _of_drive(calib, where=where)


def _of_drive(calib: Mapping[str, object], *, where: str) -> dict[str, object]:
    """The rig of a drive; KITTI's LiDAR turns clockwise and begins each turn behind the car."""
    return calib_document(calib, where=where, lidar=LIDAR_TOPIC, camera=CAMERA_TOPIC, spin="cw")


def _row(rows: Mapping[str, Floats], name: str, count: int, where: str) -> Floats:
    row = rows.get(name)
    if row is None or len(row) != count:
        raise InputError(
            f"{where}: the calib files have no {name} of {count} numbers", hint="KITTI's own files do"
        )
    return row


def _calib(path: Path) -> dict[str, Floats]:
    """Rows ``name: numbers`` of a calib file; rows that are no numbers (dates) are left out."""
    rows: dict[str, Floats] = {}
    for line in _text(path).splitlines():
        name, _, numbers = line.partition(":")
        try:
            rows[name.strip()] = np.array([float(number) for number in numbers.split()])
        except ValueError:
            continue
    return rows


def _rate_hz(stamps: Sequence[int]) -> float | None:
    span = (max(stamps) - min(stamps)) * 1e-9
    return (len(stamps) - 1) / span if span > 0 else None
