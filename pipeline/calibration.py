"""The extrinsic of some frames against a first guess: pairs in, an estimate with honest errors out.

Unlike the watch, which stays near the stored extrinsic and asks whether it still holds, a calibration doubts
its first guess: it looks at every fit within reach, and what rival fits leave open is not claimed.
"""

import dataclasses
from collections import Counter
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline import se3
from pipeline.cloud_lanes import find_lanes
from pipeline.cloud_poles import find_poles
from pipeline.edge_witness import EdgeBatch, EdgeFrame, batch_of
from pipeline.edges import Edges, find_edges
from pipeline.ego import Ego
from pipeline.frame_evidence import DropReason, Stage
from pipeline.frame_modes import EdgeModes, ModeParameters, Prior, evened, find_tops, joined_by, weighed
from pipeline.gradients import GradientPyramid, gradient_pyramid
from pipeline.ground import Ground, fit_ground
from pipeline.line_judge import LineJudge, judged_frame
from pipeline.line_witness import in_view
from pipeline.masks import horizon_line, masks_from_probabilities
from pipeline.mount import Mount
from pipeline.observability import Observability, observable
from pipeline.parameters import Parameters
from pipeline.records import AXES, CameraImage, Floats, FramePair, PointCloud, read_only
from pipeline.segmentation import Segmenter, grid_scale
from pipeline.sensor_seat import FULLER, SensorSeat, sensor_seat


@dataclass(frozen=True, slots=True)
class CalibrationParameters:
    """What a calibration rests on beside the settings of the watch.

    Attributes:
        prior: How far off the first guess may be.
        modes: How fits are sought and compared.
        most_frames: Frames of a drive that are solved jointly, evenly spread: 20 take 100 MB.
        line_frames: Frames of a drive whose lanes and poles judge between fits of the edges: the network
            takes a good part of the time.
        least_edges: Fewer edges fit anywhere: some five of them share an object, and six axes ask for three
            objects each.
        least_contrast: Score at the estimate over chance, minus 1 (as in the watch).
        least_peak: Height of the best fit over chance, in sigma of the score at random extrinsics: the
            highest of the ten thousand independent places within reach of the prior exceeds it in one case of
            a hundred.
    """

    prior: Prior = field(default_factory=Prior)
    modes: ModeParameters = field(default_factory=ModeParameters)
    most_frames: int = 20
    line_frames: int = 4
    least_edges: int = 100
    least_contrast: float = 0.15
    least_peak: float = 4.5


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """One place where the evidence fits.

    Attributes:
        T_cam_lidar: float64 (4,4).
        score: Mean response under the edges there.
        share: 0..1, how likely it is the right one; the shares of all modes add up to 1.
    """

    T_cam_lidar: Floats
    score: float
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """What the frames of one pair of sensors say.

    Attributes:
        T_estimated: float64 (4,4), the extrinsic; held directions keep the first guess.
        drift: float64 (6,), motion of the mount from the first guess to the estimate, vehicle axes in the
            order of ``records.AXES``, rad and m.
        covariance: float64 (6,6) of that drift: random error, rival modes and the floor between scenes; that
            of the first guess where nothing was found.
        observable: bool (6,), axes whose sigma is small enough (DESIGN 4), named by no held direction.
        held: Directions that are not known, named, weakest first, e.g. "pitch with up".
        reason: One clause: why something is not observable, or that all is.
        modes: The most likely first; empty where the frames have too few edges.
        contrast: Score of the first over that of chance, minus 1; 0 without modes.
        peak: Its height over chance, in sigma of the score at random extrinsics; 0 without modes.
        frames: Number of pairs that could be used.
        dropped: How many pairs gave nothing, by reason.
    """

    T_estimated: Floats
    drift: Floats
    covariance: Floats
    observable: NDArray[np.bool_]
    held: tuple[str, ...]
    reason: str
    modes: tuple[Mode, ...]
    contrast: float
    peak: float
    frames: int
    dropped: dict[DropReason, int]

    def __post_init__(self) -> None:
        for name in ("T_estimated", "drift", "covariance", "observable"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def sigma(self) -> Floats:
        """Standard deviation of each axis, float64 (6,), rad and m."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """What is kept of a frame: its edges are picked again where the estimate comes to lie."""

    stamp_ns: int
    cloud: PointCloud
    image: CameraImage
    ground: Ground | None
    edges: Edges
    gradients: GradientPyramid
    distance_m: float


def _unmeasured(name: str) -> AbstractContextManager[None]:
    """A stage whose cost nobody asked for."""
    del name
    return nullcontext()


class Calibrator:
    """Collects the frames of one pair of sensors; solves them all at the end.

    Args:
        mount: What is stored; its extrinsic is the first guess.
        parameters: Settings of the stages.
        segmenter: The network, or None: no masks, no lines.
        settings: Of the calibration.
    """

    def __init__(
        self,
        mount: Mount,
        parameters: Parameters,
        segmenter: Segmenter | None,
        settings: CalibrationParameters,
    ) -> None:
        self.mount = mount
        self.frames = 0
        self.dropped: Counter[DropReason] = Counter()
        self._parameters = parameters
        self._segmenter = segmenter
        self._settings = settings
        self._ego = Ego(mount.up, mount.T_cam_lidar[2, :3], mount.spin)
        self._seat: SensorSeat | None = None
        self._seat_points = 0
        self._kept: list[_Kept] = []
        self._stride = 1

    def step(self, pair: FramePair, stage: Stage = _unmeasured) -> DropReason | None:
        """Takes one pair in; says why it gave nothing, if so."""
        camera = self.mount.camera
        dropped: DropReason | None = None
        if pair.image.size != (camera.width, camera.height):
            dropped = "image_size"
        elif len(pair.cloud) == 0:
            dropped = "empty_cloud"
        if dropped is not None:
            self.dropped[dropped] += 1
            return dropped
        if self._seat is None or len(pair.cloud) > FULLER * self._seat_points:
            # Of the sweep as it was measured: straightening bends its rings.
            self._seat, self._seat_points = sensor_seat(pair.cloud), len(pair.cloud)
        with stage("motion"):
            straight = self._ego.straighten(pair)
        if self.frames % self._stride == 0:
            dropped = self._keep(dataclasses.replace(pair, cloud=straight.cloud), straight.distance_m, stage)
        if dropped is not None:
            self.dropped[dropped] += 1
            return dropped
        self.frames += 1
        return None

    def _keep(self, pair: FramePair, distance_m: float, stage: Stage) -> DropReason | None:
        """Keeps a frame, unless it has no edges; when there are too many, every second one goes."""
        rng = np.random.default_rng([self._parameters.seed, self.frames])
        with stage("ground"):
            ground = fit_ground(pair.cloud, self.mount.up, rng)
        with stage("edges"):
            edges = self._edges(pair.cloud, ground, self.mount.T_cam_lidar)
        if edges is None:
            return "no_scan_pattern"
        if len(edges) == 0:
            return "no_edges"
        with stage("gradients"):
            gradients = gradient_pyramid(pair.image, self.mount.camera)
        self._kept.append(
            _Kept(pair.image_stamp_ns, pair.cloud, pair.image, ground, edges, gradients, distance_m)
        )
        if len(self._kept) > self._settings.most_frames:
            self._kept = self._kept[::2]
            self._stride *= 2
        return None

    def _edges(self, cloud: PointCloud, ground: Ground | None, T_cam_lidar: Floats) -> Edges | None:
        seat, settings = self._seat, self._parameters.edges
        origin, axis = (None, None) if seat is None else (seat.origin, seat.axis)
        return find_edges(cloud, ground, self.mount.camera, T_cam_lidar, settings, origin, axis)

    def finish(self, stage: Stage = _unmeasured) -> Calibrated:
        """Solves all frames."""
        if sum(len(kept.edges) for kept in self._kept) < self._settings.least_edges:
            return self._nothing("image and cloud show too few edges that both could see")
        T_guess, modes, prior = self.mount.T_cam_lidar, self._settings.modes, self._settings.prior
        rng = np.random.default_rng(self._parameters.seed)
        with stage("search"):
            tops = find_tops(self._batch(self._kept), T_guess, prior, modes, rng)
        T_best = se3.retract(T_guess, tops[0][0])
        # The edges in view, and which stand for what part of it, are those of the best fit.
        batch = self._batch(self._picked_again(T_best))
        judge = None
        if self._segmenter is not None:
            with stage("lines"):
                judge = self._line_judge(self._segmenter, T_best)
                starts = judge.starts(T_guess, T_best, prior.sigma, rng)
                tops = joined_by(*starts, batch, T_guess, tops, prior, modes)
        with stage("refinement"):
            found = weighed(batch, T_guess, tops, prior, modes, rng, None if judge is None else judge.odds)
        return self.judged(found)

    def _line_judge(self, segmenter: Segmenter, T_best: Floats) -> LineJudge:
        """Lanes and poles of some frames, around what the best fit sees, and masks of their images."""
        mount = self.mount
        rng = np.random.default_rng(self._parameters.seed)
        horizon = horizon_line(mount.camera, T_best[:3, :3] @ mount.up)
        frames = []
        for kept in self._kept[:: -(-len(self._kept) // self._settings.line_frames)]:
            if kept.ground is None:
                continue
            pixels = kept.image.pixels
            probabilities = segmenter.probabilities(pixels)
            scale = grid_scale(*kept.image.size)
            masks = masks_from_probabilities(probabilities, pixels, self._parameters.masks, horizon, scale)
            seen = in_view(kept.cloud, mount.camera, T_best)
            origin = None if self._seat is None else self._seat.origin
            lines = [
                *find_lanes(kept.cloud, kept.ground, seen, rng, origin=origin),
                *find_poles(kept.cloud, kept.ground, seen, origin=origin),
            ]
            frames.append(judged_frame(kept.cloud, lines, masks, mount.camera))
        return LineJudge(tuple(frames), mount.camera)

    def _picked_again(self, T_cam_lidar: Floats) -> list[_Kept]:
        """The frames with the edges in view from another extrinsic; as before where one has none."""
        there = []
        for kept in self._kept:
            edges = self._edges(kept.cloud, kept.ground, T_cam_lidar)
            if edges is None or len(edges) == 0:
                return self._kept
            there.append(dataclasses.replace(kept, edges=edges))
        return there

    def _batch(self, frames: Sequence[_Kept]) -> EdgeBatch:
        joined = batch_of(
            [EdgeFrame(kept.stamp_ns, kept.edges, kept.gradients, kept.distance_m) for kept in frames],
            self.mount.camera,
            self._parameters.edge_witness.most_edges,
        )
        return evened(joined)

    def judged(self, found: EdgeModes) -> Calibrated:
        """Estimate, errors and words from the modes."""
        mount = self.mount
        T_guess = mount.T_cam_lidar
        modes = tuple(
            Mode(read_only(se3.retract(T_guess, xi)), score, float(share))
            for (xi, score), share in zip(found.tops, found.shares, strict=True)
        )
        B = se3.vehicle_block(mount.R_vehicle_cam)
        covariance = B @ found.covariance @ B.T + self._parameters.test.floor()
        information = np.asarray(np.linalg.inv(covariance), dtype=np.float64)
        if found.contrast < self._settings.least_contrast or found.peak < self._settings.least_peak:
            why = "image and cloud show nothing in common (dark, blocked, no edges, or a first guess far off)"
            return dataclasses.replace(
                self._nothing(why), modes=modes, contrast=found.contrast, peak=found.peak
            )
        seen = observable(information, mount.limits)
        # Held directions keep the first guess (FORMULAS D3).
        T_estimated = se3.retract(T_guess, B.T @ seen.restrict(B @ found.tops[0][0]))
        held = held_directions(seen)
        return Calibrated(
            T_estimated=T_estimated,
            drift=se3.mount_drift(T_guess, T_estimated, mount.R_vehicle_cam),
            covariance=covariance,
            observable=seen.axis_observed & ~leaning(seen).any(axis=0),
            held=held,
            reason=f"held: {', '.join(held)}" if held else "all six axes are observable",
            modes=modes,
            contrast=found.contrast,
            peak=found.peak,
            frames=self.frames,
            dropped=dict(self.dropped),
        )

    def _nothing(self, reason: str) -> Calibrated:
        """The first guess, and why it stays."""
        return Calibrated(
            T_estimated=self.mount.T_cam_lidar,
            drift=np.zeros(6),
            covariance=np.diag(self._settings.prior.sigma**2),
            observable=np.zeros(6, dtype=np.bool_),
            held=AXES,
            reason=reason,
            modes=(),
            contrast=0.0,
            peak=0.0,
            frames=self.frames,
            dropped=dict(self.dropped),
        )


_LEANS = 0.4
"""Share of an axis, in alert limits, from which on a direction is named after it."""


def leaning(seen: Observability) -> NDArray[np.bool_]:
    """For each held direction, the weakest first, the axes that it is named after, bool (H,6)."""
    return np.asarray(np.abs(seen.directions.T[~seen.observed]) >= _LEANS)


def held_directions(seen: Observability) -> tuple[str, ...]:
    """Names of the directions that are not observed, the weakest first: the axes that they lean on."""
    held = zip(seen.directions.T[~seen.observed], leaning(seen), strict=True)
    return tuple(
        " with ".join(AXES[k] for k in np.argsort(-np.abs(direction)) if leans[k])
        for direction, leans in held
    )
