import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from monitor.messages.point_fields import cloud_of, seconds_after, unit_intensity

STAMP_NS = 1_600_000_000_123_456_789
SWEEP = np.linspace(0, 0.1, 1001)
NUMBERS = (
    hnp.integer_dtypes(endianness="?") | hnp.unsigned_integer_dtypes(endianness="?") | hnp.floating_dtypes()
)


@pytest.mark.parametrize(
    ("values", "scale"),
    [
        pytest.param(np.arange(256, dtype=np.uint8), 255, id="uint8"),
        pytest.param(np.arange(101, dtype=np.uint8), 255, id="uint8 that never gets bright"),
        pytest.param(np.arange(256, dtype=np.uint16), 255, id="uint16 of 8 bits"),
        pytest.param(np.arange(256, dtype=">i4"), 255, id="big endian int32 of 8 bits"),
        pytest.param(np.arange(256, dtype=np.float32), 255, id="float of 8 bits"),
        pytest.param(np.arange(100, dtype=np.float32) / 100, 1, id="kitti, 0.00 to 0.99"),
        pytest.param(np.linspace(0, 1, 100), 1, id="float64, 0 to 1"),
        pytest.param(np.zeros(100, np.float32), 1, id="all dark"),
        pytest.param(np.array([0, 1, 1], np.uint16), 255, id="integers 0 and 1 are no full scale"),
    ],
)
def test_nominal_scales_are_kept(values, scale):
    assert unit_intensity(values) == pytest.approx(values.astype(float) / scale, abs=1e-6)


@pytest.mark.parametrize("dtype", [np.uint16, np.uint32, np.float32, np.float64])
def test_signal_counts_are_scaled_by_their_high_quantile(dtype):
    counts = np.arange(10_000).astype(dtype)
    found = unit_intensity(counts)
    assert found.max() == 1
    assert found[5000] == pytest.approx(0.5, abs=0.01)
    assert (np.diff(found) >= 0).all()


@pytest.mark.parametrize(("usual", "bright", "many"), [(0.5, 3000, 50), (100, 60_000, 5)])
def test_retroreflectors_do_not_change_the_scale(usual, bright, many):
    values = np.full(10_000, usual, np.float32)
    values[:many] = bright
    found = unit_intensity(values)
    assert found[many:] == pytest.approx(usual if usual <= 1 else usual / 255)
    assert found[:many] == pytest.approx(1)


def test_intensities_that_are_not_finite_or_negative_count_as_dark():
    values = np.array([np.nan, np.inf, -np.inf, -1, 0.5], np.float32)
    assert unit_intensity(values).tolist() == [0, 0, 0, 0, 0.5]


@given(hnp.arrays(NUMBERS, st.integers(0, 30)))
def test_any_intensities_end_within_0_and_1(values):
    found = unit_intensity(values)
    assert found.dtype == np.float32
    assert ((found >= 0) & (found <= 1)).all()


@pytest.mark.parametrize(
    "values",
    [
        pytest.param(SWEEP.astype(np.float32), id="float32 s"),
        pytest.param(SWEEP, id="float64 s"),
        pytest.param((SWEEP * 1e9).astype(np.uint32), id="uint32 ns"),
        pytest.param((SWEEP * 1e9).astype(">i4"), id="big endian int32 ns"),
        pytest.param((SWEEP * 1e3).astype(np.float32), id="float32 ms"),
        pytest.param((SWEEP * 1e6).astype(np.float32), id="float32 us"),
        pytest.param((SWEEP * 1e9).astype(np.float32), id="float32 ns"),
        pytest.param(STAMP_NS * 1e-9 + SWEEP, id="float64 s since 1970"),
        pytest.param(STAMP_NS + SWEEP * 1e9, id="float64 ns since 1970"),
        pytest.param(STAMP_NS + (SWEEP * 1e9).astype(np.uint64), id="uint64 ns since 1970"),
        pytest.param(STAMP_NS + (SWEEP * 1e9).astype(np.int64), id="int64 ns since 1970"),
        pytest.param(STAMP_NS // 1000 + (SWEEP * 1e6).astype(np.int64), id="int64 us since 1970"),
        pytest.param(37.0 + STAMP_NS * 1e-9 + SWEEP, id="float64 s of another clock, 37 s ahead"),
        pytest.param(5000.0 + SWEEP, id="float64 s of uptime"),
        pytest.param(5_000_000_000_000 + (SWEEP * 1e9).astype(np.uint64), id="uint64 ns of uptime"),
    ],
)
def test_times_of_every_convention_are_seconds_after_the_stamp(values):
    order = np.random.default_rng(1).permutation(len(values))  # nothing says that points come in time order
    assert seconds_after(values[order], STAMP_NS) == pytest.approx(SWEEP[order], abs=2e-6)


def test_times_before_the_stamp_are_negative():
    assert seconds_after(-SWEEP.astype(np.float32), STAMP_NS) == pytest.approx(-SWEEP, abs=1e-7)
    late = STAMP_NS * 1e-9 - 0.1 + SWEEP
    assert seconds_after(late, STAMP_NS) == pytest.approx(SWEEP - 0.1, abs=2e-6)


@pytest.mark.parametrize(
    "values",
    [
        pytest.param(np.zeros(5, np.float32), id="filler"),
        pytest.param(np.array([0, np.nan]), id="nan"),
        pytest.param(np.array([0, 1e30]), id="longer than a sweep in any unit"),
        pytest.param(np.array([0, 3_000_000_000], np.uint32), id="3 s in ns"),
        pytest.param((STAMP_NS * 1e-9 + np.array([0, 100, 200])).astype(np.float32), id="float32 since 1970"),
        pytest.param(np.array([-(2**63), 2**63 - 1]), id="the whole range of int64"),
        pytest.param(np.array([0, 2**64 - 1], np.uint64), id="the whole range of uint64"),
        pytest.param(np.array([-1.7e308, 1.7e308]), id="the whole range of float64"),
    ],
)
def test_times_that_tell_nothing_are_none(values):
    assert seconds_after(values, STAMP_NS) is None


@given(hnp.arrays(NUMBERS, st.integers(0, 10)), st.integers(0, 2**63))
def test_any_times_end_near_the_stamp_or_as_none(values, stamp_ns):
    found = seconds_after(values, stamp_ns)
    assert found is None or (found.dtype == np.float32 and (np.abs(found) <= 4.1).all())


def columns(**more):
    count = len(next(iter(more.values())))
    return {axis: np.ones(count, np.float32) for axis in "xyz"} | more


@pytest.mark.parametrize("name", ["ring", "channel", "laser_id", "line"])
@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2", "<i4", "<f4", "<f8"])
def test_rings_under_their_usual_names(name, dtype):
    assert cloud_of(columns(**{name: np.array([3, 0, 127], dtype)}), 0).ring.tolist() == [3, 0, 127]


@pytest.mark.parametrize("values", [[-1, 3], [0.5, 1], [70000, 1], [np.nan, 1], [np.inf, 1]])
def test_rings_that_are_no_indices_are_left_out(values):
    assert cloud_of(columns(ring=np.array(values, np.float64)), 0).ring is None


@pytest.mark.parametrize("name", ["intensity", "i", "reflectivity", "reflectance"])
def test_intensity_under_its_usual_names(name):
    assert cloud_of(columns(**{name: np.array([0, 0.5], np.float32)}), 0).intensity.tolist() == [0, 0.5]


def test_intensity_comes_before_reflectivity():
    cloud = cloud_of(columns(reflectivity=np.array([9], np.uint8), intensity=np.array([0.5], np.float32)), 0)
    assert cloud.intensity.tolist() == [0.5]


@pytest.mark.parametrize("name", ["t", "time", "timestamp", "offset_time", "time_stamp"])
def test_time_under_its_usual_names(name):
    assert cloud_of(columns(**{name: np.array([0, 0.5], np.float32)}), 0).time.tolist() == [0, 0.5]
