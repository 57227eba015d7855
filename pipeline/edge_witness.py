"""The second witness: how well the edges of the cloud lie on gradients of the image (PROBE sections 1, 4, 5).

The estimate is the maximum of the score near the stored extrinsic; its covariance is the sandwich
H^-1 G H^-1, where everything that falls into one cell of the image over the whole window counts as ONE
observation: the same car is one witness. What one frame adds to the score's curvature and what it scores by
chance is worked out once, when the frame enters the window.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import se3, trust_region
from pipeline.edge_score import (
    NEW_SCENE_M,
    UNITS,
    EdgeBatch,
    EdgeFrame,
    batch_of,
    curvatures,
    mean_responses,
    preference,
    score,
    score_and_gradient,
    score_by_edge,
    score_only,
)
from pipeline.edge_search import (
    EdgeWitnessParameters,
    Maxima,
    Scored,
    ascend,
    find_maxima,
    start_curvature,
)
from pipeline.records import CameraModel, Floats

__all__ = [
    "NEW_SCENE_M",
    "UNITS",
    "EdgeBatch",
    "EdgeFrame",
    "EdgeSolution",
    "EdgeWitnessParameters",
    "Trail",
    "ascend",
    "batch_of",
    "chance",
    "far_extrinsics",
    "information_of",
    "score",
    "score_only",
    "solve",
]


@dataclass(frozen=True, slots=True, eq=False)
class FrameShare:
    """What one frame adds to the sums over a window, per unit of its weight.

    Attributes:
        at: float64 (6,), xi at which the curvature was taken.
        curvature: float64 (6,6), minus the Hessian of its mean response, alert units.
        by_chance: float64 (K,), its mean response under each of the extrinsics of chance.
    """

    at: Floats
    curvature: Floats
    by_chance: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Trail:
    """What the solution of one window leaves to the next.

    Attributes:
        T_stored: float64 (4,4), the extrinsic that everything here is against.
        maxima: Those that are followed.
        inside: float64 (6,), the best xi inside the floor.
        shares: What each frame adds, by its stamp.
        places: float64 (4,4) each, the extrinsics of chance.
        doubted: Whether what was found is doubtful: the truth may then lie far off.
    """

    T_stored: Floats
    maxima: Maxima
    inside: Floats
    shares: Mapping[int, FrameShare]
    places: tuple[Floats, ...]
    doubted: bool = False


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
        preference: How clearly the cells of the image prefer the maximum to the best point inside the floor,
            standard errors (:func:`edge_score.preference`).
        block_gains: For each third of the window in time, its own score at the maximum over that at the best
            point inside the floor, minus 1.
        edges: Number of edges.
        frames: Number of frames.
        trail: What the next window may begin with.
    """

    xi: Floats
    covariance: Floats
    score: float
    score_stored: float
    contrast: float
    peak: float
    loss: float
    preference: float
    block_gains: tuple[float, ...]
    edges: int
    frames: int
    trail: Trail


def solve(
    batch: EdgeBatch,
    T_stored: Floats,
    floor: Floats,
    parameters: EdgeWitnessParameters,
    rng: np.random.Generator,
    trail: Trail | None = None,
) -> EdgeSolution:
    """Estimate over a window, with what a verdict needs beside it.

    Args:
        batch: Edges and gradients of the window's frames.
        T_stored: The stored extrinsic.
        floor: float64 (6,6), covariance of xi that is no drift: systematic floor and the stored extrinsic's
            own uncertainty, camera axes.
        parameters: See there.
        rng: Draws the extrinsics of chance, where there is no trail.
        trail: Of the window before; one against another extrinsic says nothing.
    """
    if trail is not None and not np.array_equal(trail.T_stored, T_stored):
        trail = None
    places = tuple(far_extrinsics(T_stored, parameters, rng)) if trail is None else trail.places
    known = None if trail is None else _curvature(batch, trail.shares)
    stored = score(batch, T_stored, 0)
    maxima, (xi, best) = find_maxima(
        batch,
        T_stored,
        stored,
        parameters,
        None if trail is None else trail.maxima,
        known,
        far=trail is None or trail.doubted,
    )
    T_best = se3.retract(T_stored, xi)
    shares = _shares(batch, T_stored, xi, places, {} if trail is None else trail.shares, parameters)
    H = _curvature(batch, shares)
    before = None if trail is None else (trail.inside, H)
    inside = _best_inside(batch, T_stored, (stored, best), floor, parameters, before)
    background, spread = _over_frames(batch, shares)
    (value, _, share), at_best = score_by_edge(batch, T_best, 0)
    at_inside = score_only(batch, se3.retract(T_stored, inside), 0)
    penalty = _PENALTY * float(inside @ np.linalg.solve(floor, inside))
    return EdgeSolution(
        xi=xi,
        covariance=sandwich(batch, H, share, parameters),
        score=value,
        score_stored=stored[0],
        contrast=best / background - 1.0 if background > 0 else 0.0,
        peak=(best - background) / spread if spread > 0 else 0.0,
        loss=max(0.0, 1.0 - float(at_inside.sum() / at_best.sum()) + penalty) if best > 0 else 0.0,
        preference=preference(batch, at_best, at_inside),
        block_gains=_block_gains(batch.slot, at_best, at_inside),
        edges=len(batch),
        frames=len(batch.stamps_ns),
        trail=Trail(T_stored, maxima, inside, shares, places),
    )


def _shares(
    batch: EdgeBatch,
    T_stored: Floats,
    xi: Floats,
    places: tuple[Floats, ...],
    known: Mapping[int, FrameShare],
    parameters: EdgeWitnessParameters,
) -> dict[int, FrameShare]:
    """What each frame of the batch adds; what is known and still holds at ``xi`` is not worked out again."""
    shares = {stamp: known[stamp] for stamp in batch.stamps_ns if stamp in known}
    new = [k for k, stamp in enumerate(batch.stamps_ns) if stamp not in shares]
    by_chance = {stamp: share.by_chance for stamp, share in shares.items()}
    if new:
        # Every third edge tells chance as well.
        scores = mean_responses(batch.thinned(_CHANCE_STRIDE).of_frames(new), places)
        by_chance.update({batch.stamps_ns[k]: row for k, row in zip(new, scores, strict=True)})
    off = [
        k
        for k, stamp in enumerate(batch.stamps_ns)
        if stamp not in shares or _apart(shares[stamp].at, xi) > parameters.difference
    ]
    if off:
        H = curvatures(batch.of_frames(off), se3.retract(T_stored, xi), parameters.difference)
        for k, curvature in zip(off, H, strict=True):
            stamp = batch.stamps_ns[k]
            shares[stamp] = FrameShare(xi, curvature, by_chance[stamp])
    return shares


def _apart(a: Floats, b: Floats) -> float:
    """Largest difference of two xi on any axis, alert units."""
    return float(np.abs((a - b) / UNITS).max())


def _curvature(batch: EdgeBatch, shares: Mapping[int, FrameShare]) -> Floats:
    """Minus the Hessian of the score over those frames of the batch whose share is known, alert units."""
    pairs = [
        (weight, shares[stamp].curvature)
        for weight, stamp in zip(batch.weights(), batch.stamps_ns, strict=True)
        if stamp in shares
    ]
    if not pairs:
        return np.eye(6)
    weights = np.array([weight for weight, _ in pairs])
    return np.asarray(np.tensordot(weights / weights.sum(), [H for _, H in pairs], 1), dtype=np.float64)


def _over_frames(batch: EdgeBatch, shares: Mapping[int, FrameShare]) -> tuple[float, float]:
    """Mean and standard deviation of the window's score at the extrinsics of chance."""
    weights = batch.weights()
    scores = weights @ np.stack([shares[stamp].by_chance for stamp in batch.stamps_ns]) / weights.sum()
    return float(scores.mean()), float(scores.std())


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


_PENALTY = 0.004
"""Score that one sigma^2 inside the floor costs, as a share of the best score (PROBE 5)."""


def _best_inside(
    batch: EdgeBatch,
    T_stored: Floats,
    scores: tuple[Scored, float],
    floor: Floats,
    parameters: EdgeWitnessParameters,
    known: tuple[Floats, Floats] | None,
) -> Floats:
    """The best xi when leaving the stored extrinsic costs by the floor: what needs no drift to explain it.

    ``scores`` are those at the stored extrinsic and at the maximum; ``known`` are the answer of the window
    before and the score's curvature.
    """
    (stored, gradient, share), best = scores
    inverse = np.linalg.inv(floor)
    scale = 1.0 / max(best, 1e-9)

    def cost(x: Floats) -> tuple[float, Floats]:
        xi = x * UNITS
        s, gradient = score_and_gradient(batch, se3.retract(T_stored, xi), 0)
        pull = inverse @ xi
        return (
            -s * scale + _PENALTY * float(xi @ pull),
            (-gradient * scale + 2.0 * _PENALTY * pull) * UNITS,
        )

    pull = 2.0 * _PENALTY * (UNITS[:, None] * inverse * UNITS[None, :])
    begin, start = np.zeros(6), (-stored * scale, -gradient * scale * UNITS)
    if known is None:
        B = start_curvature(share * UNITS, batch.weight, best)
    else:
        B = known[1]
        before = cost(known[0] / UNITS)
        begin, start = (known[0] / UNITS, before) if before[0] < start[0] else (begin, start)
    found, _ = trust_region.descend(
        cost, begin, start, B * scale + pull, parameters.step_limits[0], parameters.search
    )
    return np.asarray(found * UNITS, dtype=np.float64)


def sandwich(batch: EdgeBatch, H: Floats, share: Floats, parameters: EdgeWitnessParameters) -> Floats:
    """H^-1 G H^-1 with G summed over image cells across all frames (PROBE 4 c), times sigma_factor^2.

    Args:
        batch: Edges.
        H: float64 (6,6), minus the Hessian of the score at a maximum, alert units.
        share: float64 (N,6), what :func:`edge_score.score` gives there.
        parameters: See there.
    """
    H_inverse = inverse_curvature(H, parameters)
    cells = np.stack([np.bincount(batch.cell, weights=column) for column in (share * UNITS).T])
    G = cells @ cells.T
    C = H_inverse @ G @ H_inverse * parameters.sigma_factor**2
    # A direction that no cell pulls on has no stated error; the floor of H alone bounds it.
    C = C + 1e-8 * np.eye(6)
    return np.asarray(UNITS[:, None] * C * UNITS[None, :], dtype=np.float64)


def inverse_curvature(H: Floats, parameters: EdgeWitnessParameters) -> Floats:
    """H^-1 with the eigenvalues of H floored, float64 (6,6): alert units per slope."""
    values, vectors = np.linalg.eigh(H)
    values = np.maximum(values, parameters.eigenvalue_floor * max(float(values.max()), 1e-9))
    return np.asarray((vectors / values) @ vectors.T, dtype=np.float64)


def information_of(frame: EdgeFrame, camera: CameraModel, T_cam_lidar: Floats) -> Floats:
    """What a frame would say by itself, float64 (6,6), alert units: H G^-1 H by the gradients there.

    Good for a choice between frames, not for an estimate: the curvature is guessed from the gradients.
    """
    batch = batch_of([frame], camera, _ENOUGH_EDGES)
    value, _, share = score(batch, T_cam_lidar, 0)
    H = start_curvature(share * UNITS, batch.weight, value)
    cells = np.stack([np.bincount(batch.cell, weights=column) for column in (share * UNITS).T])
    # What no cell pulls on is not known, rather than known exactly.
    spread = cells @ cells.T + np.eye(6) * max(float(np.trace(cells @ cells.T)), 1e-12) * 1e-3
    return np.asarray(H @ np.linalg.solve(spread, H), dtype=np.float64)


_ENOUGH_EDGES = 600
"""Edges that tell a frame's information as well as all of them (PROBE 8)."""


_CHANCE_STRIDE = 3
"""Every third edge tells what chance gives."""


def chance(
    batch: EdgeBatch, T_stored: Floats, parameters: EdgeWitnessParameters, rng: np.random.Generator
) -> tuple[float, float]:
    """Mean and standard deviation of the score at far random extrinsics."""
    batch = batch.thinned(_CHANCE_STRIDE)
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
