"""A drive: the vehicle's motion, the sensors' clocks, and the moment at which the camera mount moves."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError
from pipeline.records import CameraImage, CameraModel, Floats, PointCloud, read_only
from pipeline.se3 import AXES_CAM_IN_VEHICLE, displaced, exp_so3, inverse, transform, vehicle_axes
from pipeline.simulation.camera import Look, Optics, optics_of, render
from pipeline.simulation.lidar import LidarModel, spinning, sweep
from pipeline.simulation.scene import Scene, SceneParameters, draw_scene
from pipeline.simulation.shadows import ShadowMap, shadow_map

START_NS = 1_700_000_000_000_000_000
"""ns; stamp of time 0, some day, so that nothing may take a stamp for a duration."""
_VIEW_M = 130.0
"""m; how far ahead shadows are drawn."""
_END_M = 10.0
"""m; the belt of trees at the end may come so near: it closes the view as well as a street."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """How the vehicle drives along its lane.

    Attributes:
        speed: Mean, m/s.
        swing: Amplitude of the speed about its mean, m/s.
        swing_period: s.
        weave: Amplitude about the middle of the lane, m.
        weave_period: s.
        bob: Amplitude of pitch on the springs, rad; half of it in roll.
        bob_period: s.
    """

    speed: float = 11.0
    swing: float = 1.5
    swing_period: float = 9.0
    weave: float = 0.25
    weave_period: float = 7.0
    bob: float = math.radians(0.25)
    bob_period: float = 0.9

    def along(self, t: Floats) -> Floats:
        """Way along the road since time 0, m."""
        w = 2.0 * math.pi / self.swing_period
        return np.asarray(self.speed * t + self.swing / w * (1.0 - np.cos(w * t)))


def _mount(place: tuple[float, float, float], turn_deg: tuple[float, float, float]) -> Floats:
    """T_vehicle_sensor of a sensor that looks ahead: x forward; roll, pitch, yaw in degrees."""
    R = np.eye(3)
    for k, angle in zip((2, 1, 0), reversed(turn_deg), strict=True):
        R = R @ exp_so3(math.radians(angle) * np.eye(3)[k])
    return transform(R, np.array(place))


def _lidar_mount() -> Floats:
    return _mount((0.9, 0.0, 1.73), (0.4, -0.6, 0.8))


def _stored_extrinsic() -> Floats:
    camera = _mount((1.25, 0.06, 1.62), (0.3, 1.5, -0.5))
    camera = camera @ transform(AXES_CAM_IN_VEHICLE, np.zeros(3))
    return inverse(camera) @ _lidar_mount()


def _camera() -> CameraModel:
    K = np.array([[640.0, 0.0, 479.5], [0.0, 640.0, 145.0], [0.0, 0.0, 1.0]])
    return CameraModel("pinhole", K, np.zeros(0), 960, 304)


@dataclass(frozen=True, slots=True, eq=False)
class DriveParameters:
    """A drive; the same parameters give the same frames.

    Attributes:
        seed: Of street and noise.
        duration: s.
        scene: The street; it must be as long as the drive and 120 m more.
        motion: Of the vehicle.
        lidar: The sensor; one turn follows the other.
        camera: Intrinsics.
        look: How the camera sees.
        exposure: Of the camera after the start of a sweep, s.
        T_vehicle_lidar: float64 (4,4), maps LiDAR to vehicle (x forward, y left, z up, origin on the ground).
        T_stored: float64 (4,4), the extrinsic T_cam_lidar that the vehicle believes in, true until the drift.
        drift: float64 (6,), motion of the camera mount in vehicle axes (roll, pitch, yaw rad, forward, left,
            up m) with the signs of FORMULAS A4.
        drift_time: When it happens, s; inf: never.
    """

    seed: int = 1
    duration: float = 14.0
    scene: SceneParameters = field(default_factory=SceneParameters)
    motion: Motion = field(default_factory=Motion)
    lidar: LidarModel = field(default_factory=lambda: spinning(64))
    camera: CameraModel = field(default_factory=_camera)
    look: Look = field(default_factory=Look)
    exposure: float = 0.053
    T_vehicle_lidar: Floats = field(default_factory=_lidar_mount)
    T_stored: Floats = field(default_factory=_stored_extrinsic)
    drift: Floats = field(default_factory=lambda: np.array([0.0, 0.0, math.radians(0.5), 0.0, 0.05, 0.0]))
    drift_time: float = math.inf

    def __post_init__(self) -> None:
        for name in ("T_vehicle_lidar", "T_stored", "drift"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        way = float(self.motion.along(np.array(self.duration)))
        if way + _VIEW_M - _END_M > self.scene.length:
            needed = way + _VIEW_M - _END_M
            raise InputError(
                f"a drive of {way:.0f} m needs a street of {needed:.0f} m, it has {self.scene.length:.0f} m",
                hint="a longer SceneParameters.length or a shorter duration",
            )

    @property
    def frames(self) -> int:
        """Whole sweeps within the drive."""
        return math.floor(self.duration / self.lidar.period + 1e-9)

    @property
    def drift_stamp_ns(self) -> int | None:
        """When the mount moves, ns; None: never."""
        return START_NS + round(self.drift_time * 1e9) if math.isfinite(self.drift_time) else None


@dataclass(frozen=True, slots=True, eq=False)
class DriveFrame:
    """A sweep, the image taken within it, and the truth.

    Attributes:
        index: Number of the sweep.
        cloud: Points of their own moments, LiDAR frame; time counts from ``cloud_stamp_ns``.
        cloud_stamp_ns: Start of the sweep, ns.
        image: The image.
        image_stamp_ns: Exposure, ns.
        labels: uint8 (H,W), class of each pixel.
        T_cam_lidar: float64 (4,4), the true extrinsic at the exposure.
        T_world_vehicle: float64 (4,4), at the exposure.
        drifted: Whether the mount has moved.
    """

    index: int
    cloud: PointCloud
    cloud_stamp_ns: int
    image: CameraImage
    image_stamp_ns: int
    labels: NDArray[np.uint8]
    T_cam_lidar: Floats
    T_world_vehicle: Floats
    drifted: bool


class Drive:
    """The frames of a drive, made when asked for, each from its own seed.

    Args:
        parameters: What is driven.
        scene: Where; None: the street of the parameters.
    """

    def __init__(self, parameters: DriveParameters, scene: Scene | None = None) -> None:
        self.parameters = parameters
        if scene is None:
            scene = draw_scene(parameters.scene, np.random.default_rng(parameters.seed))
        self.scene = scene
        ends = self.T_world_vehicle(np.array([0.0, parameters.duration]))[:, 0, 3]
        self._shadows: ShadowMap = shadow_map(self.scene, (float(ends[0]) - 20.0, float(ends[1]) + _VIEW_M))
        self._optics: Optics = optics_of(parameters.camera)

    def __len__(self) -> int:
        return self.parameters.frames

    def __iter__(self) -> Iterator[DriveFrame]:
        return (self.frame(index) for index in range(len(self)))

    def T_world_vehicle(self, times: Floats) -> Floats:  # noqa: N802 - the name of the motion
        """Pose of the vehicle, float64 (n,4,4), at times (n,), s: base on the ground, x forward."""
        m, w = self.parameters.motion, 2.0 * math.pi / self.parameters.motion.weave_period
        left = self.scene.ego_left + m.weave * np.sin(w * times)
        speed = m.speed + m.swing * np.sin(2.0 * math.pi / m.swing_period * times)
        place, heading, grade = self.scene.surface.pose(m.along(times), left)
        swing = m.bob * np.sin(2.0 * math.pi / m.bob_period * times)
        yaw = heading + np.arctan2(m.weave * w * np.cos(w * times), speed)
        pitch = swing - np.arctan(grade * np.cos(heading))
        T = np.tile(np.eye(4), (len(times), 1, 1))
        T[:, :3, :3] = _euler(0.5 * swing, pitch, yaw)
        T[:, :3, 3] = place
        return T

    def T_cam_lidar(self, time: float) -> Floats:  # noqa: N802 - the name of the extrinsic
        """The true extrinsic (4,4) at a time, s."""
        p = self.parameters
        if time < p.drift_time:
            return p.T_stored
        return displaced(p.T_stored, p.drift, vehicle_axes(p.T_stored, p.T_vehicle_lidar))

    def T_world_lidar(self, times: Floats) -> Floats:  # noqa: N802 - the name of the motion
        """Pose of the LiDAR, float64 (n,4,4), at times (n,), s."""
        return np.asarray(self.T_world_vehicle(times) @ self.parameters.T_vehicle_lidar)

    def frame(self, index: int) -> DriveFrame:
        """Frame ``index`` (0 is the first); the same whenever it is asked for."""
        p = self.parameters
        start = index * p.lidar.period
        exposed = start + p.exposure
        lidar_rng, camera_rng = (np.random.default_rng([p.seed, index, k]) for k in range(2))
        cloud = sweep(self.scene, p.lidar, self.T_world_lidar, start, lidar_rng)
        T_cam_lidar = self.T_cam_lidar(exposed)
        at_exposure = np.array([exposed])
        T_world_cam = self.T_world_lidar(at_exposure)[0] @ inverse(T_cam_lidar)
        picture = render(
            self.scene, self._shadows, self._optics, T_world_cam, time=exposed, look=p.look, rng=camera_rng
        )
        return DriveFrame(
            index,
            cloud,
            START_NS + round(start * 1e9),
            picture.image,
            START_NS + round(exposed * 1e9),
            picture.labels,
            T_cam_lidar,
            self.T_world_vehicle(at_exposure)[0],
            exposed >= p.drift_time,
        )


def _euler(roll: Floats, pitch: Floats, yaw: Floats) -> Floats:
    """Rz(yaw) Ry(pitch) Rx(roll), float64 (n,3,3) of angles (n,), rad."""
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)
