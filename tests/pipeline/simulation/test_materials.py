import numpy as np
import pytest

from pipeline.simulation.materials import Surfaces, glows, lots_of, paint_materials
from pipeline.simulation.raycast import SolidPoints
from pipeline.simulation.solids import Material
from pipeline.simulation.textures import draw_textures

TEXTURES = draw_textures(np.random.default_rng(6))
SIZE = np.array([8.0, 4.0, 6.0])


def surfaces(material, count=20_000, solids=7, resolved=200.0):
    """Points all over the long side (y = 1) of boxes of one size."""
    rng = np.random.default_rng(1)
    unit = rng.uniform(-1.0, 1.0, (3, count)).astype(np.float32)
    unit[1] = 1.0
    half = np.repeat(SIZE[:, None], count, axis=1).astype(np.float32)
    solid = rng.integers(0, solids, count).astype(np.int32)
    zero = np.zeros((3, count), dtype=np.float32)
    points = SolidPoints(np.arange(count), solid, zero, unit, zero)
    kind = np.full(count, material, dtype=np.uint8)
    sharp = np.full(count, resolved, dtype=np.float32)
    return Surfaces(points, unit * half, half, kind, sharp, TEXTURES, lots_of(TEXTURES, solids))


def painted(s, tone=0.3):
    albedo = np.full((3, s.material.size), tone, dtype=np.float32)
    paint_materials(s, albedo)
    return albedo


def test_neighbours_draw_different_lots():
    lots = lots_of(TEXTURES, 300)
    assert ((lots >= 0.0) & (lots <= 1.0)).all()
    np.testing.assert_allclose(lots.mean(axis=0), 0.5, atol=0.12)
    correlation = np.corrcoef(lots[:-1].ravel(), lots[1:].ravel())[0, 1]
    assert abs(correlation) < 0.2
    np.testing.assert_array_equal(lots[:10], lots_of(TEXTURES, 10))


@pytest.mark.parametrize("material", list(Material))
@pytest.mark.parametrize("resolved", [0.5, 30.0, 3000.0])
def test_every_material_stays_an_albedo(material, resolved):
    albedo = painted(surfaces(material, resolved=resolved))
    assert np.isfinite(albedo).all()
    assert albedo.min() >= 0.0
    assert np.median(albedo) < 1.0


@pytest.mark.parametrize("material", [Material.PLAIN, Material.LIGHT, Material.LAMP, Material.LEAVES])
def test_what_has_no_pattern_is_left_alone(material):
    np.testing.assert_array_equal(painted(surfaces(material)), np.float32(0.3))


def test_fronts_have_windows_darker_than_walls_and_differ_from_house_to_house():
    s = surfaces(Material.FRONT, count=60_000, solids=12)
    grey = painted(s, 0.45).mean(axis=0)
    dark = [float((grey[s.points.solid == k] < 0.2).mean()) for k in range(12)]
    assert 0.05 < np.mean(dark) < 0.7
    assert np.std(dark) > 0.02


def test_a_banded_post_has_two_colours():
    grey = painted(surfaces(Material.BANDS, solids=1))[1]
    assert len(np.unique(np.round(grey, 3))) == 2


def test_lamps_glow_at_night_and_lights_of_vehicles_only_then():
    for material, by_day in ((Material.LAMP, True), (Material.LIGHT, False), (Material.PLAIN, False)):
        s = surfaces(material, count=10)
        assert (glows(s, 0.0) > 0.0).all() == by_day
        assert (glows(s, 1.0) > 1.0).all() == (material != Material.PLAIN)
    lit = glows(surfaces(Material.FRONT), 1.0)
    assert 0.0 < (lit > 0.0).mean() < 0.3
