"""MCAP files: everything that is whole is given, what is damaged is counted and told (spec: losses).

With an intact index chunks are read in the order of their first message and merged; without one (truncated
files) the file is read from its start and chunks are merged one ahead, so that messages come in the order
of log time as far as the order of the chunks allows. Every chunk's CRC is checked; a damaged chunk costs
its own messages and no others.
"""

import dataclasses
import heapq
import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO, Self

import lz4.frame  # type: ignore[import-untyped]  # lz4 ships no types
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.stream_reader import CRCValidationError, breakup_chunk

from monitor.messages import Encoding, Message, codecs
from monitor.sources import Losses, TopicInfo
from pipeline.errors import InputError

MAGIC = b"\x89MCAP0\r\n"
_LARGEST_RECORD = 1 << 30
"""bytes; writers cut chunks at 1 to 100 MB, so a larger length is damage."""
_LARGEST_BACKLOG = 512 << 20
"""bytes of messages that wait for their turn; beyond it order gives way to memory."""
_ENCODINGS: dict[str, Encoding] = {"cdr": "cdr", "ros1": "ros1", "protobuf": "protobuf"}
_HEAD = struct.Struct("<BQ")
"""Opcode and length of a record."""
_FOOTER = struct.Struct("<BQQQI8s")
"""Footer record and closing magic."""
_READERS: dict[int, Callable[[ReadDataStream, int], records.McapRecord]] = {
    Opcode.SCHEMA: lambda stream, _: records.Schema.read(stream),
    Opcode.CHANNEL: lambda stream, _: records.Channel.read(stream),
    Opcode.MESSAGE: records.Message.read,
    Opcode.CHUNK: lambda stream, _: records.Chunk.read(stream),
    Opcode.DATA_END: lambda stream, _: records.DataEnd.read(stream),
}
"""What is read; other records are passed over."""
_DAMAGE = (
    McapError,
    CRCValidationError,
    zstandard.ZstdError,
    RuntimeError,
    struct.error,
    UnicodeDecodeError,
    ValueError,
    EOFError,
    OverflowError,
)
"""What mcap, zstandard and lz4 (RuntimeError) raise on damaged bytes."""


class _Skipped:
    """A whole record of no interest."""


@dataclass(slots=True)
class _Index:
    """What the summary at the end of an intact file says."""

    channels: dict[int, records.Channel]
    schemas: dict[int, records.Schema]
    counts: dict[int, int]
    chunks: list[records.ChunkIndex]
    first_ns: int
    last_ns: int


class McapFile:
    """An open MCAP file.

    Args:
        path: The file; InputError where it is missing, empty or no MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.losses = Losses()
        self._path = path
        self._file = _opened(path)
        self._size = path.stat().st_size
        self._index = self._read_index()
        self._channels = dict(self._index.channels) if self._index else {}
        self._schemas = dict(self._index.schemas) if self._index else {}
        self._read: Counter[int] = Counter()
        self._bad_chunks = 0
        self._bad_at: int | None = None
        self._end: int | None = None
        self._foreign: set[str] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the file."""
        self._file.close()

    def __iter__(self) -> Iterator[Message]:
        for message in self._in_order(self._chunks()):
            channel = self._channels.get(message.channel_id)
            if channel is None:
                self.losses.add("no_channel")
                continue
            encoding = _ENCODINGS.get(channel.message_encoding)
            if encoding is None:
                self.losses.add("encoding_not_understood")
                self._tell_foreign(channel)
                continue
            yield Message(
                topic=channel.topic,
                type=self._type(channel),
                encoding=encoding,
                data=message.data,
                log_ns=message.log_time,
                sequence=message.sequence or None,
            )
        self._tell_losses()

    def describe(self) -> tuple[TopicInfo, ...]:
        """From the summary; a file without one is read through once."""
        if self._index is not None:
            span = (self._index.first_ns, self._index.last_ns)
            return self._topics(self._index.channels, self._index.counts, span)
        with McapFile(self._path) as scan:
            stamps = [message.log_time for message in scan._in_order(scan._chunks())]
            span = (min(stamps, default=0), max(stamps, default=0))
            return scan._topics(scan._channels, scan._read, span)

    def rig_document(self) -> dict[str, object] | None:
        """None: what MCAP files carry of the rig stands in their messages."""
        return None

    def _topics(
        self, channels: dict[int, records.Channel], counts: dict[int, int], span: tuple[int, int]
    ) -> tuple[TopicInfo, ...]:
        seconds = (span[1] - span[0]) * 1e-9
        found = []
        for number, channel in channels.items():
            count = counts.get(number, 0)
            kind = self._type(channel)
            understood = channel.message_encoding in _ENCODINGS and kind in codecs()
            rate = (count - 1) / seconds if seconds > 0 and count > 1 else None
            found.append(TopicInfo(channel.topic, kind, count, rate, understood))
        return tuple(sorted(found, key=lambda topic: topic.name))

    def _type(self, channel: records.Channel) -> str:
        schema = self._schemas.get(channel.schema_id)
        name = schema.name if schema else ""
        return ros_type(name) if channel.message_encoding in {"cdr", "ros1"} else name

    def _read_index(self) -> _Index | None:
        """The summary, or None where the end of the file is missing or damaged."""
        try:
            _check_summary(self._file, self._size)
            self._file.seek(0)
            summary = SeekingReader(self._file, record_size_limit=_LARGEST_RECORD).get_summary()
        except (*_DAMAGE, OSError):
            return None
        if summary is None or summary.statistics is None:
            return None
        statistics = summary.statistics
        return _Index(
            channels=dict(summary.channels),
            schemas=dict(summary.schemas),
            counts=dict(statistics.channel_message_counts),
            chunks=sorted(summary.chunk_indexes, key=lambda chunk: chunk.message_start_time),
            first_ns=statistics.message_start_time,
            last_ns=statistics.message_end_time,
        )

    def _chunks(self) -> Iterator[tuple[int, list[records.Message]]]:
        """The first log time and the messages of each whole chunk (or of each message outside chunks)."""
        if self._index is not None and self._index.chunks:
            for entry in self._index.chunks:
                chunk = self._record(entry.chunk_start_offset)
                if isinstance(chunk, records.Chunk):
                    yield from self._chunk(chunk, entry.chunk_start_offset)
                else:
                    self._damaged_chunk(entry.chunk_start_offset)
            return
        offset = len(MAGIC)
        record: records.McapRecord | _Skipped | None = None
        while not isinstance(record, records.DataEnd):
            record = self._record(offset)
            if record is None:
                self._end = offset
                self.losses.add("rest_of_file")
                return
            yield from self._streamed(record, offset)
            offset = self._file.tell()

    def _record(self, offset: int) -> "records.McapRecord | _Skipped | None":
        """The record at ``offset``; None where it is damaged or reaches beyond the end of the file."""
        self._file.seek(offset)
        head = self._file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            return None
        opcode, length = _HEAD.unpack(head)
        if length > min(self._size - offset - _HEAD.size, _LARGEST_RECORD) or not _known(opcode):
            return None
        reader = _READERS.get(opcode)
        if reader is None:
            self._file.seek(length, os.SEEK_CUR)
            return _Skipped()
        body = self._file.read(length)
        try:
            return reader(ReadDataStream(BytesIO(body)), length)
        except _DAMAGE:
            return None

    def _streamed(
        self, record: "records.McapRecord | _Skipped", offset: int
    ) -> Iterator[tuple[int, list[records.Message]]]:
        if isinstance(record, records.Schema):
            self._schemas[record.id] = record
        elif isinstance(record, records.Channel):
            self._channels[record.id] = record
        elif isinstance(record, records.Message):
            self._read[record.channel_id] += 1
            yield record.log_time, [record]
        elif isinstance(record, records.Chunk):
            yield from self._chunk(record, offset)

    def _chunk(self, chunk: records.Chunk, offset: int) -> Iterator[tuple[int, list[records.Message]]]:
        """The messages of a chunk, by log time; nothing where its bytes do not fit its CRC."""
        try:
            inside = breakup_chunk(_unpacked(chunk), validate_crc=True)
        except _DAMAGE:
            self._damaged_chunk(offset)
            return
        messages = []
        for record in inside:
            if isinstance(record, records.Message):
                messages.append(record)
                self._read[record.channel_id] += 1
            elif isinstance(record, records.Channel):
                self._channels[record.id] = record
            elif isinstance(record, records.Schema):
                self._schemas[record.id] = record
        messages.sort(key=lambda message: message.log_time)
        yield (messages[0].log_time if messages else 0), messages

    def _damaged_chunk(self, offset: int) -> None:
        self._bad_chunks += 1
        self._bad_at = offset if self._bad_at is None else min(self._bad_at, offset)
        self.losses.add("damaged_chunk")

    @staticmethod
    def _in_order(chunks: Iterable[tuple[int, list[records.Message]]]) -> Iterator[records.Message]:
        """Merges chunks: what is older than the first message of the newest chunk is given out."""
        waiting: list[tuple[int, int, records.Message]] = []
        held = 0
        number = 0
        for first_ns, messages in chunks:
            while waiting and (waiting[0][0] < first_ns or held > _LARGEST_BACKLOG):
                oldest = heapq.heappop(waiting)[2]
                held -= len(oldest.data)
                yield oldest
            for message in messages:
                heapq.heappush(waiting, (message.log_time, number, message))
                held += len(message.data)
                number += 1
        while waiting:
            yield heapq.heappop(waiting)[2]

    def _tell_foreign(self, channel: records.Channel) -> None:
        if channel.topic not in self._foreign:
            self._foreign.add(channel.topic)
            self.losses.notes.append(
                f"topic {channel.topic}: encoding '{channel.message_encoding[:40]}' is not understood "
                f"(understood: {', '.join(_ENCODINGS)})"
            )

    def _tell_losses(self) -> None:
        """One sentence about damage, with numbers."""
        read = self._read.total()
        expected = sum(self._index.counts.values()) if self._index else None
        if expected is not None and expected > read:
            self.losses.add("damaged_message", expected - read)
        clauses = []
        if self._bad_at is not None:
            clauses.append(f"{self._bad_chunks} damaged chunks, the first after byte {self._bad_at}")
        if self._end is not None:
            clauses.append(f"the rest is missing or damaged after byte {self._end} of {self._size}")
        elif self._index is None:
            clauses.append("the summary at its end is missing or damaged")
        if clauses or (expected is not None and expected != read):
            of = f" of {expected}" if expected is not None else ""
            told = ", ".join(clauses) or "its summary counts others"
            self.losses.notes.append(f"{self._path.name}: {read}{of} messages read; {told}")


class McapKind:
    """Kind of source: MCAP files."""

    name = "mcap_file"

    def matches(self, location: str) -> bool:
        """A file that is called .mcap or starts like one."""
        path = Path(location)
        named = path.suffix.lower() == ".mcap" and not path.is_dir()
        return named or (path.is_file() and starts_with(path, MAGIC))

    def open(self, location: str) -> McapFile:
        """Opens the file."""
        return McapFile(Path(location))


SOURCE = McapKind()


def ros_type(name: str) -> str:
    """A ROS type name as ``pkg/msg/Name``: ROS 1 has no ``msg``, DDS says ``pkg::msg::dds_::Name_``."""
    parts = [part for part in name.replace("::", "/").split("/") if part != "dds_"]
    if len(parts) == 2:
        parts.insert(1, "msg")
    if "::dds_::" in name:
        parts[-1] = parts[-1].removesuffix("_")
    return "/".join(parts)


def starts_with(path: Path, magic: bytes) -> bool:
    """Whether the first bytes of a file are ``magic``; False where it can not be read."""
    try:
        with path.open("rb") as file:
            return file.read(len(magic)) == magic
    except OSError:
        return False


def _opened(path: Path) -> IO[bytes]:
    if not path.exists():
        raise InputError(f"{path} does not exist")
    if not path.is_file():
        raise InputError(f"{path} is no file")
    try:
        file = path.open("rb")
    except OSError as error:
        raise InputError(f"{path} can not be read: {error.strerror}") from error
    head = file.read(len(MAGIC))
    if head != MAGIC:
        file.close()
        what = "is empty" if not head else "is no MCAP file"
        raise InputError(f"{path} {what}", hint="an MCAP file starts with the bytes 89 4D 43 41 50 30 0D 0A")
    return file


def _known(opcode: int) -> bool:
    """Whether an opcode is one of the format or of an extension (0x80 and above)."""
    return 0 < opcode <= max(Opcode) or opcode >= 0x80


def _check_summary(file: IO[bytes], size: int) -> None:
    """Refuses a summary that does not fit its CRC: its counts and offsets would be believed."""
    file.seek(-_FOOTER.size, os.SEEK_END)
    tail = file.read(_FOOTER.size)
    opcode, length, start, _, crc, magic = _FOOTER.unpack(tail)
    if opcode != Opcode.FOOTER or length != 20 or magic != MAGIC or start > size - _FOOTER.size:
        raise ValueError(opcode)
    if crc:
        file.seek(start or size - _FOOTER.size)
        end = size - len(MAGIC) - 4
        if end - file.tell() > _LARGEST_RECORD or zlib.crc32(file.read(end - file.tell())) != crc:
            raise ValueError(crc)


def _unpacked(chunk: records.Chunk) -> records.Chunk:
    """The chunk without compression: never more bytes than it declares, and never more than any real one has.

    Raises:
        ValueError: It declares too much, or holds another number of bytes than it declares.
    """
    declared = chunk.uncompressed_size
    if declared > _LARGEST_RECORD:
        raise ValueError(declared)
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) > declared:
            raise ValueError(declared)
        data = zstandard.decompress(chunk.data, declared)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=declared + 1)
    else:
        data = chunk.data
    if len(data) != declared:
        raise ValueError(len(data))
    return dataclasses.replace(chunk, compression="", data=data)
