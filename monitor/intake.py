"""Messages in, pairs of sweep and image out, with an account of every frame: the intake of a whole rig."""

import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from monitor.messages import Decoded, Message, decode
from monitor.rig import Rig, RigPair
from monitor.sync import Paired, Pairer, Side, middle_ns, pairer_for
from pipeline.errors import InputError
from pipeline.records import CameraImage, FramePair, PointCloud

Accounts: TypeAlias = Mapping[str, tuple[int, Counter[str]]]
"""For each pair the frames that came, and those dropped before they became a pair, by reason."""


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A decoded frame that waits for its partner."""

    stamp_ns: int
    value: PointCloud | CameraImage
    sweep_s: float | None


@dataclass(slots=True)
class _Lane:
    """One pair of the rig on its way through the intake."""

    pair: RigPair
    pairer: Pairer[object, object]
    dropped: Counter[str]
    received: int = 0


class Intake:
    """Decodes the topics of a rig and pairs their frames.

    Args:
        rig: Every topic is named.

    Attributes:
        notes: What people should know of the input, one sentence each, at most a few per topic.
    """

    def __init__(self, rig: Rig) -> None:
        self._lanes = [_Lane(pair, pairer_for(pair), Counter()) for pair in rig.pairs]
        self._told: set[tuple[str, str]] = set()
        self._shown: Accounts | None = None
        self.notes: list[str] = []

    def account(self, pair: str) -> tuple[int, Counter[str]]:
        """Frames (sweeps and images) that came for a pair, and what was dropped before it became a pair."""
        return self._account(self._lane(pair)) if self._shown is None else self._shown[pair]

    def accounts(self) -> Accounts:
        """The accounts of all pairs up to the last message."""
        return {lane.pair.name: self._account(lane) for lane in self._lanes}

    def show(self, accounts: Accounts | None) -> None:
        """Tells these accounts from now on, of before messages that were read ahead; None: those of now."""
        self._shown = accounts

    def offset_ns(self, pair: str) -> int | None:
        """Median of camera stamp minus LiDAR stamp, ns."""
        return self._lane(pair).pairer.offset_ns

    def clock_jumps(self, pair: str) -> int:
        """How often the stamps of a pair's inputs jumped."""
        return self._lane(pair).pairer.clock_jumps

    def take(self, message: Message) -> list[FramePair]:
        """The pairs that a message completes. What can not be decoded is counted and told once per topic."""
        lanes = [
            (lane, side) for lane in self._lanes if (side := _side_of(lane.pair, message.topic)) is not None
        ]
        if not lanes:
            return []
        for lane, _ in lanes:
            lane.received += 1
        try:
            decoded = decode(message)
        except InputError as error:
            self._tell(message.topic, "undecodable", str(error))
            for lane, _ in lanes:
                lane.dropped["undecodable"] += 1
            return []
        pairs: list[FramePair] = []
        for lane, side in lanes:
            pairs += self._push(lane, side, message, decoded)
        return pairs

    def flush(self) -> list[FramePair]:
        """Nothing more comes: the pairs that were still waiting."""
        return [_frame_pair(lane.pair, paired) for lane in self._lanes for paired in lane.pairer.flush()]

    def _push(
        self, lane: _Lane, side: Side, message: Message, decoded: tuple[Decoded, ...]
    ) -> list[FramePair]:
        """Hands a frame to the pairing of its lane."""
        pairs: list[FramePair] = []
        for one in decoded:
            stamp_ns = one.stamp_ns or message.log_ns
            match one.value, side:
                case PointCloud() as cloud, "lidar":
                    if cloud.intensity is None and len(cloud) > 0:
                        self._tell(
                            message.topic,
                            "no intensity",
                            f"topic {message.topic} has no intensity: its clouds show no lane markings",
                        )
                    frame = _Frame(stamp_ns, cloud, message.sweep_s)
                    compared = middle_ns(stamp_ns, cloud, message.sweep_s, lane.pair.lidar.stamp)
                    found = lane.pairer.push_lidar(compared, frame, message.sequence)
                case CameraImage() as image, "camera":
                    frame = _Frame(stamp_ns, image, None)
                    found = lane.pairer.push_camera(stamp_ns, frame, message.sequence)
                case _:
                    lane.dropped["wrong_type"] += 1
                    self._tell(
                        message.topic,
                        "wrong_type",
                        f"topic {message.topic} carries {message.type}, not {_wanted(side)}",
                    )
                    continue
            pairs += [_frame_pair(lane.pair, paired) for paired in found]
        return pairs

    def _account(self, lane: _Lane) -> tuple[int, Counter[str]]:
        dropped = Counter(lane.dropped)
        for (_, reason), number in lane.pairer.dropped.items():
            dropped[reason] += number
        return lane.received, +dropped

    def _lane(self, pair: str) -> _Lane:
        return next(lane for lane in self._lanes if lane.pair.name == pair)

    def _tell(self, topic: str, trouble: str, what: str) -> None:
        """One line for people the first time a topic gives a kind of trouble; counts tell the rest."""
        if (topic, trouble) not in self._told:
            self._told.add((topic, trouble))
            self.notes.append(what)


def _side_of(pair: RigPair, topic: str) -> Side | None:
    if pair.lidar.topic == topic:
        return "lidar"
    return "camera" if pair.camera.topic == topic else None


def _wanted(side: Side) -> str:
    return "a point cloud" if side == "lidar" else "an image"


def _frame_pair(pair: RigPair, paired: Paired[object, object]) -> FramePair:
    lidar, camera = paired.lidar, paired.camera
    assert isinstance(lidar, _Frame)  # noqa: S101 - only frames are pushed
    assert isinstance(camera, _Frame)  # noqa: S101 - likewise
    assert isinstance(lidar.value, PointCloud)  # noqa: S101 - by its side
    assert isinstance(camera.value, CameraImage)  # noqa: S101 - likewise
    return FramePair(
        pair=pair.name,
        cloud=lidar.value,
        image=camera.value,
        cloud_stamp_ns=lidar.stamp_ns,
        image_stamp_ns=camera.stamp_ns,
        sweep_s=lidar.sweep_s,
    )


def pairs_of(
    source: Iterable[object], intake: Intake, stop: threading.Event | None = None
) -> Iterator[FramePair]:
    """Every pair that the messages of a source make, the last ones too, unless ``stop`` ends it early."""
    for message in source:
        if stop is not None and stop.is_set():
            return
        yield from intake.take(message) if isinstance(message, Message) else ()
    yield from intake.flush()
