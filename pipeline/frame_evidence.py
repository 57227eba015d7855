"""What one pair of sweep and image says by itself: its motion, edges and lines.

Nothing here knows of the window or the verdict: a frame can be looked at while those before it are judged.
"""

import copy
import dataclasses
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from pipeline import edge_witness, line_witness, window
from pipeline.edge_parameters import RING_JUMP
from pipeline.edge_witness import EdgeFrame
from pipeline.edges import Edges, find_edges
from pipeline.ego import Ego, Straightened
from pipeline.gradients import gradient_pyramid
from pipeline.ground import Ground, fit_ground
from pipeline.line_witness import LineFrame
from pipeline.masks import horizon_line, masks_from_probabilities
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import FramePair, Masks, PointCloud
from pipeline.segmentation import Segmenter, grid_scale
from pipeline.sensor_seat import FULLER, SensorSeat, numbered, sensor_seat
from pipeline.spin_sense import ToldSpin

Stage: TypeAlias = Callable[[str], AbstractContextManager[None]]
"""Measures what is done inside it, under a name."""

DropReason: TypeAlias = Literal["image_size", "empty_cloud", "no_scan_pattern", "no_edges"]
"""Why a pair gave no evidence, closed list.

image_size: the image is not of the size that the intrinsics are for.
empty_cloud: the sweep holds no point.
no_scan_pattern: the cloud shows neither rings nor enough points and ground in view to do without, and the
    frame had no lines either.
no_edges: no edge of the cloud falls into the image.
"""


def unmeasured(name: str) -> AbstractContextManager[None]:
    """A stage whose cost nobody asked for."""
    del name
    return nullcontext()


_LEAST_EDGES = 20
"""Edges below which a frame says nothing: three per axis."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameEvidence:
    """What one frame gave.

    Attributes:
        dropped: Why it gave nothing, or None.
        cloud: The sweep as it was used.
        edge_points: float32 (M,3), points at jumps of range, LiDAR frame.
        straight: How the sweep was brought to the exposure; None where the pair was not looked at.
        edges: Its edges, or None where they are too few.
        masks: Its masks, or None where it got none.
        lines: Its lines, or None where it got none.
    """

    dropped: DropReason | None
    cloud: PointCloud
    edge_points: np.ndarray
    straight: Straightened | None = None
    edges: Edges | None = None
    masks: Masks | None = None
    lines: LineFrame | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Glimpse:
    """What one frame gave but for its edges.

    Attributes:
        dropped: Why it can not give anything, or None.
        cloud: The sweep as it was used.
        straight: How the sweep was brought to the exposure; None where the pair was not looked at.
        ground: In the sweep, or None where there is none.
        masks: Its masks, or None where it got none.
        lines: Its lines, or None where it got none.
    """

    dropped: DropReason | None
    cloud: PointCloud
    straight: Straightened | None = None
    ground: Ground | None = None
    masks: Masks | None = None
    lines: LineFrame | None = None


def _shows_lines(lines: LineFrame | None) -> bool:
    """Whether lines were looked for and found on both sides."""
    return lines is not None and bool(lines.cloud_lines) and bool(lines.image_lines)


def edge_frame(
    pair: FramePair, edges: Edges, straight: Straightened, mount: Mount, stage: Stage
) -> EdgeFrame:
    """Edges as a window keeps them, with the gradients of the image.

    Args:
        pair: Where they are from.
        edges: Of its sweep.
        straight: How the sweep was brought to the exposure.
        mount: What is stored of the pair.
        stage: Measures the stages.
    """
    with stage("gradients"):
        gradients = gradient_pyramid(pair.image, mount.camera)
    frame = EdgeFrame(pair.image_stamp_ns, edges, gradients, straight.distance_m, mount.feigned(straight))
    with stage("information"):
        information = edge_witness.information_of(frame, mount.camera, mount.T_cam_lidar)
    return dataclasses.replace(frame, information=information)


class Scout:
    """Looks at the frames of one pair in their order.

    Args:
        mount: What is stored of the pair.
        parameters: Settings.
        segmenter: The network, or None: no masks, no lines.
    """

    def __init__(self, mount: Mount, parameters: Parameters, segmenter: Segmenter | None) -> None:
        self._mount = mount
        self._parameters = parameters
        self._segmenter = segmenter
        self._ego = Ego(mount.up, mount.T_cam_lidar[2, :3], mount.spin)
        self._seat: SensorSeat | None = None
        self._seat_points = 0
        self._unnumbered = False
        self._lines_at: tuple[int, float] | None = None
        self._barren = False
        self._count = 0

    @property
    def count(self) -> int:
        """Pairs that were looked at."""
        return self._count

    @property
    def spin_contradicted(self) -> ToldSpin | None:
        """What the sweeps say of the rotation where they surely say other than is configured, else None."""
        return self._ego.contradicted

    def copy(self) -> "Scout":
        """Another scout that goes on from here."""
        other = copy.copy(self)
        other._ego = self._ego.copy()  # noqa: SLF001 - its own kind
        return other

    def forget(self) -> None:
        """The stream was interrupted: the next pair stands alone."""
        self._ego.forget()
        self._lines_at = None

    def look(self, pair: FramePair, stage: Stage = unmeasured) -> FrameEvidence:
        """Edges of the frame, and lines when they are due."""
        return self.with_edges(self.glimpse(pair, stage), stage)

    def glimpse(self, pair: FramePair, stage: Stage = unmeasured) -> Glimpse:
        """Everything but the edges of the frame: the next one needs nothing of those."""
        mount = self._mount
        if pair.image.size != (mount.camera.width, mount.camera.height):
            return Glimpse("image_size", pair.cloud)
        if len(pair.cloud) == 0:
            return Glimpse("empty_cloud", pair.cloud)
        self._count += 1
        rng = np.random.default_rng([self._parameters.seed, self._count])
        if self._seat is None or len(pair.cloud) > FULLER * self._seat_points:
            # Of the sweep as it was measured: straightening bends its rings.
            self._seat, self._seat_points = sensor_seat(pair.cloud), len(pair.cloud)
            self._unnumbered = numbered(pair.cloud, self._seat) is not None
        with stage("motion"):
            cloud = numbered(pair.cloud, self._seat) if self._unnumbered else None
            straight = self._ego.straighten(pair if cloud is None else dataclasses.replace(pair, cloud=cloud))
        pair = dataclasses.replace(pair, cloud=straight.cloud)
        with stage("ground"):
            ground = fit_ground(pair.cloud, mount.up, rng)
        masks, lines = None, None
        if self._lines_due(pair.image_stamp_ns, straight):
            masks, lines = self._lines_of(pair, ground, rng, stage)
            self._barren = not _shows_lines(lines)
        return Glimpse(None, pair.cloud, straight, ground, masks, lines)

    def with_edges(self, seen: Glimpse, stage: Stage = unmeasured) -> FrameEvidence:
        """What the frame gave, with its edges; by any scout that has seen a sweep of this pair."""
        nothing = np.zeros((0, 3), dtype=np.float32)
        if seen.straight is None or self._seat is None:
            return FrameEvidence(seen.dropped, seen.cloud, nothing)
        with stage("edges"):
            mount, seat, settings = self._mount, self._seat, self._parameters.edges
            T = mount.T_cam_lidar
            edges = find_edges(seen.cloud, seen.ground, mount.camera, T, settings, seat.origin, seat.axis)
        enough = edges if edges is not None and len(edges) >= _LEAST_EDGES else None
        dropped: DropReason | None = None
        if enough is None and not _shows_lines(seen.lines):
            dropped = "no_scan_pattern" if edges is None else "no_edges"
        points = nothing if edges is None else edges.position[edges.kind == RING_JUMP].astype(np.float32)
        return FrameEvidence(dropped, seen.cloud, points, seen.straight, enough, seen.masks, seen.lines)

    def _lines_due(self, now_ns: int, straight: Straightened) -> bool:
        """Whether the frame gets masks and lines; it is then the last that got them."""
        waited_ns, way_m = None, None
        if self._lines_at is not None:
            waited_ns = now_ns - self._lines_at[0]
            way_m = None if straight.twist is None else straight.distance_m - self._lines_at[1]
        every_ns = self._parameters.lines_every_ns
        due = window.lines_due(waited_ns, way_m, every_ns, self._parameters.window, barren=self._barren)
        if self._segmenter is None or not due:
            return False
        self._lines_at = (now_ns, straight.distance_m)
        return True

    def _lines_of(
        self, pair: FramePair, ground: Ground | None, rng: np.random.Generator, stage: Stage
    ) -> tuple[Masks, LineFrame]:
        """Masks and lines of the frame."""
        assert self._segmenter is not None  # noqa: S101 - lines are due with a network only
        mount = self._mount
        with stage("network"):
            probabilities = self._segmenter.probabilities(pair.image.pixels)
        with stage("masks"):
            up_cam = mount.T_cam_lidar[:3, :3] @ mount.up
            horizon = horizon_line(mount.camera, up_cam)
            masks = masks_from_probabilities(
                probabilities,
                pair.image.pixels,
                self._parameters.masks,
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
                origin=None if self._seat is None else self._seat.origin,
            )
        return masks, lines
