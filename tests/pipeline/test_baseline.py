import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.baseline import (
    PRIOR_SCENES,
    Baseline,
    learn,
    left_out,
    supported_floor,
    tolerance_factor,
)
from pipeline.drift_test import DriftTestParameters
from pipeline.errors import InputError
from pipeline.road_samples import samples_of
from tests.pipeline.simulated_windows import FLOOR, RANDOM, simulated_drive

PARAMETERS = DriftTestParameters()
BIAS = np.array([1e-3, -2e-3, 1.5e-3, 0.02, -0.03, 0.01])
YEAR_S = 365 * 8 * 3600.0


def taught(drives, wanted_s=YEAR_S):
    return learn(drives, PARAMETERS, wanted_s, np.random.default_rng(0))


def simulated(seed, count, *, spread=FLOOR, bias=BIAS, **changes):
    rng = np.random.default_rng([seed, count])
    return [
        simulated_drive(rng, f"drive {i}", bias=bias, spread=spread, noise=1.2, **changes)
        for i in range(count)
    ]


def exact(drive):
    """The drive as if its windows had no error but that of the scene."""
    return dataclasses.replace(
        drive, drift=np.tile(drive.drift[0], (len(drive), 1)), covariance=drive.covariance * 1e-8
    )


def whitened(spread):
    """In units of the floor for any rig: the unit matrix where it is that floor."""
    root = np.linalg.inv(np.linalg.cholesky(FLOOR))
    return root @ spread @ root.T


def test_exact_means_give_the_closed_form():
    """The mean as bias; (8 floor + sum of squares) / (8 + n - 1) as spread, 1/n of it as doubt."""
    drives = [exact(drive) for drive in simulated(1, 5)]
    found = taught(drives)
    means = np.array([drive.drift[0] for drive in drives])
    away = means - means.mean(axis=0)
    spread = (PRIOR_SCENES * FLOOR + away.T @ away) / (PRIOR_SCENES + 4)
    assert found.bias == pytest.approx(means.mean(axis=0), abs=1e-7)
    assert whitened(found.spread) == pytest.approx(whitened(spread), abs=1e-3)
    assert whitened(found.covariance) == pytest.approx(whitened(spread) / 5, abs=1e-3)
    assert found.deviation == pytest.approx(means.std(axis=0, ddof=1), rel=1e-4)
    assert found.own == pytest.approx(np.zeros(6), abs=1e-5)


def plainly(samples, rounds):
    """Expectation and maximisation round by round, window by window; whitened by the floor."""
    unwhiten = np.linalg.inv(np.linalg.cholesky(FLOOR))
    windows = [
        (1.0 / len(sample.drift), unwhiten @ y, unwhiten @ N @ unwhiten.T)
        for sample in samples
        for y, N in zip(sample.drift, sample.covariance, strict=True)
    ]
    spread = np.eye(6)
    for _ in range(rounds):
        held = [(w, y, np.linalg.inv(spread + N)) for w, y, N in windows]
        covariance = np.linalg.inv(sum(w * P for w, _, P in held))
        bias = covariance @ sum(w * P @ y for w, y, P in held)
        total = PRIOR_SCENES * np.eye(6)
        for w, y, P in held:
            scene = spread @ P @ (y - bias)
            left = spread - spread @ P @ spread + spread @ P @ covariance @ P @ spread
            total = total + w * (np.outer(scene, scene) + left)
        spread = total / (PRIOR_SCENES + len(samples))
    return spread


@pytest.mark.parametrize("scale", [0.05, 4.0])
def test_the_spread_is_where_many_plain_rounds_end(scale):
    rng = np.random.default_rng(8)
    drives = [
        dataclasses.replace(drive, covariance=drive.covariance * rng.uniform(0.3, 3.0, (len(drive), 1, 1)))
        for drive in simulated(8, 6, spread=scale * FLOOR)
    ]
    samples, _ = samples_of(drives)
    assert whitened(taught(drives).spread) == pytest.approx(plainly(samples, 400), abs=1e-5)


def test_one_street_claims_no_spread_and_no_narrower_bound():
    (drive,) = simulated(2, 1)
    found = taught([drive])
    expected = found.expectation(PARAMETERS)
    assert whitened(expected.floor) == pytest.approx(np.eye(6), abs=1e-9)
    assert expected.bound == pytest.approx(PARAMETERS.bound())
    # What one street shows is off by what scenes do, and by the error of a window.
    own = found.scatter.noise**2 * RANDOM
    assert whitened(expected.covariance) == pytest.approx(np.eye(6) + whitened(own), abs=1e-5)
    assert found.tail.threshold is None
    assert left_out([drive], PARAMETERS) == ()


@pytest.mark.parametrize("count", [1, 2, 4, 12])
def test_the_bias_lies_within_its_stated_interval(count):
    z = []
    for seed in range(50):
        found = taught(simulated(seed, count))
        z.append((found.bias - BIAS) / np.sqrt(np.diag(found.covariance)))
    within = [np.mean(np.abs(z) < sigmas) for sigmas in (1.0, 1.96)]
    assert 0.58 < within[0] < 0.80
    assert within[1] > 0.90


@pytest.mark.parametrize(("scale", "low", "high"), [(0.25, 0.2, 0.75), (1.0, 0.75, 1.25), (4.0, 2.8, 4.5)])
def test_the_spread_of_many_streets_is_recovered(scale, low, high):
    eigenvalues = [
        np.mean(np.linalg.eigvalsh(whitened(taught(simulated(seed, 40, spread=scale * FLOOR)).spread)))
        for seed in range(4)
    ]
    assert low < np.mean(eigenvalues) < high


def test_the_floor_narrows_only_where_streets_prove_it():
    narrow = 0.1 * FLOOR
    for count, least in ((1, 1.0), (3, 1.0), (8, 1.0)):
        values = np.linalg.eigvalsh(whitened(supported_floor(narrow, FLOOR, count)))
        assert values.min() >= min(least, 0.2)
    few, many = (np.linalg.eigvalsh(whitened(supported_floor(0.3 * FLOOR, FLOOR, n))) for n in (3, 100))
    assert few == pytest.approx(0.3 * 10 / 3.940, rel=1e-3)  # chi-square of 10 at 5 %
    assert many == pytest.approx(0.3 * 107 / 84.1, rel=1e-2)
    # Never wider than before on account of doubt alone; wider where the streets are.
    assert whitened(supported_floor(0.9 * FLOOR, FLOOR, 3)) == pytest.approx(np.eye(6))
    assert whitened(supported_floor(3.0 * FLOOR, FLOOR, 3)) == pytest.approx(3.0 * np.eye(6))


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 200))
def test_a_supported_floor_is_never_narrower_than_what_was_seen(seed, count):
    factor = np.random.default_rng(seed).normal(size=(6, 6))
    spread = np.linalg.cholesky(FLOOR) @ (factor @ factor.T + 0.01 * np.eye(6)) @ np.linalg.cholesky(FLOOR).T
    values = np.linalg.eigvalsh(whitened(supported_floor(spread, FLOOR, count)))
    seen = np.linalg.eigvalsh(whitened(spread))
    assert (values >= np.minimum(seen, 1.0) - 1e-9).all()
    assert values.max() <= max(1.0, seen.max()) + 1e-9


def test_tolerance_factors_are_those_of_the_tables():
    """Two-sided, 95 % of the population with 95 % confidence (Howe's approximation is good to 2 %)."""
    for count, factor in ((2, 37.67), (3, 9.916), (4, 6.370), (10, 3.379), (50, 2.379), (100, 2.233)):
        assert tolerance_factor(count) == pytest.approx(factor, rel=0.02)


def test_few_streets_narrow_no_bound_and_many_do():
    close = 0.02 * FLOOR
    bounds = [taught(simulated(3, count, spread=close)).expectation(PARAMETERS).bound for count in (3, 30)]
    assert bounds[0][[1, 2]] == pytest.approx(PARAMETERS.bound()[[1, 2]], rel=0.5)
    assert (bounds[1][1:] < PARAMETERS.bound()[1:]).all()
    assert (bounds[1] <= bounds[0]).all()


def test_a_bound_that_healthy_streets_break_is_widened():
    """Streets that surely spread by 8 cm to the left keep no bound of 4 cm."""
    wide = FLOOR.copy()
    wide[4, 4] += 0.08**2
    found = taught(simulated(4, 30, spread=wide))
    bound = found.expectation(PARAMETERS).bound
    assert 0.10 < bound[4] < 0.25
    calm = taught(simulated(4, 30, spread=0.1 * FLOOR)).expectation(PARAMETERS).bound
    assert (calm <= PARAMETERS.bound()).all()


def test_scenes_that_change_along_a_drive_are_spread_and_no_noise():
    """Every 100 m another scene: windows far apart differ by it, near ones do not."""
    drives = []
    for index, drive in enumerate(simulated(11, 12, spread=None, way_m=1000.0)):
        draws = np.random.default_rng(index).normal(size=(11, 6)) @ np.linalg.cholesky(FLOOR).T
        scene = draws[(drive.way_m[:, 0] // 100.0).astype(int)]
        drives.append(dataclasses.replace(drive, drift=drive.drift + scene))
    found = taught(drives)
    assert found.scatter.noise < 1.8
    assert 0.6 < np.mean(np.linalg.eigvalsh(whitened(found.spread))) < 1.3
    assert np.abs((found.bias - BIAS) / np.sqrt(np.diag(found.covariance))).max() < 3.0


@settings(max_examples=12, deadline=None)
@given(order=st.permutations(range(5)))
def test_the_order_of_recordings_does_not_matter(order):
    drives = simulated(5, 5)
    found, other = taught(drives), taught([drives[i] for i in order])
    assert other.bias == pytest.approx(found.bias, abs=1e-12)
    assert other.spread == pytest.approx(found.spread, abs=1e-12)
    assert [s.recording for s in other.stretches] == [s.recording for s in found.stretches]
    assert other.tail == found.tail


def test_a_long_drive_is_several_stretches_of_one_recording():
    (drive,) = simulated(6, 1, way_m=1050.0)
    found = taught([drive])
    assert [stretch.recording for stretch in found.stretches] == ["drive 0"] * 5
    assert left_out([drive], PARAMETERS) == ()


def test_one_drive_alone_narrows_nothing_however_long_it_is():
    streets = [exact(drive) for drive in simulated(10, 40)]
    parts = [dataclasses.replace(one, drift=BIAS + 0.1 * (one.drift - BIAS)) for one in streets]
    apart = taught(parts).expectation(PARAMETERS)
    together = taught([dataclasses.replace(part, recording="long") for part in parts])
    alone = together.expectation(PARAMETERS)
    assert whitened(alone.floor) == pytest.approx(np.eye(6), abs=1e-6)
    assert alone.bound == pytest.approx(PARAMETERS.bound())
    assert np.linalg.eigvalsh(whitened(apart.floor)).max() < 0.6
    assert (apart.bound < PARAMETERS.bound()).all()


def statistics(found: Baseline, scale, seed):
    """Joint statistics of single windows of new streets, as the test forms them."""
    expected = found.expectation(PARAMETERS)
    noise = max(1.0, found.scatter.noise)
    values = []
    for drive in simulated(seed, 60, spread=scale * FLOOR, way_m=31.0):
        away = drive.drift[0] - expected.mean
        P = noise**2 * RANDOM + expected.floor + expected.covariance
        values.append(float(away @ np.linalg.solve(P, away)))
    return np.array(values)


@pytest.mark.parametrize("count", [1, 3, 10, 40])
def test_new_streets_of_an_unmoved_mount_raise_no_alarm(count):
    values = np.concatenate(
        [statistics(taught(simulated(seed, count)), 1.0, 1000 + seed) for seed in range(15)]
    )
    assert (values > PARAMETERS.alarm).mean() <= 2e-3
    assert (values > 12.59).mean() < 0.10  # chi-square of six at 5 %
    assert 4.0 < values.mean() < 8.0


def test_a_recording_under_a_mount_that_moved_stands_out_and_the_others_do_not():
    drives = simulated(7, 5, spread=0.5 * FLOOR)
    moved = drives[3].drift + np.array([0, 0, math.radians(0.8), 0, 0, 0])
    drives[3] = dataclasses.replace(drives[3], drift=moved)
    found = left_out(drives, PARAMETERS)
    by_name = {other.recording: other for other in found}
    assert max(found, key=lambda other: other.statistic).recording == "drive 3"
    assert by_name["drive 3"].statistic > PARAMETERS.alarm
    assert np.degrees(by_name["drive 3"].difference[2]) == pytest.approx(0.8, abs=0.25)


def test_healthy_recordings_do_not_stand_out():
    values = [other.statistic for seed in range(30) for other in left_out(simulated(seed, 4), PARAMETERS)]
    assert max(values) < PARAMETERS.alarm


def test_thresholds_stay_until_the_stretches_suffice():
    assert taught(simulated(8, 4)).thresholds(PARAMETERS) is PARAMETERS
    found = taught(simulated(8, 24, way_m=800.0), wanted_s=3000.0)
    assert len(found.stretches) >= found.tail.needed
    assert found.tail.threshold is not None
    own = found.thresholds(PARAMETERS)
    assert own.alarm == max(found.tail.threshold, PARAMETERS.suspicion)
    assert own.suspicion == PARAMETERS.suspicion


def test_nothing_to_learn_from_is_said():
    (drive,) = simulated(9, 1)
    with pytest.raises(InputError, match="no window was judged"):
        taught([drive.chosen(np.zeros(len(drive), dtype=bool))])
