"""Fully connected CRF by brute force: every pixel sees every pixel, float64, no lattice, no window."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def _softmax(energy: Floats) -> Floats:
    raised = np.exp(energy - energy.max(axis=0))
    return np.asarray(raised / raised.sum(axis=0), dtype=np.float64)


def normalised_kernel(features: Floats) -> Floats:
    """K~ (N,N) of features (N,d) in units of their standard deviations, self term included."""
    squares = (features**2).sum(axis=1)
    distance2 = np.maximum(squares[:, None] + squares[None] - 2.0 * features @ features.T, 0.0)
    kernel = np.exp(-0.5 * distance2)
    weight = 1.0 / np.sqrt(kernel.sum(axis=1) + 1e-20)
    return np.asarray(kernel * weight[:, None] * weight[None], dtype=np.float64)


def mean_field_exact(
    unary: NDArray[np.float32],
    image: NDArray[np.uint8],
    *,
    smoothness: tuple[tuple[float, float], float] | None,
    appearance: tuple[tuple[float, float], tuple[float, float, float], float] | None,
    iterations: int,
    class_weights: tuple[float, ...] | None = None,
    region: NDArray[np.bool_] | None = None,
) -> Floats:
    """Marginals (C,h,w) after the given number of parallel updates; outside ``region`` there are none.

    ``smoothness`` is (sigma xy, compat), ``appearance`` is (sigma xy, sigma colour, compat).
    """
    classes, height, width = unary.shape
    minus_u = -unary.reshape(classes, -1).astype(np.float64)
    rows, columns = np.mgrid[0:height, 0:width]
    kernels: list[tuple[float, Floats]] = []
    if smoothness is not None:
        (sx, sy), compat = smoothness
        kernels.append(
            (compat, normalised_kernel(np.column_stack([columns.ravel() / sx, rows.ravel() / sy])))
        )
    if appearance is not None:
        (sx, sy), colour, compat = appearance
        features = np.column_stack(
            [columns.ravel() / sx, rows.ravel() / sy, image.reshape(-1, 3) / np.array(colour)]
        )
        kernels.append((compat, normalised_kernel(features)))
    weights = np.ones(classes) if class_weights is None else np.array(class_weights)
    q = _softmax(minus_u)
    moves = np.ones(q.shape[1], dtype=np.bool_) if region is None else region.ravel()
    for _ in range(iterations):
        pull = sum((compat * (q @ kernel) for compat, kernel in kernels), np.zeros_like(q))
        q = np.where(moves, _softmax(minus_u + weights[:, None] * pull), q)
    return q.reshape(unary.shape)
