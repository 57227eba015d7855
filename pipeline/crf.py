"""Mean-field inference of a fully connected CRF (Krähenbühl and Koltun): smoothness and appearance kernels.

Every pixel sees every pixel. With features ``f`` in units of their standard deviations

    k_ij = exp(-|f_i - f_j|^2 / 2)              self term j = i included
    K~   = diag(n) K diag(n),                   n_i = 1 / sqrt(sum_j k_ij + 1e-20)   (symmetric normalisation)
    Q(0) = softmax(-U)
    Q(t+1) = softmax_l(-U_l + w_l sum_k c_k K~_k Q_l(t))

Smoothness is a separable blur, exact to float32. Appearance lives in five dimensions (x, y, three colours)
and is summed over a permutohedral lattice. Where only some pixels are in doubt, the others are held fixed and
a sample stands for them: the cost is that of the pixels in doubt.
"""

import functools
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError, RigError
from pipeline.permutohedral import lattice

Floats32: TypeAlias = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class SmoothnessKernel:
    """Neighbours tend to carry the same label, whatever their colour.

    Attributes:
        sigma_x_px: Standard deviation along the row, px of the grid that is labelled.
        sigma_y_px: Along the column, px.
        compat: Gain in energy where all neighbours agree, nats; 3 takes away a lone pixel of probability
            0.95.
    """

    sigma_x_px: float
    sigma_y_px: float
    compat: float

    def __post_init__(self) -> None:
        _require_widths(self.sigma_x_px, self.sigma_y_px)
        _require_compat(self.compat)


@dataclass(frozen=True, slots=True, eq=False)
class AppearanceKernel:
    """Pixels that are near and of like colour tend to carry the same label.

    Attributes:
        sigma_x_px: Standard deviation along the row, px of the grid that is labelled.
        sigma_y_px: Along the column, px.
        sigma_colour: Standard deviation per colour channel, grey levels of 0..255, in the image's channel
            order.
        compat: Gain in energy where all like pixels agree, nats.
    """

    sigma_x_px: float
    sigma_y_px: float
    sigma_colour: tuple[float, float, float]
    compat: float

    def __post_init__(self) -> None:
        _require_widths(self.sigma_x_px, self.sigma_y_px, *self.sigma_colour)
        _require_compat(self.compat)


@dataclass(frozen=True, slots=True, eq=False)
class CrfParameters:
    """One CRF.

    Attributes:
        smoothness: Kernel over position, or None.
        appearance: Kernel over position and colour, or None.
        iterations: Parallel updates. Five: later ones move less than 1 % of the pixels in the published
            method.
        class_weights: One factor per class on what a class gains from agreement (diagonal compatibility); a
            class below 1 spreads less. Empty: all 1, the plain Potts model.
    """

    smoothness: SmoothnessKernel | None
    appearance: AppearanceKernel | None
    iterations: int = 5
    class_weights: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.iterations < 0:
            raise RigError(
                f"CRF iterations {self.iterations} is negative", hint="0 keeps the network's labels"
            )
        for weight in self.class_weights:
            _require_compat(weight)


def mean_field(
    unary: Floats32,
    image: NDArray[np.uint8],
    parameters: CrfParameters,
    region: NDArray[np.bool_] | None = None,
) -> Floats32:
    """Marginals of the CRF after ``parameters.iterations`` parallel updates.

    Args:
        unary: float32 (C,h,w), energies -log p in nats; a constant per pixel does not matter.
        image: uint8 (h,w,3), any channel order that ``sigma_colour`` shares.
        parameters: Kernels and number of updates.
        region: bool (h,w), the pixels that are updated. All others keep ``softmax(-unary)`` and are seen as
            that; by the appearance kernel as a sample of them, where it is wide (``SAMPLE_SIGMAS``). None:
            all are updated.

    Returns:
        float32 (C,h,w), sums to one over the classes.

    Raises:
        InputError: Shapes do not fit, or an energy is not finite.
        RigError: As many class weights as classes are needed, or kernels too narrow for the size of the
            image.
    """
    _require_fitting(unary, image, parameters)
    if region is None:
        region = np.ones(image.shape[:2], dtype=np.bool_)
    if region.shape != image.shape[:2] or region.dtype != np.bool_:
        raise InputError(f"CRF: region {region.dtype}{region.shape} is no mask of image {image.shape}")
    minus_u = np.negative(unary.reshape(len(unary), -1), dtype=np.float32)
    q = _softmax(minus_u)
    if parameters.iterations and len(unary) > 1 and region.any():
        inside = np.flatnonzero(region)
        q[:, inside] = _iterate(
            minus_u[:, inside], q[:, inside], _kernels(q, image, region, parameters), parameters
        )
    return q.reshape(unary.shape)


class _Kernel(Protocol):
    """One kernel over the pixels of a region, the pixels outside held fixed.

    ``total`` is compat times K~ 1 at the region's pixels, float32 (n,).
    """

    total: Floats32

    def gains(self, q: Floats32) -> Floats32:
        """Compat times K~ Q for the probabilities float32 (c,n) of the first c classes in the region."""


def _iterate(minus_u: Floats32, q: Floats32, kernels: list[_Kernel], parameters: CrfParameters) -> Floats32:
    """The updates of the region's n pixels, float32 (C,n)."""
    weights = np.array(parameters.class_weights or (1.0,) * len(q), dtype=np.float32)
    for _ in range(parameters.iterations):
        pull = np.zeros_like(q)
        for kernel in kernels:
            # The classes sum to one, so the last one follows from the others.
            gained = kernel.gains(q[:-1])
            pull[:-1] += gained
            pull[-1] += kernel.total - functools.reduce(np.add, gained)
        q = _softmax(minus_u + weights[:, None] * pull)
    return q


def _softmax(energy: Floats32) -> Floats32:
    """Over the first axis of float32 (C,n)."""
    # Row by row: numpy reduces a short first axis several times slower.
    top = functools.reduce(np.maximum, energy)
    raised = np.exp(energy - top)
    return np.asarray(raised / functools.reduce(np.add, raised), dtype=np.float32)


def _kernels(
    q: Floats32, image: NDArray[np.uint8], region: NDArray[np.bool_], parameters: CrfParameters
) -> list[_Kernel]:
    found: list[_Kernel] = []
    smooth, like = parameters.smoothness, parameters.appearance
    if smooth is not None and smooth.compat > 0:
        found.append(_Smoothness(q, region, smooth))
    if like is not None and like.compat > 0:
        found.append(_Appearance(q, image, region, like))
    return found


_TAIL = 5.0
"""Standard deviations at which the blur stops; what lies beyond weighs 4e-6."""


class _Smoothness:
    """A separable blur over whole planes."""

    def __init__(self, q: Floats32, region: NDArray[np.bool_], kernel: SmoothnessKernel) -> None:
        height, width = region.shape
        self._taps = _taps(kernel.sigma_x_px, width), _taps(kernel.sigma_y_px, height)
        self._inside = np.flatnonzero(region)
        # The kernel is a product of one along the row and one along the column, and so are its sums.
        along_x, along_y = _sums(self._taps[0], width), _sums(self._taps[1], height)
        n = np.asarray(1.0 / np.sqrt(np.outer(along_y, along_x)), dtype=np.float32)
        self._before = n.ravel()[self._inside]
        self._after = np.float32(kernel.compat) * self._before
        self._planes = q[:-1].reshape(-1, height, width) * n
        self.total = self._after * self._blurred(n)

    def gains(self, q: Floats32) -> Floats32:
        planes = self._planes
        planes.reshape(len(planes), -1)[:, self._inside] = q * self._before
        return np.asarray(
            self._after * np.stack([self._blurred(plane) for plane in planes]), dtype=np.float32
        )

    def _blurred(self, plane: Floats32) -> Floats32:
        out = cv2.sepFilter2D(plane, cv2.CV_32F, *self._taps, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(out, dtype=np.float32).ravel()[self._inside]


def _taps(sigma: float, size: int) -> Floats32:
    radius = min(max(1, int(np.ceil(_TAIL * sigma))), max(1, size - 1))
    offsets = np.arange(-radius, radius + 1)
    return np.exp(-0.5 * (offsets / sigma) ** 2).astype(np.float32)


def _sums(taps: Floats32, size: int) -> Floats32:
    """Sum of the taps that meet a pixel, for each place of a row of ``size`` px."""
    return np.convolve(np.ones(size, np.float32), taps, mode="full")[len(taps) // 2 :][:size]


SAMPLE_SIGMAS = 1.0 / 3.0
"""Spacing of the sample of fixed pixels, in widths of the appearance kernel: some 56 within its footprint."""

_REACH_SIGMAS = 3.0
"""Fixed pixels further than this from all others are left out: less than 0.011 of a near one's weight."""


class _Appearance:
    """Position and colour, summed over a permutohedral lattice of the region and a sample of the rest."""

    def __init__(
        self, q: Floats32, image: NDArray[np.uint8], region: NDArray[np.bool_], kernel: AppearanceKernel
    ) -> None:
        inside = np.flatnonzero(region)
        fixed, weight = _sample_outside(region, kernel)
        found = lattice(_features(image, np.concatenate([inside, fixed]), kernel))
        self._lattice = found
        self._own, others = found.shares[: len(inside)], found.shares[len(inside) :]
        sums = found.blurred(self._own.T @ _ones(len(inside)) + others.T @ (weight * _ones(len(fixed))))
        self._before = _rooted(self._own @ sums)
        self._after = np.float32(kernel.compat) * self._before
        handed = np.float32(weight) * _rooted(others @ sums)
        self.total = self._after * (self._own @ found.blurred(self._own.T @ self._before + others.T @ handed))
        self._held = [others.T @ (handed * plane[fixed]) for plane in q[:-1]]

    def gains(self, q: Floats32) -> Floats32:
        # One class at a time: products with a vector are several times faster than with a narrow matrix.
        read = [
            self._own @ self._lattice.blurred(held + self._own.T @ (self._before * values))
            for values, held in zip(q, self._held, strict=True)
        ]
        return np.asarray(self._after * np.stack(read), dtype=np.float32)


def _ones(count: int) -> Floats32:
    return np.ones(count, dtype=np.float32)


def _rooted(sums: Floats32) -> Floats32:
    return np.asarray(1.0 / np.sqrt(sums + 1e-20), dtype=np.float32)


def _sample_outside(region: NDArray[np.bool_], kernel: AppearanceKernel) -> tuple[NDArray[np.int64], float]:
    """Indices of the pixels that stand for those outside the region, and how many each stands for."""
    step_x, step_y = (max(1, int(SAMPLE_SIGMAS * sigma)) for sigma in (kernel.sigma_x_px, kernel.sigma_y_px))
    reach = [int(np.ceil(_REACH_SIGMAS * sigma)) for sigma in (kernel.sigma_x_px, kernel.sigma_y_px)]
    near = cv2.boxFilter(
        region.astype(np.float32), -1, (2 * reach[0] + 1, 2 * reach[1] + 1), borderType=cv2.BORDER_CONSTANT
    )
    height, width = region.shape
    chosen = np.zeros(region.shape, dtype=np.bool_)
    chosen[min(step_y, height) // 2 :: step_y, min(step_x, width) // 2 :: step_x] = True
    chosen &= ~region
    chosen &= near > 0.5 / ((2 * reach[0] + 1) * (2 * reach[1] + 1))
    return np.flatnonzero(chosen), float(step_x * step_y)


def _features(image: NDArray[np.uint8], points: NDArray[np.int64], kernel: AppearanceKernel) -> Floats32:
    """float32 (5,n) of pixels by index, in units of the standard deviations: x, y, colours."""
    widths = np.array([kernel.sigma_x_px, kernel.sigma_y_px, *kernel.sigma_colour], dtype=np.float32)
    features = np.empty((5, len(points)), np.float32)
    features[1], features[0] = np.divmod(points, image.shape[1])
    features[2:] = image.reshape(-1, 3)[points].T
    features /= widths[:, None]
    return features


def _require_widths(*widths: float) -> None:
    for width in widths:
        if not (np.isfinite(width) and width > 0):
            raise RigError(
                f"kernel width {width} of the CRF is not positive", hint="px or grey levels above 0"
            )


def _require_compat(compat: float) -> None:
    if not (np.isfinite(compat) and compat >= 0):
        raise RigError(f"CRF weight {compat} is negative or not finite", hint="0 switches a kernel off")


def _require_fitting(unary: Floats32, image: NDArray[np.uint8], parameters: CrfParameters) -> None:
    if unary.ndim != 3 or not len(unary) or image.shape != (*unary.shape[1:], 3) or image.dtype != np.uint8:
        raise InputError(
            f"CRF: unary {unary.shape} and image {image.dtype}{image.shape} do not fit",
            hint="unary (C,h,w) and image uint8 (h,w,3)",
        )
    if not np.isfinite(unary).all():
        raise InputError("CRF: unary energies are not finite", hint="clip probabilities before the logarithm")
    if parameters.class_weights and len(parameters.class_weights) != len(unary):
        raise RigError(f"CRF: {len(parameters.class_weights)} class weights for {len(unary)} classes")
