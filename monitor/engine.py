"""FramePair or Tick in, events out: the only place where a frame becomes a verdict."""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import numpy as np

from monitor.candidate_file import document_of
from monitor.clock import Clock
from monitor.events import Event, FrameEvent, ProposalEvent, StatusEvent
from monitor.intake import Intake
from monitor.lookahead import Ahead
from monitor.sources import Losses
from monitor.statements import Identity, Measured, status_of
from monitor.status import Rates, Timing
from monitor.wording import spin_warning
from pipeline.candidate import Candidate, Proposal
from pipeline.records import FramePair
from pipeline.watch import Findings, Watch

_STATUS_EVERY_NS = 1_000_000_000
"""ns of data between statuses while nothing changes (DESIGN 5)."""

_TIMINGS = 200
"""Measurements of a stage over which quantiles are told: 20 s at 10 Hz."""

_STAMPS = 21
"""Stamps over which rates are told: two seconds at 10 Hz."""

_REFUSALS = {
    "undecodable": "Messages of an input can not be decoded.",
    "wrong_type": "An input carries messages of another type than the rig says.",
    "image_size": "Images are not of the size that the intrinsics are for.",
}
"""Drop reasons that more data do not mend, and what they mean."""

_LOST_ON_THE_WAY = frozenset({"queue_overflow", "bus_gap", "bus_gap_estimated"})
"""Losses of a live source that are frames of the watched inputs; the others are told as warnings."""

_REFUSED_IN_A_ROW = 20
"""Such frames without a usable one between them before it is a fault: a second of two sensors."""


class Engine:
    """One pair: feeds its watch, accounts for its frames, tells its status.

    Args:
        identity: What every status repeats.
        watch: The pair's window and verdict.
        intake: Where frames are counted before they are pairs.
        clock: Measures what stages cost.
    """

    def __init__(self, identity: Identity, watch: Watch, intake: Intake, clock: Clock) -> None:
        self.identity = identity
        self.watch = watch
        self._intake = intake
        self._clock = clock
        self._seq = 0
        self._told: tuple[str, str] | None = None
        self._told_ns: int | None = None
        self._now_ns = 0
        self._arrival: tuple[int, int] | None = None
        self._paired = False
        self._used = 0
        self._dropped: Counter[str] = Counter()
        self._timing: dict[str, deque[float]] = {}
        self._cloud_ns: deque[int] = deque(maxlen=_STAMPS)
        self._image_ns: deque[int] = deque(maxlen=_STAMPS)
        self.wrong_size: tuple[int, int] | None = None
        self._refused_before: Counter[str] = Counter()
        self._losses = Losses()
        self._outputs_lost: Callable[[], Mapping[str, str]] = dict
        self._proposal: Proposal | None = None

    @property
    def used(self) -> int:
        """Sweeps and images that took part so far."""
        return self._used

    @property
    def dropped(self) -> Counter[str]:
        """Sweeps and images of pairs that gave no evidence, by reason."""
        return self._dropped

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the data say against the rig's settings, one sentence each."""
        told = self.watch.spin_contradicted
        return () if told is None else (spin_warning(told),)

    def attach(self, losses: Losses, outputs_lost: Callable[[], Mapping[str, str]]) -> None:
        """Names what else a status tells: messages that the source lost, and outputs that are lost."""
        self._losses = losses
        self._outputs_lost = outputs_lost

    def step(self, pair: FramePair, arrival_ns: int, ahead: Ahead | None = None) -> list[Event]:
        """Takes a pair in: what was seen in it, and the status where one is due.

        Args:
            pair: A sweep and its image.
            arrival_ns: When the message that completed it came, on the clock of the source.
            ahead: What was found in it before its turn.
        """
        if not self._paired:
            # What was told before it bears stamps of the source's clock, which need not be the data's.
            self._paired, self.watch.memory = True, None
        self._now_ns = pair.image_stamp_ns
        self._arrival = (pair.image_stamp_ns, arrival_ns)
        self._cloud_ns.append(pair.cloud_stamp_ns)
        self._image_ns.append(pair.image_stamp_ns)
        with self._stage("frame"):
            findings = self.watch.step(pair, self._stage, None if ahead is None else ahead.foresight)
        for name, spent_ms in () if ahead is None else ahead.spent:
            self._spent(name, spent_ms)
            self._timing["frame"][-1] += spent_ms
        if findings.dropped == "image_size":
            self.wrong_size = pair.image.size
        if findings.dropped is not None:
            self._dropped[findings.dropped] += 2
            self._fault_if_refused()
            return self._due()
        self._used += 2
        self._refused_before = self._refused()
        return [self._frame_event(pair, findings), *self._due(), *self._proposed()]

    def tick(self, arrival_ns: int) -> list[Event]:
        """No pair came until ``arrival_ns`` of the source's clock: stamps are taken to run on."""
        if self._arrival is None:
            self._arrival = (arrival_ns, arrival_ns)
        data_ns, since_ns = self._arrival
        self._now_ns = max(self._now_ns, data_ns + max(0, arrival_ns - since_ns))
        self._fault_if_refused()
        self.watch.silent(self._now_ns)
        return self._due()

    def _refused(self) -> Counter[str]:
        """Frames so far that are of no use whatever the scene."""
        dropped = self._intake.account(self.identity.pair)[1] + self._dropped
        return Counter({reason: dropped[reason] for reason in _REFUSALS})

    def _fault_if_refused(self) -> None:
        """A stream of frames that can not be used is a fault, not silence."""
        since = self._refused() - self._refused_before
        if since.total() < _REFUSED_IN_A_ROW:
            return
        reason = max(since, key=lambda name: since[name])
        text = _REFUSALS[reason]
        if reason == "image_size" and self.wrong_size is not None:
            camera, (width, height) = self.watch.mount.camera, self.wrong_size
            text = f"Images are {width}x{height} px, the intrinsics are for {camera.width}x{camera.height}."
        self.watch.fault(text, self._now_ns)

    def acknowledge(self, by: str, why: str) -> list[Event]:
        """A person takes note of the drift: the status after it; nothing where no drift is told."""
        return [self._status(), *self._proposed()] if self.watch.acknowledge(self._now_ns, by, why) else []

    def finish(self) -> list[Event]:
        """The input has ended: the last status."""
        self.watch.finish(self._now_ns)
        return [self._status(), *self._proposed()]

    def _proposed(self) -> list[Event]:
        """What is proposed for a mount that has moved, where that has changed."""
        proposal = self.watch.proposal
        if proposal is self._proposal:
            return []
        self._proposal = proposal
        pair = self.identity.pair
        if isinstance(proposal, Candidate):
            return [ProposalEvent(pair, document_of(self.identity, self.watch.mount, proposal))]
        reason = "No drift stands any more." if proposal is None else proposal.reason
        return [ProposalEvent(pair, None, reason)]

    def _due(self) -> list[Event]:
        memory = self.watch.memory
        if memory is None:
            return []
        changed = self._told != (memory.state, memory.code)
        # Data time decides: a clock that ran back is a change of its own.
        waited = self._told_ns is None or abs(self._now_ns - self._told_ns) >= _STATUS_EVERY_NS
        return [self._status()] if changed or waited else []

    def _status(self) -> StatusEvent:
        memory = self.watch.memory
        assert memory is not None  # noqa: S101 - set by the first step, tick or finish
        self._told, self._told_ns = (memory.state, memory.code), self._now_ns
        received, dropped = self._intake.account(self.identity.pair)
        lost = Counter({reason: n for reason, n in self._losses.counts.items() if reason in _LOST_ON_THE_WAY})
        status = status_of(
            self.identity,
            self.watch.mount,
            memory,
            self.watch.belief,
            Measured(
                received=received + lost.total(),
                used=self._used,
                dropped=dropped + self._dropped + lost,
                window_ns=self.watch.window_stamps,
                lines_ns=self.watch.line_stamps,
                rates=self._rates(),
                timing={name: _quantiles(values) for name, values in self._timing.items()},
                outputs_lost=self._outputs_lost(),
                warnings=self.warnings,
                explanation=self.watch.inquiry.explanation,
                track=self.watch.scenes.track,
                left=self.watch.departed,
            ),
            self._seq,
            self._now_ns,
        )
        self._seq += 1
        return StatusEvent(status)

    def _rates(self) -> Rates:
        gaps = [image - cloud for image, cloud in zip(self._image_ns, self._cloud_ns, strict=True)]
        return Rates(
            lidar_hz=_rate(self._cloud_ns),
            camera_hz=_rate(self._image_ns),
            gap_ms=float(np.median(gaps)) / 1e6 if gaps else None,
            lines_hz=_rate(self.watch.line_stamps),
            edges_hz=_rate(self._image_ns),
        )

    def _frame_event(self, pair: FramePair, findings: Findings) -> FrameEvent:
        belief, lines = self.watch.belief, findings.lines
        return FrameEvent(
            pair=pair.pair,
            stamp_ns=pair.image_stamp_ns,
            image=pair.image,
            camera=self.watch.mount.camera,
            masks=findings.masks,
            points=findings.cloud.xyz,
            intensity=findings.cloud.intensity,
            edge_points=findings.edge_points,
            T_stored=self.watch.mount.T_cam_lidar,
            T_estimated=None if belief is None else belief.T_estimated,
            matches=belief.matched[-1] if belief is not None and lines is not None and belief.matched else (),
            cloud_lines=() if lines is None else lines.cloud_lines,
            image_lines=() if lines is None else lines.image_lines,
        )

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        begun = self._clock.monotonic_ns()
        try:
            yield
        finally:
            self._spent(name, (self._clock.monotonic_ns() - begun) / 1e6)

    def _spent(self, name: str, spent_ms: float) -> None:
        self._timing.setdefault(name, deque(maxlen=_TIMINGS)).append(spent_ms)


def _rate(stamps: deque[int] | tuple[int, ...]) -> float | None:
    """Mean rate of ascending stamps, Hz; None for fewer than two."""
    if len(stamps) < 2 or stamps[-1] <= stamps[0]:
        return None
    return (len(stamps) - 1) * 1e9 / (stamps[-1] - stamps[0])


def _quantiles(values: deque[float]) -> Timing:
    p50, p95 = np.quantile(np.array(values), [0.5, 0.95])
    return Timing(p50=float(p50), p95=float(p95))
