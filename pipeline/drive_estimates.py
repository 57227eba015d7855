"""The window estimates of a drive, taken from its watch: what a baseline is learned from."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from pipeline.frame_evidence import DropReason
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import Floats, FramePair
from pipeline.road_samples import WindowEstimates
from pipeline.segmentation import Segmenter
from pipeline.verdict import Memory
from pipeline.watch import Watch


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A drive as it was watched without a baseline.

    Attributes:
        estimates: Of the judgements that saw something, in order of time; may be empty.
        left_out: Judgements without edges that fit, or in which the witnesses contradicted each other.
        memory: The verdict at the end.
    """

    estimates: WindowEstimates
    left_out: int
    memory: Memory


class Driven:
    """Watches one pair along a drive and keeps what its windows estimate.

    Args:
        recording: Name of the drive.
        mount: What is stored of the pair; a baseline that it has is not looked at.
        parameters: Settings.
        segmenter: The network, or None: no lines.
    """

    def __init__(
        self, recording: str, mount: Mount, parameters: Parameters, segmenter: Segmenter | None
    ) -> None:
        self.watch = Watch(dataclasses.replace(mount, baseline=None), parameters, segmenter)
        self._recording = recording
        self._rows: list[tuple[Floats, Floats, Floats]] = []
        self._ways: list[tuple[float, float]] = []
        self._stamps: list[int] = []
        self._left_out = 0

    def step(self, pair: FramePair) -> DropReason | None:
        """Takes one pair in; why it gave nothing, or None."""
        findings = self.watch.step(pair)
        if findings.judged:
            self._judged(pair.image_stamp_ns)
        return findings.dropped

    def finish(self) -> Drive:
        """The drive is over."""
        watch = self.watch
        watch.finish(max((*watch.window_stamps, *watch.line_stamps), default=0))
        assert watch.memory is not None  # noqa: S101 - set by finish
        rows = list(zip(*self._rows, strict=True)) or [(), (), ()]
        shapes = ((-1, 6), (-1, 6, 6), (-1, 6))
        drift, covariance, feigned = (
            np.array(row, dtype=np.float64).reshape(shape) for row, shape in zip(rows, shapes, strict=True)
        )
        estimates = WindowEstimates(
            recording=self._recording,
            drift=drift,
            covariance=covariance,
            feigned=feigned,
            way_m=np.array(self._ways, dtype=np.float64).reshape(-1, 2),
            stamp_ns=np.array(self._stamps, dtype=np.int64),
        )
        return Drive(estimates, self._left_out, watch.memory)

    def _judged(self, stamp_ns: int) -> None:
        belief = self.watch.belief
        if belief is None or belief.edges is None or belief.judgement.blind or belief.judgement.contradicted:
            self._left_out += 1
            return
        evidence = belief.evidence
        self._rows.append((evidence.drift, evidence.covariance, evidence.feigned))
        self._ways.append(self.watch.window_way_m)
        self._stamps.append(stamp_ns)
