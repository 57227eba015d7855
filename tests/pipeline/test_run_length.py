"""Levels for a wanted run length against tables, brute force and the budget they are to keep."""

import numpy as np
import pytest
from scipy.stats import chi2

from pipeline.run_length import AlarmBudget, alarm_level, chance_per_scene, level_for, suspicion_level


@pytest.mark.parametrize(
    ("dimensions", "thousand", "ten_thousand"), [(1, 13.7, 18.6), (3, 19.8, 25.2), (6, 26.7, 32.4)]
)
def test_levels_are_those_of_the_simulated_table_or_a_little_safer(
    dimensions: int, thousand: float, ten_thousand: float
) -> None:
    # FORMULAS F3, window of 50: simulated to +-0.5.
    for chance, simulated in ((1e-3, thousand), (1e-4, ten_thousand)):
        assert simulated - 0.5 < level_for(chance, dimensions, 50) < simulated + 1.0


def test_chance_bounds_the_alarms_of_simulated_sums() -> None:
    rng = np.random.default_rng(3)
    longest, level = 20, 22.0
    sums = np.cumsum(rng.normal(size=(400, 500, 6)), axis=1)
    sums = np.concatenate([np.zeros((400, 1, 6)), sums], axis=1)
    highest = np.zeros((400, 501 - longest))
    for length in range(1, longest + 1):
        difference = sums[:, longest:] - sums[:, longest - length : 501 - length]
        highest = np.maximum(highest, np.sum(difference**2, axis=2) / length)
    # Alarms in neighbouring scenes are one: the run begins anew after each.
    above = highest > level
    alarms = int(above[:, 0].sum() + (above[:, 1:] & ~above[:, :-1]).sum())
    expected = chance_per_scene(level, 6, longest) * above.size
    assert 0.6 * expected < alarms < 1.3 * expected


def test_one_scene_is_plain_chi_square() -> None:
    assert level_for(1e-4, 6, 1) == pytest.approx(chi2.isf(1e-4, 6), abs=1e-4)


def test_levels_rise_from_the_first_scene_to_the_run_length_of_a_year() -> None:
    budget = AlarmBudget()
    alarms = [alarm_level(scenes, budget) for scenes in range(1, 200)]
    assert alarms[0] == pytest.approx(27.86, abs=0.01)
    assert np.all(np.diff(alarms) >= 0)
    assert alarms[-1] == alarm_level(10**9, budget)
    assert all(suspicion_level(scenes, budget) < alarms[scenes - 1] for scenes in (1, 2, 10, 50, 199))


def test_two_tests_and_a_thousand_starts_keep_to_one_alarm_a_year() -> None:
    budget = AlarmBudget()
    near_starts = sum(
        chance_per_scene(alarm_level(scenes, budget), 6, scenes) for scenes in range(1, budget.settled)
    )
    settled = chance_per_scene(alarm_level(budget.settled, budget), 6, 4096) * budget.yearly_scenes
    assert 1000 * near_starts + 2 * settled < 1.0
