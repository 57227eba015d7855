import math

import numpy as np
import pytest

from pipeline import reasons
from pipeline.records import AXES

LIMITS = np.array([*np.radians([0.75, 0.5, 0.5]), 0.20, 0.15, 0.15])


@pytest.mark.parametrize(
    ("axis", "value", "sigma", "said"),
    [
        (2, math.radians(-0.5), math.radians(0.049), "yaw -0.50 deg (sigma 0.05)"),
        (3, 0.1234, 0.02, "forward +0.123 m (sigma 0.020)"),
    ],
)
def test_a_size_bears_axis_sign_unit_and_sigma(axis, value, sigma, said):
    assert reasons.size(axis, value, sigma) == said


@pytest.mark.parametrize("axis", range(6))
def test_the_worst_axis_is_the_one_nearest_to_its_own_limit(axis):
    drift = 0.9 * LIMITS
    drift[axis] = -1.1 * LIMITS[axis]
    assert reasons.worst(drift, 0.1 * LIMITS, LIMITS).startswith(f"{AXES[axis]} -")


def test_what_was_heard_over_a_span_names_it():
    drift = math.radians(0.5) * np.eye(6)[2]
    said = reasons.over("the last 0.6 s", "has moved", (drift, 0.1 * LIMITS), LIMITS)
    assert said == "Over the last 0.6 s the mount has moved: yaw +0.50 deg (sigma 0.05)."
