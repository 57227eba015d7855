import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.road_samples import (
    STRETCH_M,
    WindowEstimates,
    effective_samples,
    largest_change,
    mean_of,
    samples_of,
    scatter_of,
    stretches_of,
)
from tests.pipeline.simulated_windows import FLOOR, RANDOM, simulated_drive


def windows(way_m, span_m=30.0, drift=None, covariance=RANDOM):
    """Windows that end at ``way_m``, healthy unless told."""
    end = np.asarray(way_m, dtype=np.float64)
    count = len(end)
    return WindowEstimates(
        "drive",
        np.zeros((count, 6)) if drift is None else drift,
        np.broadcast_to(covariance, (count, 6, 6)),
        np.zeros((count, 6)),
        np.stack([end - span_m, end], axis=1),
        (end * 1e8).astype(np.int64),
    )


def test_windows_far_apart_are_independent_and_windows_of_one_place_are_one():
    assert effective_samples(np.arange(10) * 1e6, 20.0) == pytest.approx(10.0)
    assert effective_samples(np.zeros(10), 20.0) == pytest.approx(1.0)


@pytest.mark.parametrize("phi", [0.3, 0.5, 0.8])
def test_the_worth_of_a_long_drive_is_that_of_the_long_run_variance(phi):
    step, length = 10.0, -10.0 / np.log(phi)
    count = 3000
    worth = effective_samples(np.arange(count) * step, length)
    assert worth / count == pytest.approx((1 - phi) / (1 + phi), rel=0.01)  # FORMULAS F1


def test_the_noise_of_simulated_drives_is_recovered():
    rng = np.random.default_rng(1)
    parts = [simulated_drive(rng, f"{i}", noise=1.7, way_m=600.0, step_m=6.0) for i in range(12)]
    assert scatter_of(parts).noise == pytest.approx(1.7, rel=0.08)


def test_the_correlation_of_simulated_drives_is_recovered():
    rng = np.random.default_rng(2)
    parts = [simulated_drive(rng, f"{i}", correlation_m=45.0, way_m=600.0, step_m=6.0) for i in range(20)]
    found = scatter_of(parts)
    assert found.correlation_m == pytest.approx(45.0, rel=0.3)
    assert found.noise < 1.0  # what wanders slowly is the scene


def test_two_windows_that_differ_much_do_not_prove_the_stated_sigma_wrong():
    drift = np.zeros((2, 6))
    drift[1] = 4.0 * np.sqrt(np.diag(RANDOM))
    assert 1.0 < scatter_of([windows([100.0, 135.0], drift=drift)]).noise < 2.0


def test_single_windows_tell_nothing_of_the_noise():
    assert scatter_of([windows([50.0]), windows([80.0])]).noise == 1.0


def test_windows_are_alike_at_least_over_half_their_length():
    rng = np.random.default_rng(2)
    parts = [
        simulated_drive(rng, f"{i}", correlation_m=1.0, way_m=900.0, step_m=30.0, window_m=120.0)
        for i in range(5)
    ]
    assert scatter_of(parts).correlation_m == pytest.approx(60.0)


def test_a_sample_holds_windows_that_share_no_frame_the_last_among_them():
    rng = np.random.default_rng(3)
    way = np.array([40.0, 55.0, 70.0, 110.0, 150.0])
    part = windows(way, span_m=30.0, drift=rng.normal(size=(5, 6)) * 1e-3)
    (sample,), scatter = samples_of([part])
    assert sample.drift == pytest.approx(part.drift[[0, 2, 3, 4]])
    assert sample.covariance == pytest.approx(np.tile(scatter.noise**2 * RANDOM, (4, 1, 1)))
    assert sample.street.mean == pytest.approx(part.drift[[0, 2, 3, 4]].mean(axis=0))
    assert sample.street.windows == 4
    assert 1.0 < sample.street.samples < 5.0
    assert sample.street.way_m == pytest.approx(140.0)


def test_an_error_of_the_clocks_is_part_of_a_sample_and_not_averaged_away():
    clock = np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
    part = windows(np.arange(1, 101) * 50.0)
    fooled = dataclasses.replace(part, feigned=np.tile(clock, (100, 1)))
    samples, scatter = samples_of([fooled])
    for sample in samples:
        assert sample.covariance == pytest.approx(
            np.tile(scatter.noise**2 * RANDOM + np.outer(clock, clock), (len(sample.drift), 1, 1))
        )
    mean, covariance = mean_of(fooled)
    assert mean == pytest.approx(np.zeros(6))
    assert covariance == pytest.approx(RANDOM + np.outer(clock, clock))


def test_no_drive_gives_no_sample():
    assert samples_of([windows([])])[0] == ()


@given(
    steps=st.lists(st.floats(0.0, 60.0), min_size=1, max_size=120),
    span=st.floats(0.0, 150.0),
)
def test_stretches_share_no_frame_and_are_long_enough(steps, span):
    end = np.cumsum(steps) + span
    parts = stretches_of(windows(end, span))
    assert parts
    for before, after in itertools.pairwise(parts):
        assert after.way_m[:, 0].min() >= before.way_m[:, 1].max() - 1e-6
    way = end[-1] - (end[0] - span)
    assert len(parts) <= max(1, way / STRETCH_M, 1)
    for part in parts:
        assert (np.diff(part.way_m[:, 1]) >= 1.0 - 1e-9).all()


def test_a_vehicle_that_stands_gives_one_window():
    (part,) = stretches_of(windows(np.full(50, 30.0)))
    assert len(part) == 1


def test_a_change_on_the_way_is_found_with_its_size():
    rng = np.random.default_rng(4)
    slip = np.array([0.0, 12e-3, 0.0, 0.0, 0.0, 0.0])
    for at in (4, 12, 18):
        drive = simulated_drive(rng, "slips", spread=FLOOR)
        after = np.arange(len(drive))[:, None] >= at
        found = largest_change(dataclasses.replace(drive, drift=drive.drift + after * slip), FLOOR)
        assert found.statistic > 27.86
        assert found.difference[1] == pytest.approx(12e-3, abs=1e-3)


def test_healthy_drives_show_no_change_though_scenes_change():
    rng = np.random.default_rng(5)
    for _ in range(200):
        halves = [simulated_drive(rng, "healthy", spread=FLOOR) for _ in range(2)]
        drift = np.concatenate([half.drift for half in halves])
        way = np.arange(len(drift)) * 10.0 + 40.0
        assert largest_change(windows(way, drift=drift), FLOOR).statistic < 27.86


def test_too_few_windows_and_the_speed_of_a_fooled_clock_show_no_change():
    drift = np.zeros((4, 6))
    drift[2:, 2] = 1.0
    assert largest_change(windows(np.arange(4) * 9.0, drift=drift), FLOOR).statistic == 0.0
    drift = np.zeros((20, 6))
    drift[10:, 3] = 0.5  # twice as fast, and the stamps off by one sigma
    fooled = windows(np.arange(20) * 9.0, drift=drift)
    assert largest_change(fooled, FLOOR).statistic > 27.86
    told = dataclasses.replace(fooled, feigned=drift)
    assert largest_change(told, FLOOR).statistic < 2.0


def test_a_drive_without_windows_gives_no_stretch():
    assert stretches_of(windows([])) == []


def test_segments_of_all_sizes_are_weighed_as_each_by_itself():
    """Noise and correlation from a handful of drives whose segments differ in size: permuted, they stay."""
    rng = np.random.default_rng(11)
    parts = [
        simulated_drive(rng, f"{i}", noise=1.4, way_m=600.0, step_m=step)
        for i, step in enumerate((3.0, 4.0, 7.0, 11.0, 13.0))
    ]
    found = [scatter_of([parts[i] for i in order]) for order in ([0, 1, 2, 3, 4], [4, 2, 0, 3, 1])]
    assert found[0].noise == pytest.approx(found[1].noise, rel=1e-9)
    assert found[0].correlation_m == found[1].correlation_m


def test_the_largest_change_is_the_largest_of_all_splits():
    rng = np.random.default_rng(12)
    drive = simulated_drive(rng, "slips", way_m=150.0)
    drive = dataclasses.replace(drive, feigned=rng.normal(size=drive.feigned.shape) * 1e-3)
    information = np.linalg.inv(drive.covariance)
    best = 0.0
    for split in range(3, len(drive) - 2):
        sides = []
        for part in (slice(None, split), slice(split, None)):
            total = np.linalg.inv(information[part].sum(axis=0))
            means = [
                total @ sum(J @ v for J, v in zip(information[part], values[part], strict=True))
                for values in (drive.drift, drive.feigned)
            ]
            sides.append((*means, len(information[part]) * total))
        (before, early, P), (after, late, Q) = sides
        P = P + Q + 2.0 * FLOOR + np.outer(late - early, late - early)
        best = max(best, float((after - before) @ np.linalg.solve(P, after - before)))
    assert largest_change(drive, FLOOR).statistic == pytest.approx(best, rel=1e-9)
