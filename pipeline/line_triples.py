"""Every way in which two image lanes and an image pole may show lines of a cloud (CRLF III-C).

Each correspondence has four extrinsics in closed form (``pipeline.p3l``); those are kept that an upright
camera, in front of the lines and above the road, may have (FORMULAS B (12), 4).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
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
]
"""Why no correspondence is left."""

Reason: TypeAlias = NoTriplesReason | Literal["no candidate meets the masks"]
"""Why a scene gives no coarse extrinsic."""


@dataclass(frozen=True, slots=True)
class TripleParameters:
    """Which lines take part and what is believable.

    Attributes:
        image_lanes: The longest lanes of the image; CRLF takes 2.
        image_poles: Likewise; CRLF takes 1. The longest may be missing in the cloud, all three seldom are.
        cloud_lanes: The longest lanes of the cloud; six bound two carriageways.
        cloud_poles: Poles of the cloud with the largest angle in height; a full turn shows as many behind.
            With the three above 6480 correspondences at most, some 0.1 s.
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
    """The largest lines of each kind. The longer a line, the better its direction is known.

    A cloud pole counts by its angle in height from the LiDAR: near ones fix the place along the road.
    """

    def image(label: LineLabel, most: int) -> list[ImageLine]:
        return longest_lines(image_lines, label, most)

    def cloud(label: LineLabel, most: int, *, by_angle: bool) -> list[CloudLine]:
        def size(line: CloudLine) -> float:
            reach = float(np.linalg.norm(line.start + line.end)) / 2
            return _length(line) / max(reach, 1.0) if by_angle else _length(line)

        usable = [line for line in cloud_lines if line.label == label and is_usable(line)]
        return sorted(usable, key=size, reverse=True)[:most]

    return Lines(
        image("lane", p.image_lanes),
        image("pole", p.image_poles),
        cloud("lane", p.cloud_lanes, by_angle=False),
        cloud("pole", p.cloud_poles, by_angle=True),
    )


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
    """All roots of all correspondences that an upright camera in front and above may have.

    Args:
        lines: What takes part.
        camera: Intrinsics; of the lens only K, the lines being ideal.
        up: float64 (3,), LiDAR frame, where up is, or None.
        p: What is believable.

    Returns:
        The roots, or the step at which none was left.
    """
    reason = lines.missing()
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
    lane_ends = np.stack([np.stack([line.start, line.end]) for line in lines.cloud_lanes])
    for k in (0, 1):
        # A lane may begin beside or behind the camera: a full turn of the LiDAR sees it all.
        seen &= p3l.in_front(T[:, :, None], lane_ends[cloud[:, k]][:, None]).any(axis=2)
    drawn = np.stack([np.stack([line.start, line.end]) for line in lines.image_poles])[image[:, 2]]
    return np.asarray(seen & _overlap(T, poles, drawn, camera, seen))


def _stands(T: Floats, poles: Floats, ground: Floats, up: Floats) -> Bools:
    """Whether roots (M,4) see poles (M,2,3) upright and from above the ground, given a point and up (M,3)."""
    rising = np.einsum("mi,mi->m", poles[:, 1] - poles[:, 0], up)[:, None] > 0
    foot, top = (np.where(rising, poles[:, k], poles[:, 1 - k])[:, None] for k in (0, 1))
    return np.asarray(p3l.upright(T, foot, top) & p3l.above(T, ground[:, None], up[:, None]))


def _overlap(T: Floats, ends: Floats, drawn: Floats, camera: CameraModel, seen: Bools) -> Bools:
    """Whether projections of segments (M,2,3) have a part in common with image segments (M,2,2): (M,4).

    Both lie on one line, which is how the roots were made.
    """
    along = drawn[:, 1] - drawn[:, 0]
    squared = np.einsum("mi,mi->m", along, along)
    share = []
    for point in (ends[:, 0], ends[:, 1]):
        cam = np.einsum("mkij,mj->mki", T[..., :3, :3], point) + T[..., :3, 3]
        uv = cam @ camera.K.T
        uv = uv[..., :2] / np.where(seen, uv[..., 2], 1.0)[..., None]
        share.append(np.einsum("mki,mi->mk", uv - drawn[:, None, 0], along) / squared[:, None])
    low, high = np.minimum(*share), np.maximum(*share)
    common = np.minimum(high, 1.0) - np.maximum(low, 0.0)
    return np.asarray(common > 0.0)
