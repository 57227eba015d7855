from itertools import pairwise

import numpy as np
import pytest

from pipeline import labels
from pipeline.simulation import poles
from pipeline.simulation.solids import Solids

PLACE = np.array([12.0, -5.0, 0.3])
MAKERS = {
    "street lamp": lambda rng: poles.street_lamp(PLACE, 0.2, -1.0, (0.01, 0.0), rng),
    "signed post": lambda rng: poles.signed_post(PLACE, 0.2, (0.01, 0.0), rng),
    "board": lambda rng: poles.board(PLACE, 0.2, rng),
    "signal": lambda rng: poles.signal(PLACE, 0.2, 1.0, (0.0, 0.0), rng),
    "gantry": lambda rng: poles.gantry(PLACE, PLACE + np.array([0.0, 12.0, 0.0]), 0.0, rng),
    "utility poles": lambda rng: poles.utility_poles([PLACE, PLACE + np.array([30.0, 1.0, 0.0])], 0.0, rng),
    "bollard": lambda rng: poles.bollard(PLACE, (0.0, 0.0), rng),
}


@pytest.mark.parametrize("name", MAKERS)
def test_poles_stand_on_the_ground_and_carry_only_signs(name):
    for seed in range(25):
        parts = MAKERS[name](np.random.default_rng(seed))
        assert {p.label for p in parts} <= {labels.POLE, labels.SIGN, labels.OTHER}
        mast = parts[0]
        assert mast.label == labels.POLE
        low, high = Solids.of([mast]).corners()[0, :, 2].min(), Solids.of([mast]).corners()[0, :, 2].max()
        assert low < PLACE[2] < high
        assert abs(mast.axes[2, 2]) > 0.99
        for part in parts:
            np.testing.assert_allclose(part.axes.T @ part.axes, np.eye(3), atol=1e-9)
            assert np.linalg.det(part.axes) == pytest.approx(1.0)


def test_wires_join_the_poles_and_are_not_poles():
    seen = 0
    for seed in range(20):
        parts = MAKERS["utility poles"](np.random.default_rng(seed))
        wires = [p for p in parts if p.half[0] == 0.012]
        seen += len(wires)
        assert all(w.label == labels.OTHER for w in wires)
        lengths = [2.0 * w.half[2] for w in wires]
        assert all(14.0 < one < 18.0 for one in lengths)
    assert seen > 20


def test_a_bent_arm_has_no_gaps():
    way = np.array([0.0, 1.0, 0.0])
    arm = poles.bent_arm(np.array([0.0, 0.0, 6.0]), way, (2.0, 1.0), 0.05, (0.2, 0.2, 0.2))
    ends = [(p.centre - p.half[2] * p.axes[:, 2], p.centre + p.half[2] * p.axes[:, 2]) for p in arm]
    np.testing.assert_allclose(ends[0][0], [0.0, 0.0, 6.0], atol=1e-9)
    np.testing.assert_allclose(ends[-1][1], [0.0, 2.0, 7.0], atol=1e-9)
    for before, after in pairwise(ends):
        np.testing.assert_allclose(before[1], after[0], atol=1e-9)


def test_every_kind_of_lamp_is_drawn():
    counts = {len(MAKERS["street lamp"](np.random.default_rng(k))) for k in range(60)}
    assert len(counts) >= 5
