"""Extrinsics from two lanes and the direction of up: P3L with a pole that has no place yet (CRLF (11), (12)).

A pole that the image shows is often missing among the cloud's, and the other way round. All poles stand on
the same ground, though: the normal of the ground takes the place of the pole's direction in the closed form
of FORMULAS B (11), and two lanes give the place of the camera but for the way along the road.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import p3l
from pipeline.errors import InputError
from pipeline.ground import Ground
from pipeline.line_triples import longest_lines
from pipeline.records import CameraModel, CloudLine, Floats, ImageLine


@dataclass(frozen=True, slots=True)
class LanePairParameters:
    """Which lines take part and what is believable.

    Attributes:
        image_lanes: The longest lanes of the image: more than the road has, for some are kerbs.
        image_poles: The longest poles of the image; each tells where up is.
        cloud_lanes: The longest lanes of the cloud.
        parallel: rad; lanes that enclose more do not belong to one straight road.
        apart_m: m; lanes nearer to each other are one line twice, or a doubled one.
        least_sine: Of the angle between the planes of two image lanes: below it 0.1 deg of noise in one of
            them is 3 deg in the answer.
        same_up: rad; poles that agree so well lead to one answer.
        upright: rad; how far the image may be rolled or look up or down.
        baseline_m: m; LiDAR and camera sit on one vehicle, at worst on the roof and the bumper of a truck.
        height_m: m; of the camera above the road.
    """

    image_lanes: int = 6
    image_poles: int = 4
    cloud_lanes: int = 8
    parallel: float = math.radians(5.0)
    apart_m: float = 1.0
    least_sine: float = 0.03
    same_up: float = math.radians(0.5)
    upright: float = math.radians(45.0)
    baseline_m: float = 5.0
    height_m: tuple[float, float] = (0.3, 5.0)

    def __post_init__(self) -> None:
        for name, least in (("image_lanes", 2), ("cloud_lanes", 2), ("image_poles", 0)):
            if getattr(self, name) < least:
                raise InputError(f"lane pairs: {name} {getattr(self, name)} is below {least}")


def lane_pair_extrinsics(
    cloud_lines: Sequence[CloudLine],
    image_lines: Sequence[ImageLine],
    ground: Ground,
    camera: CameraModel,
    parameters: LanePairParameters | None = None,
) -> Floats:
    """All extrinsics by which two lanes of the image may show two lanes of the cloud.

    Up in the image is square to the lanes' direction and lies in the plane of a pole, or the image is level;
    both ways along the road are tried. Along the road the camera is put beside the LiDAR.

    Args:
        cloud_lines: Lines in the LiDAR frame; of the lanes the ends may be in any order.
        image_lines: Lines in ideal px.
        ground: The road, its normal on the side of up.
        camera: Intrinsics; of the lens only K, the lines being ideal.
        parameters: What takes part; None: the defaults.

    Returns:
        float64 (N,4,4), in no particular order; none where lanes are missing, or no camera above the road and
        near the LiDAR sees them so.
    """
    p = parameters or LanePairParameters()
    lanes = longest_lines(image_lines, "lane", p.image_lanes)
    poles = longest_lines(image_lines, "pole", p.image_poles)
    cloud = longest_lines(cloud_lines, "lane", p.cloud_lanes)
    if len(lanes) < 2 or len(cloud) < 2:
        return np.zeros((0, 4, 4))
    views = _views(_normals(lanes, camera), _normals(poles, camera), p)
    roads = _roads(cloud, ground.normal, p)
    if len(views.along) == 0 or len(roads.ahead) == 0:
        return np.zeros((0, 4, 4))
    v, r = (index.ravel() for index in np.indices((len(views.along), len(roads.ahead))))
    axes_cam = np.stack([views.along[v], np.cross(views.up[v], views.along[v]), views.up[v]], axis=2)
    left = np.cross(ground.normal, roads.ahead[r])
    axes_lidar = np.stack([roads.ahead[r], left, np.broadcast_to(ground.normal, left.shape)], axis=1)
    R = axes_cam @ axes_lidar
    N = np.stack([views.first[v], views.second[v], views.along[v]], axis=1)
    beside = np.stack(
        [
            -np.einsum("mi,mij,mj->m", views.first[v], R, roads.first[r]),
            -np.einsum("mi,mij,mj->m", views.second[v], R, roads.second[r]),
            np.zeros(len(v)),
        ],
        axis=1,
    )
    t = np.linalg.solve(N, beside[..., None])[..., 0]
    centre = -np.einsum("mji,mj->mi", R, t)
    height = centre @ ground.normal + ground.offset
    near = np.linalg.norm(centre, axis=1) <= p.baseline_m
    good = near & (height >= p.height_m[0]) & (height <= p.height_m[1])
    T = np.zeros((int(good.sum()), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R[good], t[good], 1.0
    return T


def _normals(lines: Sequence[ImageLine], camera: CameraModel) -> Floats:
    """Unit normals (M,3) of the planes through the camera and the lines, camera axes."""
    ends = np.array([[line.start, line.end] for line in lines]).reshape(-1, 2, 2)
    return p3l.plane_normals(ends[:, 0], ends[:, 1], camera.K)


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """Ways to see a road, camera axes: normals (V,3) of its two lanes, its direction and up (V,3), unit."""

    first: Floats
    second: Floats
    along: Floats
    up: Floats


def _views(lanes: Floats, poles: Floats, p: LanePairParameters) -> _Views:
    rows = []
    for i in range(len(lanes)):
        for j in range(i + 1, len(lanes)):
            along = np.cross(lanes[i], lanes[j])
            sine = float(np.linalg.norm(along))
            if sine < p.least_sine:
                continue
            along = along / sine
            rows += [(lanes[i], lanes[j], along, up) for up in _ups(along, poles, p)]
    return _Views(*np.array(rows).reshape(-1, 4, 3).transpose(1, 0, 2))


def _ups(along: Floats, poles: Floats, p: LanePairParameters) -> list[Floats]:
    """Directions (3,) of up, square to the lanes, that poles in planes (M,3) tell or a level image."""
    level = np.array([[1.0, 0.0, 0.0]])
    kept: list[Floats] = []
    # A pole in the plane of the lanes' direction has no up; the level image comes last: poles know better.
    for normal in np.concatenate([poles, level]):
        up = np.cross(along, normal)
        length = float(np.linalg.norm(up))
        if length < p.least_sine:
            continue
        up = up / length * (-1.0 if up[1] > 0 else 1.0)
        if -up[1] >= math.cos(p.upright) and all(up @ other < math.cos(p.same_up) for other in kept):
            kept.append(up)
    return kept


@dataclass(frozen=True, slots=True, eq=False)
class _Roads:
    """Ways to read the cloud, LiDAR frame: a point (N,3) of each of two lanes, and unit ahead (N,3)."""

    first: Floats
    second: Floats
    ahead: Floats


def _roads(lanes: Sequence[CloudLine], up: Floats, p: LanePairParameters) -> _Roads:
    span = np.stack([line.end - line.start for line in lanes])
    d = span / np.linalg.norm(span, axis=1, keepdims=True)
    middle = np.stack([0.5 * (line.start + line.end) for line in lanes])
    pairs = np.argwhere(~np.eye(len(lanes), dtype=np.bool_))
    a, b = d[pairs[:, 0]], d[pairs[:, 1]]
    agree = np.einsum("ni,ni->n", a, b)
    ahead = a + np.where(agree < 0, -1.0, 1.0)[:, None] * b
    ahead -= (ahead @ up)[:, None] * up
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    ahead /= np.where(length > 0, length, 1.0)
    apart = np.linalg.norm(np.cross(middle[pairs[:, 1]] - middle[pairs[:, 0]], ahead), axis=1)
    good = (np.abs(agree) >= math.cos(p.parallel)) & (apart >= p.apart_m)
    good &= length[:, 0] > 0
    first, second, ahead = middle[pairs[good, 0]], middle[pairs[good, 1]], ahead[good]
    return _Roads(*(np.concatenate(two) for two in ((first, first), (second, second), (ahead, -ahead))))
