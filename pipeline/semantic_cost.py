"""How well the points of lanes and poles meet their masks: J of CRLF (9) and the search for its maximum.

J does not say which point belongs to which stroke: it needs no matching, and has side maxima. It serves to
rank coarse candidates and to draw one of them in; where lines can be matched, ``pipeline.plk`` is sharper.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline import se3
from pipeline.cameras import NEAREST_DEPTH_M, lens_models, lens_of, limit_of, project
from pipeline.errors import InputError
from pipeline.height_maps import Floats32, HeightMaps
from pipeline.records import CameraModel, CloudLine, Floats, PointCloud, read_only

_BLOCK = 1 << 17
"""Points times samples looked up at once: half a MB an array, which stays in the processor's cache."""
_MOST_POINTS = 1 << 14
"""Points, and samples, of one block: ``cv2.remap`` counts columns and rows in 16 bits."""


@dataclass(frozen=True, slots=True, eq=False)
class SemanticPoints:
    """The points P of CRLF (3) and CRLF (6).

    Attributes:
        lane: float32 (N,3), metres, LiDAR frame.
        pole: float32 (M,3), likewise.
    """

    lane: Floats32
    pole: Floats32

    def __post_init__(self) -> None:
        for name in ("lane", "pole"):
            array = np.asarray(getattr(self, name), dtype=np.float32)
            if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
                raise InputError(f"{name} points {array.shape} are not finite (N,3) coordinates")
            object.__setattr__(self, name, read_only(array))


def points_of_lines(cloud: PointCloud, lines: Sequence[CloudLine]) -> SemanticPoints:
    """The points of a cloud that its lane lines and its poles were fitted to."""
    lane, pole = (
        np.unique(
            np.concatenate([np.zeros(0, np.int64), *(line.points for line in lines if line.label == label)])
        )
        for label in ("lane", "pole")
    )
    return SemanticPoints(cloud.xyz[lane], cloud.xyz[pole])


def points_in_view(points: SemanticPoints, camera: CameraModel, T_cam_lidar: Floats) -> SemanticPoints:
    """The points that project into the image under an extrinsic (4,4), the coarse one say.

    J falls by each point that leaves the image and rises by each that enters it, mask or not: a search over
    the points all around a LiDAR ends where most of them are in view, so it begins with those that are.
    """
    lane, pole = (xyz[project(camera, se3.apply(T_cam_lidar, xyz))[1]] for xyz in (points.lane, points.pole))
    return SemanticPoints(lane, pole)


def semantic_cost(
    T_cam_lidar: Floats, points: SemanticPoints, maps: HeightMaps, camera: CameraModel
) -> Floats:
    """J of CRLF (9) for many extrinsics at once.

    The mean height over ALL points of each class, summed over the classes: points that do not project into
    the image, nearer than 0.1 m or beyond the lens among them, count 0. A class without points is left out.

    Args:
        T_cam_lidar: float64 (S,4,4).
        points: Points of both classes.
        maps: Their height maps, of the raw image.
        camera: Intrinsics of the raw image.

    Returns:
        float64 (S,), 0..2; of use only against J of the same points and maps.
    """
    total = np.zeros(len(T_cam_lidar))
    for xyz, heights in ((points.lane, maps.lane), (points.pole, maps.pole)):
        for first in range(0, len(xyz), _MOST_POINTS):
            some = xyz[first : first + _MOST_POINTS]
            step = max(1, min(_BLOCK // len(some), _MOST_POINTS))
            for k in range(0, len(total), step):
                block = slice(k, k + step)
                total[block] += _heights(T_cam_lidar[block], some, heights, maps, camera) / len(xyz)
    return total


def _heights(
    T: Floats, xyz: Floats32, heights: Floats32, maps: HeightMaps, camera: CameraModel
) -> NDArray[np.float64]:
    """Sums (S,) of the heights at which points (P,3) land under extrinsics (S,4,4).

    Looked up bilinearly: with the nearest px J is a stair too coarse for the last stages of a search.
    """
    homogeneous = np.concatenate([xyz.T, np.ones((1, len(xyz)), dtype=np.float32)])
    grid = _grid_matrix(maps, camera)
    straight = lens_of(camera) is lens_models()["pinhole"]
    rows = (grid @ T[:, :3] if straight else T[:, :3]).astype(np.float32)
    z = rows[:, 2] @ homogeneous
    seen = z > NEAREST_DEPTH_M
    np.copyto(z, np.float32(1.0), where=~seen)
    u, v = rows[:, 0] @ homogeneous, rows[:, 1] @ homogeneous
    u /= z
    v /= z
    if not straight:
        u, v = _bent(u, v, seen, camera, grid)
    # Edges of the image, half a px beyond the outermost pixel centres, on the grid.
    right = np.float32(maps.scale_x * camera.width - 0.5)
    bottom = np.float32(maps.scale_y * camera.height - 0.5)
    seen &= (u >= np.float32(-0.5)) & (u < right) & (v >= np.float32(-0.5)) & (v < bottom)
    found = cv2.remap(heights, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.einsum("sp,sp->s", found, seen, dtype=np.float64))


def _grid_matrix(maps: HeightMaps, camera: CameraModel) -> Floats:
    """Maps ``(x, y, 1)`` of the bent ray to the grid of the maps, (3,3)."""
    grid = np.diag([maps.scale_x, maps.scale_y, 1.0])
    grid[:2, 2] = 0.5 * np.array([maps.scale_x, maps.scale_y]) - 0.5
    return np.asarray(grid @ camera.K)


def _bent(
    x: Floats32, y: Floats32, seen: NDArray[np.bool_], camera: CameraModel, grid: Floats
) -> tuple[Floats32, Floats32]:
    """Grid coordinates (S,P) of slopes (S,P); clears ``seen`` beyond the fold of the lens."""
    seen &= x * x + y * y < limit_of(camera) ** 2
    slopes = np.column_stack([np.where(seen, x, 0.0).ravel(), np.where(seen, y, 0.0).ravel()])
    bent = lens_of(camera).distort(slopes, camera.D)
    where = (bent @ grid[:2, :2].T + grid[:2, 2]).astype(np.float32)
    return where[:, 0].reshape(x.shape), where[:, 1].reshape(x.shape)


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """Where a search for the maximum of J ended.

    Attributes:
        T_cam_lidar: float64 (4,4).
        cost: J there under the last maps.
        evaluations: Extrinsics at which J was computed.
    """

    T_cam_lidar: Floats
    cost: float
    evaluations: int


@dataclass(frozen=True, slots=True)
class RandomSearchParameters:
    """Algorithm 1 of CRLF with the corrections of FORMULAS B (14).

    Attributes:
        angle: rad; theta0. The printed 0.1 deg can not be meant: it never arrives.
        shift: m; t0.
        samples: Per stage; 10000 in the paper, of which a quarter suffices.
        decay: k, factor of the step from stage to stage.
    """

    angle: float = 0.1
    shift: float = 1.0
    samples: int = 2500
    decay: float = 0.1


def random_search(
    T_start: Floats,
    points: SemanticPoints,
    maps: Sequence[HeightMaps],
    camera: CameraModel,
    rng: np.random.Generator,
    parameters: RandomSearchParameters = RandomSearchParameters(),
) -> Refinement:
    """Algorithm 1 of CRLF: random steps from the best extrinsic so far, smaller from stage to stage.

    It seeks the maximum of J, CRLF (14).

    ``R <- Exp(eta dr) R, t <- t + eta dt``, the decoupled update. Samples are judged in blocks and the first
    improvement is taken, after which the rest is judged anew: the outcome is that of one after the other.

    Args:
        T_start: float64 (4,4).
        points: Points of both classes.
        maps: Of each stage, eta = 1, 0.1, ...; plateau, plateau, ridge, ridge is best (FORMULAS B (14)).
        camera: Intrinsics.
        rng: Draws the steps.
        parameters: Widths and number of the steps.

    Raises:
        InputError: No maps.
    """
    _require_stages(maps)
    R, t = T_start[:3, :3], T_start[:3, 3]
    evaluations, best = 0, 0.0
    for stage, heights in enumerate(maps):
        eta = parameters.decay**stage
        angle = rng.uniform(-parameters.angle, parameters.angle, parameters.samples)
        axis = rng.normal(size=(parameters.samples, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        turns = _rotations(eta * angle[:, None] * axis)
        shifts = eta * rng.uniform(-parameters.shift, parameters.shift, (parameters.samples, 3))
        # The maps may have changed, and heights of two modes do not compare.
        best = float(semantic_cost(_transforms(R[None], t[None]), points, heights, camera)[0])
        evaluations += 1
        done, block = 0, _FIRST_BLOCK
        while done < parameters.samples:
            some = slice(done, done + block)
            trials = _transforms(turns[some] @ R, t + shifts[some])
            costs = semantic_cost(trials, points, heights, camera)
            evaluations += len(costs)
            better = np.flatnonzero(costs > best)
            if len(better) == 0:
                done, block = done + block, min(2 * block, _LAST_BLOCK)
                continue
            first = int(better[0])
            R, t, best = trials[first, :3, :3], trials[first, :3, 3], float(costs[first])
            done, block = done + first + 1, max(_FIRST_BLOCK, first)
    return Refinement(se3.transform(se3.orthonormalised(R), t), best, evaluations)


_FIRST_BLOCK, _LAST_BLOCK = 8, 512
"""Samples judged at once: few where improvements come soon, for what follows one is judged again."""


def _require_stages(maps: Sequence[HeightMaps]) -> None:
    if not maps:
        raise InputError("a search without height maps", hint="one per stage: plateau, then ridge")


def _transforms(R: Floats, t: Floats) -> Floats:
    """4x4 matrices (S,4,4) of rotations (S,3,3) and translations (S,3)."""
    T = np.zeros((len(R), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, t, 1.0
    return T


def _rotations(phi: Floats) -> Floats:
    """Rotations (S,3,3) of axis-angle vectors (S,3)."""
    angle = np.linalg.norm(phi, axis=1)[:, None, None]
    W = np.zeros((len(phi), 3, 3))
    W[:, 0, 1], W[:, 0, 2], W[:, 1, 2] = -phi[:, 2], phi[:, 1], -phi[:, 0]
    W -= W.transpose(0, 2, 1)
    # sinc(x / pi) = sin x / x, and (1 - cos x) / x^2 = sinc(x / 2 pi)^2 / 2: no limit to take at 0.
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * W + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (W @ W)
    )


@dataclass(frozen=True, slots=True)
class EvolutionParameters:
    """Covariance matrix adaptation (Hansen's CMA-ES with its own standard weights and rates) on J.

    Attributes:
        angle: rad; standard deviation of the first generation: starts are some 6 deg off at worst.
        shift: m; likewise.
        narrow: Width at which the next stage begins, in units of the first.
        population: Extrinsics a generation: five times what six unknowns need, for J has side maxima.
        generations: Per stage, at most.
        least: Width at which a stage ends, in units of the first: 0.006 deg and 1 mm.
        reach: How far from the start the answer may lie on each axis, in units of the first width: 11 deg and
            2 m. From far behind all points fall on one pixel, which may well be on a mask.
    """

    angle: float = 0.05
    shift: float = 0.5
    narrow: float = 0.1
    population: int = 48
    generations: int = 60
    least: float = 0.002
    reach: float = 4.0

    def __post_init__(self) -> None:
        if self.population < _FEWEST:
            raise InputError(f"evolution: population {self.population} is below {_FEWEST}")


_FEWEST = 4
"""Extrinsics a generation: two parents, without which there is no covariance to learn."""


def evolution_search(
    T_start: Floats,
    points: SemanticPoints,
    maps: Sequence[HeightMaps],
    camera: CameraModel,
    rng: np.random.Generator,
    parameters: EvolutionParameters = EvolutionParameters(),
) -> Refinement:
    """The same maximum by evolution: it learns along which directions turns and shifts trade for each other.

    Random steps of one width for all directions creep along the ridge that lanes leave between roll and
    shift; steps of the learned covariance run along it.

    Args:
        T_start: float64 (4,4).
        points: Points of both classes.
        maps: Of each stage; plateau, then ridge.
        camera: Intrinsics.
        rng: Draws the generations.
        parameters: Widths, population and ends.

    Returns:
        The mean of the last generation, or the start where J says nothing against it.

    Raises:
        InputError: No maps.
    """
    _require_stages(maps)
    unit = np.array([parameters.angle] * 3 + [parameters.shift] * 3)
    mean, shape, width = np.zeros(6), np.eye(6), 1.0
    evaluations = 0
    for stage, heights in enumerate(maps):
        if stage > 0:
            width = parameters.narrow / np.sqrt(float(np.linalg.eigvalsh(shape)[-1]))
        state = _Generation(mean, shape, width, np.zeros(6), np.zeros(6))
        for _ in range(parameters.generations):
            values, axes = np.linalg.eigh(state.shape)
            steps = rng.normal(size=(parameters.population, 6)) * np.sqrt(np.maximum(values, 0.0)) @ axes.T
            places = state.mean + state.width * steps
            costs = semantic_cost(_retracted(T_start, unit * places), points, heights, camera)
            costs -= np.maximum(np.abs(places) - parameters.reach, 0.0).sum(axis=1)
            evaluations += len(costs)
            state = _next_generation(state, steps[np.argsort(-costs)], (values, axes))
            if state.width * np.sqrt(float(values[-1])) < parameters.least:
                break
        mean, shape = state.mean, state.shape
    both = np.concatenate([_retracted(T_start, (unit * mean)[None]), T_start[None]])
    costs = semantic_cost(both, points, maps[-1], camera)
    better = 0 if costs[0] > costs[1] else 1
    T = se3.transform(se3.orthonormalised(both[better, :3, :3]), both[better, :3, 3])
    return Refinement(T, float(costs[better]), evaluations + 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Generation:
    """Mean (6,), shape (6,6) and width of the steps, and both evolution paths (6,)."""

    mean: Floats
    shape: Floats
    width: float
    path_shape: Floats
    path_width: Floats


def _next_generation(state: _Generation, ranked: Floats, eigen: tuple[Floats, Floats]) -> _Generation:
    """One update of CMA-ES from steps (S,6), the best first, drawn with the eigen-decomposed shape."""
    n, half = ranked.shape[1], len(ranked) // 2
    weight = np.log(half + 0.5) - np.log(np.arange(1, half + 1))
    weight /= weight.sum()
    worth = 1.0 / float((weight**2).sum())
    c_width = (worth + 2) / (n + worth + 5)
    damping = 1 + c_width + 2 * max(0.0, np.sqrt((worth - 1) / (n + 1)) - 1)
    c_path = (4 + worth / n) / (n + 4 + 2 * worth / n)
    c_one = 2 / ((n + 1.3) ** 2 + worth)
    c_many = min(1 - c_one, 2 * (worth - 2 + 1 / worth) / ((n + 2) ** 2 + worth))
    values, axes = eigen
    chosen = ranked[:half]
    move = weight @ chosen
    white = axes @ ((axes.T @ move) / np.sqrt(np.maximum(values, 1e-20)))
    path_width = (1 - c_width) * state.path_width + np.sqrt(c_width * (2 - c_width) * worth) * white
    expected = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
    length = float(np.linalg.norm(path_width))
    # A long path means that the width lags behind; the shape must not take the blame.
    steady = length < (1.4 + 2 / (n + 1)) * expected
    path_shape = (1 - c_path) * state.path_shape + steady * np.sqrt(c_path * (2 - c_path) * worth) * move
    shape = (
        (1 - c_one - c_many) * state.shape
        + c_one * np.outer(path_shape, path_shape)
        + c_many * (chosen.T * weight) @ chosen
    )
    width = state.width * float(np.exp(c_width / damping * (length / expected - 1)))
    return _Generation(
        state.mean + state.width * move, 0.5 * (shape + shape.T), width, path_shape, path_width
    )


def _retracted(T: Floats, xi: Floats) -> Floats:
    """``se3.retract`` of one extrinsic by many xi (S,6): (S,4,4)."""
    E = _rotations(xi[:, :3])
    return _transforms(E @ T[:3, :3], E @ T[:3, 3] + xi[:, 3:])
