"""What the evidence can see: directions in units of the alert limits (FORMULAS A4, D3; DESIGN 4)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import se3
from pipeline.records import Floats, read_only

MAX_SIGMA = 2.0
"""Alert limits; a direction known worse than this is held (DESIGN 4, 'observable')."""

NULL_RATIO = 1e-9
"""Eigenvalue over the largest below which a direction has no information at all (FORMULAS D3)."""

FARTHEST = 20.0
"""Alert limits; no mount moves further (10 deg, 3 to 4 m), so a null direction is known at least so well. It
keeps a null direction that leans on an axis by a hundredth from taking that axis away as well."""


def in_vehicle_axes(xi: Floats, information: Floats, R_vehicle_cam: Floats) -> tuple[Floats, Floats]:
    """(phi, rho) in camera axes -> drift of the mount in vehicle axes (FORMULAS A4).

    Args:
        xi: float64 (6,), rad and m, camera axes.
        information: float64 (6,6), of xi.
        R_vehicle_cam: float64 (3,3), turns camera axes into vehicle axes.

    Returns:
        Drift float64 (6,) (roll, pitch, yaw, forward, left, up) to first order, and its information (6,6).
    """
    B = se3.vehicle_block(R_vehicle_cam)
    # B is orthogonal: B^-T I B^-1 = B I B^T.
    return B @ xi, B @ information @ B.T


@dataclass(frozen=True, slots=True, eq=False)
class Observability:
    """Directions of one information matrix, from the weakest to the strongest.

    Attributes:
        limits: float64 (6,), alert limits per axis, rad and m.
        sigmas: float64 (6,), standard deviation along each direction in alert limits, inf where null.
        directions: float64 (6,6), columns are unit vectors in alert limits, in the order of records.AXES.
        observed: bool (6,), directions whose sigma is at most ``MAX_SIGMA``; the others are held.
        axis_sigmas: float64 (6,), standard deviation of each axis, rad and m, directions counted as known
            to ``FARTHEST``; inf where the axis is not observed for a null direction that leans on it.
        axis_observed: bool (6,), axes whose sigma is at most ``MAX_SIGMA`` alert limits.
    """

    limits: Floats
    sigmas: Floats
    directions: Floats
    observed: NDArray[np.bool_]
    axis_sigmas: Floats
    axis_observed: NDArray[np.bool_]

    @property
    def rank(self) -> int:
        """Number of directions with any information."""
        return int(np.isfinite(self.sigmas).sum())

    def restrict(self, drift: Floats) -> Floats:
        """The part of a drift (6,) in the observed directions; held components become 0 (FORMULAS D3)."""
        V = self.directions[:, self.observed]
        return np.asarray(self.limits * (V @ (V.T @ (drift / self.limits))))


def observable(information: Floats, limits: Floats) -> Observability:
    """Eigen-decomposition of the information in units of the alert limits (FORMULAS D3).

    Args:
        information: float64 (6,6), symmetric and semidefinite; axes those of ``limits``.
        limits: float64 (6,), alert limit of each axis, rad and m, positive.

    Returns:
        Which directions and which axes are observed.
    """
    values, directions = np.linalg.eigh(information * np.outer(limits, limits))
    null = values <= NULL_RATIO * max(float(values[-1]), 0.0)
    variance = np.where(null, np.inf, 1.0 / np.where(null, 1.0, values))
    sigmas = np.sqrt(variance)
    share = directions**2
    bounded = np.sqrt(share @ np.minimum(variance, FARTHEST**2))
    leans = (share[:, null] * FARTHEST**2 > MAX_SIGMA**2).any(axis=1)
    observed = bounded <= MAX_SIGMA
    return Observability(
        read_only(limits),
        read_only(sigmas),
        read_only(directions),
        read_only(sigmas <= MAX_SIGMA),
        read_only(np.where(leans, np.inf, bounded) * limits),
        read_only(observed),
    )
