"""Fig. 5 and Fig. 6 of PLK-Calib: how far off the initial guess may be, for methods I, II and ours."""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from pipeline import plk, se3
from pipeline.plk import LinePairs, Prior, Solution
from pipeline.plk_scenes import (
    IMAGE_SIZE,
    METHODS,
    TRUTH,
    K,
    Method,
    drawn_scene,
    errors,
    observed,
    pixels,
    start_off,
)
from pipeline.records import Floats, read_only

_NEAREST = 0.1
"""m ahead; a point nearer is not projected (CRLF (1))."""


@dataclass(frozen=True, slots=True)
class Box:
    """A box of a box plot after Tukey.

    Attributes:
        low: Lowest value within 1.5 heights of the box below it.
        q1: Lower quartile.
        median: Median.
        q3: Upper quartile.
        high: Highest value within 1.5 heights of the box above it.
        outside: The values beyond, ascending.
    """

    low: float
    q1: float
    median: float
    q3: float
    high: float
    outside: tuple[float, ...]


def box(values: Floats) -> Box:
    """Box of finite values (R,), at least one."""
    q1, median, q3 = (float(q) for q in np.quantile(values, [0.25, 0.5, 0.75]))
    reach = 1.5 * (q3 - q1)
    inside = (values >= q1 - reach) & (values <= q3 + reach)
    outside = tuple(float(value) for value in np.sort(values[~inside]))
    return Box(float(values[inside].min()), q1, median, q3, float(values[inside].max()), outside)


@dataclass(frozen=True, slots=True)
class Surrounding:
    """Where drawn lines lie."""

    name: str
    near: float
    far: float


SURROUNDINGS = (
    Surrounding("yard", 3.0, 8.0),
    Surrounding("car park", 5.0, 20.0),
    Surrounding("square", 10.0, 30.0),
)
"""m ahead; the published scenes differ in size likewise, these are no copies of them."""

FIG5_LINES = 10
FIG5_SIGMA_PX = 1.0
"""px; the harder of the two noises of FORMULAS H."""


def fig5_once(where: Surrounding, rng: np.random.Generator) -> dict[Method, Floats | None]:
    """One run of Fig. 5: new lines, new noise, 5 deg about and 0.5 m along each axis with new signs."""
    pairs = observed(drawn_scene(where.near, where.far, FIG5_LINES, rng), FIG5_SIGMA_PX, rng)
    start = start_off(rng.choice([-1.0, 1.0], 6))
    return {
        "I": plk.method_one(pairs, K, start, start_two=False).T_cam_lidar,
        "II": plk.method_two(pairs, K, start),
        "ours": plk.method_one(pairs, K, start).T_cam_lidar,
    }


Half: TypeAlias = Literal["translation", "rotation"]
"""What is wrong at the start and is sought; the other half of the pose is right and held."""

OFFSETS: dict[Half, Floats] = {
    "translation": read_only(np.linspace(0.0, 5.0, 11)),
    "rotation": read_only(np.radians(np.linspace(0.0, 46.0, 24))),
}
"""m along the LiDAR's y axis, and rad about its z axis, as published."""

SUCCESS = {"translation": 0.1, "rotation": math.radians(1.0)}
"""m and rad: far above what noise leaves (0.02 m, 0.2 deg), far below another minimum."""

FIG6_LINES = 10
FIG6_MATCHES = 5
FIG6_SIGMA_PX = 1.0
_HELD_SIGMA = np.array([1e-4] * 3 + [1e-3] * 3)
"""rad and m; a prior so narrow holds half of the pose a hundred times better than the lines see it."""


def offset_start(half: Half, offset: float) -> Floats:
    """Initial guess (4,4) of Fig. 6: the camera shifted along the LiDAR's y axis, or turned in place about z.

    The camera centre in LiDAR axes is what a turn keeps right: it is the mount's position (FORMULAS A4).
    """
    if half == "rotation":
        turn = TRUTH[:3, :3] @ np.array([0.0, 0.0, offset])
        return se3.retract(TRUTH, np.concatenate([turn, np.zeros(3)]))
    shift = TRUTH[:3, :3] @ np.array([0.0, offset, 0.0])
    return se3.retract(TRUTH, np.concatenate([np.zeros(3), shift]))


def matched(pairs: LinePairs, T_start: Floats) -> LinePairs | None:
    """The five longest image lines among those whose cloud lines the initial guess puts into the image.

    None where fewer than three are left, which is how the published runs fail, too.
    """
    middle = se3.apply(T_start, 0.5 * (pairs.start + pairs.end))
    front = middle[:, 2] > _NEAREST
    uv = pixels(np.where(front[:, None], middle, [0.0, 0.0, 1.0]))
    shown = np.flatnonzero(front & ((uv >= 0.0) & (uv <= IMAGE_SIZE)).all(axis=1))
    if len(shown) < 3:
        return None
    length = np.linalg.norm(pairs.image_end - pairs.image_start, axis=1)
    chosen = np.zeros(len(pairs), dtype=np.bool_)
    chosen[shown[np.argsort(-length[shown], kind="stable")[:FIG6_MATCHES]]] = True
    return plk.select(pairs, chosen)


def fig6_once(half: Half, offset: float, rng: np.random.Generator) -> dict[Method, float]:
    """One run of Fig. 6: error of the half that is sought, m or rad, per method; NaN without answer."""
    where = SURROUNDINGS[0]
    lines = drawn_scene(where.near, where.far, FIG6_LINES, rng)
    start = offset_start(half, offset)
    pairs = matched(observed(lines, FIG6_SIGMA_PX, rng), start)
    if pairs is None:
        return dict.fromkeys(METHODS, math.nan)
    two = _half_two(pairs, half, start)
    of = 0 if half == "rotation" else 1
    return {
        "I": errors(_half_one(pairs, half, start, start).T_cam_lidar)[of],
        "II": errors(two)[of],
        "ours": errors(_best(pairs, half, start, two))[of],
    }


def _half_one(pairs: LinePairs, half: Half, T_start: Floats, T_first: Floats) -> Solution:
    """Method I from ``T_first`` with the right half of ``T_start`` held by a prior."""
    precision = 1.0 / _HELD_SIGMA**2
    precision[slice(0, 3) if half == "rotation" else slice(3, 6)] = 0.0
    prior = Prior(T_start, np.diag(precision))
    return plk.method_one(pairs, K, T_first, prior=prior, start_two=False)


def _half_two(pairs: LinePairs, half: Half, T_start: Floats) -> Floats | None:
    """The stage of method II that finds this half."""
    R_start, t_start = T_start[:3, :3], T_start[:3, 3]
    if half == "translation":
        t = plk.translation_from_planes(pairs, K, R_start, T_start)
        return None if t is None else se3.transform(R_start, t)
    R = plk.rotation_from_directions(pairs, K, T_start)
    return None if R is None else se3.transform(R, R @ R_start.T @ t_start)


def _best(pairs: LinePairs, half: Half, T_start: Floats, two: Floats | None) -> Floats:
    """Method I from the start and from the answer of II: the one that fits better."""
    found = [_half_one(pairs, half, T_start, T_start)]
    if two is not None:
        found.append(_half_one(pairs, half, T_start, two))
    return min(found, key=lambda solution: solution.chi2).T_cam_lidar
