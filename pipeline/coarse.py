"""The extrinsic of a rig that nobody knows yet, from two lanes and a pole of one frame (CRLF III-C).

All extrinsics that the three lines allow (``pipeline.line_triples``) are ranked by J
(``pipeline.semantic_cost``) above chance. The best few are drawn in by every line that they can match
(``pipeline.plk``) and ranked again. How far the best stays ahead of a different one is part of the answer.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline import plk
from pipeline.association import Association, associate, pairs_on_overlap
from pipeline.errors import InputError
from pipeline.height_maps import HeightMaps
from pipeline.line_triples import (
    Indices,
    Lines,
    NoTriples,
    NoTriplesReason,
    TripleParameters,
    Triples,
    enumerate_triples,
    is_usable,
    largest_lines,
)
from pipeline.records import CameraModel, CloudLine, Floats, ImageLine, LineMatch, read_only
from pipeline.semantic_cost import SemanticPoints, semantic_cost

_L = TypeVar("_L", CloudLine, ImageLine)

Reason: TypeAlias = NoTriplesReason | Literal["no candidate meets the masks"]
"""Why a scene gives no coarse extrinsic."""


@dataclass(frozen=True, slots=True)
class CoarseParameters:
    """What takes part in the ranking.

    Attributes:
        triples: Which lines correspond, and what is believable.
        all_lines: Longest lines of each class and sensor that may be matched in the end: a street has fewer,
            and a thousand would take minutes.
        points: Points of each class by which all candidates are ranked; the finalists meet all points.
        finalists: Different candidates that are drawn in by all lines.
        distinct_rad: rad; with ``distinct_m`` what makes a candidate a different one: twice the 3 deg and
            0.5 m asked of a coarse extrinsic, within which triples of the same lines scatter.
        distinct_m: m, of the translation.
    """

    triples: TripleParameters = field(default_factory=TripleParameters)
    all_lines: int = 16
    points: int = 200
    finalists: int = 6
    distinct_rad: float = math.radians(6.0)
    distinct_m: float = 1.0

    def __post_init__(self) -> None:
        for name, least in (("all_lines", 3), ("points", 1), ("finalists", 1)):
            if getattr(self, name) < least:
                raise InputError(f"coarse: {name} {getattr(self, name)} is below {least}")


@dataclass(frozen=True, slots=True, eq=False)
class CoarseSolution:
    """An extrinsic without any prior, and its rivals.

    Attributes:
        T_cam_lidar: float64 (4,4), the best.
        cost: J of it (plateau), over all points.
        margin: By how much it is ahead of the next distinct candidate, in heights above chance: near 0 the
            scene is ambiguous; inf where there is no other.
        candidates: float64 (k,4,4), distinct ones, the best first.
        costs: float64 (k,), J of each (plateau). Where many points are out of view a lower J may be better.
        matches: The lines that the best rests on: its own three at least, unless they share too little.
        tried: Roots that passed as believable.
    """

    T_cam_lidar: Floats
    cost: float
    margin: float
    candidates: Floats
    costs: Floats
    matches: tuple[LineMatch, ...]
    tried: int


@dataclass(frozen=True, slots=True, eq=False)
class NoCoarse:
    """The scene does not give an extrinsic, and why."""

    reason: Reason


def coarse_extrinsic(
    cloud_lines: Sequence[CloudLine],
    image_lines: Sequence[ImageLine],
    points: SemanticPoints,
    maps: HeightMaps,
    camera: CameraModel,
    *,
    up: Floats | None = None,
    parameters: CoarseParameters | None = None,
) -> CoarseSolution | NoCoarse:
    """Finds the extrinsic from one frame's lines without a prior (CRLF III-C; CRLF (10)-(13) in ``p3l``).

    Args:
        cloud_lines: Lanes and poles, LiDAR frame; ends in any order. Other classes take no part.
        image_lines: Lanes and poles, ideal px.
        points: Points of the lanes and poles of the cloud.
        maps: Plateau maps of the raw image's masks.
        camera: Intrinsics.
        up: float64 (3,), LiDAR frame, where up is, to some 45 deg; None: poles stand on the lanes' plane and
            tell it, and where one does not, both signs of the ground's normal are tried. A vector that is
            no direction gives no extrinsic.
        parameters: What takes part; None: the defaults.

    Returns:
        The extrinsic with its rivals, or why there is none. The camera is taken to be upright: rolled by less
        than 90 deg.
    """
    p = parameters or CoarseParameters()
    lines = largest_lines(cloud_lines, image_lines, p.triples)
    found = enumerate_triples(lines, camera, up, p.triples)
    if isinstance(found, NoTriples):
        return NoCoarse(found.reason)
    some = SemanticPoints(_spread(points.lane, p.points), _spread(points.pole, p.points))
    scores = semantic_cost(found.T_cam_lidar, some, above_chance(maps, SEEK), camera)
    order = np.argsort(-scores, kind="stable")[:_SHORTLIST]
    apart = order[_distinct(found.T_cam_lidar[order], p)][: _RIVALS * p.finalists]
    frame = _Frame(_longest(cloud_lines, p.all_lines), _longest(image_lines, p.all_lines), camera)
    fits = [_Fit(found.T_cam_lidar[k], _own_lines(lines, found, int(k), camera)) for k in apart]
    chance = above_chance(maps, SETTLE)
    drawn = [_drawn_in(fit, frame) for fit in fits[: p.finalists]]
    fits = [*_kept(fits[: p.finalists], drawn, points, chance, camera), *fits[p.finalists :]]
    best = int(np.argmax(semantic_cost(_extrinsics(fits), points, chance, camera)))
    # The lines that the triple's own uncertainty confused are told apart by what the others have added.
    fits[best] = _kept([fits[best]], [_drawn_in(fits[best], frame)], points, chance, camera)[0]
    T = _extrinsics(fits)
    final = semantic_cost(T, points, chance, camera)
    ranked = np.argsort(-final, kind="stable")
    ranked = ranked[_distinct(T[ranked], p)]
    costs = semantic_cost(T[ranked], points, maps, camera)
    if costs[0] <= 0.0:
        return NoCoarse("no candidate meets the masks")
    return CoarseSolution(
        read_only(T[ranked[0]]),
        float(costs[0]),
        float(final[ranked[0]] - final[ranked[1]]) if len(ranked) > 1 else math.inf,
        read_only(T[ranked]),
        read_only(costs),
        fits[ranked[0]].used.matches,
        len(found.T_cam_lidar),
    )


_CHANCE = 0.5
"""Height at which a point in view says nothing; nearer to a mask it speaks for a candidate, else against."""
SEEK, SETTLE = 3, 5
"""Powers of the heights: points say nothing 11 px or 1 deg beside a mask while triples of noisy lines
compete, and 7 px after all lines have drawn them in."""


def above_chance(maps: HeightMaps, power: int) -> HeightMaps:
    """Maps so many times steeper, by which points out of view count as chance and not as misses.

    A LiDAR that turns fully sees the road behind as well. By J itself the best camera is one far behind the
    vehicle that has all points in view, near the vanishing point, where with an e-fold of 50 px no mask is
    far. ``(gamma^d)^n`` is the plateau of ``gamma^n``.
    """
    lane, pole = (
        np.asarray(heights ** np.float32(power) - np.float32(_CHANCE), dtype=np.float32)
        for heights in (maps.lane, maps.pole)
    )
    return HeightMaps(lane, pole, maps.scale_x, maps.scale_y)


_RIVALS = 2
"""Times the finalists are compared in the end: those that were not drawn in may still be rivals."""
_SHORTLIST = 256
"""Best candidates among which distinct ones are sought: dozens of triples show the same extrinsic."""


def _spread(xyz: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    """At most so many of the points (N,3), evenly taken in their order."""
    if len(xyz) <= most:
        return xyz
    return xyz[np.linspace(0, len(xyz) - 1, most).astype(np.int64)]


def _distinct(T: Floats, p: CoarseParameters) -> Indices:
    """Indices of extrinsics (N,4,4) that differ from every earlier one that was kept."""
    kept: list[int] = []
    left = np.ones(len(T), dtype=bool)
    while left.any():
        k = int(np.argmax(left))
        kept.append(k)
        chord = np.linalg.norm(T[:, :3, :3] - T[k, :3, :3], axis=(1, 2))
        angle = 2.0 * np.arcsin(np.minimum(1.0, chord / np.sqrt(8.0)))
        shift = np.linalg.norm(T[:, :3, 3] - T[k, :3, 3], axis=1)
        left &= (angle > p.distinct_rad) | (shift > p.distinct_m)
    return np.array(kept, dtype=np.int64)


def _longest(lines: Sequence[_L], most: int) -> list[_L]:
    """The longest lanes and the longest poles."""
    by_length = sorted(
        filter(is_usable, lines), key=lambda line: -float(np.linalg.norm(line.end - line.start))
    )
    return [
        line
        for label in ("lane", "pole")
        for line in [line for line in by_length if line.label == label][:most]
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """The lines that may be matched."""

    cloud: list[CloudLine]
    image: list[ImageLine]
    camera: CameraModel


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """An extrinsic (4,4) and the pairs that it was drawn in by."""

    T_cam_lidar: Floats
    used: Association


def _extrinsics(fits: Sequence[_Fit]) -> Floats:
    """T_cam_lidar of fits, (N,4,4)."""
    return np.stack([fit.T_cam_lidar for fit in fits])


def _own_lines(lines: Lines, found: Triples, k: int, camera: CameraModel) -> Association:
    """The three pairs of a triple, cut to what both sensors see; fewer where they share too little."""
    c, i = found.cloud[k], found.image[k]
    cloud = [lines.cloud_lanes[c[0]], lines.cloud_lanes[c[1]], lines.cloud_poles[c[2]]]
    image = [lines.image_lanes[i[0]], lines.image_lanes[i[1]], lines.image_poles[i[2]]]
    rows, pairs = pairs_on_overlap(cloud, image, camera, found.T_cam_lidar[k])
    own = rows[:, 0] == rows[:, 1]
    matches = tuple(LineMatch(cloud[n], image[n]) for n in rows[own, 0].tolist())
    return Association(matches, plk.select(pairs, own))


_WIDEST = np.array([np.radians(5.0)] * 3 + [1.0] * 3)
"""rad and m; how wrong a candidate may be at most: what its lines do not see is known so well."""
_FLOOR = np.array([np.radians(0.1)] * 3 + [0.03] * 3)
"""rad and m; what the noise model of the lines does not know of."""


def _drawn_in(fit: _Fit, frame: _Frame) -> _Fit:
    """Method I on all lines that match under what the pairs of a fit leave open."""
    pairs, T, K = fit.used.pairs, fit.T_cam_lidar, frame.camera.K
    if len(pairs) == 0:
        return fit
    prior = plk.Prior(T, np.diag(_WIDEST**-2.0))
    J = plk.whitening(pairs) @ plk.jacobians(pairs, K, T)
    information = np.einsum("nki,nkj->ij", J, J)
    posterior = np.linalg.inv(information + prior.precision)
    covariance = np.asarray(posterior + np.diag(_FLOOR**2), dtype=np.float64)
    wider = associate(frame.cloud, frame.image, frame.camera, T, covariance)
    if len(wider.pairs) < len(pairs):
        return fit
    solution = plk.method_one(wider.pairs, K, T, prior=prior, start_two=False)
    return _Fit(solution.T_cam_lidar, wider)


_ONE_PX = 0.1
"""What one px of mean misfit costs one class at the steeper e-fold. The plateau is flat: smaller changes say
nothing against the lines, larger ones that a wrong pair was among them."""


def _kept(
    before: Sequence[_Fit],
    after: Sequence[_Fit],
    points: SemanticPoints,
    maps: HeightMaps,
    camera: CameraModel,
) -> list[_Fit]:
    """Of each fit what the lines made of it, unless it lost by J."""
    scores = semantic_cost(_extrinsics([*before, *after]), points, maps, camera)
    old, new = np.split(scores, 2)
    return [
        b if lost else a for a, b, lost in zip(after, before, (new < old - _ONE_PX).tolist(), strict=True)
    ]
