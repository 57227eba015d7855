"""Edges along and between the rings of a spinning LiDAR (PROBE section 1)."""

import math

import numpy as np
from numpy.typing import NDArray

from pipeline.edge_parameters import EdgeParameters
from pipeline.ground import Ground
from pipeline.paint_edges import paint_borders
from pipeline.records import Floats, PointCloud
from pipeline.rings import ScanPattern


def ring_edges(
    cloud: PointCloud, pattern: ScanPattern, ground: Ground | None, parameters: EdgeParameters
) -> list[tuple[Floats, Floats]]:
    """Positions and directions (K,3) of the edges of each kind, in the order of kinds, cloud's frame.

    Args:
        cloud: Of a sensor that stands at the origin and spins about the z axis.
        pattern: Its rings.
        ground: Its ground plane, or None: no jumps between rings, no paint.
        parameters: What counts as an edge.
    """
    xyz = cloud.xyz.take(pattern.index, axis=0).astype(np.float64)
    azimuth = _true_azimuth(xyz)
    tangent = np.column_stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(xyz))])
    found = [_ring_jumps(xyz, tangent, pattern, parameters)]
    if ground is not None:
        found.append(_jumps_between_rings(xyz, pattern, ground, parameters))
        if cloud.intensity is not None:
            intensity = cloud.intensity[pattern.index].astype(np.float64)
            joined = _joined(pattern, parameters)
            dx, dy, dz = np.diff(np.ascontiguousarray(xyz.T))
            way = np.sqrt(dx * dx + dy * dy + dz * dz)
            distance = pattern.distance
            found.append(paint_borders(xyz, tangent, intensity, distance, joined, way, ground, parameters))
    return found


_THERE_AND_BACK = 0.08
"""Share of neighbours on a ring between which the range leaps and leaps back. Sweeps of six sensors had 0.002
to 0.044 of them; simulated rings of two sensors a metre apart and more under the same numbers 0.09 to 0.5."""


def rings_are_mixed(pattern: ScanPattern, parameters: EdgeParameters) -> bool:
    """Whether the points of a ring come from sensors in several places by turns.

    Clouds of several LiDARs in one keep the ring numbers that each of them gave.
    """
    linked, leap, leaps = _leaps(pattern, parameters)
    back = leaps[:-1] & leaps[1:] & (leap[:-1] * leap[1:] < 0.0)
    triples = np.count_nonzero(linked[:-1] & linked[1:])
    return bool(np.count_nonzero(back) > _THERE_AND_BACK * triples)


def _joined(pattern: ScanPattern, parameters: EdgeParameters) -> NDArray[np.bool_]:
    """Whether each point and the next (M-1,) share a ring without a gap."""
    gap_rad = parameters.gap_steps * pattern.azimuth_step
    return np.asarray((np.diff(pattern.ring) == 0) & (np.diff(pattern.azimuth) < gap_rad))


def _leaps(
    pattern: ScanPattern, parameters: EdgeParameters
) -> tuple[NDArray[np.bool_], Floats, NDArray[np.bool_]]:
    """What lies between each point and the next (M-1,): no gap on one ring; range gained, m; a jump."""
    linked = _joined(pattern, parameters)
    leap = np.diff(pattern.distance)
    nearest = np.minimum(pattern.distance[:-1], pattern.distance[1:])
    least = np.maximum(parameters.jump_m, parameters.jump_share * nearest)
    return linked, leap, linked & (np.abs(leap) > least)


def _true_azimuth(xyz: Floats) -> Floats:
    return np.asarray(np.arctan2(xyz[:, 1], xyz[:, 0]), dtype=np.float64)


def _ring_jumps(
    xyz: Floats, tangent: Floats, pattern: ScanPattern, parameters: EdgeParameters
) -> tuple[Floats, Floats]:
    """Kind 0: the nearer point of a jump along a ring, moved towards the farther ray."""
    _, jump, leaps = _leaps(pattern, parameters)
    edge = np.flatnonzero(leaps)
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
