"""Simulated evidence: what is drawn is what was asked for, and the fit finds it again."""

import math

import numpy as np
import pytest

from pipeline.drift_test import DriftTestParameters
from pipeline.errors import InputError
from pipeline.scene_filter import Scene
from pipeline.simulation.evidence import EvidenceModel, Road, scenes
from pipeline.simulation.evidence_fit import _Block, _within, fit

FLOOR = DriftTestParameters().floor()
ROAD = (Road("town", 10.0, 0.0, 1e9, 1.0, 0.0, 1e6, 1.0),)
UNMOVED = np.zeros(6)


def streets(model: EvidenceModel, count: int, seed: int, duration_s: float = 16.0) -> list[list[Scene]]:
    rng = np.random.default_rng(seed)
    return [list(scenes(model, duration_s, lambda _: UNMOVED, rng, ROAD)) for _ in range(count)]


def test_a_drive_repeats_by_its_seed_and_holds_what_speed_and_gaps_make_of_it() -> None:
    road = (Road("town", 10.0, 0.0, 200.0, 1.0, 0.25, 1e6, 1.0),)
    one, two = (
        list(scenes(EvidenceModel(), 4000.0, lambda _: UNMOVED, np.random.default_rng(1), road))
        for _ in range(2)
    )
    assert [scene.way_m for scene in one] == [scene.way_m for scene in two]
    assert one[-1].drift == pytest.approx(two[-1].drift, abs=0.0)
    # A scene each 20 m at 10 m/s, a quarter of them unseen.
    assert len(one) == pytest.approx(1500, rel=0.05)
    assert one[-1].stamp_ns == pytest.approx(4000e9, rel=0.01)


def test_mounts_move_what_scenes_show() -> None:
    drift = np.array([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    rng = np.random.default_rng(2)
    found = list(scenes(EvidenceModel(), 200.0, lambda t: drift if t > 100.0 else UNMOVED, rng, ROAD))
    late = [scene.drift[2] for scene in found if scene.stamp_ns > 100e9]
    assert np.median(late) == pytest.approx(0.1, abs=0.01)
    assert abs(np.median([scene.drift[2] for scene in found if scene.stamp_ns <= 100e9])) < 0.01


def test_the_fit_finds_what_the_evidence_was_drawn_with() -> None:
    model = EvidenceModel(
        # Sigmas wider than what streets differ by: else a street off by the floor looks like a false mode.
        covariance=1.5**2 * EvidenceModel().covariance,
        ratio=0.7,
        common=0.4,
        common_m=1e6,
        freedom=1e6,
        ridden=0.0,
        street=0.25 * FLOOR,
        correlation_m=1e9,
    )
    found = fit(streets(model, 14, 3, 12.0), FLOOR)
    for value, truth in ((found.ratio, 0.7), (found.share, 0.5), (found.common, 0.4)):
        middle, low, high = value
        assert low < middle < high
        assert 0.7 * low < truth < 1.4 * high
    assert found.streets == 14
    assert found.ridden <= 1
    assert found.worth_spread == pytest.approx(model.worth_spread, rel=0.25)
    assert math.degrees(math.sqrt(found.covariance[1, 1])) == pytest.approx(0.105, rel=0.2)
    assert found.freedom >= 15
    assert found.squares.mean() == pytest.approx(6.0, rel=0.35)


def test_heavy_tails_and_streets_in_false_modes_are_told() -> None:
    model = EvidenceModel(ratio=0.8, common=0.0, freedom=4.0, ridden=0.0, street=1e-12 * np.eye(6))
    lost = EvidenceModel(ratio=4.0, common=0.0, freedom=1e6, ridden=0.0, street=1e-12 * np.eye(6))
    found = fit(streets(model, 14, 4, 12.0) + streets(lost, 4, 5, 12.0), FLOOR)
    assert found.freedom <= 10
    assert 4 <= found.ridden <= 6
    assert found.ridden_ratio == pytest.approx(4.0, rel=0.2)


def test_the_share_within_stated_sigmas_counts_streets_not_scenes() -> None:
    rng = np.random.default_rng(8)
    root = np.linalg.cholesky(EvidenceModel().covariance)
    sigma = np.sqrt(np.diag(root @ root.T))
    errors = [rng.normal(size=(int(rng.integers(1, 9)), 6)) for _ in range(200)]
    blocks = [
        _Block(
            [Scene(row * sigma, root @ root.T, UNMOVED, 25.0 * k, k) for k, row in enumerate(street)], FLOOR
        )
        for street in errors
    ]
    for sigmas, chance in ((1.0, 0.683), (2.0, 0.954)):
        share, low, high = _within(blocks, sigmas)
        assert share == pytest.approx(float((np.abs(np.concatenate(errors)) < sigmas).mean()))
        assert low < chance < high
        # Of independent errors the interval is the binomial one.
        count = sum(street.size for street in errors)
        assert high - low == pytest.approx(3.29 * math.sqrt(share * (1 - share) / count), rel=0.2)
        # Scenes that repeat each other tell no more than one.
        alike = [
            _Block([Scene(street[0] * sigma, root @ root.T, UNMOVED, 25.0 * k, k) for k in range(6)], FLOOR)
            for street in errors
        ]
        _, least, most = _within(alike, sigmas)
        assert most - least == pytest.approx(3.29 * math.sqrt(share * (1 - share) / 1200), rel=0.2)


def test_few_streets_are_refused() -> None:
    with pytest.raises(InputError, match="too few"):
        fit(streets(EvidenceModel(), 3, 6), FLOOR)
