"""Seeded noise that repeats without a seam, sampled by the nearest cell."""

from dataclasses import dataclass

import numpy as np

from pipeline.records import read_only
from pipeline.simulation.surface import F32

SIZE = 512
"""Cells per side, a power of two."""


@dataclass(frozen=True, slots=True, eq=False)
class Textures:
    """Noise tables.

    Attributes:
        rough: float32 (SIZE,SIZE), power falling with frequency, mean 0, deviation 1, in +-2.5: soft patches.
        fine: As ``rough``, but nearly white: grain.
        grain: float32 (SIZE,SIZE), ranks of a noise, uniform in 0..1: where leaves are.
    """

    rough: F32
    fine: F32
    grain: F32

    def __post_init__(self) -> None:
        for name in ("rough", "fine", "grain"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


def draw_textures(rng: np.random.Generator) -> Textures:
    """Draws the tables."""
    rough, fine, leaves = _noise(rng, 1.3), _noise(rng, 0.25), _noise(rng, 0.7)
    rank = np.argsort(np.argsort(leaves, axis=None)).reshape(leaves.shape)
    return Textures(rough, fine, (rank / leaves.size).astype(np.float32))


def _noise(rng: np.random.Generator, exponent: float) -> F32:
    """Noise whose amplitude falls with frequency as ``f^-exponent``."""
    f = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None, :]) * SIZE
    f[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.normal(size=(SIZE, SIZE))) / f**exponent
    values = np.fft.irfft2(spectrum, (SIZE, SIZE))
    values = np.clip(values / values.std(), -2.5, 2.5)
    return np.asarray(values, dtype=np.float32)


def sample(table: F32, u: F32, v: F32, cells_per_unit: float) -> F32:
    """Values of a table at coordinates (N,), with so many cells in a unit."""
    k = np.float32(cells_per_unit)
    i = np.floor(u * k).astype(np.int32) & (SIZE - 1)
    j = np.floor(v * k).astype(np.int32) & (SIZE - 1)
    return np.asarray(table[i, j], dtype=np.float32)


def smooth(table: F32, u: F32, v: F32, cells_per_unit: float) -> F32:
    """Values of a table at coordinates (N,), even between the cells."""
    x, y = u * np.float32(cells_per_unit), v * np.float32(cells_per_unit)
    i, j = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
    a, b = x - i, y - j
    last = SIZE - 1
    low = table[i & last, j & last] * (1 - b) + table[i & last, (j + 1) & last] * b
    high = table[(i + 1) & last, j & last] * (1 - b) + table[(i + 1) & last, (j + 1) & last] * b
    return np.asarray(low * (1 - a) + high * a, dtype=np.float32)
