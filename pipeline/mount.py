"""What is stored of one pair of sensors, and its axes."""

from dataclasses import dataclass

import numpy as np

from pipeline import se3
from pipeline.baseline import Baseline
from pipeline.deskew import SpinSense, Twist
from pipeline.drift_test import DriftTestParameters, Expectation, expectation_of_stored
from pipeline.ego import Straightened
from pipeline.records import CameraModel, Floats


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """What is stored of a pair.

    Attributes:
        camera: Intrinsics.
        T_cam_lidar: float64 (4,4), the stored extrinsic.
        T_vehicle_lidar: float64 (4,4), or None: the stored camera's own axes stand in.
        sigma_rad: Uncertainty of the stored rotation per axis, rad.
        sigma_m: Uncertainty of the stored translation per axis, m.
        limits: float64 (6,), alert limits.
        required: Axes that must be monitored for 'healthy'.
        spin: Sense of rotation of the LiDAR where it is configured.
        baseline: What healthy drives taught about this mount under this extrinsic, or None.
    """

    camera: CameraModel
    T_cam_lidar: Floats
    T_vehicle_lidar: Floats | None
    sigma_rad: float
    sigma_m: float
    limits: Floats
    required: tuple[str, ...]
    spin: SpinSense | None = None
    baseline: Baseline | None = None

    def expectation(self, test: DriftTestParameters) -> Expectation:
        """What estimates of this mount are expected to be while it has not moved."""
        if self.baseline is not None:
            return self.baseline.expectation(test)
        return expectation_of_stored(self.sigma_rad, self.sigma_m, test)

    def thresholds(self, test: DriftTestParameters) -> DriftTestParameters:
        """The test with the thresholds that are this mount's own, where a baseline could learn them."""
        return test if self.baseline is None else self.baseline.thresholds(test)

    @property
    def noise(self) -> float:
        """Factor on the stated sigma of a window; few drives make no window surer than it says it is."""
        return 1.0 if self.baseline is None else max(1.0, self.baseline.scatter.noise)

    @property
    def R_vehicle_cam(self) -> Floats:  # noqa: N802 - the name of the rotation
        """Turns camera axes into vehicle axes, (3,3)."""
        return se3.vehicle_axes(self.T_cam_lidar, self.T_vehicle_lidar)

    @property
    def up(self) -> Floats:
        """Unit vector up, LiDAR frame."""
        return np.asarray(self.R_vehicle_cam[2] @ self.T_cam_lidar[:3, :3], dtype=np.float64)

    @property
    def forward(self) -> Floats:
        """Unit vector ahead (of the vehicle, else of the camera), LiDAR frame."""
        return np.asarray(self.R_vehicle_cam[0] @ self.T_cam_lidar[:3, :3], dtype=np.float64)

    def motion(self, twist: Twist | None) -> Floats:
        """Drift (6,), vehicle axes, that a camera feigns per second that it exposes late (FORMULAS G1)."""
        if twist is None:
            return np.array([0.0, 0.0, 0.0, _ASSUMED_M_S, 0.0, 0.0])
        R_vehicle_lidar = self.R_vehicle_cam @ self.T_cam_lidar[:3, :3]
        centre = -self.T_cam_lidar[:3, :3].T @ self.T_cam_lidar[:3, 3]
        velocity = twist.velocity + np.cross(twist.omega, centre)
        return np.concatenate([R_vehicle_lidar @ twist.omega, R_vehicle_lidar @ velocity])

    def feigned(self, sweep: Straightened) -> Floats:
        """Drift (6,), vehicle axes, that one sigma of error in a sweep's time would feign (FORMULAS G1)."""
        return np.asarray(sweep.sync_s * self.motion(sweep.twist), dtype=np.float64)


_ASSUMED_M_S = 10.0
"""m/s ahead where the motion is not known: a street in town."""
