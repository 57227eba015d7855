import dataclasses

import numpy as np
import pytest

from pipeline import labels
from pipeline.simulation.paint import WHITE, YELLOW
from pipeline.simulation.solids import Material
from pipeline.simulation.streets import draw_street
from pipeline.simulation.variety import draw_variety


def street(seed, **changes):
    rng = np.random.default_rng([9, seed])
    v = draw_variety(rng)
    parameters = dataclasses.replace(v.parameters, **changes)
    return draw_street(parameters, v.light, v.weather, rng, snow=v.snow)


def check(scene):
    solids = scene.solids_at(0.0)
    for values in (solids.centre, solids.to_unit, solids.half, solids.colour):
        assert np.isfinite(values).all()
    assert (solids.half > 0.0).all()
    assert ((solids.colour >= 0.0) & (solids.colour <= 1.0)).all()
    assert solids.label.max() < len(labels.NAMES)
    assert (solids.label == labels.POLE).sum() >= 1
    # The grid of rays asks every solid in turn: what a picture costs grows with them.
    assert len(solids) < 6000
    s, d = (a.ravel().astype(np.float32) for a in np.meshgrid(np.arange(0, 60, 0.3), np.arange(-15, 15, 0.1)))
    assert set(np.unique(scene.paint.colours(s, d))) <= {0, WHITE, YELLOW}
    assert scene.paint.covers(s, d).mean() < 0.25
    assert 0.0 < scene.asphalt < 1.0


@pytest.mark.parametrize("seed", range(20))
def test_streets_are_whole_whatever_is_drawn(seed):
    check(street(seed))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20, 120))
def test_many_streets_are_whole(seed):
    check(street(seed))


@pytest.mark.parametrize("town", [False, True])
def test_one_lane_and_no_traffic_are_streets_too(town):
    scene = street(1, town=town, lanes=1, traffic=0, edge_lines=False)
    check(scene)
    assert not scene.movers


def test_what_supports_no_sign_or_lamp_is_no_pole():
    """Trunks, stakes of fences and fronts keep their own classes."""
    for seed in range(6):
        standing = street(seed).standing
        pole = standing.label == labels.POLE
        for material in (Material.BARK, Material.CANOPY, Material.FRONT, Material.RAILING, Material.POSTER):
            assert not pole[standing.material == material].any()
        # Poles are slender; heads of lamps and transformers are short.
        across = np.sort(standing.half[pole], axis=1)[:, :2].max(axis=1)
        assert across.max() < 0.45
