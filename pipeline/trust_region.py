"""Minimising by trust-region BFGS: every step stays where the quadratic model may be believed.

A line search leaves the basin that the blur of an image makes in a third of the windows (PROBE 1); a bound on
the step does not.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.records import Floats


@dataclass(frozen=True, slots=True)
class SearchParameters:
    """When a search ends.

    Attributes:
        most_steps: Steps at most.
        least_step: It ends when a step is shorter; in alert units 0.003 deg, a tenth of the least sigma.
    """

    most_steps: int = 40
    least_step: float = 0.01


def descend(
    function: Callable[[Floats], tuple[float, Floats]],
    x: Floats,
    start: tuple[float, Floats],
    B: Floats,
    radius: float,
    parameters: SearchParameters,
) -> tuple[Floats, float]:
    """The minimum and its value by trust-region BFGS in alert units: steps stay inside the blur's basin."""
    value, gradient = start
    limit = radius
    for _ in range(parameters.most_steps):
        step = trust_region_step(B, gradient, radius)
        length = float(np.linalg.norm(step))
        if length < parameters.least_step:
            break
        new_value, new_gradient = function(x + step)
        predicted = -float(gradient @ step + 0.5 * step @ B @ step)
        ratio = (value - new_value) / predicted if predicted > 0 else -1.0
        change = new_gradient - gradient
        curvature = float(step @ change)
        if curvature > 1e-8 * length * float(np.linalg.norm(change)):
            Bs = B @ step
            B = B - np.outer(Bs, Bs) / float(step @ Bs) + np.outer(change, change) / curvature
        if ratio > _ACCEPT:
            x, value, gradient = x + step, new_value, new_gradient
        radius = 0.5 * length if ratio < _SHRINK else min(limit, max(radius, 2.0 * length))
    return x, value


_ACCEPT, _SHRINK = 1e-4, 0.25
"""Shares of the predicted decrease: below the first no step is taken, below the second it is halved."""


def trust_region_step(B: Floats, gradient: Floats, radius: float) -> Floats:
    """The minimum of the quadratic model within ``radius``, by the eigenvalues of the 6x6 curvature."""
    values, vectors = np.linalg.eigh(B)
    g = vectors.T @ gradient
    values = np.maximum(values, 1e-9)
    step = -g / values
    if np.linalg.norm(step) <= radius:
        return np.asarray(vectors @ step, dtype=np.float64)
    low, high = 0.0, float(np.linalg.norm(g)) / radius
    # Plain numbers: six of them are too few for numpy.
    terms = list(zip(np.square(g).tolist(), values.tolist(), strict=True))
    for _ in range(40):
        middle = 0.5 * (low + high)
        if sum(square / (value + middle) ** 2 for square, value in terms) > radius * radius:
            low = middle
        else:
            high = middle
    return np.asarray(vectors @ (-g / (values + high)), dtype=np.float64)
