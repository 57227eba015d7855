"""Projection with its derivative by slopes, against the plain projection and its differences."""

import numpy as np
import pytest

from pipeline import cameras
from pipeline.records import CameraModel

K = np.array([[700.0, 3.0, 610.0], [0.0, 690.0, 180.0], [0.0, 0.0, 1.0]])
LENSES = {
    "pinhole": [],
    "plumb_bob": [-0.3, 0.1, 1e-3, -2e-3, -0.01],
    "rational_polynomial": [0.2, -0.1, 1e-3, 1e-3, 0.01, 0.3, -0.05, 0.002],
    "equidistant": [0.02, -0.01, 0.003, -0.001],
}


@pytest.mark.parametrize("model", LENSES)
def test_pixels_and_derivative_are_those_of_the_plain_functions(model):
    camera = CameraModel(model, K, np.array(LENSES[model], dtype=np.float64), 1240, 376)
    points = np.random.default_rng(4).uniform([-4.0, -2.0, -3.0], [4.0, 2.0, 30.0], (300, 3))
    uv, valid, xy, A = cameras.project_with_slopes(camera, points)
    plain, plain_valid = cameras.project_unbounded(camera, points)
    assert 0 < valid.sum() < len(points)
    np.testing.assert_array_equal(valid, plain_valid)
    np.testing.assert_allclose(uv[valid], plain[valid], rtol=1e-12)
    assert np.isfinite(uv).all()
    assert not xy[~valid].any()
    by_point = np.concatenate([A, -(A @ xy[:, :, None])], axis=2) / points[:, 2, None, None]
    step = 1e-6
    for axis in range(3):
        shift = step * np.eye(3)[axis]
        high, low = (cameras.project_unbounded(camera, points[valid] + sign * shift)[0] for sign in (1, -1))
        np.testing.assert_allclose(by_point[valid, :, axis], (high - low) / (2 * step), rtol=1e-5, atol=1e-3)
