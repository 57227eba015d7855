"""Gaussian sums over points of several dimensions: the permutohedral lattice (Adams, Baek and Davis 2010).

Each point hands its value to the d + 1 corners of the simplex it lies in (splat), the corners are blurred
along d + 1 directions, and each point reads its corners again (slice). In units of d + 1, a corner has
coordinates ``a_i + k / (d + 1)``, ``a_i`` and ``0 <= k <= d`` integers, that sum to zero; its key is
``k + (d + 1) sum_i strides_i a_i`` over all coordinates but the last.
"""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from pipeline.errors import RigError

Floats32: TypeAlias = NDArray[np.float32]
Ints64: TypeAlias = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """The lattice of N points.

    Attributes:
        shares: Sparse float32 (N,M): share of each point at each of the M corners that any point touches;
            d + 1 a point, rows sum to one.
        beside: int32 (d+1,2,M): each corner's neighbours along each direction, M where there is none.
    """

    shares: csr_array
    beside: NDArray[np.int32]

    def blurred(self, held: Floats32) -> Floats32:
        """Half of oneself, a quarter of each neighbour, along all directions: float32 (M,) -> (M,)."""
        padded = np.append(held, np.float32(0.0))
        for ahead, behind in self.beside:
            near = padded[ahead]
            near += padded[behind]
            near *= np.float32(0.25)
            padded[:-1] *= np.float32(0.5)
            padded[:-1] += near
        return padded[:-1]


def lattice(features: Floats32) -> Lattice:
    """The lattice of points.

    Args:
        features: float32 (d,N), finite, N > 0, in units of the Gaussian's standard deviations.

    Returns:
        The lattice; ``shares @ blurred(shares.T @ values)`` sums ``exp(-|f_i - f_j|^2 / 2)`` over all points,
        up to a common factor.

    Raises:
        RigError: The points lie too far apart for keys of 64 bit.
    """
    corners = len(features) + 1
    keys, shares, strides = _corners(features)
    vertices, place = _numbered(keys.ravel())
    matrix = csr_array(
        (shares.ravel(), place, np.arange(0, len(place) + 1, corners, dtype=np.int32)),
        shape=(len(keys), len(vertices)),
    )
    return Lattice(matrix, _neighbours(vertices, strides))


_CHUNK = 16384
"""Points at a time: their rows fit into a processor's cache."""

_FRACTION_BITS = 27
"""Gaps, at most a half, become integers of this many fraction bits; float32 carries 24."""


def _corners(features: Floats32) -> tuple[Ints64, Floats32, Ints64]:
    """Corners of each point's simplex: key int64 (N,d+1), share float32 (N,d+1), strides int64 (d,).

    With the gaps ``g_0 >= ... >= g_d`` from the nearest integers, corner p has ``a_i`` one below the nearest
    integer for all coordinates from place p on, and the share ``g_{p-1} - g_p``, or ``1 + g_d - g_0`` for
    p = 0.
    """
    d, count = features.shape
    embedding = (_elevation(d) / (d + 1)).astype(np.float32)
    strides = _strides(embedding, features)
    keys = np.empty((count, d + 1), np.int64)
    shares = np.empty((count, d + 1), np.float32)
    for begin in range(0, count, _CHUNK):
        part = slice(begin, begin + _CHUNK)
        _corners_of(np.asarray(embedding @ features[:, part], np.float32), strides, keys[part], shares[part])
    return keys, shares, strides


def _corners_of(elevated: Floats32, strides: Ints64, keys: Ints64, shares: Floats32) -> None:
    """Writes keys and shares (n,d+1) of points (d+1,n) in the plane of zero sum."""
    corners = len(elevated)
    index_bits = (corners - 1).bit_length()
    nearest = np.rint(elevated)
    gaps = ((elevated - nearest) * np.float32(1 << _FRACTION_BITS)).astype(np.int32)
    # The coordinate's number rides in the lowest bits, so that sorting values sorts coordinates too; of equal
    # ones the first comes first, as in the implementation that the recorded marginals stem from.
    gaps = ((gaps >> index_bits) << index_bits) | np.arange(corners, dtype=np.int32)[::-1, None]
    _sort_falling(gaps)
    weight = np.append(strides, 0) * corners
    steps = weight[corners - 1 - (gaps & ((1 << index_bits) - 1))]
    gaps >>= index_bits
    unit = np.float32(2.0 ** (index_bits - _FRACTION_BITS))
    shares[:, 1:] = ((gaps[:-1] - gaps[1:]) * unit).T
    shares[:, 0] = 1.0 - (gaps[0] - gaps[-1]) * unit
    # k = d + 1 - p - sum of the nearest; where it leaves 0..d, all a_i move by one instead.
    total = nearest.sum(axis=0).astype(np.int64)
    key = weight[:-1] @ nearest[:-1].astype(np.int64) - weight.sum()
    for p in range(corners):
        k = corners - p - total
        turns = k // corners
        keys[:, p] = key + k + turns * (int(weight.sum()) - corners)
        key += steps[p]


def _sort_falling(rows: NDArray[np.int32]) -> None:
    """Sorts each column of (m,n) in place, largest first: odd-even transposition, m rounds."""
    for turn in range(len(rows)):
        for i in range(turn % 2, len(rows) - 1, 2):
            above = np.maximum(rows[i], rows[i + 1])
            np.minimum(rows[i], rows[i + 1], out=rows[i + 1])
            rows[i] = above


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


def _numbered(keys: Ints64) -> tuple[Ints64, NDArray[np.int32]]:
    """``np.unique(keys, return_inverse=True)``, several times faster where most keys occur often.

    All equal keys meet in one bucket; whoever was written there last stands for them if it is their equal.
    The few whose bucket was taken by another key are their own stand-ins, and only the stand-ins are sorted.
    """
    bits = min(22, max(8, len(keys).bit_length() + 1))
    bucket = _bucket(keys, bits)
    own = np.arange(len(keys), dtype=np.int32)
    taken = np.empty(1 << bits, dtype=np.int32)
    taken[bucket] = own
    stand_in = taken[bucket]
    stand_in = np.where(keys[stand_in] == keys, stand_in, own)
    chosen = np.flatnonzero(stand_in == own)
    unique, inverse = np.unique(keys[chosen], return_inverse=True)
    number = np.empty(len(keys), dtype=np.int32)
    number[chosen] = inverse
    return unique, number[stand_in]


_KEY_LIMIT = 2**62
"""Keys are signed 64 bit; a factor of two is left for the neighbours' steps."""


def _strides(embedding: Floats32, features: Floats32) -> Ints64:
    """Mixed-radix strides (d,) that keep apart the corners of all features (d,N) and their neighbours."""
    # By the features' ranges: no pass over the elevated points.
    low, high = features.min(axis=1), features.max(axis=1)
    spans = (np.abs(embedding) @ (high - low).astype(np.float64))[:-1]
    # Rounding, a corner one below its base and a neighbour one beside its corner.
    extents = [int(np.ceil(span)) + 6 for span in spans.tolist()]
    strides = [1]
    for extent in extents[:-1]:
        strides.append(strides[-1] * extent)
    if strides[-1] * extents[-1] * (len(extents) + 1) >= _KEY_LIMIT:
        raise RigError(
            "appearance kernel of the CRF is too narrow for an image of this size",
            hint="use widths of some px and some grey levels",
        )
    return np.array(strides, dtype=np.int64)


def _neighbours(vertices: Ints64, strides: Ints64) -> NDArray[np.int32]:
    """Number of each vertex's neighbours along each direction, int32 (d+1,2,M), M where there is none."""
    d, count = len(strides), len(vertices)
    # One step adds 1 to every coordinate and takes d+1 from one of them; remainder d carries into every
    # coordinate.
    plus_one = np.where(vertices % (d + 1) == d, (d + 1) * int(strides.sum()) - d, 1) + vertices
    own = np.arange(count, dtype=np.int32)
    number = _Numbers(vertices)
    beside = np.full((d + 1, 2, count + 1), count, dtype=np.int32)
    for (ahead, behind), stride in zip(beside, [*strides.tolist(), 0], strict=True):
        ahead[:-1] = number.of(plus_one - (d + 1) * stride)
        behind[ahead[:-1]] = own
    return beside[:, :, :-1]


class _Numbers:
    """Places of keys in a sorted array without repetition."""

    def __init__(self, keys: Ints64) -> None:
        self._keys = np.append(keys, np.iinfo(np.int64).max)
        self._bits = len(keys).bit_length() + 2
        self._taken = np.full(1 << self._bits, len(keys), dtype=np.int32)
        bucket = _bucket(keys, self._bits)
        own = np.arange(len(keys), dtype=np.int32)
        self._taken[bucket] = own
        # Keys that share a bucket with a later one are looked for among themselves.
        self._hidden = own[self._taken[bucket] != own]

    def of(self, wanted: Ints64) -> NDArray[np.int32]:
        """Place of each key, or the number of all keys where it is not among them."""
        found = self._taken[_bucket(wanted, self._bits)]
        absent = np.flatnonzero(self._keys[found] != wanted)
        found[absent] = len(self._keys) - 1
        if len(self._hidden):
            place = self._hidden[
                np.minimum(np.searchsorted(self._keys[self._hidden], wanted[absent]), len(self._hidden) - 1)
            ]
            here = self._keys[place] == wanted[absent]
            found[absent[here]] = place[here]
        return found


def _bucket(keys: Ints64, bits: int) -> NDArray[np.uint64]:
    return (keys * _HASH_FACTOR).view(np.uint64) >> np.uint64(64 - bits)
