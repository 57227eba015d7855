"""One pair of sensors watched: frames in, findings and a verdict out. The loop that every mode of use drives.

Pure: no files, no clock. What a stage costs is measured by the caller through ``stage``.
"""

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from pipeline import verdict, window
from pipeline.belief import Belief, believe
from pipeline.candidate import Proposal, Proposer, moved_since
from pipeline.dating import Dating
from pipeline.drift_test import Expectation
from pipeline.drive_scenes import DriveScenes
from pipeline.edge_witness import EdgeFrame
from pipeline.frame_evidence import DropReason, FrameEvidence, Scout, Stage, edge_frame, unmeasured
from pipeline.inquiry import Inquiry
from pipeline.line_witness import LineFrame
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import FramePair, Masks, PointCloud
from pipeline.segmentation import Segmenter
from pipeline.spin_sense import ToldSpin
from pipeline.step_seeker import StepSeeker

_UNHEARD: dict[DropReason, tuple[str, str]] = {
    "image_size": ("no_pairs", "Images are not of the size that the intrinsics are for."),
    "empty_cloud": ("no_scan_pattern", "The clouds are empty."),
    "no_scan_pattern": (
        "no_scan_pattern",
        "The clouds show neither rings nor enough points and ground in view to find edges without them.",
    ),
    "no_edges": (
        "nothing_in_common",
        "The cloud shows no edges within the image: open country, or a sensor that looks elsewhere.",
    ),
}
"""Code and reason of frames that give no evidence for long."""


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """What one frame gave.

    Attributes:
        dropped: Why it gave nothing, or None.
        cloud: The sweep as it was used.
        edge_points: float32 (M,3), points at jumps of range, LiDAR frame.
        masks: Its masks, or None where it got none.
        lines: Its lines, or None where it got none.
        judged: Whether the window was judged after it.
    """

    dropped: DropReason | None
    cloud: PointCloud
    edge_points: np.ndarray
    masks: Masks | None
    lines: LineFrame | None
    judged: bool


@dataclass(frozen=True, slots=True, eq=False)
class Foresight:
    """What was found in a pair before its turn.

    Attributes:
        evidence: What the pair says.
        scout: Goes on after it.
        breaks: ``Watch.breaks`` when this was begun: what is forgotten later makes it void.
    """

    evidence: FrameEvidence
    scout: Scout
    breaks: int


class Watch:
    """The rolling window of one pair, its belief and its verdict.

    Args:
        mount: What is stored of the pair.
        parameters: Settings.
        segmenter: The network, or None: no masks, no lines.

    Attributes:
        breaks: How often what was seen before has been forgotten.
    """

    def __init__(self, mount: Mount, parameters: Parameters, segmenter: Segmenter | None) -> None:
        self.mount = mount
        self.parameters = parameters
        self.segmenter = segmenter
        self.memory: verdict.Memory | None = None
        self.belief: Belief | None = None
        self.frames = 0
        self.breaks = 0
        self._scout = Scout(mount, parameters, segmenter)
        self._edge_frames: deque[EdgeFrame] = deque()
        self._line_frames: deque[tuple[int, LineFrame]] = deque()
        self._dating = Dating(mount.camera, parameters.traces)
        self._proposer = Proposer(mount, parameters)
        self.inquiry = Inquiry(mount, parameters)
        self.scenes = DriveScenes(mount, parameters)
        self._seeker = StepSeeker(mount, parameters)
        self._begun_ns = 0
        self._judged_ns: int | None = None
        self._unheard = _UNHEARD["no_scan_pattern"]
        self.departed: Counter[window.Departure] = Counter()

    @property
    def edge_frames(self) -> tuple[EdgeFrame, ...]:
        """The window's frames with edges, ascending in time."""
        return tuple(self._edge_frames)

    @property
    def window_stamps(self) -> tuple[int, ...]:
        """Stamps of the frames in the window, ns."""
        return tuple(frame.stamp_ns for frame in self._edge_frames)

    @property
    def window_way_m(self) -> tuple[float, float]:
        """Way driven at the oldest and newest frame with edges in the window, m; (0, 0) without any."""
        frames = self._edge_frames
        return (frames[0].distance_m, frames[-1].distance_m) if frames else (0.0, 0.0)

    @property
    def proposal(self) -> Proposal | None:
        """The extrinsic proposed for a mount that has moved, or why there is none; None while it has not."""
        return self._proposer.proposal

    @property
    def line_stamps(self) -> tuple[int, ...]:
        """Stamps of the frames with lines in the window, ns."""
        return tuple(stamp for stamp, _ in self._line_frames)

    @property
    def spin_contradicted(self) -> ToldSpin | None:
        """What the sweeps say of the rotation where they surely say other than is configured, else None."""
        return self._scout.spin_contradicted

    def scout(self) -> Scout:
        """Another scout that looks at the next pair as this watch would."""
        return self._scout.copy()

    def step(
        self, pair: FramePair, stage: Stage = unmeasured, foresight: Foresight | None = None
    ) -> Findings:
        """Takes one pair in; judges the window when that is due.

        Args:
            pair: A sweep and its image.
            stage: Measures the stages.
            foresight: What was found in the pair before; used if nothing has been forgotten since.
        """
        now_ns = pair.image_stamp_ns
        self._enter(now_ns)
        findings = self._looked_at(pair, stage, foresight)
        if findings.dropped is not None:
            self._unheard = _UNHEARD[findings.dropped]
            assert self.memory is not None  # noqa: S101 - set on entry
            self.memory = verdict.unheard(self.memory, *self._unheard, now_ns, self.parameters.verdict)
            return findings
        self.frames += 1
        return self._judged(findings, now_ns, stage)

    def silent(self, now_ns: int) -> None:
        """Nothing came until ``now_ns``."""
        if self.memory is None:
            self.memory = verdict.start(now_ns)
        self.memory = verdict.silent(self.memory, now_ns, self.parameters.verdict)
        if self.memory.state == "stale":
            self._forget()

    def fault(self, reason: str, now_ns: int) -> None:
        """The inputs can not be worked with, for the reason given; the next judgement ends it."""
        if self.memory is None:
            self.memory = verdict.start(now_ns)
        self.memory = verdict.faulted(self.memory, reason, now_ns)

    def finish(self, now_ns: int = 0) -> None:
        """The recording ends: a verdict that was never reached says why."""
        if self.memory is None:
            self.memory = verdict.start(now_ns)
        if self.belief is None and (self._edge_frames or self._line_frames):
            self.belief = self._believe()
        judgement = None
        if self.belief is not None:
            judgement = self.belief.judgement
            self.memory = self._dating.redated(self.memory, self.mount, self._expectation(), self.belief)
        required = self.mount.required
        self.memory = verdict.finish(self.memory, judgement, self._scout.count, required, self._unheard)
        self._propose(now_ns, ended=True)

    def acknowledge(self, now_ns: int, by: str, why: str) -> bool:
        """A person has taken note of the drift: evidence is collected anew; False where none is told."""
        if self.memory is None or self.memory.severity is None:
            return False
        self.memory = verdict.acknowledge(self.memory, now_ns, by, why)
        self._forget()
        self._dating = Dating(self.mount.camera, self.parameters.traces)
        self.scenes.forget()
        self.inquiry.forget()
        self._begun_ns = now_ns
        return True

    def _expectation(self) -> Expectation:
        return self.mount.expectation(self.mount.thresholds(self.parameters.test))

    def _enter(self, now_ns: int) -> None:
        """Brings clock and memory to a new pair; a clock that runs back starts a new window."""
        if self.memory is None:
            self.memory = verdict.start(now_ns)
            self._begun_ns = now_ns
        newest = max((*self.window_stamps, *self.line_stamps), default=now_ns)
        if now_ns < newest or now_ns - newest > self.parameters.window.longest_ns:
            self._forget()
            self._begun_ns = now_ns
        if self.memory.state == "stale":
            self._begun_ns = now_ns
        self.memory = verdict.paired(self.memory, now_ns)

    def _forget(self) -> None:
        self._edge_frames.clear()
        self._line_frames.clear()
        self._scout.forget()
        self.breaks += 1
        self._proposer.forget()
        self._seeker.forget()
        self._judged_ns = None

    def _looked_at(self, pair: FramePair, stage: Stage, foresight: Foresight | None) -> Findings:
        """Takes what the frame says into the window."""
        if foresight is not None and foresight.breaks == self.breaks:
            self._scout, evidence = foresight.scout, foresight.evidence
        else:
            evidence = self._scout.look(pair, stage)
        now_ns = pair.image_stamp_ns
        if evidence.edges is not None and evidence.straight is not None:
            frame = edge_frame(pair, evidence.edges, evidence.straight, self.mount, stage)
            self._edge_frames.append(frame)
            self._dating.see(frame)
            self._seeker.see(frame, self.belief)
            self.inquiry.see(now_ns, evidence.straight)
        if evidence.lines is not None:
            self._line_frames.append((now_ns, evidence.lines))
        if evidence.straight is not None:
            self._retain(now_ns, evidence.straight.distance_m)
        return Findings(
            evidence.dropped,
            evidence.cloud,
            evidence.edge_points,
            evidence.masks,
            evidence.lines,
            judged=False,
        )

    def _retain(self, now_ns: int, way_m: float) -> None:
        """Drops what is too old or too dense from the window."""
        settings = self.parameters.window
        # Frames without edges age those with them: else the last of those would speak for ever.
        here = window.Candidate(now_ns, way_m, np.zeros((6, 6)))
        while self._edge_frames and window.past(_candidate(self._edge_frames[0]), here, settings):
            self._edge_frames.popleft()
            self.departed["past"] += 1
        if self._edge_frames:
            kept, left = window.retained([_candidate(frame) for frame in self._edge_frames], settings)
            self.departed.update(left)
            self._edge_frames = deque(self._edge_frames[index] for index in kept)
        while self._line_frames and self._line_frames[-1][0] - self._line_frames[0][0] > settings.longest_ns:
            self._line_frames.popleft()

    def _judged(self, findings: Findings, now_ns: int, stage: Stage) -> Findings:
        assert self.memory is not None  # noqa: S101 - set on entry
        beginning = now_ns - self._begun_ns < self.parameters.window.beginning_ns
        stirred = self.memory.state in ("suspect", "drifted") or self._seeker.due
        stirred = stirred and self.memory.severity is None
        frames = max(len(self._edge_frames), len(self._line_frames))
        due = window.judgement_due(
            now_ns,
            self._judged_ns,
            frames,
            soon=stirred,
            parameters=self.parameters.window,
            beginning=beginning,
        )
        if not due:
            return findings
        with stage("judgement"):
            self.belief = self._believe()
        self._judged_ns = now_ns
        if self.belief is None:
            return findings
        self.scenes.hear(self.belief, self.window_way_m, now_ns)
        with stage("shock"):
            steady = self._seeker.said(self.edge_frames, self.belief, now_ns) or self.scenes.said()
        with stage("inquiry"):
            doubt = self.inquiry.ask(tuple(self._edge_frames), self.belief, self.memory, steady)
        self.memory = verdict.advance(
            self.memory,
            self.belief.judgement,
            (self._shown_since(), now_ns),
            self.mount.required,
            self.mount.limits,
            self.parameters.verdict,
            steady,
            doubt,
        )
        self.memory = self._dating.dated(
            self.memory, self.mount, self._expectation(), self.belief, self._shown_since()
        )
        with stage("proposal"):
            self._propose(now_ns)
        return Findings(
            None, findings.cloud, findings.edge_points, findings.masks, findings.lines, judged=True
        )

    def _propose(self, now_ns: int, *, ended: bool = False) -> None:
        """Looks for the extrinsic that holds now, where the stored one does not."""
        assert self.memory is not None  # noqa: S101 - set on entry
        moved_ns = moved_since(self.memory)
        frames = tuple(self._edge_frames)
        lines = tuple(self._line_frames)
        self._proposer.follow(moved_ns, self.belief, frames, lines, now_ns, ended=ended)

    def _shown_since(self) -> int:
        """Stamp from which three quarters of the window's frames are: a drift in all of those would show."""
        stamps = sorted(self.window_stamps or self.line_stamps)
        return stamps[len(stamps) // 4]

    def _believe(self) -> Belief | None:
        # Lines of before the window would testify to another mount.
        since = self._edge_frames[0].stamp_ns if self._edge_frames else 0
        lines = [frame for stamp, frame in self._line_frames if stamp >= since]
        # What was followed before the window was forgotten is another mount's.
        edges = None if self.belief is None or self._judged_ns is None else self.belief.edges
        trail = None if edges is None else edges.trail
        frames = tuple(self._edge_frames)
        return believe(self.mount, self.parameters, frames, lines, self.scenes.total.scenes, trail)


def _candidate(frame: EdgeFrame) -> window.Candidate:
    """What the choice of frames needs of one."""
    return window.Candidate(frame.stamp_ns, frame.distance_m, frame.information)
