"""Surfels of a sweep beside those of an earlier one, under a motion that is tried: how far they are apart."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.deskew import Twist, displaced
from pipeline.records import Floats
from pipeline.surfels import Surfels

SURFACE_SIGMA_M = 0.01
"""m; what walls and roads are not flat within a cell, added to the measured thickness."""

ALIKE_COSINE = 0.85
"""Least cosine between the normals of a match: 32 deg, beyond it lies another side of a thing."""

LOSS_SCALE = 3.0
"""Robust (Geman-McClure) scale in standard deviations; at twice it a match counts 1/25; what lies within it
fits."""

Pairs: TypeAlias = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Indices (m,) into the later surfels and (m,) into the earlier."""


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Surfels of the later sweep beside those of the earlier one, whitened.

    Attributes:
        tau: float64 (m,), s between the two measurements.
        moved: float64 (m,3), later centres at the instant of the earlier ones.
        normal: float64 (m,3), of the earlier surfels.
        sigma: float64 (m,), m, of the distance across the plane.
        error: float64 (m,), distance across the plane over ``sigma``.
        scale: Robust standard deviation of ``error``.
        weight: float64 (m,), 0..1, of the robust loss.
    """

    tau: Floats
    moved: Floats
    normal: Floats
    sigma: Floats
    error: Floats
    scale: float
    weight: Floats


def paired(earlier: Surfels, later: Surfels, tree: cKDTree, seconds: float, twist: Twist) -> Pairs:
    """Nearest earlier surfel for each of the later, where it lies within a cell and faces alike."""
    distance, found = tree.query(displaced(later.centre, np.full(len(later), seconds), twist))
    nearest = np.asarray(found, dtype=np.int64)
    turned = later.normal @ twist.pose(seconds)[:3, :3].T
    alike = np.abs(np.einsum("ij,ij->i", turned, earlier.normal[nearest])) > ALIKE_COSINE
    chosen = np.flatnonzero(alike & (distance < earlier.size[nearest]))
    return chosen, nearest[chosen]


def compared(earlier: Surfels, later: Surfels, pairs: Pairs, tau: Floats, twist: Twist) -> Matches:
    """The pairs under a twist that lasted ``tau`` (m,) between the two measurements."""
    chosen, partner = pairs
    moved = displaced(later.centre[chosen], tau, twist)
    normal = earlier.normal[partner]
    sigma = np.sqrt(earlier.thickness[partner] ** 2 + later.thickness[chosen] ** 2 + SURFACE_SIGMA_M**2)
    error = np.einsum("ij,ij->i", moved - earlier.centre[partner], normal) / sigma
    scale = max(1.4826 * float(np.median(np.abs(error))), 1e-3) if chosen.size else 1.0
    weight = 1.0 / (1.0 + (error / (LOSS_SCALE * scale)) ** 2) ** 2
    return Matches(tau, moved, normal, sigma, error, scale, weight)


def matched(earlier: Surfels, later: Surfels, tree: cKDTree, seconds: float, twist: Twist) -> Matches:
    """The surfels that belong together, under the twist that pairs them; times count where both have them."""
    pairs = paired(earlier, later, tree, seconds, twist)
    tau = np.full(pairs[0].size, seconds)
    if earlier.time is not None and later.time is not None:
        tau = tau + later.time[pairs[0]] - earlier.time[pairs[1]]
    return compared(earlier, later, pairs, tau, twist)


def jacobian(matches: Matches) -> Floats:
    """Derivative (m,6) of ``error`` by the twist: the left one, ``tau [p x n, n] / sigma``."""
    lever = np.concatenate([np.cross(matches.moved, matches.normal), matches.normal], axis=1)
    return np.asarray(lever * (matches.tau / matches.sigma)[:, None])


def normal_equations(matches: Matches) -> tuple[Floats, Floats]:
    """Information (6,6) and gradient (6,) of the twist, by the robust weights."""
    J = jacobian(matches)
    weighted = J * matches.weight[:, None]
    return weighted.T @ J, weighted.T @ matches.error
