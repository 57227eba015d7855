"""Window estimates of simulated drives, with known bias, spread of scenes, noise and correlation."""

import math

import numpy as np

from pipeline.drift_test import DriftTestParameters
from pipeline.road_samples import WindowEstimates

RANDOM = np.diag([math.radians(0.05), math.radians(0.04), math.radians(0.03), 0.012, 0.008, 0.01]) ** 2
"""Stated covariance of one window: a good one of twenty frames (PROBE 2)."""

FLOOR = DriftTestParameters().floor()
"""How far scenes pull the estimate of any rig."""


def simulated_drive(
    rng,
    name,
    *,
    bias=None,
    spread=None,
    noise=1.0,
    correlation_m=20.0,
    way_m=200.0,
    step_m=8.0,
    window_m=30.0,
):
    """A healthy drive at 10 m/s; the scene adds one draw of ``spread`` (default none) to the whole of it."""
    end = np.arange(window_m, way_m + 1e-9, step_m)
    count = len(end)
    alike = np.exp(-np.abs(end[:, None] - end[None, :]) / correlation_m)
    random = np.linalg.cholesky(alike) @ rng.normal(size=(count, 6)) @ np.linalg.cholesky(RANDOM).T
    scene = np.zeros(6) if spread is None else np.linalg.cholesky(spread) @ rng.normal(size=6)
    return WindowEstimates(
        name,
        (np.zeros(6) if bias is None else bias) + scene + noise * random,
        np.broadcast_to(RANDOM, (count, 6, 6)),
        np.zeros((count, 6)),
        np.stack([end - window_m, end], axis=1),
        (end * 1e8).astype(np.int64),
    )
