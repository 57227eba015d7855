"""Up is found whatever the attitude of the LiDAR, and not made up where there is no ground."""

import dataclasses

import numpy as np
import pytest

from pipeline import se3
from pipeline.ground import fit_ground
from pipeline.ground_side import MOST, find_grounds
from pipeline.records import PointCloud

UP = np.array([0.0, 0.0, 1.0])
TURNS = {
    "as it is": np.eye(3),
    "quarter turn": se3.exp_so3(np.pi / 2 * UP),
    "upside down": np.diag([1.0, -1.0, -1.0]),
    "on its side": se3.exp_so3(np.array([np.pi / 2, 0.0, 0.0])),
    "askew": se3.exp_so3(np.array([0.6, -0.4, 1.0])),
}


def cloud_of(xyz):
    return PointCloud(xyz=np.asarray(xyz, dtype=np.float32), intensity=None, ring=None, time=None)


@pytest.mark.parametrize("turn", TURNS)
def test_the_road_is_found_in_any_attitude(street, turn):
    R = TURNS[turn]
    told = fit_ground(street.cloud, UP, np.random.default_rng(1))
    moved = dataclasses.replace(street.cloud, xyz=(street.cloud.xyz @ R.T).astype(np.float32))
    found = find_grounds(moved, np.random.default_rng(2))
    assert 1 <= len(found) <= MOST
    assert np.degrees(np.arccos(min(1.0, found[0].normal @ R @ told.normal))) < 1.0
    assert found[0].offset == pytest.approx(told.offset, abs=0.05)


def plane(rng, spans, height, count=4000):
    """Points of a level rectangle."""
    return np.column_stack(
        [rng.uniform(*spans[0], count), rng.uniform(*spans[1], count), np.full(count, height)]
    )


def test_a_roof_above_is_not_the_ground():
    """A tunnel: floor and ceiling are as large; what lies between is above the one and below the other."""
    rng = np.random.default_rng(3)
    walls = [plane(rng, ((-20, 20), (-1.7, 3.0)), side)[:, [0, 2, 1]] for side in (-4.4, 4.4)]
    tunnel = np.concatenate(
        [plane(rng, ((-20, 20), (-4.4, 4.4)), -1.7), plane(rng, ((-20, 20), (-4.4, 4.4)), 7.5), *walls]
    )
    found = find_grounds(cloud_of(tunnel + rng.normal(0, 0.02, tunnel.shape)), rng)
    assert found[0].normal @ UP > 0.999
    assert found[0].offset == pytest.approx(1.7, abs=0.05)


def test_where_two_planes_may_be_the_road_both_are_told():
    """A narrow lane between walls of its own width: which side is the floor only the image can tell."""
    rng = np.random.default_rng(4)
    floor = plane(rng, ((-25, 25), (-3, 9)), -3.0)
    corner = np.concatenate([floor, floor[:, [0, 2, 1]]])
    found = find_grounds(cloud_of(corner + rng.normal(0, 0.02, corner.shape)), rng)
    assert len(found) == 2
    assert sorted(abs(round(float(one.normal @ UP))) for one in found) == [0, 1]


@pytest.mark.parametrize("count", [0, 5, 99])
def test_a_handful_of_points_has_no_ground(count):
    xyz = np.random.default_rng(5).normal(0, 5, (count, 3))
    assert find_grounds(cloud_of(xyz), np.random.default_rng(1)) == ()


def test_a_ball_of_noise_has_no_ground():
    xyz = np.random.default_rng(6).normal(0, 8, (20_000, 3))
    assert find_grounds(cloud_of(xyz), np.random.default_rng(1)) == ()


def test_points_at_one_place_have_no_ground():
    assert find_grounds(cloud_of(np.ones((500, 3))), np.random.default_rng(1)) == ()


def test_a_fence_with_something_behind_it_is_not_the_ground():
    """Larger than what is seen of the road, but with a garden beyond: a ground has nothing below."""
    rng = np.random.default_rng(7)
    fence = plane(rng, ((-25, 25), (-1.7, 8.3)), 4.4, 8000)[:, [0, 2, 1]]
    road = plane(rng, ((-25, 25), (-3.3, 4.3)), -1.7)
    behind = rng.uniform([-5, 6, -1.5], [5, 16, 6], (8000, 3))
    xyz = np.concatenate([fence, road, behind])
    found = find_grounds(cloud_of(xyz + rng.normal(0, 0.02, xyz.shape)), rng)
    assert found[0].normal @ UP > 0.999
    assert found[0].offset == pytest.approx(1.7, abs=0.05)
