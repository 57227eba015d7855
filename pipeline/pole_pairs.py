"""Extrinsics from two poles and one lane: P3L with the poles as the two parallel lines (CRLF (11), (12)).

For streets that show only one painted line. The closed form asks for two parallel lines and a third one, and
does not mind which stand and which lie (FORMULAS B (11)).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import p3l
from pipeline.errors import InputError
from pipeline.ground import Ground
from pipeline.line_triples import largest_poles, longest_lines
from pipeline.records import CameraModel, CloudLine, Floats, ImageLine


@dataclass(frozen=True, slots=True)
class PolePairParameters:
    """Which lines take part and what is believable.

    Attributes:
        image_poles: The longest poles of the image.
        image_lanes: The longest lanes of the image.
        cloud_poles: Poles of the cloud, the longest and those with the largest angle in height: near ones
            tell the place best.
        cloud_lanes: The longest lanes of the cloud.
        apart_m: m; poles nearer to each other tell no direction between them.
        least_sine: Of the angle between the planes of two image poles, and between a lane's plane and the
            poles: below it 0.1 deg of noise in one of them is 3 deg in the answer.
        upright: rad; how far the image may be rolled or look up or down.
        baseline_m: m; LiDAR and camera sit on one vehicle, at worst on the roof and the bumper of a truck.
        height_m: m; of the camera above the road.
    """

    image_poles: int = 4
    image_lanes: int = 3
    cloud_poles: int = 12
    cloud_lanes: int = 6
    apart_m: float = 2.0
    least_sine: float = 0.03
    upright: float = math.radians(45.0)
    baseline_m: float = 5.0
    height_m: tuple[float, float] = (0.3, 5.0)

    def __post_init__(self) -> None:
        for name, least in (("image_poles", 2), ("cloud_poles", 2), ("image_lanes", 1), ("cloud_lanes", 1)):
            if getattr(self, name) < least:
                raise InputError(f"pole pairs: {name} {getattr(self, name)} is below {least}")


def pole_pair_extrinsics(
    cloud_lines: Sequence[CloudLine],
    image_lines: Sequence[ImageLine],
    ground: Ground,
    camera: CameraModel,
    parameters: PolePairParameters | None = None,
) -> Floats:
    """All extrinsics by which two poles and a lane of the image may show two poles and a lane of the cloud.

    Args:
        cloud_lines: Lines in the LiDAR frame; ends in any order.
        image_lines: Lines in ideal px.
        ground: The road, its normal on the side of up, along which poles stand.
        camera: Intrinsics; of the lens only K, the lines being ideal.
        parameters: What takes part; None: the defaults.

    Returns:
        float64 (N,4,4), in no particular order; none where lines are missing, or no upright camera above the
        road and near the LiDAR has the poles before it.
    """
    p = parameters or PolePairParameters()
    image_poles = longest_lines(image_lines, "pole", p.image_poles)
    image_lanes = longest_lines(image_lines, "lane", p.image_lanes)
    cloud_poles = largest_poles(cloud_lines, p.cloud_poles)
    cloud_lanes = longest_lines(cloud_lines, "lane", p.cloud_lanes)
    if min(len(image_poles), len(cloud_poles)) < _TWO or not image_lanes or not cloud_lanes:
        return np.zeros((0, 4, 4))
    stands, lies = (_normals(lines, camera) for lines in (image_poles, image_lanes))
    foot = np.stack([0.5 * (line.start + line.end) for line in cloud_poles])
    lane = np.stack([0.5 * (line.start + line.end) for line in cloud_lanes])
    ahead = np.stack([line.end - line.start for line in cloud_lanes])
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    seen = np.argwhere(np.triu(np.ones((len(stands), len(stands)), dtype=np.bool_), 1))
    known = np.argwhere(~np.eye(len(foot), dtype=np.bool_))
    gap = np.cross(foot[known[:, 1]] - foot[known[:, 0]], ground.normal)
    known = known[np.linalg.norm(gap, axis=1) >= p.apart_m]
    i, j, a, b = (index.ravel() for index in np.indices((len(seen), len(lies), len(known), len(lane))))
    n1, n2, n3 = stands[seen[i, 0]], stands[seen[i, 1]], lies[j]
    meeting = np.cross(n1, n2)
    beside = np.abs(np.einsum("mi,mi->m", meeting, n3))
    good = np.linalg.norm(meeting, axis=1) >= p.least_sine
    good &= beside >= p.least_sine * np.linalg.norm(meeting, axis=1)
    i, j, a, b, n1, n2, n3 = (array[good] for array in (i, j, a, b, n1, n2, n3))
    up = np.broadcast_to(ground.normal, n1.shape)
    poles = foot[known[a, 0]], foot[known[a, 1]]
    roots = p3l.p3l_candidates(n1, n2, n3, up, ahead[b], *poles, lane[b])
    T = roots.T_cam_lidar
    seen_so = roots.valid[:, None] & _believable(T, ground, p)
    for pole in poles:
        seen_so &= p3l.in_front(T, pole[:, None])
    return np.asarray(T[seen_so])


_TWO = 2
"""Poles that a pair has."""


def _normals(lines: Sequence[ImageLine], camera: CameraModel) -> Floats:
    """Unit normals (M,3) of the planes through the camera and the lines, camera axes."""
    start, end = (np.stack(ends) for ends in zip(*((line.start, line.end) for line in lines), strict=True))
    return p3l.plane_normals(start, end, camera.K)


def _believable(T: Floats, ground: Ground, p: PolePairParameters) -> np.ndarray:
    """Whether extrinsics (M,4,4,4) are those of an upright camera above the road and near the LiDAR."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    centre = -np.einsum("mkji,mkj->mki", R, t)
    height = centre @ ground.normal + ground.offset
    upright = -(R[..., 1, :] @ ground.normal) >= math.cos(p.upright)
    near = np.linalg.norm(t, axis=-1) <= p.baseline_m
    return np.asarray(upright & near & (height >= p.height_m[0]) & (height <= p.height_m[1]))
