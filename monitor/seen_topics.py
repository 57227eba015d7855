"""What passes by when a recording is read through: stamps of all messages, the first sweeps of each topic."""

from array import array
from dataclasses import dataclass, field

from monitor.discovery import TF_TYPES, Survey
from monitor.messages import Message, decode
from monitor.messages.header import header_stamp_ns
from monitor.rig import is_cloud
from monitor.sources import Source, Tick
from pipeline.errors import InputError
from pipeline.records import PointCloud

_SWEEPS = 5
"""Sweeps per topic that are decoded: enough to tell a constant number of points from a changing one."""
_TRANSFORMS = 1000
"""tf messages that are decoded for the list of transforms: ten seconds at the usual 100 Hz."""
NONE = -1
"""Stands for an absent number in arrays: hours of a fast topic must fit into memory."""


@dataclass(slots=True)
class Seen:
    """What was seen of one topic; the three arrays have one number per message, -1 where there is none."""

    headers: "array[int]" = field(default_factory=lambda: array("q"))
    logged: "array[int]" = field(default_factory=lambda: array("q"))
    sequences: "array[int]" = field(default_factory=lambda: array("q"))
    clouds: list[tuple[int, PointCloud, float | None]] = field(default_factory=list)
    frame: str = ""
    undecodable: str | None = None

    def arrive(self, message: Message) -> None:
        """Takes note of a message; what is beyond 64 bits is no stamp."""
        for numbers, value in (
            (self.headers, header_stamp_ns(message)),
            (self.logged, message.log_ns),
            (self.sequences, message.sequence),
        ):
            numbers.append(value if value is not None and 0 <= value < 1 << 63 else NONE)

    @property
    def stamps(self) -> list[int]:
        """Stamps as pairing sees them: of the header, else of the log."""
        both = zip(self.headers, self.logged, strict=True)
        return [log_ns if stamp in (0, NONE) else stamp for stamp, log_ns in both]


def read_through(source: Source) -> tuple[dict[str, Seen], Survey]:
    """Every topic, and the transforms."""
    seen: dict[str, Seen] = {}
    links, left = Survey(), _TRANSFORMS
    for message in source:
        if isinstance(message, Tick):
            continue
        topic = seen.setdefault(message.topic, Seen())
        topic.arrive(message)
        if is_cloud(message.type) and len(topic.clouds) < _SWEEPS and topic.undecodable is None:
            _decode_cloud(message, topic)
        if message.type in TF_TYPES and left > 0:
            left -= 1
            links.see(message)
    return seen, links


def _decode_cloud(message: Message, topic: Seen) -> None:
    try:
        decoded = decode(message)
    except InputError as error:
        topic.undecodable = str(error)
        return
    for one in decoded:
        if isinstance(one.value, PointCloud):
            topic.frame = one.frame
            topic.clouds.append((one.stamp_ns or message.log_ns, one.value, message.sweep_s))
