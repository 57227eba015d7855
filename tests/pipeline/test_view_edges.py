import dataclasses
import math

import numpy as np
import pytest

from pipeline import se3
from pipeline.edge_parameters import BETWEEN_RINGS, PAINT, RING_JUMP, EdgeParameters
from pipeline.edges import find_edges
from pipeline.ground import Ground
from pipeline.records import CameraModel, PointCloud
from pipeline.view_edges import view_edges
from pipeline.view_rows import view_angles

P = EdgeParameters()
HEIGHT, WALL_M = 1.7, 30.0
CAMERA = CameraModel(
    "pinhole", np.array([[600.0, 0, 479.5], [0, 600, 199.5], [0, 0, 1]]), np.zeros(0), 960, 400
)
T_CAM = se3.transform(se3.AXES_CAM_IN_VEHICLE.T, np.zeros(3))
"""A camera at the origin that looks along x."""

ROAD = Ground(np.array([0.0, 0.0, 1.0]), HEIGHT, np.ones(1, dtype=bool))
STEP = math.radians(0.3)


def cast(origins, boards=(), paint=None, seed=0, rays=25_000):
    """What sensors at ``origins`` see along rays in no order: a road, a wall, boards (x, y, y, z, z)."""
    rng = np.random.default_rng(seed)
    parts = []
    for origin in np.atleast_2d(np.array(origins, dtype=float)):
        a, e = rng.uniform(-0.75, 0.75, rays), rng.uniform(-0.35, 0.3, rays)
        unit = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        with np.errstate(divide="ignore"):
            road = np.where(unit[:, 2] < 0, -(HEIGHT + origin[2]) / unit[:, 2], np.inf)
        reach = np.minimum(road, (WALL_M - origin[0]) / unit[:, 0])
        for x, left, right, low, high in boards:
            at = origin + unit * ((x - origin[0]) / unit[:, :1])
            hit = (at[:, 1] > left) & (at[:, 1] < right) & (at[:, 2] > low) & (at[:, 2] < high)
            reach = np.where(hit, np.minimum(reach, (x - origin[0]) / unit[:, 0]), reach)
        parts.append(origin + unit * reach[:, None])
    xyz = np.concatenate(parts)
    xyz = xyz[rng.permutation(len(xyz))]
    intensity = np.full(len(xyz), 0.2) if paint is None else paint(xyz)
    return PointCloud(xyz.astype(np.float32), intensity.astype(np.float32))


BOARD = (10.0, -1.0, 1.0, -1.7, 0.6)
SIDES = [(0.0, 0.6, 0.2), (0.0, -0.6, 0.2)]


@pytest.mark.parametrize("origins", [(0.0, 0.0, 0.0), SIDES], ids=["one sensor", "two"])
def test_borders_of_a_board_lie_where_the_camera_sees_them(origins):
    found = find_edges(cast(origins, [BOARD]), ROAD, CAMERA, T_CAM, P)
    right, upwards, _ = view_angles(found.position @ T_CAM[:3, :3].T)
    side, top = math.atan2(1.0, 10.0), math.atan2(0.6, 10.0)
    aside = (found.kind == RING_JUMP) & (found.position[:, 0] < 12) & (upwards < top - 2 * STEP)
    assert aside.sum() > 20
    off = np.degrees(np.abs(right[aside]) - side)
    # Points of one sensor are 0.3 deg apart. Each of two sees past a side that the camera sees.
    assert np.abs(np.median(off)) < 0.05
    assert np.abs(off).max() < 0.45 or (len(origins) == 2 and (np.abs(off) < 0.45).mean() > 0.8)
    assert {-1.0, 1.0} == set(np.sign(right[aside]))
    np.testing.assert_allclose(np.abs(found.direction[aside][:, 1]), np.cos(right[aside]), atol=1e-3)
    above = (found.kind == BETWEEN_RINGS) & (np.abs(found.position[:, 1]) < 0.9)
    assert above.sum() > 10
    assert np.abs(np.degrees(np.median(upwards[above] - top))) < 0.15
    assert (found.direction[above][:, 2] > 0.9).all()


def test_an_empty_road_has_no_edges():
    assert len(find_edges(cast(SIDES), ROAD, CAMERA, T_CAM, P)) == 0


def test_both_borders_of_a_painted_line():
    def paint(xyz):
        on_road = xyz[:, 2] < -HEIGHT + 0.01
        return np.where(on_road & (np.abs(xyz[:, 1] - 1.0) < 0.15), 0.9, 0.2)

    found = find_edges(cast(SIDES, paint=paint), ROAD, CAMERA, T_CAM, P)
    assert (found.kind == PAINT).all()
    near = found.position[found.position[:, 0] < 15]
    assert len(near) > 15
    left, right = near[near[:, 1] > 1.0], near[near[:, 1] < 1.0]
    assert np.median(left[:, 1]) == pytest.approx(1.15, abs=0.04)
    assert np.median(right[:, 1]) == pytest.approx(0.85, abs=0.04)
    np.testing.assert_allclose(near[:, 2], -HEIGHT, atol=0.02)


def test_the_order_of_points_and_the_frame_of_the_cloud_do_not_matter():
    cloud = cast(SIDES, [BOARD])
    found = find_edges(cloud, ROAD, CAMERA, T_CAM, P)
    order = np.random.default_rng(5).permutation(len(cloud))
    again = find_edges(PointCloud(cloud.xyz[order], cloud.intensity[order]), ROAD, CAMERA, T_CAM, P)
    assert len(again) == len(found)
    T = se3.transform(se3.exp_so3(np.array([0.3, -0.2, 1.0])), np.array([1.0, -2.0, 0.4]))
    moved = dataclasses.replace(cloud, xyz=se3.apply(T, cloud.xyz).astype(np.float32))
    normal = T[:3, :3] @ ROAD.normal
    plane = Ground(normal, HEIGHT - float(normal @ T[:3, 3]), ROAD.inliers)
    there = find_edges(moved, plane, CAMERA, T_CAM @ se3.inverse(T), P)
    # Coordinates in single precision put some points into the next row.
    assert abs(len(there) - len(found)) < 0.05 * len(found)
    back = se3.apply(se3.inverse(T), there.position)
    nearest = np.linalg.norm(back[:, None] - found.position[None], axis=2).min(axis=1)
    assert np.median(nearest) < 1e-4


def test_without_ground_or_neighbours_there_is_no_answer():
    cloud = cast(SIDES, [BOARD])
    assert find_edges(cloud, None, CAMERA, T_CAM, P) is None
    few = PointCloud(cloud.xyz[:300], cloud.intensity[:300])
    assert view_edges(few, ROAD, CAMERA, T_CAM, P) is None
    behind = PointCloud(cloud.xyz * np.float32([-1, 1, 1]), cloud.intensity)
    assert view_edges(behind, ROAD, CAMERA, T_CAM, P) is None
    bare = PointCloud(cloud.xyz)
    assert set(find_edges(bare, ROAD, CAMERA, T_CAM, P).kind.tolist()) == {RING_JUMP, BETWEEN_RINGS}


def test_where_points_are_a_degree_apart_heights_are_left_open():
    sparse = cast(SIDES, [BOARD], rays=1200)
    found = find_edges(sparse, ROAD, CAMERA, T_CAM, P)
    assert not (found.kind == BETWEEN_RINGS).any()
    dense = cast(SIDES, [BOARD], rays=6000)
    assert (find_edges(dense, ROAD, CAMERA, T_CAM, P).kind == BETWEEN_RINGS).any()
