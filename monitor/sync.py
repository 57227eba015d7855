"""Which sweep belongs to which image: mutually nearest stamps within a gap limit, or equal sequence numbers.

A sweep is compared by the MIDDLE of its sweep (:func:`middle_ns`): that is when most of what the camera
sees was measured, wherever the laser began. All decisions follow data time; nothing here knows a clock.
"""

import statistics
from collections import Counter, deque
from dataclasses import dataclass
from typing import Generic, Literal, Protocol, TypeAlias, TypeVar, get_args

from monitor.rig import RigPair
from monitor.rig_document import SweepStamp
from pipeline.records import PointCloud

Side: TypeAlias = Literal["lidar", "camera"]
DropReason: TypeAlias = Literal["no_partner", "gap_too_large", "stamp_backwards", "queue_overflow"]
DROP_REASONS: tuple[DropReason, ...] = get_args(DropReason)
"""Why a frame found no partner, closed list.

no_partner: its nearest frame of the other sensor is nearer to another one, or there is none.
gap_too_large: its nearest frame of the other sensor is further away than the gap limit.
stamp_backwards: its stamp is not later than that of the frame before.
queue_overflow: too many frames of one sensor came while the other one was silent.
"""

WAITING_FRAMES = 32
"""Frames that wait per sensor: three seconds at 10 Hz, more than the delay of any driver."""
JUMP_NS = 2_000_000_000
"""ns; a stamp that runs back by more is another clock or a recording that starts again, not a late frame.

It is the time after which a vehicle is `stale` (DESIGN 4)."""
_OFFSETS = 101
"""Arrivals over which the offset between the clocks is told: five seconds of two sensors at 10 Hz."""

_L = TypeVar("_L")
_C = TypeVar("_C")
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, eq=False)
class Paired(Generic[_L, _C]):
    """Two items that belong together, with the stamps by which they were compared (ns)."""

    lidar: _L
    camera: _C
    lidar_ns: int
    camera_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class _Waiting(Generic[_T]):
    stamp_ns: int
    item: _T


class Pairer(Protocol[_L, _C]):
    """What both ways of pairing offer.

    Attributes:
        received: Frames pushed, per side.
        dropped: Frames that found no partner, per side and reason; what is neither here nor paired still
            waits.
        clock_jumps: How often the stamps of one sensor jumped by more than :data:`JUMP_NS`.
    """

    received: Counter[Side]
    dropped: Counter[tuple[Side, DropReason]]
    clock_jumps: int

    def push_lidar(self, stamp_ns: int, item: _L, sequence: int | None = None) -> list[Paired[_L, _C]]:
        """Takes a sweep by its middle; gives the pairs that are decided now."""

    def push_camera(self, stamp_ns: int, item: _C, sequence: int | None = None) -> list[Paired[_L, _C]]:
        """Takes an image; gives the pairs that are decided now."""

    def flush(self) -> list[Paired[_L, _C]]:
        """Nothing more comes: decides all that waits."""

    @property
    def offset_ns(self) -> int | None:
        """Median of camera stamp minus LiDAR stamp of the latest frames, ns; None before both came."""


def pairer_for(pair: RigPair) -> "Pairer[object, object]":
    """The way of pairing that the rig asks for."""
    return SequencePairing() if pair.pairing == "sequence" else StampPairing(pair.max_gap_ns)


def middle_ns(
    stamp_ns: int, cloud: PointCloud, sweep_s: float | None, convention: SweepStamp = "start"
) -> int:
    """The middle of a sweep, ns.

    Args:
        stamp_ns: Stamp of the sweep.
        cloud: Its times per point win where it has them.
        sweep_s: Duration of the sweep where the source knows it, or None: the stamp itself is the best guess.
        convention: The instant that the stamp means (the rig says it).
    """
    if cloud.time is not None and len(cloud) > 0:
        return stamp_ns + round(0.5e9 * (float(cloud.time.min()) + float(cloud.time.max())))
    if sweep_s is None or convention == "middle":
        return stamp_ns
    half = round(0.5e9 * sweep_s)
    return stamp_ns + half if convention == "start" else stamp_ns - half


class _Counts:
    """Counters that both ways of pairing share."""

    def __init__(self) -> None:
        self.received: Counter[Side] = Counter()
        self.dropped: Counter[tuple[Side, DropReason]] = Counter()
        self.clock_jumps = 0
        self._latest: dict[Side, int] = {}
        self._offsets: deque[int] = deque(maxlen=_OFFSETS)

    @property
    def offset_ns(self) -> int | None:
        """Median of camera stamp minus LiDAR stamp of the latest frames, ns; None before both came."""
        return round(statistics.median(self._offsets)) if self._offsets else None

    def _arrived(self, side: Side, stamp_ns: int) -> None:
        self.received[side] += 1
        before = self._latest.get(side)
        if before is not None and abs(stamp_ns - before) > JUMP_NS:
            self.clock_jumps += 1
        self._latest[side] = stamp_ns
        if len(self._latest) == 2:
            self._offsets.append(self._latest["camera"] - self._latest["lidar"])


class StampPairing(_Counts, Generic[_L, _C]):
    """Mutually nearest stamps: each is the other's nearest (the earlier of two equally near), in the limit.

    A pair is decided as soon as no later frame can change it: when a later frame of the same sensor came,
    or both stamps are equal. A partner never serves twice.

    Args:
        max_gap_ns: Largest difference of stamps within a pair, ns.
        waiting: Frames that wait per sensor; when one more comes, the oldest is decided with what is known.
    """

    def __init__(self, max_gap_ns: int, *, waiting: int = WAITING_FRAMES) -> None:
        super().__init__()
        self._max_gap_ns = max_gap_ns
        self._waiting = waiting
        self._lidar: deque[_Waiting[_L]] = deque()
        self._camera: deque[_Waiting[_C]] = deque()
        self._newest: dict[Side, int] = {}
        self._decided: dict[Side, int] = {}

    def push_lidar(self, stamp_ns: int, item: _L, sequence: int | None = None) -> list[Paired[_L, _C]]:
        """Takes a sweep by its middle; gives the pairs that are decided now."""
        del sequence
        restarted = self._advance("lidar", stamp_ns)
        if restarted is None:
            return []
        self._lidar.append(_Waiting(stamp_ns, item))
        return restarted + self._decide()

    def push_camera(self, stamp_ns: int, item: _C, sequence: int | None = None) -> list[Paired[_L, _C]]:
        """Takes an image; gives the pairs that are decided now."""
        del sequence
        restarted = self._advance("camera", stamp_ns)
        if restarted is None:
            return []
        self._camera.append(_Waiting(stamp_ns, item))
        return restarted + self._decide()

    def flush(self) -> list[Paired[_L, _C]]:
        """Nothing more comes: decides all that waits."""
        pairs: list[Paired[_L, _C]] = []
        while self._lidar and self._camera:
            pairs += self._step(final=True)
        while self._lidar:
            self._drop("lidar", None)
        while self._camera:
            self._drop("camera", None)
        return pairs

    def _advance(self, side: Side, stamp_ns: int) -> list[Paired[_L, _C]] | None:
        """None where a frame is refused, else the pairs that a clock which starts again closes."""
        newest = self._newest.get(side)
        self._arrived(side, stamp_ns)
        closed: list[Paired[_L, _C]] = []
        if newest is not None and stamp_ns <= newest:
            if newest - stamp_ns <= JUMP_NS:
                self.dropped[side, "stamp_backwards"] += 1
                return None
            closed = self.flush()
            self._newest.clear()
            self._decided.clear()
        self._newest[side] = stamp_ns
        return closed

    def _decide(self) -> list[Paired[_L, _C]]:
        """All that can be decided, then what must be for lack of room."""
        pairs: list[Paired[_L, _C]] = []
        while self._lidar and self._camera:
            waiting = len(self._lidar) + len(self._camera)
            pairs += self._step(final=max(len(self._lidar), len(self._camera)) > self._waiting)
            if len(self._lidar) + len(self._camera) == waiting:
                break
        if len(self._lidar) > self._waiting:
            self._drop("lidar", "queue_overflow")
        if len(self._camera) > self._waiting:
            self._drop("camera", "queue_overflow")
        return pairs

    def _step(self, *, final: bool) -> list[Paired[_L, _C]]:
        """Decides the older of the two oldest frames, if what is known suffices or ``final`` says it must."""
        lidar, camera = self._lidar[0], self._camera[0]
        early: Side = "lidar" if lidar.stamp_ns <= camera.stamp_ns else "camera"
        stamp = min(lidar.stamp_ns, camera.stamp_ns)
        gap = abs(camera.stamp_ns - lidar.stamp_ns)
        # The nearest frame of the other sensor may be one that was decided before.
        if self._past_gap(early, stamp) <= gap:
            self._drop(early, None, ahead_ns=gap)
            return []
        queue = self._lidar if early == "lidar" else self._camera
        follower = queue[1].stamp_ns if len(queue) > 1 else None
        if follower is None and gap > 0 and not final:
            return []
        late_ns = max(lidar.stamp_ns, camera.stamp_ns)
        if follower is not None and abs(follower - late_ns) < gap:
            self._drop(early, None, ahead_ns=gap)
            return []
        if gap > self._max_gap_ns:
            # The later one may still find a partner after it when this one was decided for lack of room only.
            self._drop(early, None, ahead_ns=gap)
            return []
        self._lidar.popleft()
        self._camera.popleft()
        self._decided = {"lidar": lidar.stamp_ns, "camera": camera.stamp_ns}
        return [Paired(lidar.item, camera.item, lidar.stamp_ns, camera.stamp_ns)]

    def _past_gap(self, side: Side, stamp_ns: int) -> float:
        """Distance to the newest decided frame of the other sensor, ns."""
        other = self._decided.get("camera" if side == "lidar" else "lidar")
        return float("inf") if other is None else abs(stamp_ns - other)

    def _drop(self, side: Side, reason: DropReason | None, *, ahead_ns: float = float("inf")) -> None:
        """Takes the oldest frame of a side out; without a reason, distance to the other sensor tells it."""
        stamp = self._lidar.popleft().stamp_ns if side == "lidar" else self._camera.popleft().stamp_ns
        self._decided[side] = stamp
        if reason is None:
            nearest = min(self._past_gap(side, stamp), ahead_ns)
            far = self._max_gap_ns < nearest < float("inf")
            reason = "gap_too_large" if far else "no_partner"
        self.dropped[side, reason] += 1


class SequencePairing(_Counts, Generic[_L, _C]):
    """Equal sequence numbers, whatever the stamps say: for sources that list their pairs.

    Args:
        waiting: Frames that wait per sensor; when one more comes, the oldest is dropped.
    """

    def __init__(self, *, waiting: int = WAITING_FRAMES) -> None:
        super().__init__()
        self._waiting = waiting
        self._lidar: dict[int, _Waiting[_L]] = {}
        self._camera: dict[int, _Waiting[_C]] = {}

    def push_lidar(self, stamp_ns: int, item: _L, sequence: int | None = None) -> list[Paired[_L, _C]]:
        """Takes a sweep; gives the pair if its image is there."""
        self._arrived("lidar", stamp_ns)
        lidar = _Waiting(stamp_ns, item)
        camera = None if sequence is None else self._camera.pop(sequence, None)
        if camera is None:
            self._keep("lidar", self._lidar, sequence, lidar)
            return []
        return [Paired(lidar.item, camera.item, lidar.stamp_ns, camera.stamp_ns)]

    def push_camera(self, stamp_ns: int, item: _C, sequence: int | None = None) -> list[Paired[_L, _C]]:
        """Takes an image; gives the pair if its sweep is there."""
        self._arrived("camera", stamp_ns)
        camera = _Waiting(stamp_ns, item)
        lidar = None if sequence is None else self._lidar.pop(sequence, None)
        if lidar is None:
            self._keep("camera", self._camera, sequence, camera)
            return []
        return [Paired(lidar.item, camera.item, lidar.stamp_ns, camera.stamp_ns)]

    def flush(self) -> list[Paired[_L, _C]]:
        """Nothing more comes: what waits has no partner."""
        self.dropped["lidar", "no_partner"] += len(self._lidar)
        self.dropped["camera", "no_partner"] += len(self._camera)
        self._lidar.clear()
        self._camera.clear()
        return []

    def _keep(
        self, side: Side, waiting: dict[int, _Waiting[_T]], sequence: int | None, frame: _Waiting[_T]
    ) -> None:
        """Lets a frame wait; one without a number, or whose number waits already, has no partner."""
        if sequence is None or sequence in waiting:
            self.dropped[side, "no_partner"] += 1
            return
        waiting[sequence] = frame
        if len(waiting) > self._waiting:
            del waiting[next(iter(waiting))]
            self.dropped[side, "queue_overflow"] += 1
