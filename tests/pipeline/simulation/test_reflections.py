import dataclasses
import math

import numpy as np
import pytest

from pipeline import labels
from pipeline.records import CameraModel
from pipeline.se3 import AXES_CAM_IN_VEHICLE, transform
from pipeline.simulation.camera import Look, optics_of, render
from pipeline.simulation.furniture import post
from pipeline.simulation.paint import Line, Paint
from pipeline.simulation.reflections import mirror_below
from pipeline.simulation.scene import Light, Scene
from pipeline.simulation.shadows import shadow_map
from pipeline.simulation.solids import Solids, upright
from pipeline.simulation.surface import STEP_M, RoadSurface
from pipeline.simulation.textures import draw_textures
from pipeline.simulation.weather import Weather

CAMERA = CameraModel(
    "pinhole", np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 99.5], [0.0, 0.0, 1.0]]), np.zeros(0), 320, 240
)
HEIGHT = 1.5


def street(poles, wet, grade=0.0):
    x = np.arange(-30.0, 300.0, STEP_M)
    zero = np.zeros(len(x))
    surface = RoadSurface(x, zero, zero, x, grade * x, -60.0, 60.0, 0.0, 5.0)
    light = Light(np.array([0.0, 0.0, 1.0]), 0.0, 0.8, 1.0)
    textures = draw_textures(np.random.default_rng(0))
    flat = dataclasses.replace(textures, **{n: 0 * getattr(textures, n) for n in ("rough", "fine")})
    paint = Paint((Line(1.0, 0.15),), ())
    weather = Weather(wet=wet, sight=1e6)
    return Scene(surface, paint, 0.0, Solids.of(poles), (), light, flat, 0.1, 0.0, weather=weather)


def pose(pitch=0.0):
    return transform(
        upright(0.0, (-math.tan(-pitch), 0.0)) @ AXES_CAM_IN_VEHICLE, np.array([0.0, 0.0, HEIGHT])
    )


def take(scene):
    plain = Look(blur=0.05, vignetting=0.0, noise=0.0)
    shadows = shadow_map(scene, (-20.0, 60.0))
    return render(
        scene, shadows, optics_of(CAMERA), pose(), time=0.0, look=plain, rng=np.random.default_rng(0)
    )


@pytest.mark.parametrize("pitch", [0.0, 0.1])
def test_a_mirrored_camera_sees_a_mirrored_point_where_the_camera_saw_it(pitch):
    scene, T = street([], 1.0), pose(pitch)
    mirror = mirror_below(scene, T)
    point = np.array([12.0, 2.0, 3.0])
    below = point * [1.0, 1.0, -1.0]
    seen = T[:3, :3].T @ (point - T[:3, 3])
    again = mirror.T_world_cam[:3, :3].T @ (below - mirror.T_world_cam[:3, 3])
    np.testing.assert_allclose(again, seen, atol=1e-12)


def test_on_a_slope_the_mirror_lies_in_the_slope():
    mirror = mirror_below(street([], 1.0, grade=0.05), pose())
    np.testing.assert_allclose(mirror.normal @ [1.0, 0.0, 0.05], 0.0, atol=1e-3)
    middle = 0.5 * (mirror.T_world_cam[:3, 3] + pose()[:3, 3])
    assert middle[2] == pytest.approx(0.05 * middle[0], abs=1e-3)


def test_a_dark_pole_is_mirrored_below_its_foot_and_is_road_there():
    pole = post(np.array([15.0, 0.0, 0.0]), 1.2, 0.3, (0.0, 0.0), (0.0, 0.0, 0.0))
    wet, bare = (take(street(p, 1.0)) for p in ([pole], []))
    column = slice(157, 163)
    missing = 1.0 - wet.image.pixels[:, column].mean(axis=(1, 2)) / bare.image.pixels[:, column].mean(
        axis=(1, 2)
    )
    foot = 99.5 + 300.0 * HEIGHT / 15.0
    tip = 99.5 + 300.0 * (HEIGHT + 1.2) / 15.0
    rows = np.arange(240)
    mirrored = (rows > foot + 3) & (rows < tip - 5)
    beyond = (rows > tip + 12) & (rows < 235)
    assert missing[mirrored].min() > 0.15
    assert np.abs(missing[beyond]).max() < 0.05
    assert (wet.labels[mirrored][:, column] == labels.ROAD).all()
    np.testing.assert_array_equal(wet.labels, take(street([pole], 0.0)).labels)


def test_water_mirrors_the_sky_far_away_and_hides_little_nearby():
    wet, dry = (take(street([], w)).image.pixels[:, :140].mean(axis=(1, 2)) for w in (1.0, 0.0))
    sky = slice(20, 80)
    # Exposure differs: compare with the sky of each.
    far, near = slice(104, 110), slice(220, 235)
    assert wet[far].mean() / wet[sky].mean() > dry[far].mean() / dry[sky].mean() + 0.1
    assert abs(wet[near].mean() / wet[sky].mean() - dry[near].mean() / dry[sky].mean()) < 0.25
