import numpy as np
import pytest

from pipeline import labels
from pipeline.simulation import clutter
from pipeline.simulation.solids import Material

PLACE = np.array([12.0, -5.0, 0.3])
MAKERS = {
    "tree": (lambda rng: clutter.tree(PLACE, rng), {labels.VEGETATION}),
    "conifer": (lambda rng: clutter.conifer(PLACE, rng), {labels.VEGETATION}),
    "thicket": (lambda rng: clutter.thicket(PLACE, 0.8, rng), {labels.VEGETATION}),
    "house": (lambda rng: clutter.house(PLACE, 0.3, (14.0, 9.0, 8.0), rng), {labels.CONSTRUCTION}),
    "arcade": (lambda rng: clutter.arcade(PLACE, 0.3, 15.0, rng), {labels.CONSTRUCTION}),
    "fence": (lambda rng: clutter.fence(PLACE, 0.3, 12.0, rng), {labels.CONSTRUCTION}),
    "guard rail": (lambda rng: clutter.guard_rail(PLACE, 0.3, 8.0, rng), {labels.CONSTRUCTION}),
    "billboard": (lambda rng: clutter.billboard(PLACE, 0.3, rng), {labels.CONSTRUCTION}),
    "people": (lambda rng: clutter.people(PLACE, rng), {labels.OTHER}),
    "box": (lambda rng: clutter.bin_or_box(PLACE, 0.3, rng), {labels.OTHER}),
}


@pytest.mark.parametrize("name", MAKERS)
def test_nothing_that_only_looks_like_a_pole_is_labelled_so(name):
    make, expected = MAKERS[name]
    for seed in range(25):
        parts = make(np.random.default_rng(seed))
        assert {p.label for p in parts} == expected
        for part in parts:
            assert np.isfinite(part.centre).all()
            assert (np.asarray(part.half) > 0.0).all()
            np.testing.assert_allclose(part.axes.T @ part.axes, np.eye(3), atol=1e-9)


def test_trunks_are_thin_and_thick_and_some_trees_are_bare():
    trees = [clutter.tree(PLACE, np.random.default_rng(k)) for k in range(60)]
    radius = np.array([parts[0].half[0] for parts in trees])
    assert radius.min() < 0.07
    assert radius.max() > 0.3
    bare = np.mean([all(p.material == Material.BARK for p in parts) for parts in trees])
    assert 0.1 < bare < 0.45


def test_a_trunk_is_joined_at_its_knee():
    low, high = clutter.tree(PLACE, np.random.default_rng(5))[:2]
    top = low.centre + low.half[2] * low.axes[:, 2]
    np.testing.assert_allclose(top, high.centre - high.half[2] * high.axes[:, 2], atol=1e-9)
