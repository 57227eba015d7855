"""rosbag2: a folder with ``metadata.yaml`` and .db3 or .mcap files, or a lone .db3.

MCAP files are read by our own reader, one after the other, because it goes on behind damage; the rest by
rosbags.
"""

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import apsw
from rosbags.interfaces import Connection
from rosbags.rosbag1 import ReaderError as Ros1Error
from rosbags.rosbag2 import Reader
from rosbags.rosbag2 import ReaderError as Ros2Error
from ruamel.yaml.error import YAMLError

from monitor.messages import Encoding, Message, codecs
from monitor.sources import Losses, TopicInfo
from monitor.sources.mcap_file import McapFile, ros_type
from pipeline.errors import InputError

_LARGEST_METADATA = 16 << 20
"""bytes; metadata.yaml of a drive in a thousand files has 1 MB."""
_LISTED = re.compile(r"^\s*-\s*['\"]?([^'\"\n]+\.mcap)['\"]?\s*$", re.MULTILINE)
DAMAGE = (
    Ros1Error,
    Ros2Error,
    apsw.Error,
    YAMLError,
    AssertionError,
    struct.error,
    LookupError,
    ValueError,
    RuntimeError,
    EOFError,
    OSError,
    MemoryError,
    OverflowError,
    TypeError,
)
"""What rosbags raises on damaged files: its checks are assertions in places, its parsers are not guarded."""


class BagReader(Protocol):
    """What the readers of rosbags offer."""

    @property
    def connections(self) -> list[Connection]:
        """Topics, one per publisher."""

    @property
    def message_count(self) -> int:
        """Messages that the index lists."""

    @property
    def duration(self) -> int:
        """From the first to the last message, ns."""

    def open(self) -> None:
        """Reads the index."""

    def close(self) -> None:
        """Closes the files."""

    def messages(self) -> Iterator[tuple[Connection, int, bytes]]:
        """Topic, log time in ns and bytes of every message, by log time."""


class RosbagSource:
    """A recording that rosbags reads, up to where it is damaged.

    Args:
        path: The recording, for messages.
        reader: Its reader, not yet open; InputError where it can not be opened.
        encoding: How its messages are written.
    """

    def __init__(self, path: Path, reader: BagReader, encoding: Encoding) -> None:
        self.losses = Losses()
        self._path = path
        self._reader = reader
        self._encoding: Encoding = encoding
        try:
            reader.open()
        except DAMAGE as error:
            raise InputError(
                f"{path} can not be read: {str(error) or type(error).__name__}",
                hint="`ros2 bag reindex` or `rosbag reindex` mends recordings that were cut short",
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the files."""
        self._reader.close()

    def __iter__(self) -> Iterator[Message]:
        expected = self._reader.message_count
        read = 0
        try:
            for connection, log_ns, data in self._reader.messages():
                read += 1
                yield Message(
                    topic=connection.topic,
                    type=ros_type(connection.msgtype),
                    encoding=self._encoding,
                    data=bytes(data),
                    log_ns=log_ns,
                )
        except DAMAGE as error:
            self.losses.add("rest_of_file")
            self.losses.notes.append(
                f"{self._path.name}: damaged after message {read} ({type(error).__name__})"
            )
        if read < expected:
            self.losses.add("damaged_message", expected - read)
            self.losses.notes.append(f"{self._path.name}: {read} of {expected} messages read")

    def describe(self) -> tuple[TopicInfo, ...]:
        """From the recording's index."""
        seconds = self._reader.duration * 1e-9
        counts: dict[tuple[str, str], int] = {}
        for connection in self._reader.connections:
            topic = (connection.topic, ros_type(connection.msgtype))
            counts[topic] = counts.get(topic, 0) + connection.msgcount
        return tuple(
            TopicInfo(
                name,
                kind,
                count,
                (count - 1) / seconds if count > 1 and seconds > 0 else None,
                kind in codecs(),
            )
            for (name, kind), count in sorted(counts.items())
        )

    def rig_document(self) -> dict[str, object] | None:
        """None: what bags carry of the rig stands in their messages."""
        return None


class McapSeries:
    """The MCAP files of one recording, one after the other.

    Args:
        folder: Where they lie.
        paths: The files in order.
        missing: Names that ``metadata.yaml`` lists and the folder has not.
    """

    def __init__(self, folder: Path, paths: list[Path], missing: list[str]) -> None:
        self.losses = Losses()
        self._folder = folder
        self._paths = []
        for path in paths:
            try:
                with McapFile(path):
                    self._paths.append(path)
            except InputError as error:
                self._lose(error.what)
        for name in missing:
            self._lose(f"{name} is missing")
        if not self._paths:
            raise InputError(f"{folder} has no readable .mcap file", hint="; ".join(self.losses.notes[:3]))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Files are open only while they are read."""

    def __iter__(self) -> Iterator[Message]:
        for path in self._paths:
            with McapFile(path) as file:
                yield from file
                for reason, number in file.losses.counts.items():
                    self.losses.add(reason, number)
                self.losses.notes += file.losses.notes

    def describe(self) -> tuple[TopicInfo, ...]:
        """The topics of all files."""
        found: dict[str, list[TopicInfo]] = {}
        for path in self._paths:
            with McapFile(path) as file:
                for topic in file.describe():
                    found.setdefault(topic.name, []).append(topic)
        return tuple(_merged(parts) for _, parts in sorted(found.items()))

    def rig_document(self) -> dict[str, object] | None:
        """None: what bags carry of the rig stands in their messages."""
        return None

    def _lose(self, note: str) -> None:
        self.losses.add("unreadable_file")
        self.losses.notes.append(note)


class Rosbag2Kind:
    """Kind of source: rosbag2 recordings."""

    name = "rosbag2_folder"

    def matches(self, location: str) -> bool:
        """A folder with metadata.yaml, .db3 or .mcap files, or a .db3 file."""
        path = Path(location)
        if not path.is_dir():
            return path.suffix == ".db3"
        return (path / "metadata.yaml").is_file() or any(path.glob("*.db3")) or any(path.glob("*.mcap"))

    def open(self, location: str) -> RosbagSource | McapSeries:
        """Opens the recording."""
        path = Path(location)
        if not path.exists():
            raise InputError(f"{path} does not exist")
        if path.is_file():
            return RosbagSource(path, Reader(path), "cdr")
        metadata = _metadata(path)
        databases = sorted(path.glob("*.db3*"))
        compressed = re.search(r"compression_mode: *['\"]?(file|message)", metadata, re.IGNORECASE)
        if metadata and (databases or compressed):
            return RosbagSource(path, Reader(path), "cdr")
        if databases:
            if len(databases) > 1:
                raise InputError(
                    f"{path} has {len(databases)} .db3 files and no metadata.yaml", hint="`ros2 bag reindex`"
                )
            return RosbagSource(databases[0], Reader(databases[0]), "cdr")
        listed = [Path(name).name for name in _LISTED.findall(metadata)]
        files = sorted(path.glob("*.mcap"), key=_natural)
        return McapSeries(path, files, [name for name in listed if not (path / name).is_file()])


SOURCE = Rosbag2Kind()


def _metadata(folder: Path) -> str:
    path = folder / "metadata.yaml"
    if not path.is_file():
        return ""
    try:
        if path.stat().st_size > _LARGEST_METADATA:
            raise InputError(f"{path} has {path.stat().st_size} bytes, too many for metadata")
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} can not be read: {error}") from error


def _natural(path: Path) -> tuple[tuple[str, int], ...]:
    """Sorts ``bag_2`` before ``bag_10``."""
    return tuple((text, int(digits or 0)) for text, digits in re.findall(r"(\D*)(\d{0,18})", path.name))


def _merged(parts: list[TopicInfo]) -> TopicInfo:
    counts = [part.count for part in parts if part.count is not None]
    spans = [part.count / part.rate_hz for part in parts if part.count and part.rate_hz]
    rate = sum(counts) / sum(spans) if spans else None
    first = parts[0]
    return TopicInfo(first.name, first.type, sum(counts), rate, first.understood)
