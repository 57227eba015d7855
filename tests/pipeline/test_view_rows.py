import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import se3
from pipeline.view_rows import joined, lasting_jumps, point_spacing, view_angles, view_rows


def test_angles_are_those_of_camera_axes():
    xyz = np.array([[0.0, 0.0, 5.0], [3.0, 0.0, 3.0], [0.0, -2.0, 2.0], [0.0, 2.0, 2.0], [-1.0, 0.0, 0.0]])
    right, upwards, distance = view_angles(xyz)
    np.testing.assert_allclose(np.degrees(right), [0, 45, 0, 0, -90], atol=1e-12)
    np.testing.assert_allclose(np.degrees(upwards), [0, 0, 45, -45, 0], atol=1e-12)
    np.testing.assert_allclose(distance, np.linalg.norm(xyz, axis=1))


@pytest.mark.parametrize("spacing_deg", [0.1, 0.25, 0.5, 0.9])
def test_the_spacing_of_a_grid_is_its_step(spacing_deg):
    step = math.radians(spacing_deg)
    right, upwards = np.meshgrid(np.arange(-0.6, 0.6, step), np.arange(-0.2, 0.2, step))
    found = point_spacing(right.ravel(), upwards.ravel())
    assert found == pytest.approx(step, rel=0.25)


def test_a_few_points_have_no_neighbours():
    rng = np.random.default_rng(0)
    assert point_spacing(np.zeros(0), np.zeros(0)) is None
    assert point_spacing(*rng.uniform(-0.7, 0.7, (2, 300))) is None


def test_rows_are_ordered_and_hold_every_point_once():
    rng = np.random.default_rng(1)
    right, upwards = rng.uniform(-0.5, 0.5, (2, 2000))
    distance = rng.uniform(2, 60, 2000)
    rows = view_rows(right, upwards, distance, 0.01)
    np.testing.assert_array_equal(np.sort(rows.index), np.arange(2000))
    np.testing.assert_array_equal(rows.row, np.floor(upwards[rows.index] / 0.01))
    np.testing.assert_array_equal(rows.along, right[rows.index])
    np.testing.assert_array_equal(rows.distance, distance[rows.index])
    same = np.diff(rows.row) == 0
    np.testing.assert_array_equal(joined(rows, 0.02), same & (np.diff(rows.along) < 0.02))
    assert (np.diff(rows.row) >= 0).all()
    assert (np.diff(rows.along)[same] >= 0).all()


def jumps_one_by_one(rows, least, lasting, widest):
    """The same, a point at a time: (place, way)."""
    found = set()
    count = len(rows.row)
    for sense in (1, -1):
        for place in range(count):
            line = [place + sense * k for k in range(lasting + 1)]
            if min(line) < 0 or max(line) >= count or len({int(rows.row[i]) for i in line}) > 1:
                continue
            apart = [abs(rows.along[b] - rows.along[a]) for a, b in itertools.pairwise(line)]
            behind = [rows.distance[i] - rows.distance[place] > least[place] for i in line[1:]]
            if all(a < widest for a in apart) and all(behind):
                found.add((place, float(rows.along[line[1]] - rows.along[place])))
    return found


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(2, 120), st.integers(1, 4), st.floats(0.01, 0.3))
def test_jumps_are_those_found_one_by_one(seed, count, lasting, widest):
    rng = np.random.default_rng(seed)
    right, upwards = rng.uniform(0, 1, count), rng.integers(0, 3, count) * 0.1 + 0.05
    rows = view_rows(right, upwards, rng.choice([5.0, 5.2, 20.0], count), 0.1)
    least = np.maximum(0.5, 0.06 * rows.distance)
    place, way = lasting_jumps(rows, least, lasting, widest)
    assert set(zip(place.tolist(), way.tolist(), strict=True)) == jumps_one_by_one(
        rows, least, lasting, widest
    )
    assert len(place) == len(set(zip(place.tolist(), way.tolist(), strict=True)))


def test_near_and_far_by_turns_is_no_border():
    along = np.arange(40) * 0.01
    distance = np.where(np.arange(40) < 20, 10.0, 30.0)
    mixed = np.where((np.arange(40) % 2 == 0) & (np.arange(40) > 10), 10.0, distance)
    for values, expected in ((distance, {19}), (mixed, {38})):
        rows = view_rows(along, np.zeros(40), values, 0.01)
        place, _ = lasting_jumps(rows, np.full(40, 0.5), 3, 0.026)
        assert set(place.tolist()) <= expected
    assert set(place.tolist()) == set()


def test_a_camera_that_turns_keeps_its_neighbours_near():
    rng = np.random.default_rng(2)
    ray = np.column_stack([rng.uniform(-0.4, 0.4, (500, 2)), np.ones(500)])
    xyz = ray * rng.uniform(5, 40, (500, 1))
    turned = se3.apply(se3.transform(se3.exp_so3(np.radians([1.0, -2.0, 0.0])), np.zeros(3)), xyz)
    a, b = (np.column_stack(view_angles(points)[:2]) for points in (xyz, turned))
    np.testing.assert_allclose(np.diff(a, axis=0), np.diff(b, axis=0), atol=0.03)
