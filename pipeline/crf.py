"""Mean-field inference of a fully connected CRF (Krähenbühl and Koltun): smoothness and appearance kernels.

Every pixel sees every pixel. With features ``f`` in units of their standard deviations

    k_ij = exp(-|f_i - f_j|^2 / 2)              self term j = i included
    K~   = diag(n) K diag(n),                   n_i = 1 / sqrt(sum_j k_ij + 1e-20)   (symmetric normalisation)
    Q(0) = softmax(-U)
    Q(t+1) = softmax_l(-U_l + w_l sum_k c_k K~_k Q_l(t))

Smoothness is a separable blur, exact to float32. Appearance lives in five dimensions (x, y, three colours)
and is summed over a permutohedral lattice (Adams, Baek and Davis 2010): each pixel hands its value to the six
corners of the simplex it lies in, the corners are blurred along six directions, each pixel reads its corners
again.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from pipeline.errors import InputError, RigError

Floats32: TypeAlias = NDArray[np.float32]
Filter: TypeAlias = Callable[[Floats32], Floats32]
"""Sums a kernel over all pixels: float32 (N,c) -> (N,c)."""


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
        region: bool (h,w), the pixels that take part and see each other; all others keep ``softmax(-unary)``
            and are seen by nobody. None: all take part.

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
    all_q = _softmax(np.ascontiguousarray(-unary.reshape(len(unary), -1).T, dtype=np.float32))
    if parameters.iterations and len(unary) > 1 and region.any():
        inside = np.flatnonzero(region)
        minus_u = np.ascontiguousarray(-unary.reshape(len(unary), -1)[:, inside].T, dtype=np.float32)
        all_q[inside] = _iterate(minus_u, all_q[inside], _kernels(image, region, parameters), parameters)
    return np.ascontiguousarray(all_q.T).reshape(unary.shape)


def _iterate(
    minus_u: Floats32, q: Floats32, plain: list[tuple[Filter, float]], parameters: CrfParameters
) -> Floats32:
    """The updates on float32 (N,C)."""
    classes = q.shape[1]
    kernels = [_normalised(kernel, compat, len(q), classes - 1) for kernel, compat in plain]
    weights = np.array(parameters.class_weights or (1.0,) * classes, dtype=np.float32)
    for _ in range(parameters.iterations):
        q = _softmax(minus_u + weights * _messages(q, kernels))
    return q


@dataclass(frozen=True, slots=True, eq=False)
class _Normalised:
    """A kernel with its weights, for ``c`` columns at once.

    ``before`` is n, ``after`` is compat times n, both float32 (N,c); ``total`` (N,) is compat times K~ 1.
    """

    plain: Filter
    before: Floats32
    after: Floats32
    total: Floats32

    def __call__(self, values: Floats32) -> Floats32:
        return self.after * self.plain(self.before * values)


def _normalised(plain: Filter, compat: float, pixels: int, columns: int) -> _Normalised:
    n = (1.0 / np.sqrt(plain(np.ones((pixels, 1), np.float32)) + 1e-20)).astype(np.float32)
    total = np.float32(compat) * n * plain(n)
    before = np.repeat(n, columns, axis=1)
    return _Normalised(plain, before, np.float32(compat) * before, total[:, 0])


def _messages(q: Floats32, kernels: list[_Normalised]) -> Floats32:
    """What each class gains at each pixel, float32 (N,C)."""
    last = q.shape[1] - 1
    some = np.ascontiguousarray(q[:, :last])
    pull = np.zeros_like(q)
    for kernel in kernels:
        # The classes sum to one, so the last one follows from the others: a third of the work less for three.
        gained = kernel(some)
        pull[:, :last] += gained
        pull[:, last] += kernel.total
        for column in range(last):
            pull[:, last] -= gained[:, column]
    return pull


def _softmax(energy: Floats32) -> Floats32:
    """Over the last axis of float32 (N,C)."""
    top = energy[:, 0]
    for column in range(1, energy.shape[1]):
        top = np.maximum(top, energy[:, column])
    raised = np.exp(energy - top[:, None])
    total = raised[:, 0].copy()
    for column in range(1, raised.shape[1]):
        total += raised[:, column]
    return np.asarray(raised / total[:, None], dtype=np.float32)


def _kernels(
    image: NDArray[np.uint8], region: NDArray[np.bool_], parameters: CrfParameters
) -> list[tuple[Filter, float]]:
    found: list[tuple[Filter, float]] = []
    smooth, like = parameters.smoothness, parameters.appearance
    if smooth is not None and smooth.compat > 0:
        found.append((_blur(region, smooth.sigma_x_px, smooth.sigma_y_px), smooth.compat))
    if like is not None and like.compat > 0:
        found.append((_lattice(_appearance_features(image, region, like)), like.compat))
    return found


_TAIL = 5.0
"""Standard deviations at which the blur stops; what lies beyond weighs 4e-6."""


def _blur(region: NDArray[np.bool_], sigma_x: float, sigma_y: float) -> Filter:
    """Sum of exp(-d^2/2) over the pixels of the region."""
    height, width = region.shape
    along_x, along_y = _taps(sigma_x, width), _taps(sigma_y, height)
    inside = np.flatnonzero(region)

    def blurred(values: Floats32) -> Floats32:
        planes = np.zeros((height * width, values.shape[1]), np.float32)
        planes[inside] = values
        shaped = planes.reshape(height, width, -1)
        out = cv2.sepFilter2D(shaped, cv2.CV_32F, along_x, along_y, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(out, dtype=np.float32).reshape(planes.shape)[inside]

    return blurred


def _taps(sigma: float, size: int) -> Floats32:
    radius = min(max(1, int(np.ceil(_TAIL * sigma))), max(1, size - 1))
    offsets = np.arange(-radius, radius + 1)
    return np.exp(-0.5 * (offsets / sigma) ** 2).astype(np.float32)


def _appearance_features(
    image: NDArray[np.uint8], region: NDArray[np.bool_], kernel: AppearanceKernel
) -> Floats32:
    """float32 (5,N) of the region's pixels in units of the standard deviations: x, y, colours."""
    rows, columns = np.nonzero(region)
    widths = np.array([kernel.sigma_x_px, kernel.sigma_y_px, *kernel.sigma_colour], dtype=np.float32)
    features = np.empty((5, len(rows)), np.float32)
    features[0] = columns
    features[1] = rows
    features[2:] = image[rows, columns].T
    features /= widths[:, None]
    return features


def _lattice(features: Floats32) -> Filter:
    """Gaussian sum over the permutohedral lattice of ``features`` (d,N), up to a common factor."""
    keys, shares, strides = _corners(features)
    corners, pixels = keys.shape
    vertices, place = _numbered(keys.ravel())
    slice_ = csr_array(
        (
            np.ascontiguousarray(shares.T).ravel(),
            np.ascontiguousarray(place.reshape(corners, pixels).T.astype(np.int32)).ravel(),
            np.arange(0, corners * pixels + 1, corners, dtype=np.int32),
        ),
        shape=(pixels, len(vertices)),
    )
    splat = slice_.T.tocsr()
    steps = _blur_steps(vertices, strides)

    def summed(values: Floats32) -> Floats32:
        held = splat @ values
        for step in steps:
            held = step @ held
        return np.asarray(slice_ @ held, dtype=np.float32)

    return summed


def _corners(features: Floats32) -> tuple[NDArray[np.int64], Floats32, NDArray[np.int64]]:
    """Corners of each pixel's simplex: key int64 (d+1,N), share float32 (d+1,N), strides int64 (d,).

    A corner has integer coordinates ``(d+1) a_i + k`` that sum to zero, with the same remainder k in all of
    them; its key is ``k + (d+1) sum_i strides_i a_i`` over all coordinates but the last.
    """
    d = len(features)
    elevated = _elevation(d) @ features / np.float32(d + 1)
    nearest = np.rint(elevated)
    excess = nearest.sum(axis=0).astype(np.int8)
    gap = elevated - nearest
    rank = np.tile(excess, (d + 1, 1))
    for i in range(d + 1):
        for j in range(i + 1, d + 1):
            behind = gap[i] < gap[j]
            rank[i] += behind
            rank[j] += ~behind
    # Coordinates whose rank left 0..d belong to the neighbouring multiple of d+1.
    over = (rank < 0).astype(np.int8) - (rank > d).astype(np.int8)
    rank += over * np.int8(d + 1)
    nearest += over
    gap -= over
    columns = np.arange(features.shape[1])
    ordered = np.empty_like(gap)
    for i in range(d + 1):
        ordered[rank[i], columns] = gap[i]
    shares = np.empty_like(gap)
    shares[0] = 1.0 + ordered[d] - ordered[0]
    for k in range(1, d + 1):
        shares[k] = ordered[d - k] - ordered[d + 1 - k]
    base = nearest[:d].astype(np.int64)
    strides = _strides(base)
    keys = np.empty((d + 1, features.shape[1]), np.int64)
    keys[0] = strides @ base
    by_rank = np.zeros_like(keys)
    for i in range(d):
        by_rank[rank[i], columns] = strides[i]
    for k in range(1, d + 1):
        keys[k] = keys[k - 1] - by_rank[d + 1 - k]
    return keys * (d + 1) + np.arange(d + 1)[:, None], shares, strides


def _elevation(d: int) -> Floats32:
    """Embedding of features in the plane of zero sum, float32 (d+1,d); there the blur has unit variance."""
    E = np.zeros((d + 1, d))
    for j in range(1, d + 1):
        E[:j, j - 1] = 1.0
        E[j, j - 1] = -j
        E[:, j - 1] *= (d + 1) * np.sqrt(2.0 / 3.0) / np.sqrt(j * (j + 1))
    return E.astype(np.float32)


_HASH_FACTOR = np.int64(-7046029254386353131)
"""2^64 over the golden ratio (odd): Fibonacci hashing by the top bits of the product."""


def _numbered(keys: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """``np.unique(keys, return_inverse=True)``, several times faster where most keys occur often.

    All equal keys meet in one bucket; whoever was written there last stands for them if it is their equal.
    The few whose bucket was taken by another key are their own stand-ins, and only the stand-ins are sorted.
    """
    bits = min(22, max(8, len(keys).bit_length() + 1))
    bucket = (keys * _HASH_FACTOR).view(np.uint64) >> np.uint64(64 - bits)
    own = np.arange(len(keys), dtype=np.int32)
    taken = np.empty(1 << bits, dtype=np.int32)
    taken[bucket] = own
    stand_in = taken[bucket]
    stand_in = np.where(keys[stand_in] == keys, stand_in, own)
    chosen = np.flatnonzero(stand_in == own)
    unique, inverse = np.unique(keys[chosen], return_inverse=True)
    number = np.empty(len(keys), dtype=np.int64)
    number[chosen] = inverse
    return unique, number[stand_in]


_KEY_LIMIT = 2**62
"""Keys are signed 64 bit; a factor of two is left for the neighbours' steps."""


def _strides(base: NDArray[np.int64]) -> NDArray[np.int64]:
    """Mixed-radix strides (d,) that keep apart all ``base`` (d,N) and their neighbours."""
    # A corner lies at most one below its base, a neighbour at most one beside its corner.
    extents = [int(row.max()) - int(row.min()) + 5 for row in base]
    strides = [1]
    for extent in extents[:-1]:
        strides.append(strides[-1] * extent)
    if strides[-1] * extents[-1] * (len(base) + 1) >= _KEY_LIMIT:
        raise RigError(
            "appearance kernel of the CRF is too narrow for an image of this size",
            hint="use widths of some px and some grey levels",
        )
    return np.array(strides, dtype=np.int64)


def _blur_steps(vertices: NDArray[np.int64], strides: NDArray[np.int64]) -> list[csr_array]:
    """One matrix (M,M) per lattice direction: half of oneself, a quarter of the vertex at each side."""
    d, count = len(strides), len(vertices)
    remainder = vertices % (d + 1)
    # One step adds 1 to every coordinate and takes d+1 from one of them; remainder d carries into every
    # coordinate.
    plus_one = np.where(remainder == d, (d + 1) * int(strides.sum()) - d, 1)
    steps = []
    for stride in [*strides.tolist(), 0]:
        wanted = vertices + plus_one - (d + 1) * stride
        there = np.minimum(np.searchsorted(vertices, wanted), count - 1)
        found = vertices[there] == wanted
        steps.append(_blur_matrix(there, found))
    return steps


def _blur_matrix(there: NDArray[np.int64], found: NDArray[np.bool_]) -> csr_array:
    """I/2 + S/4 + S^T/4, where S takes vertex i from vertex ``there[i]`` if ``found[i]``."""
    count = len(there)
    own = np.arange(count, dtype=np.int32)
    columns = np.repeat(own[:, None], 3, axis=1)
    values = np.zeros((count, 3), dtype=np.float32)
    values[:, 0] = 0.5
    columns[:, 1] = there
    values[:, 1] = np.float32(0.25) * found
    ahead = there[found]
    columns[ahead, 2] = own[found]
    values[ahead, 2] = 0.25
    ends = np.arange(0, 3 * count + 1, 3, dtype=np.int32)
    return csr_array((values.ravel(), columns.ravel(), ends), shape=(count, count))


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
