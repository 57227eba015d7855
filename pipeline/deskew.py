"""Points of a moving sensor brought to one instant (FORMULAS G3).

A spinning LiDAR measures for a tenth of a second while the vehicle moves: at 20 m/s a sweep is bent by two
metres. With the twist of the sensor and the time of each point the sweep is straightened, and moved to the
instant at which the camera exposes, so that what remains between cloud and image is the extrinsic alone.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline import se3
from pipeline.errors import InputError
from pipeline.records import Floats, PointCloud, read_only

SpinSense: TypeAlias = Literal["cw", "ccw"]
"""Sense of rotation of the beams, seen from the tip of the spin axis (from above)."""

_Real = TypeVar("_Real", np.float32, np.float64)

_TURN = 2.0 * math.pi
_BLOCK = 8192
"""Points moved at a time: they stay in the cache, twenty times faster than a whole sweep at once."""
_SLOW_RAD_S = 1e-9
"""rad/s; below it a second of turning moves no point by more than a micrometre at a kilometre."""


@dataclass(frozen=True, slots=True, eq=False)
class Twist:
    """Constant motion of the LiDAR in its own axes: after tau seconds its pose is ``Exp(tau w)``.

    A vehicle that drives forward and turns left with a LiDAR of vehicle axes has ``velocity[0] > 0`` and
    ``omega[2] > 0``.

    Attributes:
        omega: float64 (3,), rad/s.
        velocity: float64 (3,), m/s, of the LiDAR's origin.
    """

    omega: Floats
    velocity: Floats

    def __post_init__(self) -> None:
        for name in ("omega", "velocity"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise InputError(f"Twist.{name} is {value.tolist()}, wanted three finite numbers")
            object.__setattr__(self, name, read_only(value))

    @property
    def vector(self) -> Floats:
        """``w = (omega, velocity)`` as float64 (6,)."""
        return np.concatenate([self.omega, self.velocity])

    def pose(self, tau: float) -> Floats:
        """``Exp(tau w)``, float64 (4,4): maps points of the LiDAR at tau seconds into its frame at zero."""
        return se3.transform(
            se3.exp_so3(tau * self.omega), displaced(np.zeros((1, 3)), np.array([tau]), self)[0]
        )

    def in_frame(self, T_new_lidar: Floats) -> "Twist":
        """The same motion told in another frame of the same body (FORMULAS A3: ``Ad(T) w``)."""
        omega = T_new_lidar[:3, :3] @ self.omega
        return Twist(omega, T_new_lidar[:3, :3] @ self.velocity + np.cross(T_new_lidar[:3, 3], omega))


@dataclass(frozen=True, slots=True, eq=False)
class Spin:
    """How the beams of a LiDAR go round.

    Attributes:
        sense: Seen from the tip of ``axis``.
        axis: float64 (3,), unit, LiDAR frame: the spin axis, upwards.
        start: float64 (3,), LiDAR frame: where the beams look when the sweep begins; its part along the
            axis is ignored.
    """

    sense: SpinSense
    axis: Floats
    start: Floats

    def __post_init__(self) -> None:
        for name in ("axis", "start"):
            object.__setattr__(self, name, read_only(np.asarray(getattr(self, name), dtype=np.float64)))
        if not np.linalg.norm(np.cross(self.axis, self.start)) > 0.0:
            raise InputError(
                f"sweep start {self.start.tolist()} lies along the spin axis {self.axis.tolist()}",
                hint="give a direction across the axis, such as straight back",
            )


def sweep_times(cloud: PointCloud, sweep_s: float, spin: Spin | None) -> NDArray[np.float32] | None:
    """When each point was measured, s after the sweep began (the cloud's own ``time``: after its stamp).

    Args:
        cloud: The sweep.
        sweep_s: Duration of a turn, s.
        spin: Sense, axis and start of the turn, or None where they are not known.

    Returns:
        float32 (N,): the cloud's own times where it has any, else those of the azimuths; None without both.
    """
    if cloud.time is not None:
        return cloud.time
    if spin is None:
        return None
    return np.asarray(turned(cloud.xyz, spin) * (sweep_s / _TURN), dtype=np.float32)


def turned(points: NDArray[np.floating], spin: Spin) -> Floats:
    """Angle (N,) in 0..2 pi that the beams have turned since the sweep began when they meet points (N,3)."""
    across = np.cross(spin.axis, spin.start)
    if spin.sense == "cw":
        across = -across
    ahead = np.cross(np.cross(spin.axis, spin.start), spin.axis)
    # Equal lengths for equal scales: axis x start and (axis x start) x axis differ by the length of the axis.
    across, ahead = across / np.linalg.norm(across), ahead / np.linalg.norm(ahead)
    plan = points @ np.stack([across, ahead], axis=1).astype(points.dtype)
    return np.asarray(np.mod(np.arctan2(plan[:, 0], plan[:, 1]), _TURN), dtype=np.float64)


def displaced(points: NDArray[_Real], tau: Floats, twist: Twist) -> NDArray[_Real]:
    """``Exp(tau_i w) p_i`` in closed form (FORMULAS G3).

    Args:
        points: (N,3), metres, each in the LiDAR frame of its own instant.
        tau: float64 (N,), s, that instant after the reference.
        twist: Constant over all of them.

    Returns:
        (N,3), metres, LiDAR frame of the reference instant, in the type of ``points``.
    """
    kind = points.dtype
    moved = points.copy()
    rate = float(np.linalg.norm(twist.omega))
    if rate < _SLOW_RAD_S:
        moved += np.multiply.outer(tau, twist.velocity).astype(kind)
        return moved
    axis = twist.omega / rate
    angle = (rate * tau).astype(kind)
    sine, half = np.sin(angle), np.sin(angle / 2)
    # 1 - cos loses its digits where the angle is small.
    versine = 2 * half * half
    W = se3.skew(axis)
    moved += sine[:, None] * (points @ W.T.astype(kind))
    moved += versine[:, None] * (points @ (W @ W).T.astype(kind))
    # The path of the origin: along the axis it goes straight, across it on a circle.
    along = axis * (axis @ twist.velocity)
    path = np.stack([along, twist.velocity - along, np.cross(axis, twist.velocity)]) / rate
    moved += np.stack([angle, sine, versine], axis=1) @ path.astype(kind)
    return moved


def deskew(cloud: PointCloud, time: NDArray[np.floating], twist: Twist, reference_s: float) -> PointCloud:
    """The sweep as it would have been measured in one instant (FORMULAS G3, exact for a constant twist).

    Args:
        cloud: The sweep, each point in the LiDAR frame of its own instant.
        time: (N,), s, when each point was measured, on the clock of ``reference_s``.
        twist: Motion of the LiDAR during the sweep and up to the reference.
        reference_s: The instant to bring the points to, s. With times after the cloud's stamp and
            ``image stamp - cloud stamp`` (middle of the exposure) the ego motion between the two is undone
            as well.

    Returns:
        The cloud in the LiDAR frame of the reference instant; every point's ``time`` is the reference.

    Raises:
        InputError: If there is not one finite time per point.
    """
    tau = np.asarray(time, dtype=np.float64) - reference_s
    if tau.shape != (len(cloud),) or not np.isfinite(tau).all():
        raise InputError(f"{tau.shape} times for {len(cloud)} points", hint="give one finite time per point")
    xyz = np.empty_like(cloud.xyz)
    for first in range(0, len(xyz), _BLOCK):
        block = slice(first, first + _BLOCK)
        xyz[block] = displaced(cloud.xyz[block], tau[block], twist)
    return dataclasses.replace(cloud, xyz=xyz, time=np.full(len(cloud), reference_s, dtype=np.float32))
