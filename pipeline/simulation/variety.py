"""Streets, cameras, light and sensors of all kinds, drawn from a seed: what a network should have seen."""
# ruff: noqa: PLR2004 - the figures are odds of a draw, each beside what it decides

import math
from dataclasses import dataclass

import numpy as np

from pipeline.records import CameraModel
from pipeline.se3 import AXES_CAM_IN_VEHICLE, exp_so3, transform
from pipeline.simulation.camera import Look, Picture, optics_of, render
from pipeline.simulation.scene import Scene, SceneParameters, draw_scene
from pipeline.simulation.shadows import shadow_map
from pipeline.simulation.solids import upright

SIZES = ((960, 304), (960, 540), (960, 720), (1242, 375), (1024, 576))
"""px (width, height); the image sizes of common recordings, the large ones at half size."""


@dataclass(frozen=True, slots=True, eq=False)
class Variety:
    """What one picture is made of.

    Attributes:
        parameters: Of the street.
        camera: Intrinsics.
        height: Of the camera above the road, m.
        tilt: Roll, pitch (nose down), yaw of the camera, rad.
        aside: Of the own vehicle from the middle of its lane, m to the left.
        look: Of the sensor.
    """

    parameters: SceneParameters
    camera: CameraModel
    height: float
    tilt: tuple[float, float, float]
    aside: float
    look: Look


def draw_variety(rng: np.random.Generator) -> Variety:
    """Draws what the next picture shows and by which camera."""
    town = bool(rng.random() < 0.7)
    # Grey days are as common as clear ones.
    overcast = float(np.clip(rng.beta(0.6, 0.7), 0.0, 1.0))
    parameters = SceneParameters(
        length=220.0,
        lanes=int(rng.integers(2, 5)) if town else int(rng.integers(2, 7)),
        lane_width=float(rng.uniform(2.75, 3.5) if town else rng.uniform(3.3, 3.75)),
        town=town,
        curvature=float(rng.uniform(0.0, 0.006)),
        grade=float(rng.uniform(0.0, 0.06)),
        paint_width=float(rng.uniform(0.10, 0.20)),
        dash=((3.0, 6.0), (3.0, 9.0), (6.0, 12.0), (2.0, 4.0), (4.5, 1.5))[int(rng.integers(5))],
        edge_lines=bool(rng.random() < (0.6 if town else 0.95)),
        wear=float(rng.beta(1.3, 2.5)),
        lamp_spacing=float(rng.uniform(14.0, 45.0)),
        sign_spacing=float(rng.uniform(15.0, 60.0)),
        tree_spacing=float(rng.uniform(8.0, 40.0)),
        lean=math.radians(float(rng.uniform(0.2, 1.8))),
        parked_share=float(rng.uniform(0.1, 0.8)),
        traffic=int(rng.integers(0, 12)),
        crossings=bool(rng.random() < 0.7),
        sun_elevation=math.radians(float(rng.uniform(12.0, 65.0))),
        overcast=overcast,
    )
    tilt = tuple(np.radians(rng.normal([0.0, 1.0, 0.0], [0.8, 2.0, 2.5])).tolist())
    look = Look(
        grey=float(rng.uniform(80.0, 135.0)),
        blur=float(rng.uniform(0.35, 1.0)),
        vignetting=float(rng.uniform(0.0, 0.4)),
        noise=float(rng.uniform(0.8, 4.0)),
        tint=tuple(np.exp(rng.normal(0.0, 0.05, 3)).tolist()),
    )
    return Variety(
        parameters,
        _draw_camera(rng),
        float(rng.uniform(1.15, 2.2)),
        tilt,
        float(rng.normal(0.0, 0.3)),
        look,
    )


def _draw_camera(rng: np.random.Generator) -> CameraModel:
    width, height = SIZES[int(rng.integers(len(SIZES)))]
    focal = width * float(np.exp(rng.uniform(math.log(0.5), math.log(1.15))))
    centre = (0.5 * width + rng.normal(0.0, 8.0), height * (0.5 + rng.normal(0.0, 0.02)))
    K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    if rng.random() < 0.6:
        return CameraModel("pinhole", K, np.zeros(0), width, height)
    # Barrel distortion of raw images, weak enough that the lens does not fold in the corners.
    reach = math.hypot(width, height) / (2.0 * focal)
    k1 = -float(rng.uniform(0.0, 0.16)) / max(1.0, reach**2)
    return CameraModel("plumb_bob", K, np.array([k1, 0.1 * k1 * k1, 0.0, 0.0, 0.0]), width, height)


def picture(variety: Variety, rng: np.random.Generator) -> tuple[Picture, Scene]:
    """One picture of a new street, and the street."""
    scene = draw_scene(variety.parameters, rng)
    arc = float(rng.uniform(0.0, 60.0))
    place, heading, grade = scene.surface.pose(arc, scene.ego_left + variety.aside)
    R = upright(float(heading), (-math.atan(float(grade)), 0.0))
    for k, angle in zip((2, 1, 0), reversed(variety.tilt), strict=True):
        R = R @ exp_so3(angle * np.eye(3)[k])
    T_world_cam = transform(R @ AXES_CAM_IN_VEHICLE, place + R[:, 2] * variety.height)
    shadows = shadow_map(scene, (float(place[0]) - 20.0, float(place[0]) + 120.0))
    optics = optics_of(variety.camera)
    return render(scene, shadows, optics, T_world_cam, time=0.0, look=variety.look, rng=rng), scene
