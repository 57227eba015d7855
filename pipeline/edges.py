"""Edges of a cloud that an image shows too: jumps of range, and paint on the road (PROBE section 1).

Each edge is a point on the border as the camera sees it, with the direction across the border. Sizes that
depend on the sensor (steps along and between rings, noise of the intensity) come from the cloud itself.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline import cameras, se3
from pipeline.edge_parameters import KIND_NAMES, EdgeParameters
from pipeline.field_of_view import in_view
from pipeline.ground import Ground
from pipeline.records import CameraModel, Floats, PointCloud, read_only
from pipeline.ring_edges import ring_edges, rings_are_mixed
from pipeline.rings import scan_pattern, spin_turns
from pipeline.view_edges import view_edges

CELL_COLUMNS, CELL_ROWS = 16, 6
"""Cells of the image in which edges are capped and, over a window, count as one witness."""


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


KindOfEdges: TypeAlias = tuple[Floats, Floats]
"""Positions and directions (K,3) of all edges of one kind."""

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
    """Edges of the cloud that fall into the image or just beside it; None where neighbours can not be told.

    Neighbours are those along and between the rings of a spinning sensor. Where there are none, or those of
    several sensors under the same numbers, they are those along rows and columns of the camera's view.

    Args:
        cloud: The sweep.
        ground: Its ground plane, or None: no jumps between rings, no paint, and nothing without rings.
        camera: Intrinsics.
        T_cam_lidar: float64 (4,4), the stored extrinsic.
        parameters: What counts as an edge.
        origin: float64 (3,), where the sensor stands in the cloud's frame (``sensor_seat``); None: at
            its origin.
        axis: float64 (3,), unit, about which it spins (``sensor_seat``); None: an axis of that frame.
    """
    found = _along_rings(cloud, ground, camera, T_cam_lidar, parameters, _seated(origin, axis))
    if found is None and ground is not None:
        found = view_edges(cloud, ground, camera, T_cam_lidar, parameters)
    return None if found is None else _thinned(found, camera, T_cam_lidar, parameters)


def _along_rings(
    cloud: PointCloud,
    ground: Ground | None,
    camera: CameraModel,
    T_cam_lidar: Floats,
    parameters: EdgeParameters,
    T_lidar_sensor: Floats,
) -> list[KindOfEdges] | None:
    """Edges of each kind, cloud's frame, of a sensor that spins about an axis of its own; None: no rings."""
    at_sensor = _seen_in(cloud, ground, T_lidar_sensor)
    for turn in spin_turns(at_sensor[0]):
        T_sensor_spin = se3.transform(turn.T, np.zeros(3))
        T_lidar_spin = T_lidar_sensor @ T_sensor_spin
        own, plane = _seen_in(*at_sensor, T_sensor_spin)
        pattern = scan_pattern(own, in_view(own, camera, T_cam_lidar @ T_lidar_spin))
        if pattern is not None and not rings_are_mixed(pattern, parameters):
            R, t = T_lidar_spin[:3, :3], T_lidar_spin[:3, 3]
            found = ring_edges(own, pattern, plane, parameters)
            return [(position @ R.T + t, direction @ R.T) for position, direction in found]
    return None


def _seen_in(
    cloud: PointCloud, ground: Ground | None, T_lidar_there: Floats
) -> tuple[PointCloud, Ground | None]:
    """The cloud and its ground plane in another frame."""
    R, t = T_lidar_there[:3, :3], T_lidar_there[:3, 3]
    if not t.any() and np.array_equal(R, np.eye(3)):
        return cloud, ground
    there = dataclasses.replace(cloud, xyz=((cloud.xyz - t) @ R).astype(np.float32))
    if ground is None:
        return there, None
    offset = ground.offset + float(ground.normal @ t)
    return there, dataclasses.replace(ground, normal=R.T @ ground.normal, offset=offset)


def _seated(origin: Floats | None, axis: Floats | None) -> Floats:
    """T_lidar_sensor (4,4) of a sensor that spins about its own axis.

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
    return se3.transform(R, t)


def _thinned(
    found: list[KindOfEdges], camera: CameraModel, T_cam_lidar: Floats, parameters: EdgeParameters
) -> Edges:
    """Keeps the edges in the image (with margin), at most ``most``, by a common cap per cell and kind."""
    position = np.concatenate([f[0] for f in found])
    direction = np.concatenate([f[1] for f in found])
    kind = np.repeat(np.arange(len(found), dtype=np.uint8), [len(f[0]) for f in found])
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
    cap, beyond = 1, int(counts.max())
    while beyond - cap > 1:
        middle = (cap + beyond) // 2
        fits = int(np.minimum(counts, middle).sum()) <= most
        cap, beyond = (middle, beyond) if fits else (cap, middle)
    order = np.argsort(group, kind="stable")
    starts = np.searchsorted(group[order], np.arange(len(counts)))
    rank = np.arange(len(group)) - starts[group[order]]
    size = counts[group[order]]
    # Member k of n is kept where floor(k cap / n) steps: every n/cap-th one.
    keep = np.floor((rank + 1) * cap / size) > np.floor(rank * cap / size)
    return np.sort(order[keep | (size <= cap)])
