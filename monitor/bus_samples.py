"""zenoh samples <-> messages: which type, which encoding, who published it, what was lost on the way.

A type is taken from the sample's encoding schema, else from the key (rmw_zenoh), else from the liveliness
token of its publisher (zenoh-bridge-ros2dds), else from the rig.
"""

import statistics
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from urllib.parse import parse_qs, urlencode

import zenoh

from monitor import bus
from monitor.messages import Encoding, Message
from monitor.messages.header import header_stamp_ns
from monitor.sources.mcap_file import ros_type
from pipeline.errors import InputError

LARGEST_PAYLOAD = 256 << 20
"""bytes; a raw image of 64 Mpx has 192 MB."""
_MOST_KEYS = 1024
"""Keys that are told apart; a hostile bus may invent any number."""
_RESTART = 1_000_000
"""A gap beyond this is a publisher that numbers anew, not a loss: 28 hours at 10 Hz."""
_INTERVALS = 20
"""Intervals whose median is the period of a publisher that does not number: two seconds at 10 Hz."""
_MISSED = 1.5
"""Periods between two stamps from which a message is missing: half way between none and one."""
_TOKENS = "@/*/@ros2_lv/MP/*/*/*"
"""Liveliness of zenoh-bridge-ros2dds publishers: .../MP/<key>/<type>/<qos>, with '§' for '/'."""

_ENCODINGS: dict[str, Encoding] = {
    "application/cdr": "cdr",
    "application/protobuf": "protobuf",
    "application/x-ros1": "ros1",
    "application/octet-stream": "file",
}
_MIME = {encoding: mime for mime, encoding in _ENCODINGS.items()}


@dataclass(frozen=True, slots=True)
class Subscription:
    """One input.

    Attributes:
        topic: Topic as the rig names it and as messages will carry it; None: from the key.
        keys: Key expressions under which it comes.
        type: Message type where the bus does not tell it, or None.
        latched: Whether what was published before is asked for (tf_static, camera_info).
    """

    topic: str | None
    keys: tuple[str, ...]
    type: str | None = None
    latched: bool = False


def encoding_of(message: Message) -> zenoh.Encoding:
    """MIME type and schema of a message; what only its source knows follows the type as parameters."""
    known = {"stamp_ns": message.stamp_ns, "sweep_s": message.sweep_s, "sequence": message.sequence}
    parameters = urlencode({name: repr(value) for name, value in known.items() if value is not None})
    schema = f"{message.type}?{parameters}" if parameters else message.type
    return zenoh.Encoding(_MIME[message.encoding]).with_schema(schema)


class SampleReader:
    """Makes messages of the samples of one subscription, and tells what was lost before each.

    Args:
        session: Asked for the tokens of publishers whose type nothing else tells.
        wanted: The subscription.
        now_ns: The clock that stamps samples on arrival, ns.
    """

    def __init__(self, session: zenoh.Session, wanted: Subscription, now_ns: Callable[[], int]) -> None:
        self._session = session
        self._wanted = wanted
        self._now_ns = now_ns
        self._tokens: dict[str, str | None] = {}
        self._gaps: dict[tuple[str, bytes], _Gaps] = {}

    def message(self, sample: zenoh.Sample) -> Message:
        """The message in a sample.

        Raises:
            InputError: It is too large, or nothing tells its type.
        """
        key = str(sample.key_expr)
        size = len(sample.payload)
        if size > LARGEST_PAYLOAD:
            raise InputError(f"{key}: a sample of {size} bytes", hint=f"at most {LARGEST_PAYLOAD} are read")
        mime, _, schema = str(sample.encoding).partition(";")
        told, _, parameters = schema.partition("?")
        ros = mime in {"application/cdr", "application/x-ros1"}
        name = (ros_type(told) if ros else told) or self._type(key)
        origin = _origin(sample)
        replayed = key.startswith(f"{bus.REPLAY_ROOT}/")
        values = _parameters(parameters) if replayed else {}
        numbered = origin.sequence if origin is not None and not replayed else None
        return Message(
            topic=self._topic(key, replayed=replayed),
            type=name,
            encoding=_ENCODINGS.get(mime, "protobuf" if name.startswith("foxglove.") else "cdr"),
            data=sample.payload.to_bytes(),
            log_ns=origin.source_ns if origin is not None and replayed else self._now_ns(),
            stamp_ns=_integer(values.get("stamp_ns")),
            sequence=_integer(values.get("sequence")) if replayed else numbered,
            sweep_s=_number(values.get("sweep_s")),
        )

    def lost_before(self, sample: zenoh.Sample, message: Message) -> tuple[int, bool]:
        """Messages of the same publisher that are missing before this one, and whether that is estimated."""
        origin = _origin(sample)
        source = sample.source_info
        if origin is not None:
            publisher, sequence = origin.gid, origin.sequence
        elif source is not None:
            publisher, sequence = str(source.source_id).encode(), source.source_sn
        else:
            publisher, sequence = b"", None
        link = (str(sample.key_expr), publisher)
        if link not in self._gaps and len(self._gaps) >= _MOST_KEYS:
            self._gaps.pop(next(iter(self._gaps)))
        gaps = self._gaps.setdefault(link, _Gaps())
        if sequence is not None:
            return gaps.by_sequence(sequence), False
        stamp = header_stamp_ns(message)
        return (0 if stamp is None else gaps.by_stamp(stamp)), True

    def _type(self, key: str) -> str:
        """What the key, the publisher's token or the rig tells."""
        name = bus.rmw_type(key)
        if name is None and key not in self._tokens and len(self._tokens) < _MOST_KEYS:
            self._tokens[key] = next((kind for name, kind in _tokens(self._session) if name == key), None)
        name = name or self._tokens.get(key) or self._wanted.type
        if name is None:
            raise InputError(
                f"{key}: nothing tells the type of its messages",
                hint="give lidar.type, camera.type in the rig",
            )
        return name

    def _topic(self, key: str, *, replayed: bool) -> str:
        if self._wanted.topic is not None:
            return self._wanted.topic
        if replayed:
            return bus.replayed_topic(key)
        if bus.rmw_type(key) is not None:
            return "/" + "/".join(key.split("/")[1:-2])
        return key


class _Gaps:
    """Where one publisher has got to."""

    def __init__(self) -> None:
        self._sequence: int | None = None
        self._stamp_ns: int | None = None
        self._intervals: deque[int] = deque(maxlen=_INTERVALS)

    def by_sequence(self, sequence: int) -> int:
        """Numbers missing before this one; one that runs back is a publisher that starts again."""
        missing = 0 if self._sequence is None else sequence - self._sequence - 1
        self._sequence = sequence
        return missing if 0 < missing < _RESTART else 0

    def by_stamp(self, stamp_ns: int) -> int:
        """Periods that are missing before this stamp; 0 while the period is not known."""
        interval = 0 if self._stamp_ns is None else stamp_ns - self._stamp_ns
        self._stamp_ns = stamp_ns
        if interval <= 0:
            return 0
        full = len(self._intervals) == _INTERVALS
        period = statistics.median(self._intervals) if full else float(interval)
        self._intervals.append(interval)
        missing = round(interval / period) - 1 if interval > _MISSED * period else 0
        return missing if missing < _RESTART else 0


def _origin(sample: zenoh.Sample) -> bus.Origin | None:
    return None if sample.attachment is None else bus.origin(sample.attachment.to_bytes())


def _tokens(session: zenoh.Session) -> Iterator[tuple[str, str]]:
    """Key and type of every publisher that a zenoh-bridge-ros2dds announces."""
    for reply in session.liveliness().get(_TOKENS, timeout=1.0):
        if reply.ok is not None:
            chunks = str(reply.ok.key_expr).split("/")
            yield chunks[-3].replace("§", "/"), ros_type(chunks[-2].replace("§", "/"))


def _parameters(text: str) -> dict[str, str]:
    """Parameters of a schema; what is no such text gives none."""
    try:
        return {name: values[0] for name, values in parse_qs(text, max_num_fields=8).items()}
    except ValueError:
        return {}


def _integer(text: str | None) -> int | None:
    try:
        return None if text is None else int(text[:20])
    except ValueError:
        return None


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None
