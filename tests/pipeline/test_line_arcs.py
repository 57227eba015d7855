import numpy as np
import pytest

from pipeline import plk, se3
from pipeline.association import pairs_on_overlap
from pipeline.cloud_lines import cloud_line, total_least_squares
from pipeline.line_arcs import BEND_SIGMA, fit_arc, with_arc
from pipeline.records import CameraModel, CloudLine, ImageLine, PointCloud

CAMERA = CameraModel("pinhole", np.array([[720.0, 0, 620], [0, 720, 180], [0, 0, 1]]), np.zeros(0), 1240, 375)
T_CAM_LIDAR = se3.transform(se3.AXES_CAM_IN_VEHICLE.T, np.array([0.05, -0.1, -0.2]))
SIGMA_M = 0.03


def bend(x, radius, left=1.8, drop=-1.7):
    """Points of a painted line that touches the way ahead at x = 0, radius in m."""
    return np.column_stack([x, left + x**2 / (2 * radius), np.full(len(x), drop)])


def noisy_line(rng, radius, count=40, reach=(6.0, 30.0)):
    points = bend(np.sort(rng.uniform(*reach, count)), radius)
    points[:, 1:] += rng.normal(0, SIGMA_M, (count, 2))
    cloud = PointCloud(points.astype(np.float32))
    line = cloud_line("lane", total_least_squares(cloud.xyz.astype(np.float64)), np.arange(count))
    if line.end[0] < line.start[0]:
        length = float(np.linalg.norm(line.end - line.start))
        line = CloudLine(
            "lane", line.end, line.start, line.points, line.sigma_m, line.spread, length - line.mean_m
        )
    return line, cloud


def imaged(radius, first, last):
    """The line of least squares through the image of the bend between two distances."""
    uv = se3.apply(T_CAM_LIDAR, bend(np.linspace(first, last, 400), radius)) @ CAMERA.K.T
    uv = uv[:, :2] / uv[:, 2:]
    # Stations evenly spaced along the image line, as they are measured.
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(uv, axis=0), axis=1))])
    even = np.linspace(0.0, along[-1], 200)
    uv = np.column_stack([np.interp(even, along, axis) for axis in uv.T])
    mean = uv.mean(axis=0)
    direction = np.linalg.svd(uv - mean)[2][0]
    place = (uv - mean) @ direction
    return ImageLine("lane", mean + place.min() * direction, mean + place.max() * direction, 0.3)


def test_points_of_a_bend_without_noise_give_the_bend_itself():
    along = np.linspace(-12.0, 12.0, 60)
    across = np.column_stack([np.zeros(60), 0.1 - 0.002 * along + along**2 / 800, np.zeros(60)])
    arc = fit_arc(along, across)
    np.testing.assert_allclose(arc.offset[:, 1], [0.1, -0.002, 1 / 800], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(arc.offset[:, [0, 2]], 0.0, atol=1e-12)


@pytest.mark.parametrize("radius", [200.0, 1e9])
def test_covariance_of_the_course_is_that_of_repeated_fits(radius):
    rng = np.random.default_rng(1)
    along = np.linspace(-10.0, 10.0, 25)
    found, stated = [], []
    for _ in range(1500):
        across = np.column_stack([np.zeros(25), along**2 / (2 * radius), np.zeros(25)])
        across[:, 1:] += rng.normal(0, SIGMA_M, (25, 2))
        arc = fit_arc(along, across)
        found.append(arc.offset[:, 1])
        stated.append(arc.covariance)
    columns = np.column_stack([np.ones(3), [-10.0, 0.0, 10.0], [100.0, 0.0, 100.0]])
    measured = columns @ np.cov(np.array(found).T) @ columns.T
    np.testing.assert_allclose(
        columns @ np.mean(stated, axis=0) @ columns.T, measured, rtol=0.15, atol=0.1 * SIGMA_M**2
    )


def test_a_short_stroke_leaves_its_bend_to_the_belief():
    rng = np.random.default_rng(2)
    along = np.linspace(-0.5, 0.5, 12)
    arc = fit_arc(along, rng.normal(0, SIGMA_M, (12, 3)))
    assert np.sqrt(arc.covariance[2, 2]) == pytest.approx(BEND_SIGMA, rel=0.02)
    assert np.abs(arc.offset[2]).max() < BEND_SIGMA


def test_three_points_have_no_course():
    line = CloudLine("lane", np.zeros(3), np.array([9.0, 0, 0]), np.arange(3), 0.03, 40.0)
    cloud = PointCloud(np.array([[0, 0, 0], [4, 0.1, 0], [9, 0, 0]], dtype=np.float32))
    assert with_arc(line, cloud).arc is None


@pytest.mark.parametrize(
    ("radius", "stretch"),
    [
        (150.0, (8.0, 12.0)),
        (150.0, (15.0, 28.0)),
        (-300.0, (8.0, 12.0)),
        (-300.0, (15.0, 28.0)),
        (1e9, (7.0, 29.0)),
    ],
)
def test_each_stretch_of_a_bend_fits_the_cloud_line_at_the_truth(radius, stretch):
    """Whitened distances at the true extrinsic are those of a chi-square with 2 degrees of freedom."""
    rng = np.random.default_rng(3)
    image = imaged(radius, *stretch)
    bent, straight = [], []
    for _ in range(120):
        line, cloud = noisy_line(rng, radius)
        for model, into in ((with_arc(line, cloud), bent), (line, straight)):
            _, pair = pairs_on_overlap([model], [image], CAMERA, T_CAM_LIDAR)
            r = plk.residuals(pair, CAMERA.K, T_CAM_LIDAR)[0]
            into.append(float(r @ np.linalg.solve(pair.covariance[0], r)))
    # The image line has no noise here and the floor of the model is not simulated.
    assert np.mean(bent) < 2.2
    assert np.mean(np.array(bent) > 9.2) < 0.03
    if radius == 150.0:
        assert np.mean(straight) > 10
