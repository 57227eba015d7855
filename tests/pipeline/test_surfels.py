import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import se3
from pipeline.records import PointCloud
from pipeline.surfels import MIN_POINTS, _least_axes, surfels


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000))
def test_closed_form_axes_are_those_of_lapack(seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(50, 3, 3)) * 10.0 ** rng.uniform(-3, 0, (50, 1, 3))
    C = A @ A.transpose(0, 2, 1)
    packed = np.stack([C[:, 0, 0], C[:, 1, 1], C[:, 2, 2], C[:, 0, 1], C[:, 0, 2], C[:, 1, 2]])
    values, normal = _least_axes(packed)
    exact, vectors = np.linalg.eigh(C)
    np.testing.assert_allclose(values.T, exact[:, :2], atol=1e-7 * exact[:, 2].max())
    clear = exact[:, 1] - exact[:, 0] > 1e-4 * exact[:, 2]
    cosine = np.abs(np.einsum("im,mi->m", normal, vectors[:, :, 0]))[clear]
    np.testing.assert_allclose(cosine, 1.0, atol=1e-5)


def test_equal_eigenvalues_give_numbers():
    same = np.array([[1.0], [1.0], [1.0], [0.0], [0.0], [0.0]])
    for packed in (same, 0.0 * same):
        values, normal = _least_axes(packed)
        assert np.isfinite(values).all()
        assert np.isfinite(normal).all()


def room(rng, turn, *, noise=0.01, count=60_000):
    """Points on the six walls of a box around the sensor, turned, and how far a point is from the walls."""
    half = np.array([20.0, 12.0, 6.0])
    xyz = rng.uniform(-half, half, (count, 3))
    axis, side = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    xyz[np.arange(count), axis] = side * half[axis] + rng.normal(0, noise, count)

    def off(points):
        return np.abs(np.abs(points @ turn) - half).min(axis=1)

    return (xyz @ turn.T).astype(np.float32), off


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_surfels_lie_on_the_walls_in_any_frame(seed):
    rng = np.random.default_rng(seed)
    turn = se3.exp_so3(rng.normal(size=3) * 2)
    xyz, off = room(rng, turn)
    found = surfels(PointCloud(xyz))
    assert len(found) > 500
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-9)
    along = np.abs(found.normal @ turn).max(axis=1)
    thin = found.thickness < 0.03
    assert thin.mean() > 0.8
    assert np.percentile(off(found.centre[thin]), 95) < 0.02
    assert np.percentile(np.degrees(np.arccos(np.minimum(1.0, along[thin]))), 90) < 5.0


def test_order_of_points_does_not_matter():
    rng = np.random.default_rng(2)
    xyz, _ = room(rng, np.eye(3))
    order = rng.permutation(len(xyz))
    first, second = surfels(PointCloud(xyz)), surfels(PointCloud(xyz[order]))
    np.testing.assert_allclose(first.centre, second.centre, atol=1e-9)
    np.testing.assert_allclose(np.abs((first.normal * second.normal).sum(axis=1)), 1.0, atol=1e-9)


def test_a_single_ring_on_the_road_and_a_wire_are_no_planes():
    angle = np.linspace(0, 2 * math.pi, 4000, endpoint=False)
    rng = np.random.default_rng(1)
    ring = np.column_stack([9 * np.cos(angle), 9 * np.sin(angle), np.full(4000, -1.8)])
    wire = np.column_stack([np.linspace(5, 15, 3000), np.full(3000, 4.0), np.full(3000, 3.0)])
    xyz = np.concatenate([ring, wire]) + rng.normal(0, 0.01, (7000, 3))
    assert len(surfels(PointCloud(xyz.astype(np.float32)))) == 0


def test_times_are_means_and_the_seam_is_left_out():
    rng = np.random.default_rng(4)
    xyz, _ = room(rng, np.eye(3))
    # The seam lies across the walls at 0.2 rad, not on the border of cells.
    begun = np.mod(np.arctan2(xyz[:, 1], xyz[:, 0]) - 0.2, 2 * math.pi) / (2 * math.pi)
    found = surfels(PointCloud(xyz, time=(0.1 * begun).astype(np.float32)))
    expected = 0.1 * np.mod(np.arctan2(found.centre[:, 1], found.centre[:, 0]) - 0.2, 2 * math.pi)
    np.testing.assert_allclose(found.time, expected / (2 * math.pi), atol=3e-3)
    assert len(found) < len(surfels(PointCloud(xyz)))


def test_few_far_or_huge_points_give_none():
    for xyz in (
        np.zeros((0, 3)),
        np.zeros((5, 3)),
        np.full((MIN_POINTS, 3), 1e30),
        np.full((100, 3), 500.0),
        np.full((100, 3), 1e-30),
    ):
        cloud = PointCloud(xyz.astype(np.float32), time=np.zeros(len(xyz), dtype=np.float32))
        assert len(surfels(cloud)) == 0
