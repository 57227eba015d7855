import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import strips
from pipeline.strips import StripShape, strips_about

SHAPE = StripShape(rise=0.08, asymmetry=0.35, narrowest_m=0.05, widest_m=0.8, background_m=0.6)
REACH = SHAPE.widest_m + SHAPE.background_m


def line(seed, points=220):
    """A road of noise with paint of all widths, and the windows of its peaks; some end at a gap."""
    rng = np.random.default_rng(seed)
    along = np.cumsum(rng.uniform(0.01, 0.08, points))
    intensity = rng.normal(0.2, 0.01, points)
    for begin in rng.integers(0, points - 12, 8):
        intensity[begin : begin + rng.integers(1, 12)] += rng.uniform(0.1, 0.5)
    inner = intensity[1:-1]
    peak = np.flatnonzero((inner > intensity[:-2]) & (inner > intensity[2:]) & (inner > 0.28)) + 1
    gap = points // 2
    first = np.maximum(np.where(peak >= gap, gap, 0), np.searchsorted(along, along[peak] - REACH))
    last = np.minimum(np.where(peak >= gap, points, gap), np.searchsorted(along, along[peak] + REACH))
    return along, intensity, peak, first, last


def by_hand(along, intensity, p, a, b):
    """One strip, point by point: walk from the peak to the half level on both sides."""
    level = intensity[p]
    far = [k for k in range(a, b) if abs(along[k] - along[p]) > SHAPE.widest_m / 2]
    if not far:
        return None
    half = 0.5 * (level + np.median(intensity[far]))
    i = next((k for k in range(p - 1, a - 1, -1) if intensity[k] < half), None)
    j = next((k for k in range(p + 1, b) if intensity[k] < half), None)
    if i is None or j is None or along[j - 1] - along[i + 1] > SHAPE.widest_m:
        return None
    sides = []
    for low, high in (
        (along[i + 1] - SHAPE.background_m, along[i + 1]),
        (along[j - 1], along[j - 1] + SHAPE.background_m),
    ):
        road = [intensity[k] for k in range(a, b) if low < along[k] < high]
        if len(road) < 2:
            return None
        sides.append(np.mean(road))
    rise = level - np.mean(sides)
    if rise < SHAPE.rise or abs(sides[0] - sides[1]) > SHAPE.asymmetry * rise:
        return None
    borders = []
    for k, side in ((i, sides[0]), (j - 1, sides[1])):
        step = intensity[k + 1] - intensity[k]
        borders.append(k + np.clip((0.5 * (level + side) - intensity[k]) / step, 0, 1))
    left, right = (np.interp(border, np.arange(len(along)), along) for border in borders)
    return None if right - left < SHAPE.narrowest_m else (j, *borders)


@settings(max_examples=80, deadline=None)
@given(st.integers(0, 100_000))
def test_strips_are_those_found_by_hand(seed):
    along, intensity, *windows = line(seed)
    found = {int(peak): strip for peak, *strip in strips_about(along, intensity, tuple(windows), SHAPE)}
    for p, a, b in zip(*windows, strict=True):
        expected = by_hand(along, intensity, p, a, b)
        assert (expected is None) == (int(p) not in found)
        if expected is not None:
            assert found[int(p)] == pytest.approx(expected, abs=1e-9)


def test_peaks_weighed_in_blocks_are_weighed_alike(monkeypatch):
    along, intensity, *windows = line(1)
    whole = strips_about(along, intensity, tuple(windows), SHAPE)
    monkeypatch.setattr(strips, "_TABLE", 100)
    assert strips_about(along, intensity, tuple(windows), SHAPE) == whole


def test_points_without_number_on_a_short_way_cost_little():
    along = np.linspace(0.0, 1.0, 60_000)
    intensity = np.random.default_rng(0).uniform(0.1, 0.9, 60_000)
    peak = np.arange(5, 60_000, 12)
    window = (peak, np.zeros_like(peak), np.full_like(peak, 60_000))
    tracemalloc.start()
    assert strips_about(along, intensity, window, SHAPE) == []
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 50e6


def test_there_are_strips_to_compare():
    along, intensity, *windows = line(1)
    assert len(strips_about(along, intensity, tuple(windows), SHAPE)) >= 3


def test_a_peak_with_no_road_beside_it_is_no_strip():
    along, intensity = np.linspace(0.0, 0.3, 7), np.array([0.2, 0.2, 0.2, 0.9, 0.2, 0.2, 0.2])
    window = (np.array([3]), np.array([0]), np.array([7]))
    assert strips_about(along, intensity, window, SHAPE) == []


def test_no_peak_no_strip():
    none = np.zeros(0, dtype=np.int64)
    assert strips_about(np.zeros(0), np.zeros(0), (none, none, none), SHAPE) == []
