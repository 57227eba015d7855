import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.cloud_lines import cloud_line, total_least_squares


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_fit_is_the_line_with_its_noise(seed):
    rng = np.random.default_rng(seed)
    origin, direction = rng.normal(0, 10, 3), rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    points = origin + rng.uniform(-8, 8, (400, 1)) * direction + rng.normal(0, 0.03, (400, 3))
    axis = total_least_squares(points)
    assert abs(axis.direction @ direction) == pytest.approx(1.0, abs=1e-5)
    assert axis.sigma == pytest.approx(0.03, rel=0.15)
    np.testing.assert_allclose(axis.mean, points.mean(axis=0))
    # Brute force: no line near it is closer to the points.
    across = points - axis.mean - np.outer((points - axis.mean) @ axis.direction, axis.direction)
    for _ in range(10):
        other = axis.direction + rng.normal(0, 1e-3, 3)
        other /= np.linalg.norm(other)
        offset = points - axis.mean - np.outer((points - axis.mean) @ other, other)
        assert (offset**2).sum() >= (across**2).sum()


def test_record_reaches_from_the_first_point_to_the_last():
    rng = np.random.default_rng(1)
    x = rng.uniform(2, 30, 50) ** 0.9
    points = np.column_stack([x, 0.1 * x, np.full(50, -1.7)])
    line = cloud_line("lane", total_least_squares(points), np.arange(50))
    length = np.linalg.norm(line.end - line.start)
    assert length == pytest.approx(np.ptp(x) * np.hypot(1, 0.1))
    along = (points - line.start) @ (line.end - line.start) / length
    assert along.min() == pytest.approx(0.0, abs=1e-9)
    assert line.mean_m == pytest.approx(along.mean())
    assert line.spread == pytest.approx(((along - along.mean()) ** 2).sum())


def test_two_points_fit_without_noise():
    axis = total_least_squares(np.array([[0.0, 0, 0], [1, 2, 2]]))
    assert axis.sigma == pytest.approx(0.0, abs=1e-12)
