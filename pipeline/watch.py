"""One pair of sensors watched: frames in, findings and a verdict out. The loop that every mode of use drives.

Pure: no files, no clock. What a stage costs is measured by the caller through ``stage``.
"""

import dataclasses
from collections import Counter, deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from pipeline import edge_witness, line_witness, scene_sum, verdict, window
from pipeline.belief import Belief, believe
from pipeline.dating import Dating
from pipeline.drift_test import Expectation
from pipeline.edge_witness import EdgeFrame
from pipeline.edges import RING_JUMP, Edges, find_edges
from pipeline.ego import Ego, Straightened
from pipeline.gradients import GradientPyramid, gradient_pyramid
from pipeline.ground import Ground, fit_ground
from pipeline.line_witness import LineFrame
from pipeline.masks import horizon_line, masks_from_probabilities
from pipeline.mount import Mount
from pipeline.onset import Onset
from pipeline.parameters import Parameters
from pipeline.records import Floats, FramePair, Masks, PointCloud
from pipeline.rings import sensor_origin
from pipeline.scene_filter import Scene
from pipeline.segmentation import Segmenter, grid_scale

Stage: TypeAlias = Callable[[str], AbstractContextManager[None]]
DropReason: TypeAlias = Literal["image_size", "empty_cloud", "no_scan_pattern", "no_edges"]
"""Why a pair gave no evidence, closed list.

image_size: the image is not of the size that the intrinsics are for.
empty_cloud: the sweep holds no point.
no_scan_pattern: the cloud shows no rings, and the frame had no lines either.
no_edges: no edge of the cloud falls into the image.
"""


def _unmeasured(name: str) -> AbstractContextManager[None]:
    """A stage whose cost nobody asked for."""
    del name
    return nullcontext()


_LEAST_EDGES = 20
"""Edges below which a frame says nothing: three per axis."""


_SCENE_STAMPS = 1024
"""Scenes whose stamps are kept: 20 km; a drift that began before is told to have begun before the data."""


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


class Watch:
    """The rolling window of one pair, its belief and its verdict.

    Args:
        mount: What is stored of the pair.
        parameters: Settings.
        segmenter: The network, or None: no masks, no lines.
    """

    def __init__(self, mount: Mount, parameters: Parameters, segmenter: Segmenter | None) -> None:
        self.mount = mount
        self.parameters = parameters
        self.memory: verdict.Memory | None = None
        self.belief: Belief | None = None
        self.frames = 0
        self._segmenter = segmenter
        ahead = mount.T_cam_lidar[2, :3]
        self._ego = Ego(mount.up, ahead, mount.spin)
        self._origin: Floats | None = None
        self._edge_frames: deque[EdgeFrame] = deque()
        self._line_frames: deque[tuple[int, LineFrame]] = deque()
        self._dating = Dating(mount.camera, parameters.traces)
        self.scenes = scene_sum.begin(mount.expectation(parameters.test))
        self._scene_stamps: deque[int] = deque(maxlen=_SCENE_STAMPS)
        self._begun_m: float | None = None
        self._begun_ns = 0
        self._judged_ns: int | None = None
        self._lines_at: tuple[int, float] | None = None
        self.departed: Counter[window.Departure] = Counter()
        self._count = 0

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
    def line_stamps(self) -> tuple[int, ...]:
        """Stamps of the frames with lines in the window, ns."""
        return tuple(stamp for stamp, _ in self._line_frames)

    def step(self, pair: FramePair, stage: Stage = _unmeasured) -> Findings:
        """Takes one pair in; judges the window when that is due."""
        now_ns = pair.image_stamp_ns
        self._enter(now_ns)
        findings = self._evidence_of(pair, stage)
        if findings.dropped is not None:
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
        self.memory = verdict.finish(self.memory, judgement, self._count, self.mount.required)

    def acknowledge(self, now_ns: int, by: str, why: str) -> bool:
        """A person has taken note of the drift: evidence is collected anew; False where none is told."""
        if self.memory is None or self.memory.severity is None:
            return False
        self.memory = verdict.acknowledge(self.memory, now_ns, by, why)
        self._forget()
        self._dating = Dating(self.mount.camera, self.parameters.traces)
        self.scenes = scene_sum.begin(self._expectation())
        self._scene_stamps.clear()
        self._begun_m = None
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
        self._ego.forget()
        self._judged_ns = None
        self._lines_at = None

    def _evidence_of(self, pair: FramePair, stage: Stage) -> Findings:
        """Edges of the frame, and lines when they are due."""
        mount, nothing = self.mount, np.zeros((0, 3), dtype=np.float32)
        if pair.image.size != (mount.camera.width, mount.camera.height):
            return Findings("image_size", pair.cloud, nothing, None, None, judged=False)
        if len(pair.cloud) == 0:
            return Findings("empty_cloud", pair.cloud, nothing, None, None, judged=False)
        self._count += 1
        rng = np.random.default_rng([self.parameters.seed, self._count])
        if self._origin is None:
            # Of the sweep as it was measured: straightening bends its rings.
            self._origin = sensor_origin(pair.cloud)
        with stage("motion"):
            straight = self._ego.straighten(pair)
        pair = dataclasses.replace(pair, cloud=straight.cloud)
        with stage("ground"):
            ground = fit_ground(pair.cloud, mount.up, rng)
        with stage("edges"):
            edges = find_edges(
                pair.cloud, ground, mount.camera, mount.T_cam_lidar, self.parameters.edges, self._origin
            )
        masks, lines = None, None
        if self._lines_due(now_ns=pair.image_stamp_ns, straight=straight):
            masks, lines = self._lines_of(pair, ground, rng, stage)
        enough = edges is not None and len(edges) >= _LEAST_EDGES
        if edges is not None and enough:
            with stage("gradients"):
                gradients = gradient_pyramid(pair.image, mount.camera)
            self._edge_frames.append(self._informed(pair, edges, gradients, straight))
            self._dating.see(self._edge_frames[-1])
        found_lines = lines is not None and bool(lines.cloud_lines) and bool(lines.image_lines)
        dropped: DropReason | None = None
        if not enough and not found_lines:
            dropped = "no_scan_pattern" if edges is None else "no_edges"
        self._retain()
        points = nothing if edges is None else edges.position[edges.kind == RING_JUMP].astype(np.float32)
        return Findings(dropped, pair.cloud, points, masks, lines, judged=False)

    def _informed(
        self, pair: FramePair, edges: Edges, gradients: GradientPyramid, straight: Straightened
    ) -> EdgeFrame:
        """The frame as the window keeps it."""
        mount = self.mount
        frame = EdgeFrame(pair.image_stamp_ns, edges, gradients, straight.distance_m, mount.feigned(straight))
        information = edge_witness.information_of(frame, mount.camera, mount.T_cam_lidar)
        return dataclasses.replace(frame, information=information)

    def _lines_due(self, now_ns: int, straight: Straightened) -> bool:
        """Whether the frame gets masks and lines; it is then the last that got them."""
        waited_ns, way_m = None, None
        if self._lines_at is not None:
            waited_ns = now_ns - self._lines_at[0]
            way_m = None if straight.twist is None else straight.distance_m - self._lines_at[1]
        every_ns = self.parameters.lines_every_ns
        due = window.lines_due(waited_ns, way_m, every_ns, self.parameters.window)
        if self._segmenter is None or not due:
            return False
        self._lines_at = (now_ns, straight.distance_m)
        return True

    def _lines_of(
        self, pair: FramePair, ground: Ground | None, rng: np.random.Generator, stage: Stage
    ) -> tuple[Masks, LineFrame]:
        """Masks and lines of the frame."""
        assert self._segmenter is not None  # noqa: S101 - lines are due with a network only
        mount, now_ns = self.mount, pair.image_stamp_ns
        with stage("network"):
            probabilities = self._segmenter.probabilities(pair.image.pixels)
        with stage("masks"):
            up_cam = mount.T_cam_lidar[:3, :3] @ mount.up
            horizon = horizon_line(mount.camera, up_cam)
            masks = masks_from_probabilities(
                probabilities,
                pair.image.pixels,
                self.parameters.masks,
                horizon,
                grid_scale(*pair.image.size),
            )
        with stage("lines"):
            lines = line_witness.find_lines(
                pair.cloud,
                pair.image,
                masks,
                mount.camera,
                mount.T_cam_lidar,
                up=mount.up,
                forward=mount.forward,
                rng=rng,
                ground=ground,
                origin=self._origin,
            )
        self._line_frames.append((now_ns, lines))
        return masks, lines

    def _retain(self) -> None:
        """Drops what is too old or too dense from the window."""
        settings = self.parameters.window
        if self._edge_frames:
            frames = [window.Candidate(f.stamp_ns, f.distance_m, f.information) for f in self._edge_frames]
            kept, left = window.retained(frames, settings)
            self.departed.update(left)
            self._edge_frames = deque(self._edge_frames[index] for index in kept)
        while self._line_frames and self._line_frames[-1][0] - self._line_frames[0][0] > settings.longest_ns:
            self._line_frames.popleft()

    def _judged(self, findings: Findings, now_ns: int, stage: Stage) -> Findings:
        assert self.memory is not None  # noqa: S101 - set on entry
        beginning = now_ns - self._begun_ns < self.parameters.window.beginning_ns
        stirred = self.memory.state in ("suspect", "drifted") and self.memory.severity is None
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
        self._sum_scene(self.belief, now_ns)
        self.memory = verdict.advance(
            self.memory,
            self.belief.judgement,
            (self._shown_since(), now_ns),
            self.mount.required,
            self.mount.limits,
            self.parameters.verdict,
            self._steady(),
        )
        self.memory = self._dating.dated(
            self.memory, self.mount, self._expectation(), self.belief, self._shown_since()
        )
        return Findings(
            None, findings.cloud, findings.edge_points, findings.masks, findings.lines, judged=True
        )

    def _sum_scene(self, belief: Belief, now_ns: int) -> None:
        """Adds the window to the sum over scenes, once it shares no frame with the last that was added."""
        oldest_m, newest_m = self.window_way_m
        if self._begun_m is None:
            self._begun_m = oldest_m
        seen = belief.edges is not None and not belief.judgement.blind and not belief.judgement.contradicted
        whole = newest_m - self._begun_m >= scene_sum.NEW_SCENE_M
        if not (seen and whole and scene_sum.is_new(self.scenes, oldest_m, newest_m)):
            return
        evidence = belief.evidence
        scene = Scene(evidence.drift, evidence.covariance, evidence.feigned, newest_m, now_ns)
        expectation = self.mount.expectation(self.parameters.test)
        self.scenes = scene_sum.advance(self.scenes, scene, expectation, self.parameters.scenes)
        self._scene_stamps.append(now_ns)

    def _steady(self) -> verdict.Steady | None:
        """What all scenes so far say."""
        total, settings = self.scenes, self.parameters.scenes
        since_ns = total.since_ns
        if since_ns is None:
            return None
        before_ns = max((stamp for stamp in self._scene_stamps if stamp < since_ns), default=self._begun_ns)
        return verdict.Steady(
            alarming=scene_sum.alarming(total, settings),
            suspicious=scene_sum.suspicious(total, settings),
            drift=total.moved,
            sigma=np.sqrt(np.diag(total.moved_covariance)),
            scenes=total.scenes,
            onset=Onset(since_ns, before_ns, since_ns),
        )

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
        return believe(self.mount, self.parameters, frames, lines, self.scenes.scenes, trail)
