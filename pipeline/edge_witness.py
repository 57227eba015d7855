"""The second witness: how well the edges of the cloud lie on gradients of the image (PROBE sections 1, 4, 5).

The score of an extrinsic is the weighted mean gradient response under all projected edges of a window of
frames. The estimate is its maximum near the stored extrinsic; its covariance is the sandwich H^-1 G H^-1,
where everything that falls into one cell of the image over the whole window counts as ONE observation: the
same car is one witness.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline import cameras, se3, trust_region
from pipeline.edges import CELLS, Edges
from pipeline.gradients import GradientPyramid, sample
from pipeline.records import CameraModel, Floats
from pipeline.trust_region import SearchParameters

UNITS = np.array([math.radians(0.25)] * 3 + [0.05] * 3)
"""Alert units in which steps are measured (0.25 deg, 5 cm): each matters about as much to perception."""


@dataclass(frozen=True, slots=True)
class EdgeWitnessParameters:
    """How the maximum is sought and how sure it is.

    Attributes:
        step_limits: Longest step at each level of the pyramid, alert units: what its blur can bridge.
        search: When the climb of one level ends; its lengths are alert units.
        difference: Step of the differences that give the Hessian, alert units.
        eigenvalue_floor: Smallest eigenvalue of the Hessian as a share of the largest.
        sigma_factor: Scatter of window estimates over their stated sigma on four drives (PROBE 4): k.
        least_gain: A maximum reached over a coarser level must score so much more to be preferred, share:
            coarse levels lead into false modes, which score up to 3 % more; real drifts gain over 12 %.
        stirring_gain: Where the best maximum scores so much more than the stored extrinsic, share, others are
            sought from further away: what looks like one small drift may be another, larger one.
        wide_gain: A maximum found from further away must score so much more than the best near one: false
            modes score up to 3 % more than the truth (PROBE 6).
        wide_rad: Turn about each axis from which it is sought.
        wide_m: Shift along each axis from which it is sought.
        farthest_rad: A maximum further from the stored extrinsic is not believed.
        farthest_m: Likewise.
        contrast_starts: Random extrinsics that tell the score of chance.
        contrast_rad: Their rotation: least and most.
        contrast_m: Their shift.
        most_edges: Edges of a window that are looked at: 600 a frame do as well as 1500 (PROBE 8).
    """

    step_limits: tuple[float, float, float] = (0.3, 0.6, 1.0)
    search: SearchParameters = field(default_factory=SearchParameters)
    difference: float = 0.3
    eigenvalue_floor: float = 0.01
    sigma_factor: float = 2.0
    least_gain: float = 0.02
    stirring_gain: float = 0.03
    wide_gain: float = 0.05
    wide_rad: float = math.radians(1.0)
    wide_m: float = 0.3
    farthest_rad: float = math.radians(5.0)
    farthest_m: float = 1.0
    contrast_starts: int = 48
    contrast_rad: tuple[float, float] = (math.radians(3.0), math.radians(6.0))
    contrast_m: float = 0.3
    most_edges: int = 10_000


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
    """

    stamp_ns: int
    edges: Edges
    gradients: GradientPyramid
    distance_m: float = 0.0
    feigned: Floats = field(default_factory=lambda: np.zeros(6))


NEW_SCENE_M = 20.0
"""m driven after which a cell of the image shows other things: half of the range at which most edges lie."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeBatch:
    """Edges of several frames in one set of arrays.

    ``slot`` says which frame an edge belongs to, ``cell`` which part of the image on which stretch of road,
    ``kind`` what it is the edge of (``edges.KIND_NAMES``).
    """

    position: Floats
    direction: Floats
    weight: Floats
    cell: NDArray[np.int64]
    slot: NDArray[np.int64]
    kind: NDArray[np.uint8]
    stacks: tuple[NDArray[np.uint16], ...]
    scales: tuple[tuple[float, float], ...]
    camera: CameraModel

    def __len__(self) -> int:
        return len(self.weight)

    def thinned(self, stride: int) -> "EdgeBatch":
        """Every ``stride``-th edge, the same images."""
        return dataclasses.replace(
            self,
            position=np.asfortranarray(self.position[::stride]),
            direction=np.asfortranarray(self.direction[::stride]),
            weight=self.weight[::stride].copy(),
            cell=self.cell[::stride],
            slot=self.slot[::stride].copy(),
            kind=self.kind[::stride],
        )


def batch_of(frames: Sequence[EdgeFrame], camera: CameraModel, most_edges: int) -> EdgeBatch:
    """Joins frames of one camera, at least one; every n-th edge where there are more than ``most_edges``."""
    total = sum(len(f.edges) for f in frames)
    kept = slice(None, None, max(1, -(-total // most_edges)))
    stretches = [int((f.distance_m - frames[0].distance_m) // NEW_SCENE_M) for f in frames]
    return EdgeBatch(
        # Coordinate by coordinate in memory: that is how they are worked on, some hundred times.
        position=np.asfortranarray(np.concatenate([f.edges.position for f in frames])[kept]),
        direction=np.asfortranarray(np.concatenate([f.edges.direction for f in frames])[kept]),
        weight=np.concatenate([f.edges.weight for f in frames])[kept],
        cell=np.concatenate(
            [f.edges.cell + CELLS * stretch for f, stretch in zip(frames, stretches, strict=True)]
        )[kept],
        slot=np.repeat(np.arange(len(frames)), [len(f.edges) for f in frames])[kept],
        kind=np.concatenate([f.edges.kind for f in frames])[kept],
        stacks=tuple(
            np.stack([f.gradients.levels[level] for f in frames])
            for level in range(len(frames[0].gradients.levels))
        ),
        scales=frames[0].gradients.scales,
        camera=camera,
    )


@dataclass(frozen=True, slots=True, eq=False)
class EdgeSolution:
    """The maximum of the score over a window.

    Attributes:
        xi: float64 (6,), against the stored extrinsic, camera axes.
        covariance: float64 (6,6) of xi: the sandwich times sigma_factor^2.
        score: Score at the maximum.
        score_stored: Score at the stored extrinsic.
        contrast: Score at the maximum over that of chance, minus 1.
        peak: Height of the maximum over chance, in standard deviations of the score at random extrinsics.
        loss: Share of the best score that is lost if the stored extrinsic may move inside the floor only (G
            of PROBE 5).
        block_gains: For each third of the window in time, its own score at the maximum over that at the best
            point inside the floor, minus 1.
        edges: Number of edges.
        frames: Number of frames.
    """

    xi: Floats
    covariance: Floats
    score: float
    score_stored: float
    contrast: float
    peak: float
    loss: float
    block_gains: tuple[float, ...]
    edges: int
    frames: int


def score(batch: EdgeBatch, T_cam_lidar: Floats, level: int) -> tuple[float, Floats, Floats]:
    """Score of an extrinsic, its gradient by xi, and each edge's share of that gradient.

    Returns:
        Score (weighted mean response), gradient float64 (6,) by (phi, rho) at ``T_cam_lidar``, and float64
        (N,6) whose sum is the gradient. The direction across each edge is held while differentiating.
    """
    value, by_point, points = _respond(batch, T_cam_lidar, level)
    total = float(batch.weight.sum())
    w = batch.weight / total
    share = np.empty((6, len(w)))
    _by_turn(points, by_point, share)
    share[3:] = by_point
    share *= w
    return float(batch.weight @ value) / total, share.sum(axis=1), share.T


def _score_and_gradient(batch: EdgeBatch, T_cam_lidar: Floats, level: int) -> tuple[float, Floats]:
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
    R = T_cam_lidar[:3, :3]
    points = R @ batch.position.T + T_cam_lidar[:3, 3:]
    uv, valid, xy, A = cameras.project_with_slopes(batch.camera, points.T)
    turned = R @ batch.direction.T
    # The step along the direction, times the depth: its angle is all that is asked for.
    step = turned[:2] - xy.T * turned[2]
    angle = np.arctan2(
        A[:, 1, 0] * step[0] + A[:, 1, 1] * step[1], A[:, 0, 0] * step[0] + A[:, 0, 1] * step[1]
    )
    value, slope = sample(batch.stacks[level], batch.slot, uv, angle, batch.scales[level])
    if not valid.all():
        value, slope = np.where(valid, value, 0.0), np.where(valid[:, None], slope, 0.0)
    by_point = np.empty_like(points)
    by_point[0] = slope[:, 0] * A[:, 0, 0] + slope[:, 1] * A[:, 1, 0]
    by_point[1] = slope[:, 0] * A[:, 0, 1] + slope[:, 1] * A[:, 1, 1]
    by_point[2] = -(by_point[0] * xy[:, 0] + by_point[1] * xy[:, 1])
    by_point /= np.where(valid, points[2], 1.0)
    return value, by_point, points


def score_only(batch: EdgeBatch, T_cam_lidar: Floats, level: int) -> Floats:
    """Weighted response of each edge, (N,); its sum over the sum of the weights is the score."""
    return batch.weight * _respond(batch, T_cam_lidar, level)[0]


def solve(
    batch: EdgeBatch,
    T_stored: Floats,
    floor: Floats,
    parameters: EdgeWitnessParameters,
    rng: np.random.Generator,
) -> EdgeSolution:
    """Estimate over a window, with what a verdict needs beside it.

    Args:
        batch: Edges and gradients of the window's frames.
        T_stored: The stored extrinsic.
        floor: float64 (6,6), covariance of xi that is no drift: systematic floor and the stored extrinsic's
            own uncertainty, camera axes.
        parameters: See there.
        rng: Draws the extrinsics of chance.
    """
    stored = score(batch, T_stored, 0)
    xi, best = _best_maximum(batch, T_stored, stored, parameters)
    T_best = se3.retract(T_stored, xi)
    background, spread = chance(batch, T_stored, parameters, rng)
    inside = _best_inside(batch, T_stored, (stored, best), floor, parameters)
    at_best = score_only(batch, T_best, 0)
    at_inside = score_only(batch, se3.retract(T_stored, inside), 0)
    penalty = _PENALTY * float(inside @ np.linalg.solve(floor, inside))
    return EdgeSolution(
        xi=xi,
        covariance=_covariance(batch, T_best, parameters),
        score=best,
        score_stored=stored[0],
        contrast=best / background - 1.0 if background > 0 else 0.0,
        peak=(best - background) / spread if spread > 0 else 0.0,
        loss=max(0.0, 1.0 - float(at_inside.sum() / at_best.sum()) + penalty) if best > 0 else 0.0,
        block_gains=_block_gains(batch.slot, at_best, at_inside),
        edges=len(batch),
        frames=len(batch.stacks[0]),
    )


_BLOCKS = 3
"""Parts of the window that must each prefer the new extrinsic: one passing truck is not three witnesses."""


def _block_gains(slot: NDArray[np.int64], at_best: Floats, at_inside: Floats) -> tuple[float, ...]:
    frames = int(slot.max()) + 1
    block = np.minimum(slot * _BLOCKS // max(frames, _BLOCKS), _BLOCKS - 1)
    best = np.bincount(block, at_best, minlength=_BLOCKS)
    inside = np.bincount(block, at_inside, minlength=_BLOCKS)
    return tuple(
        float(b / i - 1.0) if i > 0 else 0.0 for b, i in zip(best, inside, strict=True) if b > 0 or i > 0
    )


_Scored: TypeAlias = tuple[float, Floats, Floats]
"""What :func:`score` gives."""


def _best_maximum(
    batch: EdgeBatch, T_stored: Floats, stored: _Scored, parameters: EdgeWitnessParameters
) -> tuple[Floats, float]:
    """The nearest maximum, unless one that a coarser level leads to scores clearly more."""
    nearest, value = ascend(batch, T_stored, np.zeros(6), 0, parameters, stored)
    xi, best = np.zeros(6), stored[0]
    thin = batch.thinned(_COARSE_STRIDE)
    for schedule in ((), (1, 0), (2, 1, 0)):
        candidate = nearest if not schedule else np.zeros(6)
        for level in schedule:
            candidate, _ = ascend(thin, T_stored, candidate, level, parameters)
        if schedule and np.linalg.norm((candidate - nearest) / UNITS) < _SAME_MODE:
            continue
        if schedule:
            candidate, value = ascend(batch, T_stored, candidate, 0, parameters)
        wanted = best * (1.0 + parameters.least_gain) if schedule else best
        if value > wanted and _near(candidate, parameters):
            xi, best = candidate, value
    if best <= stored[0] * (1.0 + parameters.stirring_gain):
        return xi, best
    candidate, value = _from_further_away(batch, thin, T_stored, xi, parameters)
    better = value > best * (1.0 + parameters.wide_gain) and _near(candidate, parameters)
    return (candidate, value) if better else (xi, best)


def _near(xi: Floats, parameters: EdgeWitnessParameters) -> bool:
    """Whether an answer lies where it may be believed."""
    turn, shift = float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))
    return turn <= parameters.farthest_rad and shift <= parameters.farthest_m


def _from_further_away(
    batch: EdgeBatch, thin: EdgeBatch, T_stored: Floats, xi: Floats, parameters: EdgeWitnessParameters
) -> tuple[Floats, float]:
    """The highest maximum reached from turns and shifts of each axis, both ways; its score."""
    steps = np.diag([parameters.wide_rad] * 3 + [parameters.wide_m] * 3)
    top, height = xi, score(thin, se3.retract(T_stored, xi), 0)[0]
    for start in np.concatenate([steps, -steps]):
        reached, _ = ascend(thin, T_stored, start, 1, parameters)
        reached, value = ascend(thin, T_stored, reached, 0, parameters)
        if value > height and _near(reached, parameters):
            top, height = reached, value
    return ascend(batch, T_stored, top, 0, parameters)


_COARSE_STRIDE = 3
"""Every third edge leads through the coarse levels; all of them decide."""

_SAME_MODE = 1.0
"""Alert units; maxima nearer to each other are one, found twice."""


def ascend(
    batch: EdgeBatch,
    T_stored: Floats,
    xi: Floats,
    level: int,
    parameters: EdgeWitnessParameters,
    scored: _Scored | None = None,
) -> tuple[Floats, float]:
    """The top reached from ``xi``, whose score may be known, at one level of the pyramid; its score.

    Args:
        batch: Edges and gradients.
        T_stored: float64 (4,4), the extrinsic that ``xi`` perturbs.
        xi: float64 (6,), where the climb begins, camera axes.
        level: Of the pyramid.
        parameters: See there.
        scored: What :func:`score` gives at ``xi``, where it is known.
    """

    def negative(x: Floats) -> tuple[float, Floats]:
        s, gradient = _score_and_gradient(batch, se3.retract(T_stored, x * UNITS), level)
        # Gradient by xi at a point away from the reference: retraction composes to first order (A2).
        return -s, -gradient * UNITS

    value, gradient, share = scored or score(batch, se3.retract(T_stored, xi), level)
    curvature = _start_curvature(share * UNITS, batch.weight, value)
    start = (-value, -gradient * UNITS)
    x, least = trust_region.descend(
        negative, xi / UNITS, start, curvature, parameters.step_limits[level], parameters.search
    )
    return np.asarray(x * UNITS, dtype=np.float64), -least


def _start_curvature(share: Floats, weight: Floats, value: float) -> Floats:
    """First guess of the curvature from the edges' gradients g (PROBE 1): 4/s sum w g g^T / sum w."""
    total = float(weight.sum())
    per_edge = share * (total / np.maximum(weight, 1e-12))[:, None]
    outer = (per_edge * (weight / total)[:, None]).T @ per_edge
    return np.asarray(4.0 / max(value, 1e-6) * outer + 1e-6 * np.eye(6), dtype=np.float64)


_PENALTY = 0.004
"""Score that one sigma^2 inside the floor costs, as a share of the best score (PROBE 5)."""


def _best_inside(
    batch: EdgeBatch,
    T_stored: Floats,
    scores: tuple[_Scored, float],
    floor: Floats,
    parameters: EdgeWitnessParameters,
) -> Floats:
    """The best xi when leaving the stored extrinsic costs by the floor: what needs no drift to explain it.

    ``scores`` are those at the stored extrinsic and at the maximum.
    """
    (stored, gradient, share), best = scores
    inverse = np.linalg.inv(floor)
    scale = 1.0 / max(best, 1e-9)

    def cost(x: Floats) -> tuple[float, Floats]:
        xi = x * UNITS
        s, gradient = _score_and_gradient(batch, se3.retract(T_stored, xi), 0)
        pull = inverse @ xi
        return (
            -s * scale + _PENALTY * float(xi @ pull),
            (-gradient * scale + 2.0 * _PENALTY * pull) * UNITS,
        )

    B = _start_curvature(share * UNITS, batch.weight, best) * scale
    B = B + 2.0 * _PENALTY * (UNITS[:, None] * inverse * UNITS[None, :])
    start = (-stored * scale, -gradient * scale * UNITS)
    found, _ = trust_region.descend(cost, np.zeros(6), start, B, parameters.step_limits[0], parameters.search)
    return np.asarray(found * UNITS, dtype=np.float64)


def _covariance(batch: EdgeBatch, T: Floats, parameters: EdgeWitnessParameters) -> Floats:
    """H^-1 G H^-1 with G summed over image cells across all frames (PROBE 4 c), times sigma_factor^2."""
    H = np.zeros((6, 6))
    for axis in range(6):
        step = np.zeros(6)
        step[axis] = parameters.difference
        ahead = _score_and_gradient(batch, se3.retract(T, step * UNITS), 0)[1] * UNITS
        behind = _score_and_gradient(batch, se3.retract(T, -step * UNITS), 0)[1] * UNITS
        H[axis] = -(ahead - behind) / (2.0 * parameters.difference)
    values, vectors = np.linalg.eigh(0.5 * (H + H.T))
    values = np.maximum(values, parameters.eigenvalue_floor * max(float(values.max()), 1e-9))
    H_inverse = (vectors / values) @ vectors.T
    share = score(batch, T, 0)[2] * UNITS
    cells = np.stack([np.bincount(batch.cell, weights=column) for column in share.T])
    G = cells @ cells.T
    C = H_inverse @ G @ H_inverse * parameters.sigma_factor**2
    # A direction that no cell pulls on has no stated error; the floor of H alone bounds it.
    C = C + 1e-8 * np.eye(6)
    return np.asarray(UNITS[:, None] * C * UNITS[None, :], dtype=np.float64)


def chance(
    batch: EdgeBatch, T_stored: Floats, parameters: EdgeWitnessParameters, rng: np.random.Generator
) -> tuple[float, float]:
    """Mean and standard deviation of the score at far random extrinsics."""
    batch = batch.thinned(_COARSE_STRIDE)
    scores = [float(score_only(batch, T, 0).sum()) for T in far_extrinsics(T_stored, parameters, rng)]
    weight = float(batch.weight.sum())
    return float(np.mean(scores)) / weight, float(np.std(scores)) / weight


def far_extrinsics(
    T_cam_lidar: Floats, parameters: EdgeWitnessParameters, rng: np.random.Generator
) -> Iterator[Floats]:
    """Random extrinsics so far from the given one that what fits there fits by chance."""
    for _ in range(parameters.contrast_starts):
        axis, shift = rng.normal(size=3), rng.normal(size=3)
        angle = rng.uniform(*parameters.contrast_rad)
        turn = axis / np.linalg.norm(axis) * angle
        xi = np.concatenate([turn, shift / np.linalg.norm(shift) * parameters.contrast_m])
        yield se3.retract(T_cam_lidar, xi)
