"""Trials: labels take turns, and what a label says is what is made wrong."""

import math

import numpy as np
import pytest

from pipeline import drift_trials, se3
from pipeline.drift_trials import KINDS
from pipeline.mount import Mount
from pipeline.records import AXES, CameraModel

CAMERA = CameraModel(
    "pinhole", np.array([[300.0, 0, 159.5], [0, 300.0, 79.5], [0, 0, 1]]), np.zeros(0), 320, 160
)


def mount(seed=0, *, vehicle=True, camera=CAMERA):
    rng = np.random.default_rng(seed)
    turned = se3.exp_so3(rng.normal(0.0, 0.1, 3)) @ se3.AXES_CAM_IN_VEHICLE.T
    T = se3.transform(turned, rng.normal(0.0, 0.3, 3))
    T_vehicle_lidar = se3.transform(se3.exp_so3(rng.normal(0.0, 0.3, 3)), rng.normal(size=3))
    limits = np.array([0.01] * 3 + [0.1] * 3)
    return Mount(camera, T, T_vehicle_lidar if vehicle else None, 0.002, 0.02, limits, ("yaw",))


@pytest.mark.parametrize("kind", KINDS)
def test_labels_take_turns_and_repeat_with_the_seed(kind):
    names = drift_trials.labels_of(kind)
    count = drift_trials.count(kind, 7)
    assert count >= 7
    assert count % len(names) == 0
    assert drift_trials.count(kind, 1) == len(names)

    def drawn():
        return [drift_trials.draw(kind, k, mount(), np.random.default_rng([1, k])) for k in range(count)]

    one, other = drawn(), drawn()
    assert [t.label for t in one] == list(names) * (count // len(names))
    assert all(np.array_equal(a.drift, b.drift) for a, b in zip(one, other, strict=True))


def test_combined_errors_are_as_large_as_they_should_be():
    true = mount()
    for seed in range(100):
        drift = drift_trials.draw("combined", 0, true, np.random.default_rng(seed)).drift
        stored = se3.stored_before(true.T_cam_lidar, drift, true.T_vehicle_lidar[:3, :3])
        angle = math.degrees(se3.rotation_angle(stored[:3, :3], true.T_cam_lidar[:3, :3]))
        assert 0.5 <= angle <= 1.2
        assert 0.1 <= np.linalg.norm(drift[3:]) <= 0.2


def test_compensating_pairs_keep_the_bearing_at_their_range():
    for number in range(drift_trials.count("compensating", 1)):
        drift = drift_trials.draw("compensating", number, mount(), np.random.default_rng(0)).drift
        pitch, yaw, left, up = (drift[AXES.index(name)] for name in ("pitch", "yaw", "left", "up"))
        assert pitch - up / 20.0 == pytest.approx(0.0, abs=1e-12)
        assert yaw + left / 20.0 == pytest.approx(0.0, abs=1e-12)
        assert np.count_nonzero(drift) == 2


def test_offline_turns_are_about_the_axes_of_the_camera():
    true = mount()
    for number, label in enumerate(drift_trials.labels_of("offline")):
        drift = drift_trials.draw("offline", number, true, np.random.default_rng(number)).drift
        stored = se3.stored_before(true.T_cam_lidar, drift, true.T_vehicle_lidar[:3, :3])
        turn = np.degrees(se3.log_so3(stored[:3, :3] @ true.T_cam_lidar[:3, :3].T))
        words = label.split()
        axis, amount = "xyz".index(words[1]), float(words[2])
        if words[0] == "about":
            assert np.abs(turn) == pytest.approx(amount * np.eye(3)[axis], abs=1e-6)
            assert drift[3:] == pytest.approx(0.0, abs=1e-9)
        else:
            centres = [-T[:3, :3].T @ T[:3, 3] for T in (stored, true.T_cam_lidar)]
            shift = true.T_cam_lidar[:3, :3] @ (centres[1] - centres[0])
            assert np.abs(shift) == pytest.approx(amount * np.eye(3)[axis], abs=1e-9)


def test_slips_are_along_one_axis_by_what_their_label_says():
    signs = set()
    for number, label in enumerate(drift_trials.labels_of("slip")):
        drift = drift_trials.draw("slip", number, mount(), np.random.default_rng(number)).drift
        axis, amount, unit = label.split()
        size = math.radians(float(amount)) if unit == "deg" else float(amount)
        expected = size * np.eye(6)[AXES.index(axis)]
        assert np.abs(drift) == pytest.approx(expected, abs=1e-12)
        signs.add(float(np.sign(drift.sum())))
    assert signs == {-1.0, 1.0}
