"""Every way in which two image lanes and an image pole may show lines of a cloud (CRLF III-C).

Each correspondence has four extrinsics in closed form (``pipeline.p3l``); those are kept that an upright
camera, in front of the lines and above the road, may have (FORMULAS B (12), 4).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline import p3l
from pipeline.association import OUTERMOST
from pipeline.errors import InputError
from pipeline.records import CameraModel, CloudLine, Floats, ImageLine, LineLabel

_L = TypeVar("_L", CloudLine, ImageLine)

Indices: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]

NoTriplesReason: TypeAlias = Literal[
    "fewer than two lanes in the image",
    "no pole in the image",
    "fewer than two lanes in the cloud",
    "no pole in the cloud",
    "no two parallel lanes apart from each other in the cloud",
    "the image's lanes lie in one plane with the camera",
    "every pole stands dead ahead or in line with the lanes",
    "no correspondence puts the lines in front of an upright camera above the road",
    "up is no direction",
]
"""Why no correspondence is left."""


@dataclass(frozen=True, slots=True)
class TripleParameters:
    """Which lines take part and what is believable.

    Attributes:
        image_lanes: The longest lanes of the image; CRLF takes 2.
        image_poles: Likewise; CRLF takes 1. The longest may be missing in the cloud, all three seldom are.
        cloud_lanes: The longest lanes of the cloud; six bound two carriageways.
        cloud_poles: Poles of the cloud, the longest and those with the largest angle in height; a full turn
            shows as many behind. With the three above 6480 correspondences at most, some 0.1 s.
        parallel: rad; lanes that enclose more do not belong to one straight road.
        apart_m: m; lanes nearer to each other are one line twice, or a doubled one.
        least_sine: Of the angle between the planes of two image lanes, and between a pole's plane and the
            lanes: below it 0.1 deg of noise is 3 deg, or a seventeenth of the pole's range, in the answer.
        baseline_m: m; LiDAR and camera sit on one vehicle, at worst on the roof and the bumper of a truck.
    """

    image_lanes: int = 4
    image_poles: int = 3
    cloud_lanes: int = 6
    cloud_poles: int = 12
    parallel: float = math.radians(5.0)
    apart_m: float = 1.0
    least_sine: float = 0.03
    baseline_m: float = 5.0

    def __post_init__(self) -> None:
        for name, least in (("image_lanes", 2), ("cloud_lanes", 2), ("image_poles", 1), ("cloud_poles", 1)):
            if getattr(self, name) < least:
                raise InputError(f"triples: {name} {getattr(self, name)} is below {least}")


@dataclass(frozen=True, slots=True, eq=False)
class NoTriples:
    """No correspondence is left, and why."""

    reason: NoTriplesReason


@dataclass(frozen=True, slots=True, eq=False)
class Lines:
    """The lines that take part, the largest first."""

    image_lanes: list[ImageLine]
    image_poles: list[ImageLine]
    cloud_lanes: list[CloudLine]
    cloud_poles: list[CloudLine]

    def missing(self) -> NoTriplesReason | None:
        """The first kind of which there are too few."""
        if len(self.image_lanes) < 2:
            return "fewer than two lanes in the image"
        if not self.image_poles:
            return "no pole in the image"
        if len(self.cloud_lanes) < 2:
            return "fewer than two lanes in the cloud"
        return None if self.cloud_poles else "no pole in the cloud"


def largest_lines(
    cloud_lines: Sequence[CloudLine], image_lines: Sequence[ImageLine], p: TripleParameters
) -> Lines:
    """The largest lines of each kind. The longer a line, the better its direction is known."""
    return Lines(
        longest_lines(image_lines, "lane", p.image_lanes),
        longest_lines(image_lines, "pole", p.image_poles),
        longest_lines(cloud_lines, "lane", p.cloud_lanes),
        largest_poles(cloud_lines, p.cloud_poles),
    )


def largest_poles(lines: Sequence[CloudLine], most: int) -> list[CloudLine]:
    """Poles of a cloud, in turn the longest and the one with the largest angle in height that are left.

    Near ones fix the place along the road and are the long ones of the image; but what stands beside the
    LiDAR and is no pole, a post or a person, has a large angle too and would fill all places.
    """

    def angle(line: CloudLine) -> float:
        return _length(line) / max(float(np.linalg.norm(line.start + line.end)) / 2, 1.0)

    by_length = longest_lines(lines, "pole", None)
    by_angle = sorted(by_length, key=angle, reverse=True)
    in_turn = chain.from_iterable(zip(by_length, by_angle, strict=True))
    return list({id(line): line for line in in_turn}.values())[:most]


def longest_lines(lines: Sequence[_L], label: LineLabel, most: int | None) -> list[_L]:
    """The longest usable lines of a class; None: all."""
    usable = [line for line in lines if line.label == label and is_usable(line)]
    return sorted(usable, key=_length, reverse=True)[:most]


def _length(line: CloudLine | ImageLine) -> float:
    return float(np.linalg.norm(line.end - line.start))


def is_usable(line: CloudLine | ImageLine) -> bool:
    """Whether a line has ends within reach that differ, and a noise that is a number."""
    sigma = line.sigma_m if isinstance(line, CloudLine) else line.sigma_px
    ends = np.stack([line.start, line.end])
    return bool((np.abs(ends) < OUTERMOST).all() and abs(sigma) < OUTERMOST and _length(line) > 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Triples:
    """The believable roots of all correspondences.

    Attributes:
        T_cam_lidar: float64 (N,4,4).
        cloud: int64 (N,3), the lanes and the pole of :class:`Lines` that each comes from.
        image: int64 (N,3), likewise.
    """

    T_cam_lidar: Floats
    cloud: Indices
    image: Indices


def enumerate_triples(
    lines: Lines, camera: CameraModel, up: Floats | None, p: TripleParameters
) -> Triples | NoTriples:
    """All roots of all correspondences that an upright camera in front and above may have: CRLF (10)-(13).

    Args:
        lines: What takes part.
        camera: Intrinsics; of the lens only K, the lines being ideal.
        up: float64 (3,), LiDAR frame, where up is, or None.
        p: What is believable.

    Returns:
        The roots, or the step at which none was left.
    """
    reason = lines.missing() or _misleading(up)
    if reason is not None:
        return NoTriples(reason)
    lane_n, pole_n = (
        p3l.plane_normals(
            np.stack([line.start for line in kind]), np.stack([line.end for line in kind]), camera.K
        )
        for kind in (lines.image_lanes, lines.image_poles)
    )
    image_pairs = np.argwhere(np.triu(np.ones((len(lane_n), len(lane_n)), dtype=bool), 1))
    sine = np.linalg.norm(np.cross(lane_n[image_pairs[:, 0]], lane_n[image_pairs[:, 1]]), axis=1)
    image_pairs = image_pairs[sine >= p.least_sine]
    if len(image_pairs) == 0:
        return NoTriples("the image's lanes lie in one plane with the camera")
    cloud_pairs, along = _lane_pairs(lines.cloud_lanes, p)
    if len(cloud_pairs) == 0:
        return NoTriples("no two parallel lanes apart from each other in the cloud")
    i, k, a, c = np.indices((len(image_pairs), len(pole_n), len(cloud_pairs), len(lines.cloud_poles)))
    image = np.column_stack([image_pairs[i.ravel()], k.ravel()])
    cloud = np.column_stack([cloud_pairs[a.ravel()], c.ravel()])
    d_l = along[a.ravel()]
    normals = lane_n[image[:, 0]], lane_n[image[:, 1]], pole_n[image[:, 2]]
    solvable = _solvable(normals, d_l, lines, cloud, p)
    image, cloud, d_l = image[solvable], cloud[solvable], d_l[solvable]
    n1, n2, n3 = (n[solvable] for n in normals)
    middle, pole_ends, d_p = _places(lines)
    roots = p3l.p3l_candidates(
        n1,
        n2,
        n3,
        d_l,
        d_p[cloud[:, 2]],
        middle[cloud[:, 0]],
        middle[cloud[:, 1]],
        pole_ends[cloud[:, 2]].mean(axis=1),
    )
    if not roots.valid.any():
        return NoTriples("every pole stands dead ahead or in line with the lanes")
    seen = roots.valid[:, None] & _believable(roots.T_cam_lidar, d_l, (image, cloud), lines, camera, up, p)
    if not seen.any():
        return NoTriples("no correspondence puts the lines in front of an upright camera above the road")
    which = np.nonzero(seen)[0]
    return Triples(roots.T_cam_lidar[seen], cloud[which], image[which])


def _misleading(up: Floats | None) -> NoTriplesReason | None:
    """Why a vector can not tell where up is."""
    if up is None or 0.0 < float(np.linalg.norm(up)) < OUTERMOST:
        return None
    return "up is no direction"


def _solvable(
    normals: tuple[Floats, Floats, Floats], d_l: Floats, lines: Lines, cloud: Indices, p: TripleParameters
) -> Bools:
    """Correspondences (M,) whose pole stands beside the road in the image and across it in the cloud."""
    n1, n2, n3 = normals
    meeting = np.cross(n1, n2)
    beside = np.abs(np.einsum("mi,mi->m", meeting, n3)) >= p.least_sine * np.linalg.norm(meeting, axis=1)
    across = np.linalg.norm(np.cross(d_l, _places(lines)[2][cloud[:, 2]]), axis=1) >= p.least_sine
    return np.asarray(beside & across)


def _places(lines: Lines) -> tuple[Floats, Floats, Floats]:
    """Middles (n,3) of the cloud's lanes, and ends (m,2,3) and unit directions (m,3) of its poles."""
    middle = np.stack([0.5 * (line.start + line.end) for line in lines.cloud_lanes])
    ends = np.stack([np.stack([line.start, line.end]) for line in lines.cloud_poles])
    span = ends[:, 1] - ends[:, 0]
    return middle, ends, span / np.linalg.norm(span, axis=1, keepdims=True)


def _lane_pairs(lanes: list[CloudLine], p: TripleParameters) -> tuple[Indices, Floats]:
    """Ordered pairs (n,2) of parallel lanes apart from each other, and the mean of their directions (n,3)."""
    span = np.stack([line.end - line.start for line in lanes])
    d = span / np.linalg.norm(span, axis=1, keepdims=True)
    pairs = np.argwhere(~np.eye(len(lanes), dtype=bool))
    first, second = d[pairs[:, 0]], d[pairs[:, 1]]
    agree = np.einsum("ni,ni->n", first, second)
    mean = first + np.where(agree < 0, -1.0, 1.0)[:, None] * second
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    middle = np.stack([0.5 * (line.start + line.end) for line in lanes])
    apart = np.linalg.norm(np.cross(middle[pairs[:, 1]] - middle[pairs[:, 0]], mean), axis=1)
    good = (np.abs(agree) >= np.cos(p.parallel)) & (apart >= p.apart_m)
    return pairs[good], mean[good]


_STANDS_M = 0.3
"""m; a pole whose middle is nearer to the lanes' plane does not tell which side is up."""


def _believable(
    T: Floats,
    d_l: Floats,
    which: tuple[Indices, Indices],
    lines: Lines,
    camera: CameraModel,
    up: Floats | None,
    p: TripleParameters,
) -> Bools:
    """Roots (M,4) of T (M,4,4,4) that may be seen: cheirality and overlap of FORMULAS B (12), 4."""
    image, cloud = which
    middle, pole_ends, _ = _places(lines)
    first, poles = middle[cloud[:, 0]], pole_ends[cloud[:, 2]]
    normal = np.cross(d_l, middle[cloud[:, 1]] - first)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    told = np.einsum("mi,mi->m", poles.mean(axis=1) - first, normal)
    told = np.where(np.abs(told) > _STANDS_M, told, 0.0) if up is None else normal @ up
    seen = np.linalg.norm(T[..., :3, 3], axis=-1) <= p.baseline_m
    seen &= p3l.in_front(T[:, :, None], poles[:, None]).all(axis=2)
    upwards = (told >= 0)[:, None] & _stands(T, poles, first, normal)
    seen &= upwards | ((told <= 0)[:, None] & _stands(T, poles, first, -normal))
    ends = [np.stack([_ends(line) for line in kind]) for kind in (lines.cloud_lanes, lines.cloud_poles)]
    drawn = [np.stack([_ends(line) for line in kind]) for kind in (lines.image_lanes, lines.image_poles)]
    for k, kind in enumerate((0, 0, 1)):
        # Few are left from step to step.
        row, root = np.nonzero(seen)
        seen[row, root] = _overlap(
            T[row, root], ends[kind][cloud[row, k]], drawn[kind][image[row, k]], camera.K
        )
    return np.asarray(seen)


def _ends(line: CloudLine | ImageLine) -> Floats:
    """Start and end of a line, (2,3) or (2,2)."""
    return np.stack([line.start, line.end])


def _stands(T: Floats, poles: Floats, ground: Floats, up: Floats) -> Bools:
    """Whether roots (M,4) see poles (M,2,3) upright and from above the ground, given a point and up (M,3)."""
    rising = np.einsum("mi,mi->m", poles[:, 1] - poles[:, 0], up)[:, None] > 0
    foot, top = (np.where(rising, poles[:, k], poles[:, 1 - k])[:, None] for k in (0, 1))
    return np.asarray(p3l.upright(T, foot, top) & p3l.above(T, ground[:, None], up[:, None]))


def _overlap(T: Floats, ends: Floats, drawn: Floats, K: Floats) -> Bools:
    """Whether segments (S,2,3) project, by extrinsics (S,4,4), onto a part of image segments (S,2,2): (S,).

    Both lie on one line, which is how the roots were made. Of a segment that runs on behind the camera, as
    lanes do where a LiDAR turns fully, the part in front counts; one without such a part projects nowhere.
    """
    cam = np.einsum("sij,skj->ski", T[:, :3, :3], ends) + T[:, None, :3, 3]
    depth = cam[..., 2]
    near = depth < p3l.NEAREST_M
    rise = np.where(near[:, 0] != near[:, 1], depth[:, 1] - depth[:, 0], 1.0)
    cut = cam[:, 0] + ((p3l.NEAREST_M - depth[:, 0]) / rise)[:, None] * (cam[:, 1] - cam[:, 0])
    uvw = np.where(near[..., None], cut[:, None], cam) @ K.T
    shown = ~near.all(axis=1)
    uv = uvw[..., :2] / np.where(shown[:, None], uvw[..., 2], 1.0)[..., None]
    along = drawn[:, 1] - drawn[:, 0]
    share = np.einsum("ski,si->sk", uv - drawn[:, :1], along) / np.einsum("si,si->s", along, along)[:, None]
    common = np.minimum(share.max(axis=1), 1.0) - np.maximum(share.min(axis=1), 0.0)
    return np.asarray(shown & (common > 0.0))
