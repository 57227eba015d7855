"""How a sensor sits in the frame of its cloud: the apex and the axis of its rings, found in the points.

Clouds come in the frame of the sensor, of the vehicle, or of whatever a driver was told; rings are cones
about the sensor alone.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.medians import group_medians, median
from pipeline.records import Floats, PointCloud, read_only
from pipeline.rings import elevation_rings, ring_numbers, spin_turns
from pipeline.se3 import exp_so3

_ORIGIN_POINTS = 8000
"""Points that tell where the sensor stands: some hundred a ring."""

_ORIGIN_STEPS = 12
"""Gauss-Newton steps; from 2 m off the last one moves by less than a millimetre."""

_FARTHEST_ORIGIN_M = 5.0
"""m; a vehicle's own frame lies nearer."""

_LEAST_UPRIGHT = math.cos(math.radians(30.0))
"""Cosine of the largest tilt that is sought: beyond it another axis of the frame is nearly as near."""

_SHARPER = 0.5
"""Share of the rings' spread that must be gone when they are seen from the origin that was found."""

FULLER = 1.25
"""A sweep of so many times the points tells the seat anew: the first one after a start is often a part of a
turn, which tells it wrongly. Whole sweeps of one drive differ by less."""

_OUTLIER_SIGMAS = 3.0
"""Robust sigmas beyond which a point does not count: near objects between the lasers."""


@dataclass(frozen=True, slots=True, eq=False)
class SensorSeat:
    """How the sensor sits in the frame of its cloud.

    Attributes:
        origin: float64 (3,), the apex of its rings, m.
        axis: float64 (3,), unit, its spin axis, near to the x, y or z axis of the frame.
    """

    origin: Floats
    axis: Floats

    def __post_init__(self) -> None:
        object.__setattr__(self, "origin", read_only(self.origin))
        object.__setattr__(self, "axis", read_only(self.axis))


def sensor_origin(cloud: PointCloud) -> Floats:
    """Where the sensor stands in the cloud's frame, float64 (3,), m; zero where nothing says otherwise."""
    return sensor_seat(cloud).origin


def sensor_seat(cloud: PointCloud) -> SensorSeat:
    """Where the sensor stands in the cloud's frame and about which axis it spins.

    Rings are cones with one apex and one axis (PROBE 8): seen from there each keeps its elevation. A cloud
    that was moved and turned to the vehicle's frame shows its rings bent instead, which tells the way back.
    Where rings do not become much sharper the sensor is taken to sit straight at the origin.
    """
    finite = np.isfinite(cloud.xyz).all(axis=1)
    cloud = PointCloud(cloud.xyz[finite], ring=None if cloud.ring is None else cloud.ring[finite])
    if len(cloud) == 0:
        return SensorSeat(np.zeros(3), np.eye(3)[2])
    turn = spin_turns(cloud)[0]
    straight = SensorSeat(np.zeros(3), turn[2])
    ring = ring_numbers(dataclasses.replace(cloud, xyz=(cloud.xyz @ turn.T).astype(np.float32)))
    if ring is None:
        return straight
    chosen = np.flatnonzero(ring >= 0)
    chosen = chosen[:: max(1, len(chosen) // _ORIGIN_POINTS)]
    order = chosen[np.argsort(ring[chosen], kind="stable")]
    group = np.unique(ring[order], return_inverse=True)[1]
    xyz = cloud.xyz[order].astype(np.float64) @ turn.T
    origin, R = np.zeros(3), np.eye(3)
    # From metres off the two together do not converge: the apex goes first.
    for unknowns in (3,) * _ORIGIN_STEPS + (5,) * _ORIGIN_STEPS:
        error, J = _cone_errors((xyz - origin) @ R.T, group)
        J = J[:, :unknowns]
        spread = 1.48 * median(np.abs(error))
        kept = np.abs(error) <= _OUTLIER_SIGMAS * max(spread, 1e-9)
        information = J[kept].T @ J[kept] + 1e-9 * np.eye(unknowns)
        step = np.zeros(5)
        step[:unknowns] = -np.linalg.solve(information, J[kept].T @ error[kept])
        origin = origin + R.T @ step[:3]
        R = exp_so3(np.array([step[3], step[4], 0.0])) @ R
    before, after = (_cone_errors(p, group)[0] for p in (xyz, (xyz - origin) @ R.T))
    near = float(np.linalg.norm(origin)) <= _FARTHEST_ORIGIN_M and R[2, 2] >= _LEAST_UPRIGHT
    if not near or median(np.abs(after)) >= _SHARPER * median(np.abs(before)):
        return straight
    return SensorSeat(origin @ turn, R[2] @ turn)


def numbered(cloud: PointCloud, seat: SensorSeat) -> PointCloud | None:
    """The sweep as it was measured with the rings that only its elevations tell; None where they tell none.

    Args:
        cloud: The sweep; None comes back too where it names its rings, or their order tells them.
        seat: How its sensor sits in it.
    """
    finite = np.flatnonzero(np.isfinite(cloud.xyz).all(axis=1))
    xyz = (cloud.xyz[finite] - seat.origin) @ _to_z(seat.axis).T
    bare = PointCloud(xyz.astype(np.float32), ring=None if cloud.ring is None else cloud.ring[finite])
    found = elevation_rings(bare)
    if found is None:
        return None
    ring = np.zeros(len(cloud), dtype=np.uint16)
    ring[finite] = np.maximum(found, 0)
    return dataclasses.replace(cloud, ring=ring)


def _to_z(axis: Floats) -> Floats:
    """Rotation (3,3) that brings a unit axis to z the shortest way."""
    across = np.cross(axis, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(across))
    if sine == 0.0:
        return np.eye(3)
    return exp_so3(across / sine * math.atan2(sine, float(axis[2])))


def _cone_errors(p: Floats, group: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Angle (N,) of points from the cone of their ring about z; its slope (N,5) by apex, turns about x, y."""
    rho = np.maximum(np.hypot(p[:, 0], p[:, 1]), 1e-6)
    count = int(group[-1]) + 1
    k = group_medians(p[:, 2] / rho, group, count)[group]
    reach = np.hypot(rho, p[:, 2]) * np.sqrt(1.0 + k * k)
    error = (p[:, 2] - k * rho) / reach
    J = np.column_stack([k * p[:, 0] / rho, k * p[:, 1] / rho, -np.ones(len(p))]) / reach[:, None]
    # The apex moves points against it, a turn w by w x p.
    about_x = J[:, 1] * p[:, 2] - J[:, 2] * p[:, 1]
    about_y = J[:, 2] * p[:, 0] - J[:, 0] * p[:, 2]
    J = np.column_stack([J, about_x, about_y])
    # The cone of each ring is fitted anew at every apex: what all its points share tells nothing.
    members = np.maximum(np.bincount(group, minlength=count), 1)
    table = np.column_stack([error, J])
    means = np.column_stack([np.bincount(group, column, minlength=count) / members for column in table.T])
    table -= means[group]
    return table[:, 0], table[:, 1:]
