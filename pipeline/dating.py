"""When the drift that is told began: the past of one pair, and the onset that it gives."""

import dataclasses

import numpy as np

from pipeline import se3
from pipeline.belief import Belief
from pipeline.drift_test import Expectation
from pipeline.edge_witness import EdgeFrame
from pipeline.mount import Mount
from pipeline.onset import Onset, change_point
from pipeline.records import CameraModel, Floats
from pipeline.traces import TraceParameters, WindowTrace, fractions, spread, thinned
from pipeline.verdict import Memory


class Dating:
    """The past of one pair, as far as it is kept.

    Args:
        camera: Intrinsics.
        parameters: How much is kept.
    """

    def __init__(self, camera: CameraModel, parameters: TraceParameters) -> None:
        self._camera = camera
        self._parameters = parameters
        self._frames: list[EdgeFrame] = []
        self._windows: list[WindowTrace] = []
        self._told_ns: int | None = None
        self._settled = False

    def see(self, frame: EdgeFrame) -> None:
        """Keeps what is needed of a frame, the newest."""
        if self._frames and frame.stamp_ns < self._frames[-1].stamp_ns:
            self._forget()
        if self._settled:
            return
        settings = self._parameters
        if self._told_ns is not None:
            # What lies before the telling is thinned no more: the moment is in it.
            if not self._frames or frame.stamp_ns - self._frames[-1].stamp_ns >= settings.after_ns:
                self._frames.append(thinned(frame, settings))
            return
        self._frames.append(thinned(frame, settings))
        kept = spread([f.stamp_ns for f in self._frames], settings.most_frames)
        self._frames = [self._frames[index] for index in kept]

    def dated(
        self, memory: Memory, mount: Mount, expectation: Expectation, belief: Belief, shown_since_ns: int
    ) -> Memory:
        """The memory after a judgement, its onset told as sharply as the past allows once a drift is told.

        The onset is told at once and again when the window has settled; between and after it stays.

        Args:
            memory: After the judgement.
            mount: What is stored of the pair.
            expectation: Of a mount that has not moved.
            belief: What was judged.
            shown_since_ns: Since when a drift would have shown in the window.
        """
        now_ns = memory.input_ns
        if self._settled:
            return memory
        if not (belief.judgement.blind or belief.judgement.contradicted):
            self._judged(WindowTrace(shown_since_ns, now_ns, belief.judgement.drift))
        if memory.severity is None or not belief.judgement.alarming:
            return memory
        first = self._told_ns is None
        self._told_ns = now_ns if self._told_ns is None else self._told_ns
        settles = now_ns - self._told_ns >= self._parameters.settled_ns
        if not (first or settles):
            return memory
        memory = self.redated(memory, mount, expectation, belief)
        if settles:
            self._forget()
        return memory

    def redated(self, memory: Memory, mount: Mount, expectation: Expectation, belief: Belief) -> Memory:
        """The memory with its onset told by all that is kept now; as it is where nothing better is known."""
        if self._told_ns is None or self._settled or not belief.judgement.alarming:
            return memory
        mean = se3.vehicle_block(mount.R_vehicle_cam).T @ expectation.mean
        T_expected = se3.retract(mount.T_cam_lidar, mean)
        found = self._by_frames(T_expected, belief.T_estimated)
        if found is None or found.stamp_ns == found.from_ns:
            # All frames that are kept may be from after it: windows reach further back.
            covariance = belief.evidence.covariance + expectation.floor
            earlier = self._by_windows(belief.judgement.drift, covariance)
            if found is None:
                found = earlier
            elif earlier is not None and earlier.from_ns < found.from_ns:
                found = _before(earlier, found.to_ns)
        known = memory.onset
        if found is None or (
            # Nothing that is kept was free of it, and the verdict remembers a time that was.
            known is not None and found.stamp_ns == found.from_ns and known.from_ns < found.from_ns
        ):
            return memory
        return dataclasses.replace(memory, onset=found)

    def _forget(self) -> None:
        """Stamps of before say nothing of now, or are wanted no more; what was dated stays so."""
        self._frames.clear()
        self._windows.clear()
        self._settled = self._told_ns is not None

    def _judged(self, window: WindowTrace) -> None:
        self._windows.append(window)
        kept = spread([w.stamp_ns for w in self._windows], self._parameters.most_windows)
        self._windows = [self._windows[index] for index in kept]

    def _by_frames(self, T_expected: Floats, T_estimated: Floats) -> Onset | None:
        if not self._frames:
            return None
        stamps = np.array([f.stamp_ns for f in self._frames], dtype=np.int64)
        scores = fractions(self._frames, self._camera, T_expected, T_estimated)
        return change_point(stamps, scores, self._parameters.change)

    def _by_windows(self, drift: Floats, covariance: Floats) -> Onset | None:
        stamps = np.array([w.stamp_ns for w in self._windows], dtype=np.int64)
        pull = np.linalg.solve(covariance, drift)
        scores = np.array([float(pull @ w.drift) for w in self._windows]) / float(pull @ drift)
        found = change_point(stamps, scores, self._parameters.change)
        if found is None:
            return None
        # A window that shows nothing of it holds younger frames that a drift would not show in yet.
        first = next(w for w in self._windows if w.stamp_ns == found.from_ns)
        stamp = first.shown_since_ns if found.stamp_ns == found.from_ns else found.stamp_ns
        return dataclasses.replace(found, stamp_ns=stamp, from_ns=first.shown_since_ns)


def _before(earlier: Onset, to_ns: int) -> Onset:
    """What windows say of a time from before the frames."""
    stamp = min(earlier.stamp_ns, to_ns)
    return dataclasses.replace(earlier, stamp_ns=stamp, to_ns=max(stamp, min(earlier.to_ns, to_ns)))
