import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline import se3
from pipeline.records import AXES

UNIT = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)
AXIS = UNIT.map(lambda v: v / np.linalg.norm(v))
ANGLE = (
    st.floats(0.0, np.pi)
    | st.floats(0.0, 1e-5)
    | st.floats(0.0, 1e-5).map(lambda below: np.pi - below)
    | st.sampled_from([0.0, 1e-12, 1e-6, np.pi / 2, np.pi])
)
TURN = st.builds(lambda axis, angle: axis * angle, AXIS, ANGLE)
SHIFT = st.tuples(*[st.floats(-5, 5)] * 3).map(np.array)
POSE = st.builds(lambda phi, t: se3.transform(se3.exp_so3(phi), t), TURN, SHIFT)
DRIFT = st.builds(
    lambda angles, shift: np.concatenate([angles, shift]),
    st.tuples(st.floats(-3.0, 3.0), st.floats(-1.4, 1.4), st.floats(-3.0, 3.0)).map(np.array),
    SHIFT,
)

FORWARD = se3.AXES_CAM_IN_VEHICLE.T
"""R_cam_vehicle of a camera that looks ahead."""
TURN_LEFT = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
LEFT = FORWARD @ TURN_LEFT.T
"""R_cam_vehicle of a camera that looks to the left."""
LIDARS = {"straight": np.eye(3), "turned by 90 deg": TURN_LEFT, "backward": np.diag([-1.0, -1.0, 1.0])}
"""R_vehicle_lidar."""


def rig(R_cam_vehicle, R_vehicle_lidar):
    return se3.transform(R_cam_vehicle @ R_vehicle_lidar, np.array([0.3, -0.2, 0.5]))


class TestExponential:
    @given(TURN)
    def test_is_a_rotation_about_its_axis(self, phi):
        R = se3.exp_so3(phi)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-14)
        np.testing.assert_allclose(R @ phi, phi, atol=1e-14)

    @given(TURN)
    def test_against_the_power_series(self, phi):
        W, term, total = se3.skew(phi), np.eye(3), np.eye(3)
        for n in range(1, 40):
            term = term @ W / n
            total = total + term
        np.testing.assert_allclose(se3.exp_so3(phi), total, atol=1e-13)

    @given(TURN)
    def test_logarithm_returns(self, phi):
        R = se3.exp_so3(phi)
        back = se3.log_so3(R)
        np.testing.assert_allclose(se3.exp_so3(back), R, atol=1e-14)
        # At half a turn both signs of the axis are right.
        if np.linalg.norm(phi) < np.pi - 1e-9:
            np.testing.assert_allclose(back, phi, atol=2e-14)
        else:
            assert np.linalg.norm(back) == pytest.approx(np.linalg.norm(phi), abs=1e-14)

    @given(AXIS, ANGLE)
    def test_rotation_angle(self, axis, angle):
        base = se3.exp_so3(np.array([0.3, -1.0, 2.0]))
        found = se3.rotation_angle(base, se3.exp_so3(axis * angle) @ base)
        # The chord is flat at 180 degrees: rounding of 1e-15 there is 1e-7 in the angle.
        assert found == pytest.approx(angle, abs=1e-13 if angle < 3.0 else 2e-7)

    @given(UNIT, UNIT)
    def test_skew_is_the_cross_product(self, a, b):
        np.testing.assert_allclose(se3.skew(a) @ b, np.cross(a, b), atol=1e-15)


class TestMotions:
    @given(POSE)
    def test_inverse(self, T):
        np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-13)

    @given(POSE, TURN, SHIFT)
    def test_local_inverts_retract(self, T, phi, rho):
        there = se3.retract(T, np.concatenate([phi, rho]))
        np.testing.assert_allclose(se3.retract(T, se3.local(T, there)), there, atol=1e-13)
        if np.linalg.norm(phi) < np.pi - 1e-9:
            np.testing.assert_allclose(se3.local(T, there), [*phi, *rho], atol=1e-12)

    @given(POSE, SHIFT)
    def test_apply_takes_points_of_any_float(self, T, point):
        expected = T @ np.array([*point, 1.0])
        np.testing.assert_allclose(se3.apply(T, point[None])[0], expected[:3], atol=1e-13)
        single = se3.apply(T, point[None].astype(np.float32))
        assert single.dtype == np.float64

    @given(POSE)
    def test_orthonormalised(self, T):
        R = T[:3, :3]
        noisy = R + 1e-3 * np.random.default_rng(0).normal(size=(3, 3))
        near = se3.orthonormalised(noisy)
        np.testing.assert_allclose(near @ near.T, np.eye(3), atol=1e-14)
        assert np.linalg.norm(near - noisy) <= np.linalg.norm(R - noisy) + 1e-15
        np.testing.assert_allclose(se3.orthonormalised(R), R, atol=1e-14)


class TestConventions:
    """FORMULAS A3, A4 by central differences."""

    T = se3.retract(np.eye(4), np.array([0.4, -1.1, 0.7, 0.5, -0.3, 1.2]))
    STEP = 1e-5

    def differences(self, function):
        columns = []
        for axis in range(6):
            xi = np.zeros(6)
            xi[axis] = self.STEP
            columns.append((function(xi) - function(-xi)) / (2 * self.STEP))
        return np.column_stack(columns)

    def test_decoupled_perturbation(self):
        t = self.T[:3, 3]
        M = np.block([[np.eye(3), np.zeros((3, 3))], [-se3.skew(t), np.eye(3)]])

        def decoupled(xi):
            T = se3.retract(self.T, xi)
            return np.concatenate([se3.log_so3(T[:3, :3] @ self.T[:3, :3].T), T[:3, 3] - t])

        # rho_d = rho - [t] phi
        np.testing.assert_allclose(self.differences(decoupled), M, atol=1e-9)

    def test_adjoint_takes_the_left_to_the_right_perturbation(self):
        inverse = se3.inverse(self.T)
        R, t = inverse[:3, :3], inverse[:3, 3]
        adjoint = np.block([[R, np.zeros((3, 3))], [se3.skew(t) @ R, R]])

        def right(xi):
            step = inverse @ se3.retract(self.T, xi)
            return np.concatenate([se3.log_so3(step[:3, :3]), step[:3, 3]])

        np.testing.assert_allclose(self.differences(right), adjoint, atol=1e-9)

    @pytest.mark.parametrize("R_vehicle_lidar", LIDARS.values(), ids=LIDARS.keys())
    def test_vehicle_block(self, R_vehicle_lidar):
        R_vc = R_vehicle_lidar @ self.T[:3, :3].T
        found = self.differences(lambda xi: se3.mount_drift(self.T, se3.retract(self.T, xi), R_vc))
        np.testing.assert_allclose(found, se3.vehicle_block(R_vc), atol=1e-9)


class TestDrift:
    @given(POSE, DRIFT, TURN)
    def test_mount_drift_inverts_displaced(self, T, drift, phi):
        R_vc = se3.exp_so3(phi)
        found = se3.mount_drift(T, se3.displaced(T, drift, R_vc), R_vc)
        np.testing.assert_allclose(found, drift, atol=1e-12)

    @given(POSE, DRIFT, TURN | st.none())
    def test_what_was_injected_is_what_is_found(self, T_true, drift, phi):
        R_vl = None if phi is None else se3.exp_so3(phi)
        stored = se3.stored_before(T_true, drift, R_vl)
        T_vl = None if R_vl is None else se3.transform(R_vl, np.array([1.0, 2.0, 3.0]))
        found = se3.mount_drift(stored, T_true, se3.vehicle_axes(stored, T_vl))
        np.testing.assert_allclose(found, drift, atol=1e-12)

    @pytest.mark.parametrize("axis", range(6), ids=AXES)
    @pytest.mark.parametrize("R_cam_vehicle", [FORWARD, LEFT], ids=["ahead", "left"])
    @pytest.mark.parametrize("R_vehicle_lidar", LIDARS.values(), ids=LIDARS.keys())
    @pytest.mark.parametrize("known", [True, False], ids=["vehicle", "no vehicle"])
    def test_each_axis_alone(self, axis, R_cam_vehicle, R_vehicle_lidar, known):
        T_true = rig(R_cam_vehicle, R_vehicle_lidar)
        drift = np.zeros(6)
        drift[axis] = 0.05
        stored = se3.stored_before(T_true, drift, R_vehicle_lidar if known else None)
        T_vl = se3.transform(R_vehicle_lidar, np.array([1.0, 0.0, 1.7])) if known else None
        R_vc = se3.vehicle_axes(stored, T_vl)
        np.testing.assert_allclose(se3.mount_drift(stored, T_true, R_vc), drift, atol=1e-14)
        assert np.abs(se3.local(stored, T_true)).max() == pytest.approx(0.05, rel=1e-3)


class TestSigns:
    """What a driver would see: the point's direction in the camera after the mount moved."""

    @staticmethod
    def moved(axis, R_cam_vehicle, point_vehicle, R_vehicle_lidar):
        """A point (vehicle axes, from the camera) in camera axes, before and after 0.1 of drift, (2,3)."""
        T = se3.transform(R_cam_vehicle @ R_vehicle_lidar, np.zeros(3))
        drift = np.zeros(6)
        drift[AXES.index(axis)] = 0.1
        now = se3.displaced(T, drift, R_cam_vehicle.T)
        point = R_vehicle_lidar.T @ np.array(point_vehicle)
        return np.stack([se3.apply(T, point[None])[0], se3.apply(now, point[None])[0]])

    # Camera axes of what appears: 0 right, 1 down, 2 depth.
    @pytest.mark.parametrize(
        ("axis", "point", "component", "sign"),
        [
            ("yaw", (20.0, 0.0, 0.0), 0, 1),  # camera turns left, the scene moves right
            ("pitch", (20.0, 0.0, 0.0), 1, -1),  # nose down, the scene moves up
            ("roll", (20.0, -5.0, 0.0), 1, -1),  # right side down, what is on the right moves up
            ("forward", (20.0, 0.0, 0.0), 2, -1),  # the scene comes nearer
            ("left", (20.0, 0.0, 0.0), 0, 1),  # the scene moves right
            ("up", (20.0, 0.0, 0.0), 1, 1),  # the scene moves down
        ],
    )
    @pytest.mark.parametrize("R_vehicle_lidar", LIDARS.values(), ids=LIDARS.keys())
    def test_camera_that_looks_ahead(self, axis, point, component, sign, R_vehicle_lidar):
        before, after = self.moved(axis, FORWARD, point, R_vehicle_lidar)
        assert sign * (after - before)[component] > 0.09

    @pytest.mark.parametrize(
        ("axis", "point", "component", "sign"),
        [
            ("yaw", (0.0, 20.0, 0.0), 0, 1),  # still: turning left moves the scene right
            (
                "roll",
                (0.0, 20.0, 0.0),
                1,
                1,
            ),  # what looks left is lifted: the scene moves down
            ("pitch", (5.0, 20.0, 0.0), 1, -1),  # nose down: what is ahead, on this camera's right, moves up
            ("forward", (0.0, 20.0, 0.0), 0, -1),  # the scene passes backward, to this camera's left
            ("left", (0.0, 20.0, 0.0), 2, -1),  # the scene comes nearer
            ("up", (0.0, 20.0, 0.0), 1, 1),
        ],
    )
    @pytest.mark.parametrize("R_vehicle_lidar", LIDARS.values(), ids=LIDARS.keys())
    def test_camera_that_looks_left(self, axis, point, component, sign, R_vehicle_lidar):
        before, after = self.moved(axis, LEFT, point, R_vehicle_lidar)
        assert sign * (after - before)[component] > 0.09


@given(POSE, TURN, SHIFT)
def test_the_distance_of_two_extrinsics_is_that_of_the_step_between_them(T, phi, shift):
    """CRLF (15), (16), half turns among them, where the axis of the difference is lost."""
    R = se3.exp_so3(phi) @ T[:3, :3]
    other = se3.transform(R, T[:3, 3] + shift)
    for one, two in ((T, other), (other, T)):
        distance, angle = se3.pose_error(one, two)
        assert distance == pytest.approx(np.linalg.norm(shift), abs=1e-9)
        assert angle == pytest.approx(np.linalg.norm(phi), abs=1e-6)
