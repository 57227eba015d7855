import numpy as np
import pytest

from pipeline import labels
from pipeline.simulation.windscreen import Windscreen, draw_windscreen, seen_through

RNG = np.random.default_rng(1)
STREET = RNG.integers(0, 256, (120, 200, 3)).astype(np.uint8)
CLASSES = RNG.integers(0, 9, (120, 200)).astype(np.uint8)


def through(seed=0, **what):
    return seen_through(Windscreen(**what), STREET, CLASSES, np.random.default_rng(seed))


def test_nothing_in_the_way_changes_nothing():
    pixels, classes = through()
    np.testing.assert_array_equal(pixels, STREET)
    np.testing.assert_array_equal(classes, CLASSES)


@pytest.mark.parametrize("seed", range(8))
def test_what_the_bonnet_hides_is_not_labelled_and_the_rest_is_untouched(seed):
    pixels, classes = through(seed, bonnet=0.2)
    hidden = classes == labels.IGNORE
    assert 0.02 < hidden.mean() < 0.35
    np.testing.assert_array_equal(pixels[~hidden], STREET[~hidden])
    np.testing.assert_array_equal(classes[~hidden], CLASSES[~hidden])
    # Once hidden, hidden down to the lower edge.
    assert (np.diff(hidden.astype(int), axis=0) >= 0).all()
    assert (CLASSES != labels.IGNORE).all()


@pytest.mark.parametrize(
    "what", [{"drops": 30.0}, {"falling": 200.0}, {"falling": 200.0, "flakes": True}, {"reflection": 0.2}]
)
def test_weather_on_the_glass_leaves_the_labels(what):
    pixels, classes = through(3, **what)
    np.testing.assert_array_equal(classes, CLASSES)
    changed = (pixels != STREET).any(axis=2).mean()
    assert 0.005 < changed <= 1.0
    again, _ = through(3, **what)
    np.testing.assert_array_equal(pixels, again)


def test_rain_falls_only_when_it_rains():
    drawn = [draw_windscreen(np.random.default_rng(k), rain=False, snow=False) for k in range(50)]
    assert all(s.drops == s.falling == 0.0 for s in drawn)
    wet = [draw_windscreen(np.random.default_rng(k), rain=True, snow=False) for k in range(50)]
    assert any(s.drops > 0.0 for s in wet)
    assert any(s.falling > 0.0 for s in wet)
