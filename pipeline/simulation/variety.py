"""Streets, cameras, weather and sensors of all kinds, drawn from a seed: what a network should have seen."""
# ruff: noqa: PLR2004 - the figures are odds of a draw, each beside what it decides

import math
from dataclasses import dataclass, replace

import numpy as np

from pipeline.errors import InputError
from pipeline.records import CameraImage, CameraModel
from pipeline.se3 import AXES_CAM_IN_VEHICLE, exp_so3, transform
from pipeline.simulation.camera import Look, Optics, Picture, optics_of, render
from pipeline.simulation.scene import Light, Scene, SceneParameters
from pipeline.simulation.shadows import shadow_map
from pipeline.simulation.solids import upright
from pipeline.simulation.streets import draw_street
from pipeline.simulation.weather import Weather, lamps_of
from pipeline.simulation.windscreen import Windscreen, draw_windscreen, seen_through

SIZES = (
    (640, 360),
    (800, 600),
    (960, 540),
    (960, 720),
    (1164, 874),
    (1242, 375),
    (1280, 384),
    (1280, 720),
    (1280, 800),
    (1440, 928),
    (1600, 900),
    (1920, 1200),
)
"""px (width, height); image sizes of common cameras."""
_SHARES = np.array([3, 2, 4, 3, 3, 4, 3, 5, 3, 2, 2, 0.5])
"""How often each size is drawn; large ones cost much and are reduced for training anyhow."""
_ATTEMPTS = 20
"""Lenses that are tried; of those drawn here not one in fifty folds."""


@dataclass(frozen=True, slots=True, eq=False)
class Variety:
    """What one picture is made of.

    Attributes:
        parameters: Of the street.
        optics: Of the camera.
        height: Of the camera above the road, m.
        tilt: Roll, pitch (nose down), yaw of the camera, rad.
        aside: Of the own vehicle from the middle of its lane, m to the left.
        look: Of the sensor.
        light: Sun and sky.
        weather: Hour and weather; its lamps come with the street.
        snow: 0..1, how much lies on the ground.
        screen: What is between street and lens.
    """

    parameters: SceneParameters
    optics: Optics
    height: float
    tilt: tuple[float, float, float]
    aside: float
    look: Look
    light: Light
    weather: Weather
    snow: float
    screen: Windscreen

    @property
    def camera(self) -> CameraModel:
        """Intrinsics."""
        return self.optics.camera


def draw_variety(rng: np.random.Generator) -> Variety:
    """Draws what the next picture shows and by which camera."""
    parameters = _draw_parameters(rng)
    light, weather, rain = _draw_hour(parameters, rng)
    snow = float(rng.uniform(0.1, 1.0)) if rng.random() < 0.05 else 0.0
    optics = draw_camera(rng)
    tilt = np.radians(rng.normal([0.0, 1.0, 0.0], [1.2, 2.5, 3.5]))
    # Cameras that look aside or back see poles too; out of town they would mostly see grass.
    if parameters.town and rng.random() < 0.15:
        tilt[2] = rng.uniform(-math.pi, math.pi)
    night = weather.night
    look = Look(
        grey=float(rng.uniform(80.0, 150.0) * (1.0 - 0.45 * night)),
        blur=float(rng.uniform(0.35, 1.0)),
        vignetting=float(rng.uniform(0.0, 0.4)),
        noise=float(rng.uniform(0.5, 3.0) + 3.0 * night),
        tint=tuple(np.exp(rng.normal(0.0, 0.08, 3)).tolist()),
        bloom=float(rng.uniform(0.0, 0.06) if night > 0.0 else rng.uniform(0.0, 0.02)),
        contrast=float(rng.uniform(0.0, 1.0)),
        veil=float(rng.uniform(0.01, 0.12)) if rng.random() < 0.12 else 0.0,
    )
    return Variety(
        parameters,
        optics,
        float(np.exp(rng.uniform(math.log(0.9), math.log(3.0)))),
        (float(tilt[0]), float(tilt[1]), float(tilt[2])),
        float(rng.normal(0.0, 0.4)),
        look,
        light,
        weather,
        snow,
        draw_windscreen(rng, rain=rain, snow=snow > 0.0),
    )


def _draw_parameters(rng: np.random.Generator) -> SceneParameters:
    town = bool(rng.random() < 0.68)
    return SceneParameters(
        length=float(rng.uniform(110.0, 240.0)),
        lanes=int(rng.integers(1, 6)) if town else int(rng.integers(2, 7)),
        lane_width=float(rng.uniform(2.6, 3.6) if town else rng.uniform(3.0, 3.9)),
        town=town,
        curvature=float(rng.uniform(0.0, 0.010)),
        grade=float(rng.uniform(0.0, 0.07)),
        paint_width=float(rng.uniform(0.08, 0.30) if rng.random() < 0.3 else rng.uniform(0.10, 0.16)),
        dash=((3.0, 6.0), (3.0, 9.0), (6.0, 12.0), (2.0, 4.0), (4.5, 1.5), (1.0, 1.0), (1.5, 3.0))[
            int(rng.integers(7))
        ],
        edge_lines=bool(rng.random() < (0.45 if town else 0.9)),
        wear=float(rng.beta(1.3, 2.0)),
        lamp_spacing=float(np.exp(rng.uniform(math.log(10.0), math.log(50.0)))),
        sign_spacing=float(np.exp(rng.uniform(math.log(10.0), math.log(60.0)))),
        tree_spacing=float(np.exp(rng.uniform(math.log(6.0), math.log(40.0)))),
        lean=math.radians(float(rng.uniform(0.2, 2.0))),
        parked_share=float(rng.uniform(0.0, 0.9)),
        traffic=int(rng.integers(0, 14)),
        crossings=bool(rng.random() < 0.7),
        sun_elevation=math.radians(float(rng.uniform(6.0, 65.0))),
        # Grey days are as common as clear ones.
        overcast=float(np.clip(rng.beta(0.6, 0.7), 0.0, 1.0)),
    )


def _draw_hour(p: SceneParameters, rng: np.random.Generator) -> tuple[Light, Weather, bool]:
    """Sun, sky and weather, and whether it rains."""
    kind, overcast, night = rng.random(), p.overcast, 0.0
    if kind < 0.07:
        night = float(rng.uniform(0.85, 1.0))
    elif kind < 0.13:
        night = float(rng.uniform(0.3, 0.85))
    wet = float(rng.uniform(0.25, 1.0)) if rng.random() < 0.14 else 0.0
    rain = wet > 0.0 and rng.random() < 0.6
    if rain:
        overcast = max(overcast, float(rng.uniform(0.7, 1.0)))
    sight = float(np.exp(rng.uniform(math.log(25.0), math.log(250.0)))) if rng.random() < 0.1 else 0.0
    if sight:
        overcast = max(overcast, 0.8)
    azimuth, low = float(rng.uniform(0.0, 2.0 * math.pi)), math.degrees(p.sun_elevation)
    sun = np.array([math.cos(azimuth), math.sin(azimuth), math.tan(p.sun_elevation)])
    day = (1.0 - night) ** 2
    direct = (1.0 - overcast) * float(rng.uniform(0.8, 1.8)) * (day if night < 0.3 else 0.0)
    ambient = (0.35 + 0.35 * overcast) * day + 0.012 * night
    light = Light(sun / np.linalg.norm(sun), direct, ambient, overcast)
    # A low sun is yellow, and so is the sky under it.
    warm = max(0.0, 1.0 - low / 25.0)
    weather = Weather(
        sight=sight or float(rng.uniform(300.0, 1500.0)),
        night=night,
        wet=wet,
        glossy=True,
        billows=float(np.exp(rng.uniform(math.log(0.3), math.log(2.5)))),
        glow=(0.80 - 0.3 * warm, 0.78 - 0.08 * warm, 0.76 + 0.1 * warm),
        sun=(0.84 - 0.4 * warm, 0.96 - 0.15 * warm, 1.05 + 0.15 * warm),
    )
    return light, weather, bool(rain)


def draw_camera(rng: np.random.Generator) -> Optics:
    """A camera of any common size and angle of view whose lens does not fold inside the image."""
    for _ in range(_ATTEMPTS):
        try:
            return optics_of(draw_lens(rng))
        except InputError:
            continue
    raise InputError("no drawn lens was whole", hint="a narrower range of distortions")


def draw_lens(rng: np.random.Generator) -> CameraModel:
    """A camera whose lens may fold in the corners."""
    width, height = SIZES[int(rng.choice(len(SIZES), p=_SHARES / _SHARES.sum()))]
    focal = width * float(np.exp(rng.uniform(math.log(0.45), math.log(2.2))))
    # Cropped images have their principal point anywhere near the middle.
    centre = (
        width * (0.5 + float(rng.normal(0.0, 0.02))),
        height * (0.5 + float(np.clip(rng.normal(0.0, 0.07), -0.2, 0.2))),
    )
    K = np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])
    if rng.random() < 0.6:
        return CameraModel("pinhole", K, np.zeros(0), width, height)
    reach = math.hypot(width, height) / (2.0 * focal)
    k1 = -float(rng.uniform(-0.05, 0.3)) / max(1.0, reach**2)
    D = np.array([k1, 0.1 * k1 * k1, *rng.normal(0.0, 5e-4, 2), 0.0])
    return CameraModel("plumb_bob", K, D, width, height)


def picture(variety: Variety, rng: np.random.Generator) -> tuple[Picture, Scene]:
    """One picture of a new street, and the street."""
    scene = draw_street(variety.parameters, variety.light, variety.weather, rng, snow=variety.snow)
    arc = float(rng.uniform(0.0, 40.0))
    place, heading, grade = scene.surface.pose(arc, scene.ego_left + variety.aside)
    R = upright(float(heading), (-math.atan(float(grade)), 0.0))
    for k, angle in zip((2, 1, 0), reversed(variety.tilt), strict=True):
        R = R @ exp_so3(angle * np.eye(3)[k])
    T_world_cam = transform(R @ AXES_CAM_IN_VEHICLE, place + R[:, 2] * variety.height)
    if variety.weather.night > 0.0:
        lamps = lamps_of(scene.standing, T_world_cam[:3, 3])
        scene = replace(scene, weather=replace(scene.weather, lamps=lamps))
    ahead = math.cos(variety.tilt[2])
    reach = (
        float(place[0]) - (20.0 if ahead > 0.5 else 100.0),
        float(place[0]) + (110.0 if ahead > -0.5 else 20.0),
    )
    shown = render(
        scene, shadow_map(scene, reach), variety.optics, T_world_cam, time=0.0, look=variety.look, rng=rng
    )
    pixels, classes = seen_through(variety.screen, shown.image.pixels, shown.labels, rng)
    return Picture(CameraImage(pixels), classes), scene
