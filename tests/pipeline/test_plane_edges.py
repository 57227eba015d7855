import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.plane_edges import SURFACE_M, borders, creases
from pipeline.planes import find_planes, thinned
from pipeline.uncertain_lines import UncertainLine, across, structure_line

SPACING = 0.008


def wedge(rng, opening, counts=(2500, 2500), sigma=0.02):
    """Two walls that meet in the upright line x = 12, y = 0, opening to the sensor or away from it."""
    parts = []
    for sign, count in zip((1, -1), counts, strict=True):
        d = np.array([math.cos(opening / 2), sign * math.sin(opening / 2), 0.0])
        n = np.cross(d, [0.0, 0.0, 1.0])
        s = rng.random((count, 2)) * [3.0, 2.5]
        parts.append(
            [12.0, 0.0, -1.0] + s[:, :1] * d + s[:, 1:] * [0, 0, 1] + sigma * rng.normal(size=(count, 1)) * n
        )
    return np.concatenate(parts)


def edges_of(xyz, rng, *, find_borders=False):
    cells = thinned(xyz, np.ones(len(xyz), dtype=bool), SPACING)
    planes = find_planes(cells, xyz)
    return borders(planes, cells, xyz, SPACING, rng) if find_borders else creases(planes, cells, xyz)


@pytest.mark.parametrize("degrees", [60, 90, 120])
def test_the_covariance_of_a_crease_by_monte_carlo(degrees):
    values = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        lines = edges_of(wedge(rng, math.radians(degrees), (1500, 2500)), rng)
        # Points spread at random leave gaps, which may part a crease; pieces are joined later.
        line = max(lines, key=lambda piece: piece.length)
        assert 0.8 < line.length < 2.7
        e = []
        for end in (line.start, line.end):
            foot = np.array([12.0, 0.0, 0.0]) + (end[2] / line.direction[2]) * np.array(
                [0.0, 0.0, line.direction[2]]
            )
            e.append(line.axes @ (foot - end))
        e = np.concatenate(e)
        axes = line.axes
        normals = [
            [math.sin(a), math.cos(a), 0.0] for a in (math.radians(degrees) / 2, -math.radians(degrees) / 2)
        ]
        N = np.linalg.inv(np.array(normals) @ axes.T)
        floor = np.kron(np.eye(2), SURFACE_M**2 * N @ N.T)
        values.append(e @ np.linalg.solve(line.covariance - floor, e))
    # Chi-square of 4: mean 4, its standard error over 40 is 0.45.
    assert 2.5 < np.mean(values) < 6.0


def test_walls_that_do_not_reach_each_other_make_no_crease():
    rng = np.random.default_rng(0)
    xyz = wedge(rng, math.radians(90))
    apart = xyz[np.hypot(xyz[:, 0] - 12, xyz[:, 1]) > 1.2]
    assert edges_of(apart, rng) == []


def test_planes_that_pass_through_each_other_make_no_crease():
    rng = np.random.default_rng(0)
    s = rng.uniform(-2, 2, (6000, 2))
    flat = np.column_stack([12 + s[:, 0], s[:, 1], 0.5 * s[:, 0]])
    other = np.column_stack([12 + s[:, 0], s[:, 1], -1.5 * s[:, 0]])
    assert edges_of(np.concatenate([flat, other]), rng) == []


def test_borders_before_something_farther_are_found_and_others_not():
    board = np.random.default_rng(1).random((9000, 2)) * [4.0, 2.4] + [-2.0, -1.2]
    rng = np.random.default_rng(2)
    near = np.column_stack([np.full(9000, 10.0) + 0.01 * rng.normal(size=9000), board])
    v = rng.uniform(-1, 1, (20000, 2)) * [12.0, 8.0]
    behind = np.column_stack([np.full(20000, 25.0) + 0.01 * rng.normal(size=20000), v])
    hidden = (np.abs(behind[:, 1] * 10 / 25) < 2.0) & (np.abs(behind[:, 2] * 10 / 25) < 1.2)
    lines = edges_of(np.concatenate([near, behind[~hidden]]), rng, find_borders=True)
    on_board = [line for line in lines if abs(line.start[0] - 10) < 0.1]
    assert len(on_board) == 4
    # The wall behind ends where the board hides it: that is no edge, and neither is the end of the view.
    assert [line for line in lines if abs(line.start[0] - 25) < 1.0] == []
    for line in on_board:
        axis = int(np.abs(line.direction).argmax())
        other = 3 - axis
        side = {1: 2.0, 2: 1.2}[other]
        error = np.abs([line.start[other], line.end[other]]) - side
        assert np.abs(error).max() < 0.08
        assert (np.abs(error) / np.sqrt(np.diag(line.covariance)[[0, 2]])).max() < 3.0
    assert edges_of(near, rng, find_borders=True) == []


def test_axes_are_across_and_seen_from_the_origin():
    rng = np.random.default_rng(3)
    for _ in range(50):
        d, place = rng.normal(size=3), 10 * rng.normal(size=3)
        d /= np.linalg.norm(d)
        axes = across(d, place)
        np.testing.assert_allclose(axes @ np.column_stack([d, *axes]), [[0, 1, 0], [0, 0, 1]], atol=1e-12)
        # Sideways is across the plane through the eye and the line.
        assert abs(axes[0] @ place) < 1e-9 * np.linalg.norm(place)
    assert np.isfinite(across(np.array([1.0, 0, 0]), np.array([5.0, 0, 0]))).all()


def test_a_line_turned_keeps_its_covariance_along_its_axes():
    rng = np.random.default_rng(4)
    A = rng.normal(size=(4, 4))
    line = UncertainLine("jump", np.array([5.0, 1, 0]), np.array([5.0, 1, 3]), np.arange(5), 1e-4 * A @ A.T)
    R = Rotation.random(random_state=1).as_matrix()
    turned = line.moved(R, np.zeros(3))
    np.testing.assert_allclose(turned.axes, line.axes @ R.T, atol=1e-12)
    eye = np.array([0.5, 1.0, -2.0])
    record = structure_line(turned, eye)
    arm = np.array([0.0, line.length]) - record.mean_m
    variance = record.sigma_m**2 * (1 / len(record.points) + np.outer(arm, arm) / record.spread)
    np.testing.assert_allclose(variance, turned.seen_from(eye), rtol=1e-6)
