"""The ego motion of the LiDAR, tracked from sweep to sweep, and sweeps straightened by it (FORMULAS G3).

A cloud with times per point is straightened by them. One without is straightened by its azimuths where the
sense of rotation is configured or told by the bend of the sweeps themselves, and left as it is otherwise. A
sense that is configured is held against that bend.
"""

import copy
from collections import deque
from dataclasses import dataclass

import numpy as np

from pipeline.deskew import Spin, SpinSense, Twist, deskew, sweep_times
from pipeline.motion import Motion, estimate_twist
from pipeline.records import Floats, FramePair, PointCloud
from pipeline.spin_sense import TELLING_M_S, SpinEvidence, ToldSpin, spin_evidence, spin_sense
from pipeline.surfels import Surfels, surfels

_NS = 1e9

_LONGEST_REACH_S = 0.3
"""s; a sweep is not moved further than this to the exposure: beyond it the twist of now is a guess."""

_TRACK_EVERY_NS = 300_000_000
"""ns; a registration holds so long: at 3 m/s^2 a sweep is then bent wrongly by 2 cm at its ends, at most."""

SYNC_KNOWN_S = 0.003
"""s; error of stamps that hardware sets, where each point's time is known."""

SYNC_TURN_S = 0.010
"""s; where the turn is known but not its beginning, or what a compensated sweep was compensated to: the beams
pass through a camera's view in some 25 ms."""

SYNC_UNKNOWN_S = 0.025
"""s; where nothing tells when in the turn a point was measured: a quarter of a turn at 10 Hz."""

_ASK_APART = 3
"""Sweeps between two that are asked: the bend that tells the sense grows with the way between them."""

_LONGEST_TURN_S = 0.3
"""s; sweeps further apart than this are not one turn after the other."""

_MOST_EVIDENCE = 12
"""Pairs of sweeps that are asked for the sense of rotation; a vehicle that stands never tells it."""


@dataclass(frozen=True, slots=True, eq=False)
class Straightened:
    """A sweep at the instant of its image.

    Attributes:
        cloud: The sweep, brought to the exposure where that was possible.
        straight: Whether it was.
        distance_m: Way driven since the start, m, as far as the motion was known.
        twist: Motion of the LiDAR, or None where it is not known.
        sync_s: How well the time between points and exposure is known, one sigma, s.
    """

    cloud: PointCloud
    straight: bool
    distance_m: float
    twist: Twist | None
    sync_s: float


class Ego:
    """Tracks one LiDAR.

    Args:
        axis: float64 (3,), unit, LiDAR frame: the spin axis, upwards.
        ahead: float64 (3,), LiDAR frame: where the camera looks.
        spin: Sense of rotation where it is configured.
    """

    def __init__(self, axis: Floats, ahead: Floats, spin: SpinSense | None) -> None:
        self._axis = axis
        self._ahead = ahead
        self._sense: SpinSense | None = spin
        self._configured = spin
        self._told: ToldSpin | None = None
        self._asked = False
        self._evidence: list[SpinEvidence] = []
        self._recent: deque[tuple[int, Surfels]] = deque(maxlen=_ASK_APART)
        self._period_s: float | None = None
        self._tried = 0
        self._one_instant = False
        self._previous: tuple[int, PointCloud | Surfels] | None = None
        self._tracked_ns: int | None = None
        self._twist: Twist | None = None
        self._distance_m = 0.0

    @property
    def twist(self) -> Twist | None:
        """Motion at the last registration, or None where it is not known."""
        return self._twist

    @property
    def contradicted(self) -> ToldSpin | None:
        """What the sweeps say of the rotation where they surely say other than is configured, else None."""
        return None if self._configured in (None, self._told) else self._told

    def copy(self) -> "Ego":
        """Another that goes on from here."""
        other = copy.copy(self)
        other._evidence, other._recent = list(self._evidence), self._recent.copy()  # noqa: SLF001 - its own kind
        return other

    def forget(self) -> None:
        """The stream was interrupted: the next sweep stands alone."""
        self._previous = None
        self._tracked_ns = None
        self._twist = None
        self._recent.clear()

    def straighten(self, pair: FramePair) -> Straightened:
        """Tracks the motion up to this sweep, and brings the sweep to the exposure of its image."""
        seen: PointCloud | Surfels = pair.cloud
        if self._previous is not None:
            seen = self._advance(pair, *self._previous)
        self._previous = (pair.cloud_stamp_ns, seen)
        cloud = self._at_exposure(pair)
        return Straightened(
            cloud or pair.cloud, cloud is not None, self._distance_m, self._twist, self._sync_s(pair)
        )

    def _sync_s(self, pair: FramePair) -> float:
        """How well the time between points and exposure is known."""
        if pair.cloud.time is not None or (self._sense is not None and pair.sweep_s is not None):
            return SYNC_KNOWN_S
        known = self._sense is not None or self._one_instant or pair.sweep_s is not None
        return SYNC_TURN_S if known else SYNC_UNKNOWN_S

    def _advance(self, pair: FramePair, before_ns: int, before: PointCloud | Surfels) -> PointCloud | Surfels:
        """Registers this sweep with the one before when that is due; gives what the next one needs of it."""
        seconds = (pair.cloud_stamp_ns - before_ns) / _NS
        if seconds <= 0:
            self.forget()
            return pair.cloud
        self._period_s = seconds
        held = self._tracked_ns is not None and pair.cloud_stamp_ns - self._tracked_ns < _TRACK_EVERY_NS
        seen: PointCloud | Surfels = pair.cloud
        if not held or self._asks(pair):
            earlier = before if isinstance(before, Surfels) else surfels(before)
            seen = surfels(pair.cloud)
            self._register(pair, earlier, seen, seconds)
        if self._twist is not None:
            self._distance_m += float(np.linalg.norm(self._twist.velocity)) * seconds
        return seen

    def _register(self, pair: FramePair, before: Surfels, seen: Surfels, seconds: float) -> None:
        found = estimate_twist(before, seen, seconds, self._twist)
        self._twist = found.twist if isinstance(found, Motion) else None
        self._tracked_ns = pair.cloud_stamp_ns if self._twist is not None else None
        if self._asked or pair.cloud.time is not None:
            return
        turn_s, earlier = self._turn_s(pair), self._earlier()
        if earlier is not None and self._twist is not None and turn_s is not None:
            apart_s = (pair.cloud_stamp_ns - earlier[0]) / _NS
            self._ask(spin_evidence(earlier[1], seen, apart_s, turn_s, self._axis, self._twist))
        self._recent.append((pair.cloud_stamp_ns, seen))

    def _asks(self, pair: FramePair) -> bool:
        """Whether the sense of rotation is still open and this sweep may tell it."""
        return not self._asked and pair.cloud.time is None and self._configured is None

    def _earlier(self) -> tuple[int, Surfels] | None:
        """The sweep that one is held against to tell the sense of rotation, and its stamp; None: not now.

        Where it is configured only sweeps that are registered anyway are asked, and only in motion.
        """
        if self._configured is None:
            return self._recent[0] if len(self._recent) == _ASK_APART else None
        moving = self._twist is not None and float(np.linalg.norm(self._twist.velocity)) > TELLING_M_S
        return self._recent[-1] if self._recent and moving else None

    def _turn_s(self, pair: FramePair) -> float | None:
        """Duration of a turn: as the source states it, else the time from one sweep to the next."""
        if pair.sweep_s is not None:
            return pair.sweep_s
        if self._period_s is None or self._period_s > _LONGEST_TURN_S:
            return None
        return self._period_s

    def _ask(self, answer: object) -> None:
        """Collects what sweeps say of the sense of rotation until it is sure or asked often enough."""
        self._tried += 1
        if isinstance(answer, SpinEvidence):
            self._evidence.append(answer)
        told = spin_sense(self._evidence)
        self._told = told
        self._asked = told is not None or self._tried >= _MOST_EVIDENCE
        if self._configured is not None:
            return
        self._one_instant = told == "one instant"
        if told == "cw" or told == "ccw":  # noqa: PLR1714 - narrows the type
            self._sense = told

    def _at_exposure(self, pair: FramePair) -> PointCloud | None:
        if self._twist is None:
            return None
        time = self._times(pair)
        if time is None:
            return None
        reference_s = (pair.image_stamp_ns - pair.cloud_stamp_ns) / _NS
        if pair.cloud.time is None and self._sense is not None and pair.sweep_s is None:
            # What the stamp of such a sweep means is not known; the beams meet the camera's view at mid turn.
            reference_s = 0.5 * (self._turn_s(pair) or 0.0)
        if abs(reference_s - float(np.median(time))) > _LONGEST_REACH_S:
            return None
        return deskew(pair.cloud, time, self._twist, reference_s)

    def _times(self, pair: FramePair) -> np.ndarray | None:
        """When each point was measured; by azimuth a turn begins straight behind the camera.

        Cameras beside spinning LiDARs are triggered, or chosen, when the beams look their way, in the middle
        of the turn whose stamp the pair carries.
        """
        if pair.cloud.time is not None:
            return pair.cloud.time
        if self._one_instant:
            return np.full(len(pair.cloud), 0.5 * (pair.sweep_s or 0.0), dtype=np.float32)
        turn_s = self._turn_s(pair)
        if self._sense is None or turn_s is None:
            return None
        return sweep_times(pair.cloud, turn_s, Spin(self._sense, self._axis, -self._ahead))
