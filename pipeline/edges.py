"""Edges of a cloud that an image shows too: jumps of range, and paint on the road (PROBE section 1).

Each edge is a point on the border as the camera sees it, with the direction across the border. Sizes that
depend on the sensor (steps along and between rings, noise of the intensity) come from the cloud itself.
"""

import dataclasses
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipeline import cameras, se3
from pipeline.ground import Ground
from pipeline.medians import median
from pipeline.records import CameraModel, Floats, PointCloud, read_only
from pipeline.rings import ScanPattern, scan_pattern, spin_turns
from pipeline.strips import StripShape, strips_about

RING_JUMP, BETWEEN_RINGS, PAINT = 0, 1, 2
"""Kinds of edges."""

KIND_NAMES: tuple[Literal["ring_jump", "between_rings", "paint"], ...] = (
    "ring_jump",
    "between_rings",
    "paint",
)

CELL_COLUMNS, CELL_ROWS = 16, 6
"""Cells of the image in which edges are capped and, over a window, count as one witness."""


@dataclass(frozen=True, slots=True)
class EdgeParameters:
    """What counts as an edge. Lengths in metres, angles in steps of the sensor itself.

    Attributes:
        jump_m: Smallest jump along a ring, m: the depth of a parked car's flank.
        jump_share: The same as a share of the nearer range: noise and slant grow with range.
        jump_up_m: Smallest jump to the ring above, m.
        jump_up_share: The same as a share: the road itself recedes from ring to ring.
        sparsest_rad: With rings further apart, jumps between them are left out: where in the gap the edge is
            lies open, and half of this gap is three times the blur of the image.
        above_ground_m: The nearer point of a jump to the ring above stands at least so high, m.
        gap_steps: A gap along the ring of more azimuth steps breaks it: what lies there was not seen.
        inset: How far an edge lies from the nearer point towards the farther ray, in steps: between the two,
            a little on the side of the body, for a beam that grazes it still returns.
        weights: Weight of each kind: between rings the edge is known to half a ring's gap only.
        most: Edges kept per frame.
        margin_px: Edges so far outside the image are kept: a wrong extrinsic may move them in.
        ground_band_m: Paint lies within so much of the ground plane, m.
        paint_nearest_m: Nearer, the car's own hood and shadow are seen.
        paint_farthest_m: Farther, a strip is narrower than a step.
        strip_narrowest_m: Narrower is noise.
        strip_widest_m: Wider is no longer a line.
        background_m: Width of road at each side of a strip with which it is compared, m.
        paint_noise: A strip rises over its background by so many sigma of the intensity noise.
        paint_contrast: The same as a share of the road's median intensity.
        paint_asymmetry: Largest difference of the two backgrounds as a share of the rise: a kerb is a step.
    """

    jump_m: float = 0.5
    jump_share: float = 0.06
    jump_up_m: float = 1.0
    jump_up_share: float = 0.15
    sparsest_rad: float = math.radians(0.8)
    above_ground_m: float = 0.4
    gap_steps: float = 2.6
    inset: float = 0.45
    weights: tuple[float, float, float] = (1.0, 0.5, 1.0)
    most: int = 1500
    margin_px: float = 30.0
    ground_band_m: float = 0.15
    paint_nearest_m: float = 3.0
    paint_farthest_m: float = 35.0
    strip_narrowest_m: float = 0.05
    strip_widest_m: float = 0.8
    background_m: float = 0.6
    paint_noise: float = 5.0
    paint_contrast: float = 0.35
    paint_asymmetry: float = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """Edges of one cloud.

    Attributes:
        position: float64 (N,3), metres, LiDAR frame.
        direction: float64 (N,3), unit, across the border, LiDAR frame.
        kind: uint8 (N,), RING_JUMP, BETWEEN_RINGS or PAINT.
        weight: float64 (N,).
        cell: int64 (N,), number of the image cell and kind in which it falls under the stored extrinsic.
    """

    position: Floats
    direction: Floats
    kind: NDArray[np.uint8]
    weight: Floats
    cell: NDArray[np.int64]

    def __post_init__(self) -> None:
        for name in ("position", "direction", "kind", "weight", "cell"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.position)


_STRAIGHT = 1e-9
"""Sine of a tilt that is none."""

CELLS = CELL_COLUMNS * CELL_ROWS
"""Number of image cells."""


def find_edges(
    cloud: PointCloud,
    ground: Ground | None,
    camera: CameraModel,
    T_cam_lidar: Floats,
    parameters: EdgeParameters,
    origin: Floats | None = None,
    axis: Floats | None = None,
) -> Edges | None:
    """Edges of the cloud that fall into the image or just beside it; None where the cloud shows no rings.

    Args:
        cloud: The sweep.
        ground: Its ground plane, or None: no jumps between rings, no paint.
        camera: Intrinsics.
        T_cam_lidar: float64 (4,4), the stored extrinsic.
        parameters: What counts as an edge.
        origin: float64 (3,), where the sensor stands in the cloud's frame (``sensor_seat``); None: at
            its origin.
        axis: float64 (3,), unit, about which it spins (``sensor_seat``); None: an axis of that frame.
    """
    T_lidar_sensor = _seated(origin, axis)
    if T_lidar_sensor is not None:
        R, t = T_lidar_sensor[:3, :3], T_lidar_sensor[:3, 3]
        there = dataclasses.replace(cloud, xyz=((cloud.xyz - t) @ R).astype(np.float32))
        plane = None
        if ground is not None:
            offset = ground.offset + float(ground.normal @ t)
            plane = dataclasses.replace(ground, normal=R.T @ ground.normal, offset=offset)
        found = find_edges(there, plane, camera, T_cam_lidar @ T_lidar_sensor, parameters)
        if found is None:
            return None
        position, direction = found.position @ R.T + t, found.direction @ R.T
        return dataclasses.replace(found, position=position, direction=direction)
    for turn in spin_turns(cloud):
        if np.array_equal(turn, np.eye(3)):
            found = _about_z(cloud, ground, camera, T_cam_lidar, parameters)
        else:
            T_back = se3.transform(turn.T, np.zeros(3))
            turned = dataclasses.replace(cloud, xyz=(cloud.xyz @ turn.T).astype(np.float32))
            plane = None if ground is None else dataclasses.replace(ground, normal=turn @ ground.normal)
            found = _about_z(turned, plane, camera, T_cam_lidar @ T_back, parameters)
            if found is not None:
                position, direction = found.position @ turn, found.direction @ turn
                found = dataclasses.replace(found, position=position, direction=direction)
        if found is not None:
            return found
    return None


def _seated(origin: Floats | None, axis: Floats | None) -> Floats | None:
    """T_lidar_sensor (4,4) of a sensor that spins about its own axis; None: the cloud has that frame.

    The axis of the cloud's frame that is nearest to the spin axis is turned to it the shortest way.
    """
    t = np.zeros(3) if origin is None else origin
    R = np.eye(3)
    if axis is not None:
        nearest = int(np.argmax(np.abs(axis)))
        own = np.sign(axis[nearest]) * np.eye(3)[nearest]
        across = np.cross(own, axis)
        sine = float(np.linalg.norm(across))
        if sine > _STRAIGHT:
            R = se3.exp_so3(across / sine * math.atan2(sine, float(own @ axis)))
    if not t.any() and np.array_equal(R, np.eye(3)):
        return None
    return se3.transform(R, t)


def _about_z(
    cloud: PointCloud,
    ground: Ground | None,
    camera: CameraModel,
    T_cam_lidar: Floats,
    parameters: EdgeParameters,
) -> Edges | None:
    """The edges of a sensor that spins about the z axis of its cloud."""
    pattern = scan_pattern(cloud, _in_view(cloud, camera, T_cam_lidar))
    if pattern is None:
        return None
    xyz = cloud.xyz.take(pattern.index, axis=0).astype(np.float64)
    azimuth = _true_azimuth(xyz)
    tangent = np.column_stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(xyz))])
    found = [_ring_jumps(xyz, tangent, pattern, parameters)]
    if ground is not None:
        found.append(_jumps_between_rings(xyz, pattern, ground, parameters))
        if cloud.intensity is not None:
            intensity = cloud.intensity[pattern.index].astype(np.float64)
            found.append(_paint(xyz, tangent, intensity, pattern, ground, parameters))
    position = np.concatenate([f[0] for f in found])
    direction = np.concatenate([f[1] for f in found])
    kind = np.repeat(np.arange(len(found), dtype=np.uint8), [len(f[0]) for f in found])
    return _thinned(position, direction, kind, camera, T_cam_lidar, parameters)


def _in_view(cloud: PointCloud, camera: CameraModel, T_cam_lidar: Floats) -> NDArray[np.bool_]:
    """Points inside the camera's field of view plus a margin of some degrees, bool (N,)."""
    border = _border_rays(camera)
    T = T_cam_lidar.astype(np.float32)
    z = cloud.xyz @ T[2, :3] + T[2, 3]
    x = cloud.xyz @ T[0, :3] + T[0, 3]
    y = cloud.xyz @ T[1, :3] + T[1, 3]
    left, right, top, bottom = border
    return np.asarray(
        (z > cameras.NEAREST_DEPTH_M) & (x > left * z) & (x < right * z) & (y > top * z) & (y < bottom * z)
    )


_VIEW_MARGIN = math.tan(math.radians(3.0))
"""Margin of the view as a slope: what a wrong extrinsic of some degrees would bring in."""

_WIDEST_SLOPE = 5.0
"""Slope of the steepest ray that is looked at (79 deg off axis), for lenses that see more."""


@lru_cache(maxsize=16)
def _border_rays(camera: CameraModel) -> tuple[float, float, float, float]:
    """Slopes x/z and y/z of the border of the image: left, right, top, bottom, with the margin."""
    u = np.linspace(0.0, camera.width - 1.0, 17)
    v = np.linspace(0.0, camera.height - 1.0, 17)
    sides = (
        np.column_stack([np.zeros_like(v), v]),
        np.column_stack([np.full_like(v, camera.width - 1.0), v]),
        np.column_stack([u, np.zeros_like(u)]),
        np.column_stack([u, np.full_like(u, camera.height - 1.0)]),
    )
    slopes = [np.nan_to_num(cameras.undistort(camera, s), nan=np.inf) for s in sides]

    def clipped(value: float) -> float:
        return float(np.clip(value, -_WIDEST_SLOPE, _WIDEST_SLOPE))

    finite = [
        np.where(np.isfinite(s), s, sign * _WIDEST_SLOPE)
        for s, sign in zip(slopes, (-1, 1, -1, 1), strict=True)
    ]
    return (
        clipped(float(finite[0][:, 0].min())) - _VIEW_MARGIN,
        clipped(float(finite[1][:, 0].max())) + _VIEW_MARGIN,
        clipped(float(finite[2][:, 1].min())) - _VIEW_MARGIN,
        clipped(float(finite[3][:, 1].max())) + _VIEW_MARGIN,
    )


def _true_azimuth(xyz: Floats) -> Floats:
    return np.asarray(np.arctan2(xyz[:, 1], xyz[:, 0]), dtype=np.float64)


def _ring_jumps(
    xyz: Floats, tangent: Floats, pattern: ScanPattern, parameters: EdgeParameters
) -> tuple[Floats, Floats]:
    """Kind 0: the nearer point of a jump along a ring, moved towards the farther ray."""
    r = pattern.distance
    near_gap = np.diff(pattern.azimuth) < parameters.gap_steps * pattern.azimuth_step
    same = (np.diff(pattern.ring) == 0) & near_gap
    jump = np.diff(r)
    nearest = np.minimum(r[:-1], r[1:])
    edge = np.flatnonzero(
        same & (np.abs(jump) > np.maximum(parameters.jump_m, parameters.jump_share * nearest))
    )
    forward = jump[edge] > 0
    near = np.where(forward, edge, edge + 1)
    flat = np.hypot(xyz[near, 0], xyz[near, 1])
    shift = np.where(forward, 1.0, -1.0) * parameters.inset * pattern.azimuth_step * flat
    return xyz[near] + shift[:, None] * tangent[near], tangent[near]


def _jumps_between_rings(
    xyz: Floats, pattern: ScanPattern, ground: Ground, parameters: EdgeParameters
) -> tuple[Floats, Floats]:
    """Kind 1: a point above the ground beside which the ring above sees much farther, moved half a gap up."""
    if pattern.ring_spacing > parameters.sparsest_rad:
        return np.zeros((0, 3)), np.zeros((0, 3))
    upward = 1 if ground.normal[2] >= 0 else -1
    turn = 4.0 * math.pi
    key = pattern.ring * turn + pattern.azimuth
    wanted = (pattern.ring + upward) * turn + pattern.azimuth
    right = np.clip(np.searchsorted(key, wanted), 1, len(key) - 1)
    partner = np.where(wanted - key[right - 1] < key[right] - wanted, right - 1, right)
    beside = np.abs(key[partner] - wanted) < 0.6 * pattern.azimuth_step
    gap = (pattern.elevation[partner] - pattern.elevation) * upward
    neighbours = (gap > 0.2 * pattern.ring_spacing) & (gap < 2.2 * pattern.ring_spacing)
    jump = pattern.distance[partner] - pattern.distance
    far = jump > np.maximum(parameters.jump_up_m, parameters.jump_up_share * pattern.distance)
    edge = np.flatnonzero(beside & neighbours & far & (ground.heights(xyz) > parameters.above_ground_m))
    azimuth, elevation = _true_azimuth(xyz[edge]), pattern.elevation[edge]
    up = np.column_stack(
        [-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth), np.cos(elevation)]
    )
    shift = 0.5 * upward * gap[edge] * pattern.distance[edge]
    return xyz[edge] + shift[:, None] * up, up


def _paint(
    xyz: Floats,
    tangent: Floats,
    intensity: Floats,
    pattern: ScanPattern,
    ground: Ground,
    parameters: EdgeParameters,
) -> tuple[Floats, Floats]:
    """Kind 2: both borders of each bright strip along a ring on the ground, at half of its rise."""
    on_ground = np.abs(ground.heights(xyz)) < parameters.ground_band_m
    on_ground &= (pattern.distance > parameters.paint_nearest_m) & (
        pattern.distance < parameters.paint_farthest_m
    )
    if int(on_ground.sum()) < 10:
        return np.zeros((0, 3)), np.zeros((0, 3))
    beside = (np.diff(pattern.ring) == 0) & (
        np.diff(pattern.azimuth) < parameters.gap_steps * pattern.azimuth_step
    )
    pairs = beside & on_ground[1:] & on_ground[:-1]
    noise = 1.48 * median(np.abs(np.diff(intensity)[pairs])) / math.sqrt(2.0) if pairs.any() else 0.0
    road = median(intensity[on_ground])
    least = max(parameters.paint_noise * noise, parameters.paint_contrast * road)
    # Stretches of ground along one ring without a gap; strips are sought inside each.
    starts = np.flatnonzero(np.concatenate([[True], ~pairs]))
    stretch = np.cumsum(np.concatenate([[True], ~pairs])) - 1
    dx, dy, dz = np.diff(np.ascontiguousarray(xyz.T))
    along = np.concatenate([[0.0], np.cumsum(np.where(pairs, np.sqrt(dx * dx + dy * dy + dz * dz), 0.0))])
    peak = np.flatnonzero(
        on_ground
        & (intensity > road + least)
        & (intensity >= np.concatenate([[-np.inf], np.where(pairs, intensity[:-1], -np.inf)]))
        & (intensity > np.concatenate([np.where(pairs, intensity[1:], -np.inf), [-np.inf]]))
    )
    ends = np.concatenate([starts[1:], [len(xyz)]])
    reach = parameters.strip_widest_m + parameters.background_m
    first = np.maximum(starts[stretch[peak]], np.searchsorted(along, along[peak] - reach))
    last = np.minimum(ends[stretch[peak]], np.searchsorted(along, along[peak] + reach))
    shape = StripShape(
        least,
        parameters.paint_asymmetry,
        parameters.strip_narrowest_m,
        parameters.strip_widest_m,
        parameters.background_m,
    )
    borders: list[float] = []
    last_end = -1
    for p, end, left, right in strips_about(along, intensity, (peak, first, last), shape):
        if p > last_end:
            last_end = int(end)
            borders.extend((left, right))
    if not borders:
        return np.zeros((0, 3)), np.zeros((0, 3))
    place = np.array(borders)
    whole = np.floor(place).astype(np.int64)
    part = (place - whole)[:, None]
    nxt = np.minimum(whole + 1, len(xyz) - 1)
    return (1.0 - part) * xyz[whole] + part * xyz[nxt], tangent[whole]


def _thinned(
    position: Floats,
    direction: Floats,
    kind: NDArray[np.uint8],
    camera: CameraModel,
    T_cam_lidar: Floats,
    parameters: EdgeParameters,
) -> Edges:
    """Keeps the edges in the image (with margin), at most ``most``, by a common cap per cell and kind."""
    uv, valid = cameras.project_unbounded(camera, position @ T_cam_lidar[:3, :3].T + T_cam_lidar[:3, 3])
    m = parameters.margin_px
    with np.errstate(invalid="ignore"):
        valid &= (
            (uv[:, 0] > -m) & (uv[:, 0] < camera.width + m) & (uv[:, 1] > -m) & (uv[:, 1] < camera.height + m)
        )
    kept = np.flatnonzero(valid)
    column = np.clip(uv[kept, 0] / camera.width * CELL_COLUMNS, 0, CELL_COLUMNS - 1).astype(np.int64)
    row = np.clip(uv[kept, 1] / camera.height * CELL_ROWS, 0, CELL_ROWS - 1).astype(np.int64)
    cell = row * CELL_COLUMNS + column
    chosen = _capped(cell * len(KIND_NAMES) + kind[kept], parameters.most)
    kept, cell = kept[chosen], cell[chosen]
    weight = np.asarray(parameters.weights)[kind[kept]]
    return Edges(position[kept], direction[kept], kind[kept], weight, cell)


def _capped(group: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Indices of at most ``most`` members, the cap per group as high as can be, evenly spread in each."""
    if len(group) <= most:
        return np.arange(len(group))
    counts = np.bincount(group)
    caps = np.arange(1, int(counts.max()) + 1)
    totals = np.minimum(counts[None, :], caps[:, None]).sum(axis=1)
    cap = int(caps[max(0, int(np.searchsorted(totals, most, side="right")) - 1)])
    order = np.argsort(group, kind="stable")
    starts = np.searchsorted(group[order], np.arange(len(counts)))
    rank = np.arange(len(group)) - starts[group[order]]
    size = counts[group[order]]
    # Member k of n is kept where floor(k cap / n) steps: every n/cap-th one.
    keep = np.floor((rank + 1) * cap / size) > np.floor(rank * cap / size)
    return np.sort(order[keep | (size <= cap)])
