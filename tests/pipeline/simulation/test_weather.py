import numpy as np
import pytest

from pipeline import labels
from pipeline.simulation.poles import lantern
from pipeline.simulation.solids import Solids
from pipeline.simulation.textures import draw_textures
from pipeline.simulation.weather import Weather, dusk, head_light, lamp_light, lamps_of, sky

TEXTURES = draw_textures(np.random.default_rng(3))
SUN = np.array([0.6, 0.0, 0.8])


def dome(n=4000, seed=0):
    d = np.random.default_rng(seed).normal(size=(3, n))
    d[2] = np.abs(d[2])
    return d.astype(np.float32)


@pytest.mark.parametrize("overcast", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("billows", [0.3, 1.0, 2.5])
def test_the_sky_is_bright_and_whole(overcast, billows):
    shown = sky(Weather(billows=billows), TEXTURES, dome(), SUN, overcast)
    assert np.isfinite(shown).all()
    assert (shown > 0.0).all()
    assert 0.3 < np.median(shown) < 1.3


def test_the_length_of_a_ray_does_not_matter():
    d = dome(300)
    np.testing.assert_allclose(
        sky(Weather(), TEXTURES, d, SUN, 0.3), sky(Weather(), TEXTURES, 2.0 * d, SUN, 0.3), rtol=1e-6
    )


def test_the_sun_is_where_it_stands_and_the_night_is_dark():
    suns = dome(40, seed=5).astype(np.float64)
    suns /= np.linalg.norm(suns, axis=0)
    bright = []
    for sun in suns.T:
        shown = sky(Weather(), TEXTURES, np.column_stack([sun, sun * [-1.0, -1.0, 1.0]]), sun, 0.0)
        bright.append(shown[:, 0].min() / shown[:, 1].max())
    # Behind a cloud now and then.
    assert np.median(bright) > 5.0
    assert min(bright) < 3.0
    night = sky(Weather(night=1.0), TEXTURES, dome(), SUN, 0.5)
    assert night.max() < 0.3
    assert dusk(Weather()) == 1.0


def test_a_lamp_lights_the_ground_below_by_the_inverse_square():
    lamp = Weather(night=1.0, lamps=np.array([[0.0, 0.0, 6.0], [500.0, 0.0, 6.0]]))
    up = np.array([[0.0], [0.0], [1.0]], dtype=np.float32)
    place = np.array([[0.0, 0.0, 0.0, 60.0], [0.0, 0.0, 0.0, 0.0], [0.0, 3.0, 8.0, 0.0]], dtype=np.float32)
    light = lamp_light(lamp, place, up)
    assert light[1, 1] / light[1, 0] == pytest.approx((36.0 + 0.3) ** 1.5 / (9.0 + 0.3) ** 1.5 / 2.0, rel=0.1)
    assert (light[:, 2:] == 0.0).all()
    assert (lamp_light(Weather(lamps=lamp.lamps), place, up) == 0.0).all()


def test_head_lights_reach_ahead_and_not_up():
    direction = np.array([[0.0, 0.0, 0.0, 1.5], [0.05, 0.05, -0.6, 0.05], [1.0] * 4], dtype=np.float32)
    depth = np.array([15.0, 45.0, 15.0, 15.0], dtype=np.float32)
    light = head_light(Weather(night=1.0), direction, depth, np.ones(4, dtype=np.float32))[1]
    assert light[0] > 3.0 * light[1] > 0.0
    assert light[0] > 20.0 * light[2]
    assert light[0] > 20.0 * light[3]


def test_the_nearest_lamps_burn():
    parts = [part for x in np.arange(0.0, 400.0, 10.0) for part in lantern(np.array([x, 2.0, 6.0]), 0.0, 1.0)]
    found = lamps_of(Solids.of(parts), np.array([100.0, 0.0, 1.5]))
    assert 5 < len(found) < 20
    assert np.abs(found[:, 0] - 100.0).max() <= 80.0
    assert parts[1].label == labels.POLE
