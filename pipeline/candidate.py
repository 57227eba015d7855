"""A new extrinsic for a mount that has moved: proposed from windows that agree, never applied by itself.

One window that is surely wrong about the stored extrinsic need not know the right one (PROBE 5): the
proposal rests on windows that share no objects where there are such, and on one, said so, where there are
not. Either way it is held against frames that it was not made from (:mod:`pipeline.hold_out`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from scipy.special import chdtrc

from pipeline import se3
from pipeline.belief import Belief, believe
from pipeline.edge_witness import NEW_SCENE_M, EdgeFrame
from pipeline.hold_out import HoldOut, HoldOutParameters, held_out
from pipeline.line_witness import LineFrame
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import Floats, read_only
from pipeline.verdict import Memory


@dataclass(frozen=True, slots=True)
class CandidateParameters:
    """What a proposal asks for.

    Attributes:
        agreeing: Windows that agree, from which a proposal is more than one window's word (PROBE 11).
        agreement: Chance, at least, of windows differing so much where all mean the same mount.
        least_frames: Frames of one window, at least, when half of them are held out: single frames are off
            by 0.2 deg (PROBE 2), so that each half should have some.
        most_windows: Windows remembered: with more the floor between scenes outweighs what one more adds.
        hold_out: Of the check.
    """

    agreeing: int = 3
    agreement: float = 1e-3
    least_frames: int = 8
    most_windows: int = 12
    hold_out: HoldOutParameters = field(default_factory=HoldOutParameters)


@dataclass(frozen=True, slots=True, eq=False)
class WindowEstimate:
    """What one window says of the extrinsic.

    Attributes:
        from_ns: Stamp of its oldest frame, ns.
        to_ns: Of its newest.
        from_m: Way driven at its oldest frame, m.
        to_m: At its newest.
        frames: Number of frames.
        xi: float64 (6,), against the stored extrinsic, camera axes.
        covariance: float64 (6,6), of its random error.
    """

    from_ns: int
    to_ns: int
    from_m: float
    to_m: float
    frames: int
    xi: Floats
    covariance: Floats

    def __post_init__(self) -> None:
        for name in ("xi", "covariance"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A proposed extrinsic that passed its hold-out check.

    Attributes:
        stamp_ns: Stamp of the data at which it was proposed, ns.
        T_cam_lidar: float64 (4,4).
        covariance: float64 (6,6), of (phi, rho) in camera axes, rad and m: random error and floor between
            scenes.
        windows: Those it was made from, oldest first; no two share objects.
        agreed: Whether they are enough to be more than one window's word.
        hold_out: Of the check.
    """

    stamp_ns: int
    T_cam_lidar: Floats
    covariance: Floats
    windows: tuple[WindowEstimate, ...]
    agreed: bool
    hold_out: HoldOut

    def __post_init__(self) -> None:
        for name in ("T_cam_lidar", "covariance"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


@dataclass(frozen=True, slots=True)
class NoCandidate:
    """Why nothing is proposed.

    Attributes:
        stamp_ns: Stamp of the data at which that was found, ns.
        reason: One sentence.
        hold_out: Of the check, where there was one.
    """

    stamp_ns: int
    reason: str
    hold_out: HoldOut | None = None


Proposal: TypeAlias = Candidate | NoCandidate


def window_estimate(mount: Mount, belief: Belief, frames: Sequence[EdgeFrame]) -> WindowEstimate:
    """What a window said, from what was believed after it."""
    B = se3.vehicle_block(mount.R_vehicle_cam)
    return WindowEstimate(
        from_ns=frames[0].stamp_ns,
        to_ns=frames[-1].stamp_ns,
        from_m=frames[0].distance_m,
        to_m=frames[-1].distance_m,
        frames=len(frames),
        xi=se3.local(mount.T_cam_lidar, belief.T_estimated),
        covariance=B.T @ belief.evidence.covariance @ B,
    )


def combined(windows: Sequence[WindowEstimate]) -> tuple[Floats, Floats, float]:
    """One answer from several windows: information form (FORMULAS F6), as if independent.

    Returns:
        xi float64 (6,); its covariance float64 (6,6) without floor, widened by what the windows scatter
        beyond their sigma; and that scatter, chi-square per degree of freedom (1 for one window).
    """
    known = [np.linalg.inv(window.covariance) for window in windows]
    covariance = np.linalg.inv(np.sum(known, axis=0))
    xi = covariance @ sum((K @ w.xi for K, w in zip(known, windows, strict=True)), np.zeros(6))
    if len(windows) == 1:
        return xi, covariance, 1.0
    misfit = sum(float((w.xi - xi) @ K @ (w.xi - xi)) for K, w in zip(known, windows, strict=True))
    scatter = misfit / (6.0 * (len(windows) - 1))
    return xi, max(1.0, scatter) * covariance, scatter


def agree(windows: Sequence[WindowEstimate], floor: Floats, chance: float) -> bool:
    """Whether windows of several scenes may mean the same mount.

    Args:
        windows: Their estimates.
        floor: float64 (6,6), by which scenes differ, camera axes.
        chance: Probability, at least, of a scatter as large as theirs.
    """
    if len(windows) < 2:
        return True
    wide = [
        WindowEstimate(w.from_ns, w.to_ns, w.from_m, w.to_m, w.frames, w.xi, w.covariance + floor)
        for w in windows
    ]
    freedom = 6.0 * (len(windows) - 1)
    return float(chdtrc(freedom, freedom * combined(wide)[2])) >= chance


class Proposer:
    """Remembers what windows say of a mount that has moved, and proposes what they agree on.

    Args:
        mount: What is stored of the pair.
        parameters: Settings of the pair.
        criteria: What a proposal asks for; None: the defaults.
    """

    def __init__(
        self, mount: Mount, parameters: Parameters, criteria: CandidateParameters | None = None
    ) -> None:
        self._mount = mount
        self._parameters = parameters
        self._criteria = criteria or CandidateParameters()
        self._windows: list[WindowEstimate] = []
        self._tried_ns: int | None = None
        self.proposal: Proposal | None = None

    def forget(self) -> None:
        """Begins anew, without windows: stamps and ways of before mean nothing. A proposal stands."""
        self._windows.clear()
        self._tried_ns = None

    def follow(
        self,
        moved_ns: int | None,
        belief: Belief | None,
        frames: Sequence[EdgeFrame],
        lines: Sequence[tuple[int, LineFrame]],
        now_ns: int,
        *,
        ended: bool = False,
    ) -> None:
        """Takes a window after its judgement; proposes where there is something to add.

        Args:
            moved_ns: Stamp from which frames show the moved mount (:func:`moved_since`); None: it has not
                moved, and what was proposed before is void.
            belief: What is believed after the window, or None.
            frames: The window's frames with edges, ascending in time.
            lines: Those with lines, each after its stamp, likewise.
            now_ns: Stamp of the data.
            ended: No frame will follow: what there is must do.
        """
        if moved_ns is None:
            self.forget()
            self.proposal = None
            return
        shown = [frame for frame in frames if frame.stamp_ns >= moved_ns]
        if belief is not None and len(shown) == len(frames):
            self.note(belief, shown)
        # Too few frames at the end say nothing against what was proposed before.
        last = ended and (self.proposal is None or len(shown) >= self._criteria.least_frames)
        if last or self.due(shown):
            self.propose(shown, lines, now_ns)

    def note(self, belief: Belief, frames: Sequence[EdgeFrame]) -> None:
        """Takes what a window says in which all frames show the moved mount."""
        silent = belief.edges is None or belief.judgement.blind or belief.judgement.contradicted
        if silent or len(frames) < self._criteria.least_frames:
            return
        window = window_estimate(self._mount, belief, frames)
        if self._windows and not _apart(self._windows[-1], window):
            # The same scene seen in more frames says it better, unless it now runs into the one before.
            before = self._windows[-2] if len(self._windows) > 1 else None
            if window.frames > self._windows[-1].frames and (before is None or _apart(before, window)):
                self._windows[-1] = window
            return
        self._windows = [*self._windows, window][-self._criteria.most_windows :]

    def due(self, frames: Sequence[EdgeFrame]) -> bool:
        """Whether these frames have something to add: none of them was looked at when last tried."""
        if len(frames) < self._criteria.least_frames:
            return False
        return self._tried_ns is None or frames[0].stamp_ns > self._tried_ns

    def propose(
        self, frames: Sequence[EdgeFrame], lines: Sequence[tuple[int, LineFrame]], now_ns: int
    ) -> Proposal:
        """Makes a candidate from earlier windows, or from the older part of this one, and checks it.

        Args:
            frames: The window's frames with edges, all of which show the moved mount, ascending in time.
            lines: Those with lines, each after its stamp, likewise.
            now_ns: Stamp of the data.
        """
        self.proposal = self._proposed(frames, lines, now_ns)
        if len(frames) >= self._criteria.least_frames:
            self._tried_ns = frames[-1].stamp_ns
        return self.proposal

    def _proposed(
        self, frames: Sequence[EdgeFrame], lines: Sequence[tuple[int, LineFrame]], now_ns: int
    ) -> Proposal:
        if len(frames) < self._criteria.least_frames:
            few = f"{len(frames)} frame{'s' if len(frames) != 1 else ''} with edges since the drift began"
            return NoCandidate(now_ns, f"{few} are too few to propose from some and check on others.")
        B = se3.vehicle_block(self._mount.R_vehicle_cam)
        floor = B.T @ self._mount.expectation(self._parameters.test).floor @ B
        windows = self._agreeing(frames[0], floor)
        held = frames
        if not windows:
            middle = len(frames) // 2
            made, held = frames[:middle], frames[middle:]
            older = [frame for stamp, frame in lines if stamp < held[0].stamp_ns]
            belief = believe(self._mount, self._parameters, made, older)
            if belief is None or belief.judgement.blind or belief.judgement.contradicted:
                return NoCandidate(
                    now_ns, "The older part of the window alone does not say where the mount is."
                )
            windows = [window_estimate(self._mount, belief, made)]
        xi, covariance, _ = combined(windows)
        T_candidate, covariance = se3.retract(self._mount.T_cam_lidar, xi), covariance + floor
        newer = [frame for stamp, frame in lines if stamp >= held[0].stamp_ns]
        check = held_out(
            self._mount,
            self._parameters,
            self._criteria.hold_out,
            (T_candidate, covariance),
            held,
            newer,
            windows[-1].to_m,
        )
        if isinstance(check, str):
            return NoCandidate(now_ns, check)
        if check.reason is not None:
            return NoCandidate(now_ns, check.reason, check)
        enough = len(windows) >= self._criteria.agreeing
        return Candidate(now_ns, T_candidate, covariance, tuple(windows), enough, check)

    def _agreeing(self, first: EdgeFrame, floor: Floats) -> list[WindowEstimate]:
        """The newest windows that agree with each other and share no objects with what begins here."""
        earlier = [
            window
            for window in self._windows
            if window.to_ns < first.stamp_ns and first.distance_m - window.to_m >= NEW_SCENE_M
        ]
        while not agree(earlier, floor, self._criteria.agreement):
            earlier = earlier[1:]
        return earlier


def moved_since(memory: Memory) -> int | None:
    """Stamp from which frames show the moved mount, ns; None where no drift stands."""
    if memory.severity is None or memory.onset is None:
        return None
    # At the beginning of its interval the onset says that nothing before was free of the drift.
    always = memory.onset.stamp_ns == memory.onset.from_ns
    return memory.onset.from_ns if always else memory.onset.to_ns


def _apart(before: WindowEstimate, after: WindowEstimate) -> bool:
    """Whether two windows share neither frames nor objects."""
    return after.from_ns > before.to_ns and after.from_m - before.to_m >= NEW_SCENE_M
