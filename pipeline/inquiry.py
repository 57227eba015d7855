"""The inquiry into what moved: sections of a drive are kept, and asked when something stirs (FORMULAS G)."""

from collections import deque
from collections.abc import Sequence

import numpy as np

from pipeline import se3
from pipeline.belief import Belief
from pipeline.causes import Cause, CauseParameters, Explanation, Section, explain
from pipeline.edge_score import EdgeFrame
from pipeline.ego import Straightened
from pipeline.mount import Mount
from pipeline.opinions import Doubt, Steady
from pipeline.parameters import Parameters
from pipeline.records import CameraModel, Floats
from pipeline.sections import Move, Passage, Place, fresh, linearised
from pipeline.verdict import Memory

_SECTIONS = 90
"""Sections kept: two kilometres, some minutes; a cause that is older than they are stands in all of them."""

_MOST_MOVES = 512
"""Frames whose motion is remembered: more than any window holds."""


class Inquiry:
    """What one drive says of mount, clock and lens.

    Args:
        mount: What is stored of the pair.
        parameters: Settings.
    """

    def __init__(self, mount: Mount, parameters: Parameters) -> None:
        self.explanation: Explanation | None = None
        self._mount = mount
        self._parameters = parameters
        # Moves without their frames: a frame weighs megabytes, and the window drops most of them.
        self._moves: deque[Move] = deque(maxlen=_MOST_MOVES)
        self._sections: deque[Section] = deque(maxlen=_SECTIONS)
        self._window: Section | None = None
        self._asked_ns: int | None = None

    def see(self, stamp_ns: int, sweep: Straightened) -> None:
        """Remembers how the vehicle moved while a frame was taken, the newest."""
        if self._moves and stamp_ns < self._moves[-1].stamp_ns:
            self.forget()
        motion = self._mount.motion(sweep.twist)
        self._moves.append(Move(stamp_ns, motion, sweep.twist is not None, sweep.sync_s))

    def forget(self) -> None:
        """The stream was interrupted, or a new extrinsic holds: what was seen before is of no use."""
        self._moves.clear()
        self._sections.clear()
        self._window = self._asked_ns = self.explanation = None

    def ask(
        self, frames: Sequence[EdgeFrame], belief: Belief, memory: Memory, steady: Steady | None
    ) -> Doubt | None:
        """What speaks against a moved mount after a judgement.

        Args:
            frames: The window's frames with edges, ascending in time.
            belief: What was judged.
            memory: Before the judgement.
            steady: What all scenes of the drive together say, or None.

        Returns:
            Another cause, or that it is open; None where the mount may be blamed, or nothing is wrong.
        """
        judgement = belief.judgement
        sudden = judgement.alarming or judgement.suspicious
        slow = steady is not None and (steady.alarming or steady.suspicious)
        claimed = judgement.alarming or (steady is not None and steady.alarming)
        moves = {move.stamp_ns: move for move in self._moves}
        window = [Passage(frame, moves[frame.stamp_ns]) for frame in frames if frame.stamp_ns in moves]
        if belief.edges is None or judgement.blind or not window:
            return None
        if steady is not None and steady.timed:
            return _jumped(steady, window[-1].move)
        self._close(window, belief.edges.xi)
        if sudden and memory.severity is None:
            self._look_closer(window, belief.edges.xi)
        else:
            self._window = self._asked_ns = None
        expectation = self._mount.expectation(self._parameters.test)
        if sudden or memory.severity is not None:
            # Before the last quiet judgement nothing was wrong: what was seen then is of another mount.
            self._explain(expectation.covariance + expectation.floor, memory.quiet_ns)
        elif slow and steady is not None:
            # All scenes tell of a change on the way: the stored extrinsic's own doubt is no part of it.
            self._explain(expectation.floor, steady.onset.from_ns)
        else:
            self._explain(expectation.covariance + expectation.floor, None)
        if self.explanation is None:
            return None
        settings = self._parameters.causes
        return doubt_of(self.explanation, self._mount, settings, stirred=sudden or slow, claimed=claimed)

    def _close(self, window: Sequence[Passage], xi: Floats) -> None:
        """Keeps the newest frames as a section of their own once they make one."""
        last = self._sections[-1] if self._sections else None
        settings = self._parameters.window
        new = fresh(window, last, settings.least_frames, settings.dense_frames)
        if new:
            self._sections.append(linearised(new, xi, self._place(), self._parameters.edge_witness))

    def _look_closer(self, window: Sequence[Passage], xi: Floats) -> None:
        """Takes the whole window as a section: what stirs may be younger than any that is kept."""
        now_ns, wait_ns = window[-1].frame.stamp_ns, self._parameters.window.judge_every_ns
        if self._asked_ns is not None and now_ns - self._asked_ns < wait_ns:
            return
        self._asked_ns = now_ns
        self._window = linearised(window, xi, self._place(), self._parameters.edge_witness)

    def _explain(self, covariance: Floats, since_ns: int | None) -> None:
        """Asks the sections after ``since_ns``, and the window in place of those that it holds."""
        window = () if self._window is None else (self._window,)
        sections = [
            s
            for s in self._sections
            if (since_ns is None or s.from_ns > since_ns) and all(s.to_ns < w.from_ns for w in window)
        ]
        sections += window
        limits, settings = self._mount.limits, self._parameters.causes
        self.explanation = explain(sections, covariance, limits, settings) if sections else None

    def _place(self) -> Place:
        mount, expectation = self._mount, self._mount.expectation(self._parameters.test)
        B = se3.vehicle_block(mount.R_vehicle_cam)
        return Place(
            camera=mount.camera,
            T_expected=se3.retract(mount.T_cam_lidar, B.T @ expectation.mean),
            R_vehicle_cam=mount.R_vehicle_cam,
            floor=expectation.floor,
            zoom=self._parameters.causes.zoom,
        )


def doubt_of(
    found: Explanation, mount: Mount, parameters: CauseParameters, *, stirred: bool, claimed: bool
) -> Doubt | None:
    """What an explanation has against a moved mount.

    Args:
        found: What the sections say.
        mount: What is stored of the pair.
        parameters: Thresholds.
        stirred: Whether there is suspicion.
        claimed: Whether the evidence is to be called a drift.

    Returns:
        Another cause, or that it is open; while nothing stirs, a clock or lens that surely changed and
        matters, though no window alone shows it.
    """
    if not stirred:
        return _unnoticed(found, mount, parameters)
    cause = found.cause(parameters)
    if cause == "mount" or (cause == "cause_open" and not claimed):
        return None
    return _told(cause, found)


def _unnoticed(found: Explanation, mount: Mount, parameters: CauseParameters) -> Doubt | None:
    late = abs(found.time_offset_s) * found.motion
    if found.changed("clock", parameters) and found.separable and bool(np.any(late > mount.limits)):
        return _told("time_offset", found)
    turned = abs(found.zoom) * _border(mount.camera)
    if found.changed("lens", parameters) and turned > float(mount.limits[1:3].min()):
        return _told("intrinsics_changed", found)
    return None


def _border(camera: CameraModel) -> float:
    """Angle, rad, by which a ray at the left or right border turns per unit of log focal length."""
    f, centre = float(camera.K[0, 0]), float(camera.K[0, 2])
    slope = max(centre, camera.width - 1 - centre) / f
    return slope / (1.0 + slope**2)


REASONS = {
    "time_offset": "Sweeps and images are {delay:+.0f} ms apart (sigma {delay_sigma:.0f}) beyond "
    "their stamps: the mount need not have moved.",
    "intrinsics_changed": "The focal length is {zoom:+.1f} % off the stored one (sigma {zoom_sigma:.1f}): "
    "the mount need not have moved.",
    "forward_or_sync": "A mount that has moved forward or back, or images {alone:+.0f} ms off in time: "
    "the speeds driven so far do not tell which.",
    "cause_open": "Mount, clock or lens has changed: the drive so far does not tell which.",
}
"""What is said of each cause but the mount."""


def _jumped(steady: Steady, move: Move) -> Doubt:
    """Of a sudden move that a jump of the time between sweeps and images would feign (FORMULAS G1)."""
    late_s = float(steady.drift @ move.motion) / max(float(move.motion @ move.motion), _SLOWEST**2)
    return Doubt("forward_or_sync", REASONS["forward_or_sync"].format(alone=1e3 * late_s))


_SLOWEST = 0.1
"""m/s; below it no time offset is worth a figure."""


def _told(cause: Cause, found: Explanation) -> Doubt:
    sizes = {
        "delay": 1e3 * found.time_offset_s,
        "delay_sigma": 1e3 * found.time_sigma_s,
        "alone": 1e3 * found.time_alone_s,
        "zoom": 1e2 * found.zoom,
        "zoom_sigma": 1e2 * found.zoom_sigma,
    }
    return Doubt(cause, REASONS[cause].format(**sizes))
