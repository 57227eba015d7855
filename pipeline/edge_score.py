"""The score of an extrinsic: the weighted mean gradient response under all projected edges of some frames.

Edges of several frames lie in one set of arrays; the images stay where they are. A score is a sum over
edges, so what one frame adds to it can be known once and be added again (FORMULAS D2).
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline import cameras, se3
from pipeline.edges import CELLS, Edges
from pipeline.gradients import GradientPyramid, sample
from pipeline.records import CameraModel, Floats

UNITS = np.array([math.radians(0.25)] * 3 + [0.05] * 3)
"""Alert units in which steps are measured (0.25 deg, 5 cm): each matters about as much to perception."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFrame:
    """What the edge witness keeps of one frame.

    Attributes:
        stamp_ns: Stamp of the image.
        edges: Edges of the cloud.
        gradients: Gradients of the image.
        distance_m: Way driven so far, m.
        feigned: float64 (6,), drift in vehicle axes that an error of one sigma in the time between sweep and
            image would feign (FORMULAS G1).
        information: float64 (6,6), what the frame says by itself (:func:`edge_witness.information_of`).
    """

    stamp_ns: int
    edges: Edges
    gradients: GradientPyramid
    distance_m: float = 0.0
    feigned: Floats = field(default_factory=lambda: np.zeros(6))
    information: Floats = field(default_factory=lambda: np.zeros((6, 6)))


NEW_SCENE_M = 20.0
"""m driven after which a cell of the image shows other things: half of the range at which most edges lie."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeBatch:
    """Edges of several frames in one set of arrays.

    Attributes:
        position: float64 (N,3), metres, LiDAR frame.
        direction: float64 (N,3), unit, across the border, LiDAR frame.
        weight: float64 (N,).
        cell: int64 (N,), which part of the image on which stretch of road.
        slot: int64 (N,), frame that an edge belongs to, ascending.
        kind: uint8 (N,), what it is the edge of (``edge_parameters.KIND_NAMES``).
        images: For each level of the pyramid those of the frames, uint16 (4,h,w).
        scales: For each level, see ``gradients.GradientPyramid``.
        camera: Intrinsics.
        stamps_ns: Stamps of the frames.
    """

    position: Floats
    direction: Floats
    weight: Floats
    cell: NDArray[np.int64]
    slot: NDArray[np.int64]
    kind: NDArray[np.uint8]
    images: tuple[tuple[NDArray[np.uint16], ...], ...]
    scales: tuple[tuple[float, float], ...]
    camera: CameraModel
    stamps_ns: tuple[int, ...]

    def __len__(self) -> int:
        return len(self.weight)

    def thinned(self, stride: int) -> "EdgeBatch":
        """Every ``stride``-th edge, the same images."""
        return self._picked(slice(None, None, stride))

    def of_frames(self, frames: Sequence[int]) -> "EdgeBatch":
        """The edges of these frames only, given in ascending order."""
        number = np.full(len(self.stamps_ns), -1)
        number[list(frames)] = np.arange(len(frames))
        picked = self._picked(np.flatnonzero(number[self.slot] >= 0))
        return dataclasses.replace(
            picked,
            slot=number[picked.slot],
            images=tuple(tuple(level[k] for k in frames) for level in self.images),
            stamps_ns=tuple(self.stamps_ns[k] for k in frames),
        )

    def weights(self) -> Floats:
        """Sum of the weights of each frame, (F,)."""
        sums = np.bincount(self.slot, self.weight, minlength=len(self.stamps_ns))
        return np.asarray(sums, dtype=np.float64)

    def _picked(self, kept: "slice | NDArray[np.int64]") -> "EdgeBatch":
        return dataclasses.replace(
            self,
            # Coordinate by coordinate in memory: that is how they are worked on, some hundred times.
            position=np.asfortranarray(self.position[kept]),
            direction=np.asfortranarray(self.direction[kept]),
            weight=self.weight[kept].copy(),
            cell=self.cell[kept],
            slot=self.slot[kept].copy(),
            kind=self.kind[kept],
        )


def batch_of(frames: Sequence[EdgeFrame], camera: CameraModel, most_edges: int) -> EdgeBatch:
    """Joins frames of one camera, at least one; ``most_edges`` of all edges, evenly, where there are more."""
    total = sum(len(f.edges) for f in frames)
    stretches = [int((f.distance_m - frames[0].distance_m) // NEW_SCENE_M) for f in frames]
    levels = range(len(frames[0].gradients.levels))
    whole = EdgeBatch(
        position=np.concatenate([f.edges.position for f in frames]),
        direction=np.concatenate([f.edges.direction for f in frames]),
        weight=np.concatenate([f.edges.weight for f in frames]),
        cell=np.concatenate(
            [f.edges.cell + CELLS * stretch for f, stretch in zip(frames, stretches, strict=True)]
        ),
        slot=np.repeat(np.arange(len(frames)), [len(f.edges) for f in frames]),
        kind=np.concatenate([f.edges.kind for f in frames]),
        images=tuple(tuple(f.gradients.levels[level] for f in frames) for level in levels),
        scales=frames[0].gradients.scales,
        camera=camera,
        stamps_ns=tuple(f.stamp_ns for f in frames),
    )
    # Evenly: with every second edge or every third a window would know less for one frame more.
    kept = min(total, most_edges)
    return whole._picked(np.arange(kept) * total // max(kept, 1))  # noqa: SLF001 - of its own kind


def seen_from(batch: EdgeBatch, extrinsics: Sequence[Floats]) -> EdgeBatch:
    """The edges under each of the extrinsics at once: in the camera frame, as if each were a frame's own.

    Slots stay those of the frames; ``cell`` becomes the number of the extrinsic.
    """
    stack = np.stack(extrinsics)
    order = np.argsort(np.tile(batch.slot, len(stack)), kind="stable")
    number, edge = np.divmod(order, len(batch))
    points = np.einsum("kij,nj->kni", stack[:, :3, :3], batch.position) + stack[:, None, :3, 3]
    turned = np.einsum("kij,nj->kni", stack[:, :3, :3], batch.direction)
    return dataclasses.replace(
        batch,
        position=np.asfortranarray(points[number, edge]),
        direction=np.asfortranarray(turned[number, edge]),
        weight=batch.weight[edge],
        cell=number,
        slot=batch.slot[edge],
        kind=batch.kind[edge],
    )


def score(batch: EdgeBatch, T_cam_lidar: Floats, level: int) -> tuple[float, Floats, Floats]:
    """Score of an extrinsic, its gradient by xi, and each edge's share of that gradient.

    Returns:
        Score (weighted mean response), gradient float64 (6,) by (phi, rho) at ``T_cam_lidar``, and float64
        (N,6) whose sum is the gradient. The direction across each edge is held while differentiating.
    """
    return score_by_edge(batch, T_cam_lidar, level)[0]


def score_by_edge(
    batch: EdgeBatch, T_cam_lidar: Floats, level: int
) -> tuple[tuple[float, Floats, Floats], Floats]:
    """What :func:`score` and :func:`score_only` give, for the price of one."""
    value, by_point, points = _respond(batch, T_cam_lidar, level)
    total = float(batch.weight.sum())
    w = batch.weight / total
    share = np.empty((6, len(w)))
    _by_turn(points, by_point, share)
    share[3:] = by_point
    share *= w
    scored = float(batch.weight @ value) / total, share.sum(axis=1), share.T
    return scored, batch.weight * value


def score_and_gradient(batch: EdgeBatch, T_cam_lidar: Floats, level: int) -> tuple[float, Floats]:
    """The first two of :func:`score`, for a third less."""
    value, by_point, points = _respond(batch, T_cam_lidar, level)
    total = float(batch.weight.sum())
    turns = _by_turn(points, by_point, np.empty_like(points))
    return float(batch.weight @ value) / total, np.concatenate(
        [turns @ batch.weight, by_point @ batch.weight]
    ) / total


def _by_turn(points: Floats, by_point: Floats, out: Floats) -> Floats:
    """``p x s`` into the first rows of ``out``: the slope by a turn about the camera's centre (A2)."""
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[k] = points[i] * by_point[j] - points[j] * by_point[i]
    return out


def _respond(batch: EdgeBatch, T_cam_lidar: Floats, level: int) -> tuple[Floats, Floats, Floats]:
    """Response (N,) under each edge, its derivative (3,N) by the point, the points (3,N), camera frame."""
    count = len(batch)
    value, by_point, points = np.empty(count), np.empty((3, count)), np.empty((3, count))
    for first in range(0, count, _BLOCK):
        block = slice(first, first + _BLOCK)
        value[block] = _responded(batch, T_cam_lidar, level, block, (by_point[:, block], points[:, block]))
    return value, by_point, points


_BLOCK = 16384
"""Edges worked on at once: what is worked out on the way takes some 400 bytes for each."""


def _responded(
    batch: EdgeBatch, T_cam_lidar: Floats, level: int, block: slice, out: tuple[Floats, Floats]
) -> Floats:
    """Response of the edges in a ``block``; derivatives and points go to ``out``."""
    by_point, points = out
    R = T_cam_lidar[:3, :3]
    np.add(R @ batch.position[block].T, T_cam_lidar[:3, 3:], out=points)
    uv, valid, xy, A = cameras.project_with_slopes(batch.camera, points.T)
    turned = R @ batch.direction[block].T
    # The step along the direction, times the depth: its angle is all that is asked for.
    step = turned[:2] - xy.T * turned[2]
    angle = np.arctan2(
        A[:, 1, 0] * step[0] + A[:, 1, 1] * step[1], A[:, 0, 0] * step[0] + A[:, 0, 1] * step[1]
    )
    value, slope = sample(batch.images[level], batch.slot[block], uv, angle, batch.scales[level])
    if not valid.all():
        value, slope = np.where(valid, value, 0.0), np.where(valid[:, None], slope, 0.0)
    by_point[0] = slope[:, 0] * A[:, 0, 0] + slope[:, 1] * A[:, 1, 0]
    by_point[1] = slope[:, 0] * A[:, 0, 1] + slope[:, 1] * A[:, 1, 1]
    by_point[2] = -(by_point[0] * xy[:, 0] + by_point[1] * xy[:, 1])
    by_point /= np.where(valid, points[2], 1.0)
    return value


def score_only(batch: EdgeBatch, T_cam_lidar: Floats, level: int) -> Floats:
    """Weighted response of each edge, (N,); its sum over the sum of the weights is the score."""
    return batch.weight * _respond(batch, T_cam_lidar, level)[0]


def preference(batch: EdgeBatch, better: Floats, worse: Floats) -> float:
    """How clearly the cells of the image prefer one extrinsic to another, standard errors.

    A cell is one witness: what many edges of one cell have in common says no more than a few. Each difference
    counts by the root of the cell's weight, as a mean over so many edges would. A false mode that a few dense
    objects prefer scores more in the sum over edges, and does not here.

    Args:
        batch: Edges.
        better: float64 (N,), what :func:`score_only` gives under the one extrinsic.
        worse: The same under the other.
    """
    weight = np.bincount(batch.cell, batch.weight)
    seen = weight > 0
    gain = np.bincount(batch.cell, better - worse)[seen] / np.sqrt(weight[seen])
    scatter = float(np.sqrt((gain**2).sum()))
    return float(gain.sum()) / scatter if scatter > 0 else 0.0


def _by_frame_and_extrinsic(seen: EdgeBatch, values: Floats, extrinsics: int) -> Floats:
    """Sums (F,K) of values (N,) of edges of :func:`seen_from`."""
    frames = len(seen.stamps_ns)
    sums = np.bincount(seen.slot * extrinsics + seen.cell, values, minlength=frames * extrinsics)
    return np.asarray(sums, dtype=np.float64).reshape(frames, extrinsics)


def _parts(batch: EdgeBatch, extrinsics: int) -> Iterator[EdgeBatch]:
    """The batch by its frames, in their order, so few at once as are quickly seen from so many extrinsics."""
    edges = np.bincount(batch.slot, minlength=len(batch.stamps_ns))
    part = (np.cumsum(edges) - edges) * extrinsics // _SEEN_AT_ONCE
    for number in np.unique(part):
        yield batch.of_frames(np.flatnonzero(part == number).tolist())


_SEEN_AT_ONCE = 4 * _BLOCK
"""Edges under all of the extrinsics together that :func:`seen_from` makes, of some frames: 10 MB."""


def mean_responses(batch: EdgeBatch, extrinsics: Sequence[Floats]) -> Floats:
    """Weighted mean response of each frame under each extrinsic, (F,K)."""
    sums = []
    for part in _parts(batch, len(extrinsics)):
        seen = seen_from(part, extrinsics)
        sums.append(_by_frame_and_extrinsic(seen, score_only(seen, np.eye(4), 0), len(extrinsics)))
    return np.concatenate(sums) / batch.weights()[:, None]


def curvatures(batch: EdgeBatch, T_cam_lidar: Floats, difference: float) -> Floats:
    """Minus the Hessian of each frame's mean response, (F,6,6), alert units, by differences of gradients.

    Args:
        batch: Edges and gradients.
        T_cam_lidar: float64 (4,4), where.
        difference: Step to both sides, alert units.
    """
    steps = np.concatenate([np.eye(6), -np.eye(6)]) * difference * UNITS
    places, parts = [se3.retract(T_cam_lidar, step) for step in steps], []
    for part in _parts(batch, len(steps)):
        seen = seen_from(part, places)
        share = score(seen, np.eye(4), 0)[2] * seen.weight.sum() * UNITS
        parts.append(
            np.stack([_by_frame_and_extrinsic(seen, column, len(steps)) for column in share.T], axis=2)
        )
    sums = np.concatenate(parts)
    H = (sums[:, 6:] - sums[:, :6]) / (2.0 * difference * batch.weights()[:, None, None])
    return np.asarray(0.5 * (H + H.transpose(0, 2, 1)), dtype=np.float64)
