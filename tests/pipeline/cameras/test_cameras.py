import importlib
import pkgutil

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import cameras
from pipeline.errors import InputError
from pipeline.records import CameraModel

K = np.array([[720.0, 1.5, 610.0], [0.0, 715.0, 180.0], [0.0, 0.0, 1.0]])
PLUMB_BOB = [-0.36, 0.17, 1e-3, -5e-4, -0.04]
"""Like the raw images of a common benchmark: folds at a radius of about 1.2."""
LENSES = {
    "pinhole": [],
    "none": [],
    "": [],
    "plumb_bob": PLUMB_BOB,
    "rational_polynomial": [0.8, -0.3, 2e-4, -3e-4, 0.02, 1.15, 0.1, -0.02],
    "equidistant": [-0.02, 0.006, -0.004, 0.0008],
    "fisheye": [-0.02, 0.006, -0.004, 0.0008],
}
"""One set of coefficients for every name under which a lens is known."""


def camera_of(model, D=None, K_camera=K):
    D = LENSES[model] if D is None else D
    return CameraModel(model, K_camera, np.array(D, dtype=np.float64), 1242, 375)


def rays(camera, count=400, seed=0, share=0.98):
    """Normalised coordinates inside the lens' limit, at most 70 degrees off the axis."""
    rng = np.random.default_rng(seed)
    largest = min(share * cameras.lens_of(camera).limit(camera.D), np.tan(np.radians(70.0)))
    radius, angle = rng.uniform(0, largest, count), rng.uniform(0, 2 * np.pi, count)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def points(camera, count=400, seed=0):
    depth = np.random.default_rng(seed + 1).uniform(0.5, 60.0, (count, 1))
    return np.column_stack([rays(camera, count, seed), np.ones(count)]) * depth


def opencv(camera, points_cam):
    still = np.zeros(3)
    if camera.model in {"equidistant", "fisheye"}:
        # OpenCV's fisheye has the skew as a factor of the focal length.
        alpha = float(camera.K[0, 1] / camera.K[0, 0])
        straight = camera.K.copy()
        straight[0, 1] = 0.0
        uv, _ = cv2.fisheye.projectPoints(points_cam[:, None], still, still, straight, camera.D, alpha=alpha)
    else:
        # OpenCV's projectPoints ignores the skew: it works on a K without and is added here.
        straight = np.eye(3)
        uv, _ = cv2.projectPoints(points_cam[:, None], still, still, straight, camera.D)
        return uv[:, 0] @ camera.K[:2, :2].T + camera.K[:2, 2]
    return uv[:, 0]


every_lens = pytest.mark.parametrize("model", sorted(LENSES))


class TestRegistry:
    def test_every_file_offers_a_model_and_every_name_is_tested(self):
        files = [module.name for module in pkgutil.iter_modules(cameras.__path__)]
        named = {
            name for file in files for name in importlib.import_module(f"pipeline.cameras.{file}").MODEL.names
        }
        assert named == set(cameras.lens_models()) == set(LENSES)

    def test_unknown_model_names_the_known(self):
        with pytest.raises(InputError, match=r"'omnidirectional' is not known.*equidistant.*plumb_bob"):
            cameras.lens_of(camera_of("omnidirectional", []))

    @pytest.mark.parametrize(("model", "count"), [("plumb_bob", 8), ("equidistant", 4)])
    def test_coefficients_that_no_lens_knows(self, model, count):
        point = np.array([[0.1, 0.2, 1.0]])
        known = np.full(count, 0.01)
        plain, _ = cameras.project(camera_of(model, known), point)
        padded, _ = cameras.project(camera_of(model, [*known, 0.0, 0.0]), point)
        np.testing.assert_array_equal(plain, padded)
        with pytest.raises(InputError, match=f"beyond the {count}"):
            cameras.project(camera_of(model, [*known, 0.0, 0.01]), point)

    @pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
    def test_missing_coefficients_are_zero(self, model):
        some = camera_of(model, [0.02, -0.01])
        same = camera_of(model, [0.02, -0.01, 0.0, 0.0])
        ahead = points(some)
        np.testing.assert_array_equal(cameras.project(some, ahead)[0], cameras.project(same, ahead)[0])


class TestProjection:
    @every_lens
    def test_against_opencv(self, model):
        camera = camera_of(model)
        uv, valid = cameras.project_unbounded(camera, points(camera))
        assert valid.all()
        np.testing.assert_allclose(uv, opencv(camera, points(camera)), atol=1e-9)

    @every_lens
    def test_on_the_axis(self, model):
        uv, valid = cameras.project(camera_of(model), np.array([[0.0, 0.0, 3.0]]))
        assert valid.all()
        np.testing.assert_array_equal(uv, [[610.0, 180.0]])

    @every_lens
    def test_what_lies_behind_or_too_near_does_not_project(self, model):
        behind = np.array(
            [[0.0, 0.0, -1.0], [1.0, 1.0, -5.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.1, 0.0, 0.05]]
        )
        uv, valid = cameras.project(camera_of(model), behind)
        assert not valid.any()
        assert np.isnan(uv).all()

    @every_lens
    def test_not_a_number_does_not_project(self, model):
        _, valid = cameras.project(camera_of(model), np.array([[np.nan, 0.0, 5.0], [0.0, 0.0, np.nan]]))
        assert not valid.any()

    @every_lens
    def test_nothing(self, model):
        uv, valid = cameras.project(camera_of(model), np.zeros((0, 3)))
        assert uv.shape == (0, 2)
        assert valid.shape == (0,)
        assert cameras.undistort(camera_of(model), np.zeros((0, 2))).shape == (0, 2)

    def test_borders_lie_half_a_pixel_outside(self):
        camera = camera_of("pinhole", K_camera=np.diag([1.0, 1.0, 1.0]))
        inside = np.array([[-0.5, -0.5], [1241.49, 374.49], [0.0, 0.0]])
        outside = np.array([[-0.51, 0.0], [0.0, -0.51], [1241.5, 0.0], [0.0, 374.5]])
        uv = np.vstack([inside, outside])
        found, valid = cameras.project(camera, np.column_stack([uv, np.ones(len(uv))]))
        np.testing.assert_array_equal(valid, [True] * 3 + [False] * 4)
        np.testing.assert_array_equal(found, uv)

    @every_lens
    def test_jacobians_against_differences(self, model):
        camera = camera_of(model)
        lens, xy, step = cameras.lens_of(camera), rays(camera), 1e-6
        J = lens.jacobian(xy, camera.D)
        for axis in range(2):
            shift = step * np.eye(2)[axis]
            slope = (lens.distort(xy + shift, camera.D) - lens.distort(xy - shift, camera.D)) / (2 * step)
            np.testing.assert_allclose(J[:, :, axis], slope, atol=1e-8)

    @every_lens
    def test_jacobian_on_the_axis(self, model):
        camera = camera_of(model)
        J = cameras.lens_of(camera).jacobian(np.zeros((1, 2)), camera.D)
        np.testing.assert_allclose(J, np.eye(2)[None], atol=1e-12)


class TestFold:
    @every_lens
    def test_distorted_radius_grows_up_to_the_limit_and_not_beyond(self, model):
        camera = camera_of(model)
        D = camera.D.copy()
        if model in {"plumb_bob", "rational_polynomial"}:
            D[2:4] = 0.0  # without the tangential part the radius alone tells
        lens = cameras.lens_of(camera)
        limit = lens.limit(D)
        radius = np.linspace(0.0, min(limit, 30.0), 2000)
        grown = lens.distort(np.column_stack([radius, 0 * radius]), D)[:, 0]
        assert (np.diff(grown) > 0).all()
        if np.isfinite(limit):
            beyond = lens.distort(np.array([[limit, 0.0], [1.01 * limit, 0.0]]), D)[:, 0]
            assert beyond[1] < beyond[0]

    def test_where_a_common_lens_folds(self):
        k1, k2 = -0.36, 0.17
        # d/dr (r + k1 r^3 + k2 r^5 + k3 r^7) = 0 at r^2 = s; k3 chosen so that s = 1.44.
        s = 1.44
        k3 = -(1 + 3 * k1 * s + 5 * k2 * s**2) / (7 * s**3)
        camera = camera_of("plumb_bob", [k1, k2, 0.0, 0.0, k3])
        assert cameras.lens_of(camera).limit(camera.D) == pytest.approx(1.2, abs=1e-9)

    @pytest.mark.parametrize(
        ("model", "D"), [("plumb_bob", PLUMB_BOB), ("equidistant", [-0.3, 0.0, 0.0, 0.0])]
    )
    def test_nothing_projects_beyond_the_fold(self, model, D):
        camera = camera_of(model, D)
        limit = cameras.lens_of(camera).limit(camera.D)
        assert np.isfinite(limit)
        angle = np.linspace(0, 2 * np.pi, 50)
        for share, seen in ((0.999, True), (1.001, False), (1.5, False), (50.0, False)):
            around = np.column_stack([np.cos(angle), np.sin(angle)]) * limit * share
            uv, valid = cameras.project_unbounded(camera, np.column_stack([around, np.ones(50)]) * 7.0)
            assert (valid == seen).all()
            assert (np.isfinite(uv).all(axis=1) == seen).all()

    def test_a_pole_of_the_denominator_is_a_limit(self):
        camera = camera_of("rational_polynomial", [0.0, 0.0, 0.0, 0.0, 0.0, -0.25])
        assert cameras.lens_of(camera).limit(camera.D) == pytest.approx(2.0)

    def test_lenses_that_never_fold(self):
        for model, D in (("pinhole", []), ("plumb_bob", [0.1]), ("plumb_bob", []), ("equidistant", [])):
            assert cameras.lens_of(camera_of(model, D)).limit(np.array(D)) == np.inf


class TestInverse:
    @every_lens
    def test_undistort_inverts_the_projection(self, model):
        camera = camera_of(model)
        uv, _ = cameras.project_unbounded(camera, points(camera))
        np.testing.assert_allclose(cameras.undistort(camera, uv), rays(camera), atol=1e-8)

    @settings(max_examples=60, deadline=None)
    @given(
        k=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.3, 0.3), st.floats(-0.1, 0.1)),
        p=st.tuples(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3)),
        seed=st.integers(0, 1000),
    )
    def test_any_plumb_bob(self, k, p, seed):
        camera = camera_of("plumb_bob", [k[0], k[1], *p, k[2]])
        inside = rays(camera, 50, seed, share=0.9)
        inside = inside[np.hypot(*inside.T) < 1.2]
        uv, valid = cameras.project_unbounded(camera, np.column_stack([inside, np.ones(len(inside))]))
        assert valid.all()
        np.testing.assert_allclose(cameras.undistort(camera, uv), inside, atol=1e-6)

    @settings(max_examples=60, deadline=None)
    @given(k=st.tuples(*[st.floats(-0.05, 0.05)] * 4), seed=st.integers(0, 1000))
    def test_any_fisheye(self, k, seed):
        camera = camera_of("equidistant", k)
        inside = rays(camera, 50, seed, share=0.9)
        uv, _ = cameras.project_unbounded(camera, np.column_stack([inside, np.ones(len(inside))]))
        np.testing.assert_allclose(cameras.undistort(camera, uv), inside, atol=1e-6)

    def test_a_lens_that_stretches_then_folds(self):
        # From the distorted coordinates Newton's method oscillates here.
        camera = camera_of("plumb_bob", [0.5, 0.0, 0.0, 0.0, -0.0625])
        assert np.isfinite(cameras.lens_of(camera).limit(camera.D))
        inside = rays(camera, share=0.99)
        uv, _ = cameras.project_unbounded(camera, np.column_stack([inside, np.ones(len(inside))]))
        np.testing.assert_allclose(cameras.undistort(camera, uv), inside, atol=1e-7)

    def test_a_fisheye_up_to_its_widest_rays(self):
        camera = camera_of("equidistant", [])
        r = np.tan(np.radians([80.0, 85.0, 89.0, 89.8]))
        uv, _ = cameras.project_unbounded(camera, np.column_stack([r, 0.0 * r, np.ones(4)]))
        np.testing.assert_allclose(cameras.undistort(camera, uv)[:, 0], r, rtol=1e-6)

    def test_pixels_that_no_ray_reaches(self):
        for model, D in (
            ("plumb_bob", PLUMB_BOB),
            ("equidistant", []),
            ("equidistant", [-0.3, 0.0, 0.0, 0.0]),
        ):
            camera = camera_of(model, D)
            # 720 px focal length: beyond 2.5 of normalised radius no lens here has an image.
            far = np.array([[610.0 + 1900.0, 180.0], [610.0, 180.0 - 1900.0], [-1200.0, 1500.0]])
            assert np.isnan(cameras.undistort(camera, far)).all()

    @every_lens
    def test_ideal_and_raw_pixels(self, model):
        camera = camera_of(model)
        grid = np.stack(np.meshgrid(np.linspace(0, 1241, 30), np.linspace(0, 374, 10)), axis=-1).reshape(
            -1, 2
        )
        ideal = cameras.ideal_pixels(camera, grid)
        # The corners of a sensor may lie outside the circle that its lens lights.
        lit = np.isfinite(ideal).all(axis=1)
        assert lit.mean() > 0.5
        grid, ideal = grid[lit], ideal[lit]
        np.testing.assert_allclose(cameras.raw_pixels(camera, ideal), grid, atol=1e-6)
        # An ideal pixel is where a pinhole with the same K sees the ray of the raw one.
        seen = np.column_stack([cameras.undistort(camera, grid), np.ones(len(grid))])
        np.testing.assert_allclose(cameras.project_unbounded(camera_of("pinhole"), seen)[0], ideal, atol=1e-9)
