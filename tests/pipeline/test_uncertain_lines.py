import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline.uncertain_lines import UncertainLine, across, structure_line


def line_of(rng, origin=None):
    """An upright edge some 10 m ahead, well known sideways, badly in depth."""
    start = np.array([rng.uniform(7, 14), rng.uniform(-3, 3), rng.uniform(-1, 0)])
    end = start + np.array([*rng.normal(0, 0.3, 2), rng.uniform(1, 4)])
    A = np.diag([0.02, 0.15, 0.02, 0.15]) @ rng.normal(size=(4, 4))
    extra = {} if origin is None else {"origin": origin}
    return UncertainLine("border", start, end, np.arange(9), A @ A.T / 4, **extra)


def offsets_from(eye, line, rng, count=60_000):
    """By simulation: how far off, m, both ends appear from a place: the plane of eye and line as it was."""
    noise = rng.multivariate_normal(np.zeros(4), line.covariance, count)
    ends = np.stack([line.start, line.end])
    moved = ends + noise.reshape(count, 2, 2) @ line.axes
    normal = np.cross(ends[0] - eye, ends[1] - eye)
    return (moved - eye) @ (normal / np.linalg.norm(normal))


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.5, 0.2, -0.4), (1.0, -3.0, 0.5), (4.0, 4.0, -2.0)])
def test_what_a_camera_sees_of_an_error_is_what_a_simulation_says(place):
    rng = np.random.default_rng(3)
    eye = np.array(place)
    for _ in range(3):
        line = line_of(rng)
        simulated = np.cov(offsets_from(eye, line, rng).T)
        scale = np.sqrt(np.outer(np.diag(simulated), np.diag(simulated)))
        seen = line.seen_from(eye)
        np.testing.assert_allclose(seen / scale, simulated / scale, atol=0.03)
        record = structure_line(line, eye)
        arm = np.array([0.0, line.length]) - record.mean_m
        told = record.sigma_m**2 * (1.0 / len(record.points) + np.outer(arm, arm) / record.spread)
        np.testing.assert_allclose(told / scale, simulated / scale, atol=0.03)


def test_a_camera_three_metres_aside_sees_a_third_of_the_depth():
    """10 m ahead: sin(atan(3 / 10)) = 0.29 of 20 cm in depth, where a tenth was told before."""
    line = UncertainLine(
        "crease",
        np.array([10.0, 0.0, -1.0]),
        np.array([10.0, 0.0, 1.0]),
        np.arange(9),
        np.diag([1e-4, 0.04, 1e-4, 0.04]),
    )
    share = 3.0 / np.hypot(3.0, 10.0)
    for eye in (np.array([0.0, 3.0, 0.0]), np.array([0.0, -3.0, 0.0])):
        seen = np.diag(line.seen_from(eye))
        np.testing.assert_allclose(seen, share**2 * 0.04 + (1 - share**2) * 1e-4, rtol=1e-9)
    np.testing.assert_allclose(np.diag(line.seen_from(np.zeros(3))), 1e-4, rtol=1e-9)
    # Up and down an upright edge there is no more of its depth to see.
    np.testing.assert_allclose(np.diag(line.seen_from(np.array([0.0, 0.0, 3.0]))), 1e-4, rtol=1e-9)


def test_another_frame_changes_nothing_that_is_seen():
    rng = np.random.default_rng(4)
    R = Rotation.random(random_state=2).as_matrix()
    t = np.array([1.5, 0.3, 1.9])
    for origin in (None, np.array([0.2, -0.1, 0.4])):
        line, eye = line_of(rng, origin), np.array([0.3, 2.0, -1.0])
        moved = line.moved(R, t)
        np.testing.assert_allclose(moved.axes, line.axes @ R.T, atol=1e-12)
        np.testing.assert_allclose(moved.seen_from(R @ eye + t), line.seen_from(eye), atol=1e-15)


def test_axes_are_those_of_the_sensor_and_fields_can_not_be_written():
    rng = np.random.default_rng(5)
    origin = np.array([1.5, 0.3, 1.9])
    line = line_of(rng, origin)
    middle = 0.5 * (line.start + line.end) - origin
    np.testing.assert_allclose(line.axes, across(line.direction, middle), atol=1e-15)
    assert not line.origin.flags.writeable


def test_a_line_that_points_at_the_camera_has_a_number():
    line = UncertainLine(
        "jump", np.array([5.0, 0.0, 0.0]), np.array([8.0, 0.0, 0.0]), np.arange(5), 1e-4 * np.eye(4)
    )
    np.testing.assert_allclose(line.seen_from(np.zeros(3)), 1e-4 * np.eye(2), atol=1e-12)
