"""Rigs drawn at random on drawn streets: LiDAR, camera, mounts, motion. For judging, not for training."""
# ruff: noqa: PLR2004 - the figures are odds of a draw, each beside what it decides

import math

import numpy as np

from pipeline.errors import InputError
from pipeline.records import CameraModel, Floats
from pipeline.se3 import AXES_CAM_IN_VEHICLE, exp_so3, inverse, transform
from pipeline.simulation.camera import Look, optics_of
from pipeline.simulation.drive import DriveParameters, Motion
from pipeline.simulation.lidar import LidarModel, spinning
from pipeline.simulation.scene import SceneParameters

_SIZES = ((960, 304), (1242, 375), (960, 600), (1280, 720), (1024, 640))
"""px (width, height); formats of common cameras, some reduced: a larger image costs seconds to draw."""
_RINGS = (16, 32, 64, 64, 128)
"""64 rings are the most common; the others have their own troubles."""
_TURNS_DEG = (0.0, 0.0, 90.0, -90.0, 180.0)
"""Yaw of the LiDAR's axes: drivers differ in which one points ahead."""
_ATTEMPTS = 20
"""Lenses that are tried; not one in fifty folds inside the image."""


def draw_rig(rng: np.random.Generator) -> DriveParameters:
    """A rig on a street by day, for one frame; its stored extrinsic is the true one."""
    height = float(rng.uniform(1.2, 2.3))
    camera_place = (float(rng.uniform(0.5, 2.0)), float(rng.normal(0.0, 0.15)), height)
    lidar_place = (
        camera_place[0] - float(rng.uniform(0.0, 1.0)),
        float(rng.normal(0.0, 0.1)),
        height + float(rng.uniform(0.05, 0.5)),
    )
    T_vehicle_camera = _mount(camera_place, rng.normal([0.0, 1.5, 0.0], [0.7, 1.5, 1.5])) @ transform(
        AXES_CAM_IN_VEHICLE, np.zeros(3)
    )
    turn_deg = float(rng.choice(_TURNS_DEG))
    T_vehicle_lidar = _mount(lidar_place, rng.normal([0.0, 0.0, turn_deg], 0.7))
    return DriveParameters(
        seed=int(rng.integers(2**31)),
        duration=0.1,
        scene=_draw_scene(rng),
        motion=Motion(speed=float(rng.uniform(0.0, 14.0)), swing=0.0, bob=math.radians(0.1)),
        lidar=_draw_lidar(turn_deg, rng),
        camera=_draw_camera(rng),
        look=Look(
            grey=float(rng.uniform(85.0, 130.0)),
            blur=float(rng.uniform(0.35, 0.9)),
            noise=float(rng.uniform(0.8, 3.0)),
            contrast=float(rng.uniform(0.0, 1.0)),
        ),
        exposure=float(rng.uniform(0.045, 0.055)),
        T_vehicle_lidar=T_vehicle_lidar,
        T_stored=inverse(T_vehicle_camera) @ T_vehicle_lidar,
    )


def _mount(place: tuple[float, float, float], turn_deg: Floats) -> Floats:
    """T_vehicle_sensor (4,4) of a place, m, and roll, pitch (nose down), yaw, deg."""
    R = np.eye(3)
    for k in (2, 1, 0):
        R = R @ exp_so3(math.radians(float(turn_deg[k])) * np.eye(3)[k])
    return transform(R, np.array(place))


def _draw_lidar(turn_deg: float, rng: np.random.Generator) -> LidarModel:
    """A spinning LiDAR that looks ahead in the middle of its sweep, as cameras are triggered."""
    rings = int(rng.choice(_RINGS))
    layout = spinning(rings)
    return LidarModel(
        layout.elevations,
        layout.columns,
        clockwise=bool(rng.random() < 0.6),
        start=math.pi - math.radians(turn_deg),
        sigma=float(rng.uniform(0.01, 0.03)),
    )


def _draw_camera(rng: np.random.Generator) -> CameraModel:
    """A camera of any common angle of view, two in five with a lens that bends."""
    for _ in range(_ATTEMPTS):
        width, height = _SIZES[int(rng.integers(len(_SIZES)))]
        focal = width * float(rng.uniform(0.5, 1.1))
        # Cropped images have their principal point anywhere near the middle.
        centre = width * (0.5 + float(rng.normal(0.0, 0.02))), height * (0.5 + float(rng.normal(0.0, 0.03)))
        K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
        if rng.random() < 0.6:
            return CameraModel("pinhole", K, np.zeros(0), width, height)
        reach = math.hypot(width, height) / (2.0 * focal)
        k1 = -float(rng.uniform(0.0, 0.25)) / max(1.0, reach**2)
        camera = CameraModel("plumb_bob", K, np.array([k1, 0.1 * k1 * k1, 0.0, 0.0, 0.0]), width, height)
        try:
            optics_of(camera)
        except InputError:
            continue
        return camera
    raise InputError("no drawn lens was whole", hint="a narrower range of distortions")


def _draw_scene(rng: np.random.Generator) -> SceneParameters:
    """A street by day with paint that can be seen."""
    return SceneParameters(
        length=float(rng.uniform(150.0, 260.0)),
        lanes=int(rng.integers(2, 6)),
        lane_width=float(rng.uniform(2.8, 3.7)),
        town=bool(rng.random() < 0.65),
        curvature=float(rng.uniform(0.0, 0.004)),
        grade=float(rng.uniform(0.0, 0.04)),
        paint_width=float(rng.uniform(0.10, 0.20)),
        edge_lines=bool(rng.random() < 0.7),
        wear=float(rng.uniform(0.0, 0.5)),
        lamp_spacing=float(rng.uniform(14.0, 40.0)),
        sign_spacing=float(rng.uniform(14.0, 45.0)),
        tree_spacing=float(rng.uniform(12.0, 40.0)),
        parked_share=float(rng.uniform(0.0, 0.7)),
        traffic=int(rng.integers(0, 9)),
        sun_elevation=math.radians(float(rng.uniform(15.0, 60.0))),
        overcast=float(rng.uniform(0.0, 1.0)),
    )
