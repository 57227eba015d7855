"""What a frame says by itself, at once or in two steps."""

import dataclasses
import math

import numpy as np
import pytest

from pipeline import se3
from pipeline.frame_evidence import Scout
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import FramePair, PointCloud


@pytest.fixture(scope="module")
def scene(drive, limits):
    """The mount and three pairs of a drive."""
    p = drive.parameters
    mount = Mount(
        camera=p.camera,
        T_cam_lidar=p.T_stored,
        T_vehicle_lidar=p.T_vehicle_lidar,
        sigma_rad=math.radians(0.1),
        sigma_m=0.02,
        limits=limits,
        required=("pitch", "yaw"),
    )
    frames = [drive.frame(index) for index in (3, 4, 5)]
    pairs = [FramePair("front", f.cloud, f.image, f.cloud_stamp_ns, f.image_stamp_ns, 0.1) for f in frames]
    return mount, pairs


def test_another_scout_of_the_pair_finds_the_edges_that_the_first_left_open(scene):
    mount, pairs = scene
    one, two, other = (Scout(mount, Parameters(), None) for _ in range(3))
    other.look(pairs[0])
    for pair in pairs:
        whole = one.look(pair)
        # The first goes on before the edges of this frame are known.
        seen = two.glimpse(pair)
        found = other.with_edges(seen)
        assert found.dropped is None
        assert found.edges is not None
        for name in ("position", "direction", "weight", "cell", "kind"):
            np.testing.assert_array_equal(getattr(found.edges, name), getattr(whole.edges, name))
        np.testing.assert_array_equal(found.edge_points, whole.edge_points)
        np.testing.assert_array_equal(found.cloud.xyz, whole.cloud.xyz)
    assert (one.count, two.count, other.count) == (3, 3, 1)


@pytest.mark.parametrize("points", [1, 3000])
def test_a_part_of_a_sweep_at_the_start_does_not_settle_where_the_sensor_sits(scene, points):
    mount, pairs = scene
    # In the vehicle's frame the sensor is not at the origin.
    T = mount.T_vehicle_lidar
    mount = dataclasses.replace(
        mount, T_cam_lidar=mount.T_cam_lidar @ se3.inverse(T), T_vehicle_lidar=np.eye(4)
    )
    moved = []
    for pair in pairs:
        xyz = se3.apply(T, pair.cloud.xyz).astype(np.float32)
        moved.append(dataclasses.replace(pair, cloud=dataclasses.replace(pair.cloud, xyz=xyz, time=None)))
    c = moved[0].cloud
    part = PointCloud(c.xyz[:points], c.intensity[:points], c.ring[:points])
    started, whole = (Scout(mount, Parameters(), None) for _ in range(2))
    started.look(dataclasses.replace(moved[0], cloud=part))
    started.forget()
    found, expected = started.look(moved[1]), whole.look(moved[1])
    np.testing.assert_array_equal(found.edges.position, expected.edges.position)


def test_what_can_not_be_looked_at_is_dropped_in_either_way(scene):
    mount, pairs = scene
    scout = Scout(mount, Parameters(), None)
    empty = dataclasses.replace(pairs[0], cloud=PointCloud(np.zeros((0, 3), dtype=np.float32)))
    for found in (scout.look(empty), scout.with_edges(scout.glimpse(empty))):
        assert (found.dropped, found.straight, len(found.edge_points)) == ("empty_cloud", None, 0)
    assert scout.count == 0
