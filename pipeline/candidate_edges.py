"""Extrinsics that compete, judged by the edges of the cloud against the gradients of the image.

Lines that look alike leave several extrinsics open, and most of all the way along the road and the two ends
of it. Edges know nothing of lines: at a wrong extrinsic they meet gradients by chance only.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline import edge_witness, se3
from pipeline.edge_parameters import EdgeParameters
from pipeline.edge_witness import EdgeBatch, EdgeFrame, EdgeWitnessParameters
from pipeline.edges import CELLS, find_edges
from pipeline.gradients import GradientPyramid
from pipeline.ground import Ground
from pipeline.records import CameraModel, Floats, PointCloud


@dataclass(frozen=True, slots=True, eq=False)
class CandidateParameters:
    """How candidates are drawn in and compared.

    Attributes:
        reach_m: The way along the road is sought so far to both sides.
        step_m: Between places that are looked at: half of what the blurred gradients bridge at 10 m.
        places: Best places along the road that are climbed from, of each candidate.
        starts: Drawn around a prior: of six axes a third of two sigma each is one of 700.
        kept_starts: The best of them, which are climbed from.
        start_rad: rad; with ``start_m`` how far these are apart: what the coarsest level bridges.
        start_m: m, of the camera's centre.
        finalists: Distinct candidates that are judged by the edges of their own view.
        least_edges: Fewer say nothing.
        most_edges: Looked at, of each finalist.
        same_rad: rad; with ``same_m`` how near two candidates are that will end at one place.
        same_m: m, of the camera's centre.
        distinct_rad: rad; with ``distinct_m`` what makes a finalist a different answer: nearer ones are told
            apart by whoever refines the first.
        distinct_m: m, of the camera's centre.
        baseline_m: m; LiDAR and camera sit on one vehicle.
        edges: What counts as an edge.
        witness: How the climb works.
    """

    reach_m: float = 5.0
    step_m: float = 0.3
    places: int = 3
    starts: int = 700
    kept_starts: int = 12
    start_rad: float = math.radians(1.5)
    start_m: float = 0.3
    finalists: int = 8
    least_edges: int = 60
    most_edges: int = 1500
    same_rad: float = math.radians(0.5)
    same_m: float = 0.2
    distinct_rad: float = math.radians(2.0)
    distinct_m: float = 0.5
    baseline_m: float = 5.0
    edges: EdgeParameters = field(default_factory=EdgeParameters)
    witness: EdgeWitnessParameters = field(default_factory=EdgeWitnessParameters)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What candidates are judged by.

    Attributes:
        cloud: The sweep.
        ground: Its ground plane, the normal on the side of up.
        gradients: Of the image.
        camera: Intrinsics.
        origin: float64 (3,), where the sensor stands in the cloud's frame.
    """

    cloud: PointCloud
    ground: Ground
    gradients: GradientPyramid
    camera: CameraModel
    origin: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """A candidate drawn in by the edges.

    Attributes:
        T_cam_lidar: float64 (4,4).
        score: Mean response under the edges of its own view, 0..1.
        chance: The same at random extrinsics around it.
        peak: Score over chance, in standard deviations of the score at those.
        cells: float64 (CELLS,), share of each cell of the image in the score, less the mean: they sum to 0.
    """

    T_cam_lidar: Floats
    score: float
    chance: float
    peak: float
    cells: Floats


def judge_candidates(
    candidates: Floats,
    scene: Scene,
    parameters: CandidateParameters,
    rng: np.random.Generator,
    *,
    along_road: bool,
) -> tuple[Judged, ...]:
    """Draws candidates in by the edges and ranks what they end at.

    Args:
        candidates: float64 (N,4,4).
        scene: What they are judged by.
        parameters: See there.
        rng: Draws the extrinsics of chance.
        along_road: Whether the place along the road is open, in the direction the candidate looks.

    Returns:
        Distinct answers, the best first; none where the cloud shows too few edges.
    """
    reached: list[tuple[float, Floats]] = []
    for T in candidates:
        batch = _batch(T, scene, parameters)
        if batch is None:
            continue
        thin = batch.thinned(_STRIDE)
        for start in _places(thin, T, scene, parameters) if along_road else (T,):
            xi, value = edge_witness.ascend(thin, start, np.zeros(6), 1, parameters.witness)
            reached.append((value, se3.retract(start, xi)))
    reached = [pair for pair in reached if _is_near(pair[1], parameters)]
    if not reached:
        return ()
    order = sorted(reached, key=lambda pair: -pair[0])
    T = np.stack([pair[1] for pair in order])
    judged = []
    for k in distinct(T, parameters.same_rad, parameters.same_m)[: parameters.finalists].tolist():
        one = _judge(T[k], scene, parameters, rng)
        if one is not None and _is_near(one.T_cam_lidar, parameters):
            judged.append(one)
    return ranked(judged, parameters)


_STRIDE = 3
"""Every third edge leads to a place; all decide."""


def ranked(judged: Sequence[Judged], parameters: CandidateParameters) -> tuple[Judged, ...]:
    """Distinct answers, the best first."""
    if not judged:
        return ()
    order = sorted(judged, key=lambda one: -one.score)
    T = np.stack([one.T_cam_lidar for one in order])
    kept = distinct(T, parameters.distinct_rad, parameters.distinct_m).tolist()
    return tuple(order[k] for k in kept)


def distinct(T: Floats, angle: float, shift: float, most: int | None = None) -> NDArray[np.int64]:
    """Indices of extrinsics (N,4,4) that differ from every earlier one that was kept, by turn or by place.

    Args:
        T: The extrinsics, the best first.
        angle: rad; a larger turn is a difference.
        shift: m; likewise of the camera's centre.
        most: So many are kept; None: all.
    """
    kept: list[int] = []
    left = np.ones(len(T), dtype=np.bool_)
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    while left.any() and len(kept) != most:
        k = int(np.argmax(left))
        kept.append(k)
        chord = np.linalg.norm(T[:, :3, :3] - T[k, :3, :3], axis=(1, 2))
        turned = 2.0 * np.arcsin(np.minimum(1.0, chord / math.sqrt(8.0))) > angle
        left &= turned | (np.linalg.norm(centres - centres[k], axis=1) > shift)
        left[k] = False
    return np.array(kept, dtype=np.int64)


def best_starts(
    T: Floats, sigma: Floats, scene: Scene, p: CandidateParameters, rng: np.random.Generator
) -> Floats:
    """Where in a wide prior the edges begin to fit, by the coarsest level: float64 (N,4,4).

    Args:
        T: float64 (4,4), middle of the prior.
        sigma: float64 (6,), of (phi, rho), rad and m.
        scene: What fits.
        p: See there.
        rng: Draws the starts.
    """
    batch = _batch(T, scene, p)
    if batch is None:
        return np.zeros((0, 4, 4))
    thin = batch.thinned(_STRIDE)
    starts = np.stack([se3.retract(T, sigma * rng.normal(size=6)) for _ in range(p.starts)])
    score = np.array([float(edge_witness.score_only(thin, start, 2).sum()) for start in starts])
    starts = starts[np.argsort(-score, kind="stable")]
    return starts[distinct(starts, p.start_rad, p.start_m, p.kept_starts)]


def _is_near(T: Floats, p: CandidateParameters) -> bool:
    """Whether camera and LiDAR may sit on one vehicle: t is as long as they are apart."""
    return float(np.linalg.norm(T[:3, 3])) <= p.baseline_m


def _batch(T: Floats, scene: Scene, p: CandidateParameters) -> EdgeBatch | None:
    edges = find_edges(scene.cloud, scene.ground, scene.camera, T, p.edges, scene.origin)
    if edges is None or len(edges) < p.least_edges:
        return None
    return edge_witness.batch_of([EdgeFrame(0, edges, scene.gradients)], scene.camera, p.most_edges)


def _places(thin: EdgeBatch, T: Floats, scene: Scene, p: CandidateParameters) -> list[Floats]:
    """The best places (4,4) along the ground in the direction of view: local maxima of the blurred score."""
    up = scene.ground.normal
    ahead = T[2, :3] - (T[2, :3] @ up) * up
    length = float(np.linalg.norm(ahead))
    if length < _LOOKS_DOWN:
        return [T]
    count = round(p.reach_m / p.step_m)
    way = p.step_m * np.arange(-count, count + 1)
    starts = np.repeat(T[None], len(way), axis=0)
    starts[:, :3, 3] -= way[:, None] * (T[:3, :3] @ ahead / length)
    score = np.array([float(edge_witness.score_only(thin, start, 1).sum()) for start in starts])
    padded = np.concatenate([[-np.inf], score, [-np.inf]])
    tops = np.flatnonzero((score >= padded[:-2]) & (score >= padded[2:]))
    return [starts[k] for k in tops[np.argsort(-score[tops])][: p.places].tolist()]


_LOOKS_DOWN = 0.1
"""Sine of the angle between view and plumb line below which there is no direction ahead."""


def _judge(T: Floats, scene: Scene, p: CandidateParameters, rng: np.random.Generator) -> Judged | None:
    """A candidate climbed to the top with the edges of its own view."""
    batch = _batch(T, scene, p)
    if batch is None:
        return None
    xi, _ = edge_witness.ascend(batch.thinned(_STRIDE), T, np.zeros(6), 1, p.witness)
    xi, _ = edge_witness.ascend(batch, T, xi, 0, p.witness)
    T = se3.retract(T, xi)
    response = edge_witness.score_only(batch, T, 0)
    total = float(batch.weight.sum())
    score = float(response.sum()) / total
    cells = np.bincount(batch.cell, response - score * batch.weight, minlength=CELLS) / total
    chance, spread = edge_witness.chance(batch, T, p.witness, rng)
    return Judged(T, score, chance, (score - chance) / max(spread, 1e-9), cells)
