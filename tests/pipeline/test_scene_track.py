"""A mount followed over scenes: on its walk, around false modes, with honest sigmas."""

import math

import numpy as np
import pytest

from pipeline.drift_test import DriftTestParameters, Expectation, expectation_of_stored
from pipeline.scene_filter import Scene
from pipeline.scene_track import TrackParameters, begin, followed

STORED = expectation_of_stored(math.radians(0.1), 0.02, DriftTestParameters())
NOISE = np.diag([math.radians(0.06) ** 2] * 3 + [0.015**2] * 3)
ZERO = np.zeros(6)


def test_one_scene_is_weighed_against_what_was_expected() -> None:
    drift = np.array([0.001, -0.002, 0.001, 0.01, -0.01, 0.02])
    track = followed(begin(STORED), Scene(drift, NOISE, ZERO, 0.0, 0), STORED, TrackParameters())
    gain = STORED.covariance @ np.linalg.inv(STORED.covariance + STORED.floor + NOISE)
    assert track.drift == pytest.approx(gain @ drift)
    assert track.drift_covariance == pytest.approx(STORED.covariance - gain @ STORED.covariance, abs=1e-12)


def test_without_walk_many_streets_make_a_mean_and_a_standing_street_does_not() -> None:
    still = TrackParameters(walk_rad=0.0, walk_m=0.0)
    drift = np.full(6, 0.001)
    moving, standing = begin(STORED), begin(STORED)
    for index in range(200):
        moving = followed(moving, Scene(drift, NOISE, ZERO, 2000.0 * index, index), STORED, still)
        standing = followed(standing, Scene(drift, NOISE, ZERO, 0.0, index), STORED, still)
    # The stored extrinsic's own prior leans a little on yaw and left together.
    assert moving.drift == pytest.approx(drift, rel=0.15)
    assert np.diag(moving.drift_covariance).max() < 0.02 * np.diag(STORED.floor).max()
    floor_left = np.linalg.inv(np.linalg.inv(STORED.covariance) + np.linalg.inv(STORED.floor))
    assert np.linalg.eigvalsh(standing.drift_covariance - 0.99 * floor_left).min() > 0.0


def test_sigma_is_honest_for_a_mount_that_wanders() -> None:
    rng, parameters = np.random.default_rng(2), TrackParameters(walk_rad=0.01, walk_m=0.05)
    known = Expectation(ZERO, 1e-6 * np.eye(6), 1e-6 * np.eye(6), ZERO)
    mount, track, squares = ZERO.copy(), begin(known), []
    street = 1e-3 * rng.normal(size=6)
    kept = math.exp(-20.0 / parameters.correlation_m)
    for index in range(2000):
        mount = mount + rng.normal(size=6) * np.array([0.01] * 3 + [0.05] * 3) * math.sqrt(2.0 / 3600.0)
        drift = mount + street + np.linalg.cholesky(NOISE) @ rng.normal(size=6)
        track = followed(track, Scene(drift, NOISE, ZERO, 20.0 * index, 2 * index * 10**9), known, parameters)
        street = kept * street + math.sqrt(1.0 - kept**2) * 1e-3 * rng.normal(size=6)
        off = track.drift - mount
        squares.append(off @ np.linalg.solve(track.drift_covariance, off))
    assert 4.5 < np.mean(squares[100:]) < 7.5


def test_one_false_mode_moves_it_by_little() -> None:
    track = begin(STORED)
    for index in range(100):
        track = followed(track, Scene(ZERO, NOISE, ZERO, 20.0 * index, index), STORED, TrackParameters())
    far = np.array([0.0, math.radians(3.0), 0.0, 0.0, 0.0, 0.6])
    pulled = followed(track, Scene(far, NOISE, ZERO, 2000.0, 100), STORED, TrackParameters())
    assert abs(pulled.drift[1]) < math.radians(0.05)
