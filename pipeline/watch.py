"""One pair of sensors watched: frames in, findings and a verdict out. The loop that every mode of use drives.

Pure: no files, no clock. What a stage costs is measured by the caller through ``stage``.
"""

import dataclasses
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from pipeline import drift_test, edge_witness, fusion, line_witness, se3, verdict, window
from pipeline.deskew import SpinSense
from pipeline.drift_test import Evidence, Judgement
from pipeline.edge_witness import EdgeFrame, EdgeSolution
from pipeline.edges import RING_JUMP, find_edges
from pipeline.ego import Ego, Straightened
from pipeline.fusion import Testimony
from pipeline.gradients import gradient_pyramid
from pipeline.ground import Ground, fit_ground
from pipeline.line_witness import LineFrame, LineSolution
from pipeline.masks import horizon_line, masks_from_probabilities
from pipeline.parameters import Parameters
from pipeline.records import CameraModel, Floats, FramePair, LineMatch, Masks, PointCloud, read_only
from pipeline.rings import sensor_origin
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

_LINES_FIT = 1e-3
"""Chance of right pairs to fit each other no better; below it some are wrong, nobody knows which."""

_LINES_REACH = 2.5
"""Sigmas of the prior of the matching: an answer beyond it comes from lines taken for each other."""


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """What is stored of a pair.

    Attributes:
        camera: Intrinsics.
        T_cam_lidar: float64 (4,4), the stored extrinsic.
        T_vehicle_lidar: float64 (4,4), or None: the stored camera's own axes stand in.
        sigma_rad: Uncertainty of the stored rotation per axis, rad.
        sigma_m: Uncertainty of the stored translation per axis, m.
        limits: float64 (6,), alert limits.
        required: Axes that must be monitored for 'healthy'.
        spin: Sense of rotation of the LiDAR where it is configured.
    """

    camera: CameraModel
    T_cam_lidar: Floats
    T_vehicle_lidar: Floats | None
    sigma_rad: float
    sigma_m: float
    limits: Floats
    required: tuple[str, ...]
    spin: SpinSense | None = None

    @property
    def R_vehicle_cam(self) -> Floats:  # noqa: N802 - the name of the rotation
        """Turns camera axes into vehicle axes, (3,3)."""
        return se3.vehicle_axes(self.T_cam_lidar, self.T_vehicle_lidar)

    @property
    def up(self) -> Floats:
        """Unit vector up, LiDAR frame."""
        return np.asarray(self.R_vehicle_cam[2] @ self.T_cam_lidar[:3, :3], dtype=np.float64)

    @property
    def forward(self) -> Floats:
        """Unit vector ahead (of the vehicle, else of the camera), LiDAR frame."""
        return np.asarray(self.R_vehicle_cam[0] @ self.T_cam_lidar[:3, :3], dtype=np.float64)

    def feigned(self, sweep: Straightened) -> Floats:
        """Drift (6,), vehicle axes, that one sigma of error in a sweep's time would feign (FORMULAS G1)."""
        R_vehicle_lidar = self.R_vehicle_cam @ self.T_cam_lidar[:3, :3]
        if sweep.twist is None:
            return np.array([0.0, 0.0, 0.0, sweep.sync_s * _ASSUMED_M_S, 0.0, 0.0])
        centre = -self.T_cam_lidar[:3, :3].T @ self.T_cam_lidar[:3, 3]
        velocity = sweep.twist.velocity + np.cross(sweep.twist.omega, centre)
        motion = np.concatenate([R_vehicle_lidar @ sweep.twist.omega, R_vehicle_lidar @ velocity])
        return np.asarray(sweep.sync_s * motion, dtype=np.float64)


_ASSUMED_M_S = 10.0
"""m/s ahead where the motion is not known: a street in town."""


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
class Belief:
    """What is believed after the last judgement.

    Attributes:
        judgement: The test's result.
        T_estimated: float64 (4,4), the estimated extrinsic.
        edges: The edge witness, or None where it said nothing.
        lines: The line witness, or None likewise.
        edges_drift: Its testimony in vehicle axes, or None.
        lines_drift: Likewise.
        matched: Lines matched in each frame of the window that has lines, heard or not.
    """

    judgement: Judgement
    T_estimated: Floats
    edges: EdgeSolution | None
    lines: LineSolution | None
    edges_drift: Testimony | None
    lines_drift: Testimony | None
    matched: tuple[tuple[LineMatch, ...], ...]


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
        self._begun_ns = 0
        self._judged_ns: int | None = None
        self._lines_ns: int | None = None
        self._count = 0

    @property
    def window_stamps(self) -> tuple[int, ...]:
        """Stamps of the frames in the window, ns."""
        return tuple(frame.stamp_ns for frame in self._edge_frames)

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
        judgement = self.belief.judgement if self.belief is not None else None
        self.memory = verdict.finish(self.memory, judgement, self._count, self.mount.required)

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
        self._lines_ns = None

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
        masks, lines = self._lines_of(pair, ground, rng, stage)
        enough = edges is not None and len(edges) >= _LEAST_EDGES
        if edges is not None and enough:
            with stage("gradients"):
                gradients = gradient_pyramid(pair.image, mount.camera)
            self._edge_frames.append(
                EdgeFrame(
                    pair.image_stamp_ns, edges, gradients, straight.distance_m, self.mount.feigned(straight)
                )
            )
        found_lines = lines is not None and bool(lines.cloud_lines) and bool(lines.image_lines)
        dropped: DropReason | None = None
        if not enough and not found_lines:
            dropped = "no_scan_pattern" if edges is None else "no_edges"
        self._retain()
        points = nothing if edges is None else edges.position[edges.kind == RING_JUMP].astype(np.float32)
        return Findings(dropped, pair.cloud, points, masks, lines, judged=False)

    def _lines_of(
        self, pair: FramePair, ground: Ground | None, rng: np.random.Generator, stage: Stage
    ) -> tuple[Masks | None, LineFrame | None]:
        """Masks and lines of the frame, if it is time for them."""
        now_ns, wait_ns = pair.image_stamp_ns, self.parameters.lines_every_ns
        due = self._lines_ns is None or now_ns - self._lines_ns >= wait_ns - wait_ns // 10
        if self._segmenter is None or not due:
            return None, None
        mount = self.mount
        self._lines_ns = now_ns
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
            kept = window.retained(list(self.window_stamps), settings)
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
        self.memory = verdict.advance(
            self.memory,
            self.belief.judgement,
            (self._shown_since(), now_ns),
            self.mount.required,
            self.mount.limits,
            self.parameters.verdict,
        )
        return Findings(
            None, findings.cloud, findings.edge_points, findings.masks, findings.lines, judged=True
        )

    def _shown_since(self) -> int:
        """Stamp from which three quarters of the window's frames are: a drift in all of those would show."""
        stamps = sorted(self.window_stamps or self.line_stamps)
        return stamps[len(stamps) // 4]

    def _believe(self) -> Belief | None:
        """Solves the window, fuses the witnesses, tests the stored extrinsic."""
        mount, test = self.mount, self.parameters.test
        R_vc = mount.R_vehicle_cam
        B = se3.vehicle_block(R_vc)
        C_ref = drift_test.stored_covariance(mount.sigma_rad, mount.sigma_m)
        floor = test.floor()
        feigned = np.mean([f.feigned for f in self._edge_frames] or [np.zeros(6)], axis=0)
        edges = self._solve_edges(B.T @ (floor + np.outer(feigned, feigned) + C_ref) @ B)
        matched = self._solve_lines()
        lines = matched if matched is not None and _testifies(matched) else None
        edges_drift = None if edges is None else _testimony(edges.xi, np.linalg.inv(edges.covariance), B)
        lines_drift = None
        if lines is not None:
            own = _testimony(lines.estimate.xi, lines.estimate.information, B)
            lines_drift = fusion.with_floor(own, test.lines_floor())
        if edges_drift is None and lines_drift is None:
            return None
        contradicted = False
        if edges_drift is not None and lines_drift is not None:
            contradicted = fusion.contradiction(fusion.with_floor(edges_drift, floor), lines_drift)
        fused = edges_drift or lines_drift
        assert fused is not None  # noqa: S101 - one of the two is there
        if edges_drift is not None and lines_drift is not None and not contradicted:
            fused = fusion.intersected(edges_drift, lines_drift)
        T_estimated = se3.retract(mount.T_cam_lidar, B.T @ fused.drift)
        evidence = Evidence(
            drift=se3.mount_drift(mount.T_cam_lidar, T_estimated, R_vc),
            covariance=fused.covariance(),
            loss=np.inf if edges is None else edges.loss,
            contrast=np.inf if edges is None else edges.contrast,
            peak=np.inf if edges is None else edges.peak,
            persistent=edges is None or min(edges.block_gains, default=0.0) > 0.0,
            frames=len(self._edge_frames),
            contradicted=contradicted,
            feigned=feigned,
        )
        return Belief(
            judgement=drift_test.judge(evidence, C_ref, mount.limits, test),
            T_estimated=read_only(T_estimated),
            edges=edges,
            lines=lines,
            edges_drift=edges_drift,
            lines_drift=lines_drift,
            matched=() if matched is None else matched.matches,
        )

    def _solve_edges(self, floor: Floats) -> EdgeSolution | None:
        if not self._edge_frames:
            return None
        settings = self.parameters.edge_witness
        batch = edge_witness.batch_of(tuple(self._edge_frames), self.mount.camera, settings.most_edges)
        rng = np.random.default_rng(self.parameters.seed)
        return edge_witness.solve(batch, self.mount.T_cam_lidar, floor, settings, rng)

    def _solve_lines(self) -> LineSolution | None:
        # Lines of before the window would testify to another mount.
        since = self._edge_frames[0].stamp_ns if self._edge_frames else 0
        frames = [frame for stamp, frame in self._line_frames if stamp >= since]
        if not frames:
            return None
        solution = line_witness.solve_lines(frames, self.mount.camera, self.mount.T_cam_lidar)
        return solution if solution.estimate.features > 0 else None


def _testifies(lines: LineSolution) -> bool:
    """Whether matched lines may be heard: fitting each other, within reach of the matching."""
    estimate = lines.estimate
    within = bool(np.all(np.abs(estimate.xi) <= _LINES_REACH * line_witness.PRIOR_SIGMA))
    return within and lines.fit >= _LINES_FIT


def _testimony(xi: Floats, information: np.ndarray, B: Floats) -> Testimony:
    """Drift in vehicle axes from xi and its information in camera axes (FORMULAS A4; B is orthogonal)."""
    return Testimony(B @ xi, B @ information @ B.T)
