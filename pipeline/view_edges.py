"""Edges of a cloud without rings: borders of near things as the camera sees them, and paint (PROBE 1, 8).

The rows and columns of the view take the place of rings (``view_rows``). Of the extrinsic only the place of
the camera matters here: neighbours stay neighbours when it turns, and centimetres of parallax between them
are less than their distance.
"""

import numpy as np
from numpy.typing import NDArray

from pipeline.edge_parameters import EdgeParameters
from pipeline.field_of_view import in_view
from pipeline.ground import Ground
from pipeline.paint_edges import paint_borders
from pipeline.records import CameraModel, Floats, PointCloud
from pipeline.view_rows import ViewRows, joined, lasting_jumps, point_spacing, view_angles, view_rows


def view_edges(
    cloud: PointCloud,
    ground: Ground,
    camera: CameraModel,
    T_cam_lidar: Floats,
    parameters: EdgeParameters,
) -> list[tuple[Floats, Floats]] | None:
    """Positions and directions (K,3) of the edges of each kind, in the order of kinds, cloud's frame.

    None where too few points are in view to be neighbours.

    Args:
        cloud: Points in any order, of any sensors.
        ground: Its ground plane: from row to row of the view it recedes like the border of a thing.
        camera: Intrinsics.
        T_cam_lidar: float64 (4,4), the stored extrinsic.
        parameters: What counts as an edge.
    """
    seen = np.flatnonzero(in_view(cloud, camera, T_cam_lidar))
    xyz = cloud.xyz[seen].astype(np.float64)
    R, t = T_cam_lidar[:3, :3], T_cam_lidar[:3, 3]
    right, upwards, distance = view_angles(xyz @ R.T + t)
    spacing = point_spacing(right, upwards)
    if spacing is None:
        return None
    rows = view_rows(right, upwards, distance, spacing)
    columns = view_rows(upwards, right, distance, spacing)
    standing = ground.heights(xyz) > parameters.view_above_ground_m
    aside = np.column_stack([np.cos(right), np.zeros_like(right), -np.sin(right)]) @ R
    up = (
        np.column_stack(
            [-np.sin(upwards) * np.sin(right), -np.cos(upwards), -np.sin(upwards) * np.cos(right)]
        )
        @ R
    )
    least = np.maximum(parameters.jump_m, parameters.jump_share * distance)
    least_up = np.maximum(parameters.jump_up_m, parameters.jump_up_share * distance)
    # Along a row the tangent runs level: a step in azimuth is shorter the higher the ray.
    reach = distance * np.cos(upwards)
    found = [_jumps(xyz, rows, (aside, reach), standing, least, parameters.inset, parameters)]
    if spacing <= parameters.sparsest_rad:
        found.append(_jumps(xyz, columns, (up, distance), standing, least_up, 0.5, parameters))
    else:
        found.append((np.zeros((0, 3)), np.zeros((0, 3))))
    if cloud.intensity is not None:
        order = rows.index
        # Only what leads aside counts: points of a row lie at the nearer and the farther side of it by turns.
        way = np.diff(rows.along) * reach[order][:-1]
        intensity = cloud.intensity[seen][order].astype(np.float64)
        linked = joined(rows, parameters.gap_steps * spacing)
        found.append(
            paint_borders(xyz[order], aside[order], intensity, rows.distance, linked, way, ground, parameters)
        )
    return found


def _jumps(
    xyz: Floats,
    rows: ViewRows,
    tangents: tuple[Floats, Floats],
    standing: NDArray[np.bool_],
    least: Floats,
    inset: float,
    parameters: EdgeParameters,
) -> tuple[Floats, Floats]:
    """Points beside which others lie farther, moved towards those; ``tangents``: unit (N,3), m/rad (N,)."""
    widest = parameters.gap_steps * rows.width
    place, way = lasting_jumps(rows, least[rows.index], parameters.view_lasting, widest)
    point = rows.index[place]
    kept = standing[point]
    point, way = point[kept], way[kept]
    direction, reach = tangents[0][point], tangents[1][point]
    return xyz[point] + (inset * way * reach)[:, None] * direction, direction
