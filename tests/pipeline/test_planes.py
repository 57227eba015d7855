import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.planes import MAX_SIGMA_M, MOST_CELLS, MOST_PLANES, find_planes, least_axes, thinned
from pipeline.records import Floats

SPACING = 0.008


def patch(origin, u, v, count, rng, sigma=0.02):
    """Points spread evenly over a parallelogram, noisy across it."""
    n = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    s = rng.random((count, 2))
    return np.array(origin) + s @ np.array([u, v], dtype=float) + sigma * rng.normal(size=(count, 1)) * n


def planes_of(xyz: Floats, spacing=SPACING):
    cells = thinned(xyz, np.ones(len(xyz), dtype=bool), spacing)
    return find_planes(cells, xyz), cells


def room(rng, count=6000):
    """Two walls and a floor that meet in a corner, 10 m away."""
    corner = np.array([10.0, 2.0, -1.5])
    x, y, z = np.eye(3) * [-4.0, -4.0, 3.0]
    parts = [patch(corner, a, b, count, rng) for a, b in ((y, z), (x, z), (x, y))]
    return np.concatenate(parts), np.repeat(np.arange(3), count)


def test_axes_in_closed_form_are_those_of_the_iteration():
    rng = np.random.default_rng(1)
    turn = Rotation.random(500, random_state=2).as_matrix()
    # Planes, thin and thick, balls, and a neighbourhood of one single place.
    spread = np.column_stack([rng.uniform(0.0, 0.1, 500), rng.uniform(0.2, 1.0, (500, 2))])
    spread[:50] = rng.uniform(0.0, 1.0, (50, 3))
    spread[50:60, 0] = 0.0
    spread[60] = 0.0
    C = turn @ (spread[:, :, None] ** 2 * turn.transpose(0, 2, 1))
    values, axis = least_axes(C[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].T)
    expected, V = np.linalg.eigh(C)
    np.testing.assert_allclose(values, expected, atol=1e-12)
    clear = expected[:, 1] - expected[:, 0] > 1e-3
    assert clear.sum() > 480
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", axis, V[:, :, 0]))[clear], 1.0, atol=1e-9)
    assert np.isfinite(axis).all()


def test_the_walls_of_a_room():
    rng = np.random.default_rng(0)
    xyz, wall = room(rng)
    planes, _ = planes_of(xyz)
    assert len(planes) == 3
    for plane in planes:
        own = np.bincount(wall[plane.points], minlength=3)
        axis = int(own.argmax())
        # The band of a plane holds a strip of 6 cm of each of the others, which are 3 and 4 m wide.
        assert own[axis] > 0.96 * own.sum()
        assert own[axis] > 0.95 * (wall == axis).sum()
        assert abs(plane.normal[axis]) > math.cos(math.radians(0.2))
        assert plane.sigma_m == pytest.approx(0.02, rel=0.06)
        np.testing.assert_allclose(plane.basis @ plane.basis.T, np.eye(2), atol=1e-9)
        np.testing.assert_allclose(plane.basis @ plane.normal, 0, atol=1e-9)


def test_the_covariance_of_a_plane_is_that_of_its_errors():
    values = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        xyz = patch((12.0, -2.0, -1.0), (0, 4.0, 0), (0.5, 0, 2.0), 900, rng)
        planes, _ = planes_of(xyz)
        assert len(planes) == 1
        plane = planes[0]
        normal = np.cross((0, 4.0, 0), (0.5, 0, 2.0))
        normal = normal / np.linalg.norm(normal) * np.sign(normal @ plane.normal)
        true = (plane.centre - [12.0, -2.0, -1.0]) @ normal
        # Offset at the centre, and slopes of the true plane against the fitted one.
        error = np.array([-true, *(-(plane.basis @ normal) / (normal @ plane.normal))])
        values.append(error @ np.linalg.solve(plane.covariance, error))
    # Chi-square of 3: mean 3, its standard error over 60 is 0.32.
    assert 2.0 < np.mean(values) < 4.2


def test_a_wall_behind_a_lamp_post_is_one_plane():
    rng = np.random.default_rng(1)
    left = patch((15.0, -6.0, -1.0), (0, 5.0, 0), (0, 0, 3.0), 4000, rng)
    right = patch((15.0, 0.0, -1.0), (0, 5.0, 0), (0, 0, 3.0), 4000, rng)
    planes, _ = planes_of(np.concatenate([left, right]))
    assert len(planes) == 1
    assert len(planes[0].points) > 7500


def test_a_step_is_two_planes():
    rng = np.random.default_rng(2)
    low = patch((15.0, -6.0, -1.0), (0, 5.0, 0), (0, 0, 3.0), 4000, rng)
    high = patch((15.3, -1.0, -1.0), (0, 5.0, 0), (0, 0, 3.0), 4000, rng)
    planes, _ = planes_of(np.concatenate([low, high]))
    assert len(planes) == 2
    assert sorted(round(float(plane.centre[0]), 1) for plane in planes) == [15.0, 15.3]


def test_a_round_tower_is_no_plane_and_a_bush_is_none():
    rng = np.random.default_rng(3)
    turn, height = rng.uniform(-1.2, 1.2, 6000), rng.uniform(-1, 3, 6000)
    tower = np.column_stack([12 - 1.0 * np.cos(turn), 1.0 * np.sin(turn), height])
    planes, _ = planes_of(tower + 0.01 * rng.normal(size=tower.shape))
    assert all(np.ptp(tower[plane.points, 1]) < 1.2 for plane in planes)
    bush = rng.normal(size=(6000, 3)) * 0.8 + [10, 0, 0]
    assert planes_of(bush)[0] == []


@pytest.mark.parametrize("seed", range(4))
def test_no_axis_is_up_and_no_order_is_meant(seed):
    rng = np.random.default_rng(seed)
    xyz, _ = room(rng, 4000)
    R = Rotation.random(random_state=seed).as_matrix()
    order = rng.permutation(len(xyz))
    a, b = planes_of(xyz)[0], planes_of((xyz @ R.T)[order])[0]
    assert len(a) == len(b) == 3
    for plane in a:
        other = max(b, key=lambda p: abs(p.normal @ (R @ plane.normal)))
        assert abs(other.normal @ (R @ plane.normal)) > math.cos(math.radians(0.2))
        assert abs((R @ plane.centre - other.centre) @ other.normal) < 0.005


def test_one_ring_over_anything_is_no_plane():
    rng = np.random.default_rng(4)
    azimuth = np.linspace(-0.6, 0.6, 800)
    for elevation in (0.0, 0.03):
        r = 10 + np.cumsum(rng.normal(0, 0.05, 800))
        u = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.full(800, math.tan(elevation))])
        two = np.concatenate([u * r[:, None], (u + np.array([0, 0, 0.004])) * (r + 0.01)[:, None]])
        assert planes_of(two)[0] == []


def test_time_is_bounded_whatever_comes():
    rng = np.random.default_rng(5)
    xyz = rng.uniform(-70, 70, (150_000, 3))
    cells = thinned(xyz, np.ones(len(xyz), dtype=bool), 0.002)
    assert 0 < len(cells.position) <= MOST_CELLS
    planes = find_planes(cells, xyz)
    assert len(planes) <= MOST_PLANES
    assert all(plane.sigma_m <= MAX_SIGMA_M for plane in planes)


def test_cells_are_means_of_their_points():
    rng = np.random.default_rng(6)
    xyz, _ = room(rng, 500)
    keep = rng.random(len(xyz)) < 0.7
    cells = thinned(xyz, keep, SPACING)
    assert (cells.of_point[~keep] == -1).all()
    for cell in range(0, len(cells.position), 7):
        members = xyz[cells.of_point == cell]
        np.testing.assert_allclose(cells.position[cell], members.mean(axis=0))
        assert np.ptp(members, axis=0).max() <= cells.size[cell]


@pytest.mark.parametrize("count", [0, 1, 7, 30])
def test_few_points_are_an_ordinary_answer(count):
    for xyz in (np.ones((count, 3)) * 5, np.full((count, 3), np.nan), np.zeros((count, 3))):
        assert planes_of(xyz)[0] == []
