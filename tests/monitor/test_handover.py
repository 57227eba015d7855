"""Values handed to another process: the same on arrival, and small where the other side has them."""

import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from monitor.handover import give, link, receive, share
from monitor.model_file import model_bytes
from pipeline.records import PointCloud
from pipeline.segmentation import Segmenter


def handed(value, known=None, there=None):
    ours, theirs = link()
    with ours, theirs:
        give(ours, value, known or {})
        return receive(theirs, known if there is None else there)


@given(
    st.lists(
        arrays.arrays(
            st.sampled_from([np.float64, np.float32, np.uint16, np.bool_]),
            st.tuples(st.integers(0, 5), st.integers(0, 5)),
        ),
        max_size=4,
    )
)
def test_small_arrays_arrive(values):
    found = handed(values)
    for a, b in zip(values, found, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("order", ["C", "F", "strided"])
def test_large_arrays_arrive(order):
    rng = np.random.default_rng(1)
    value = rng.normal(size=(70_001, 6))
    value = value[::2, 1:4] if order == "strided" else np.asarray(value, order=order)
    first, text, second = handed((value, "between", value[:7]))
    np.testing.assert_array_equal(first, value)
    np.testing.assert_array_equal(second, value[:7])
    assert text == "between"


def test_what_is_shared_lies_in_the_memory_of_both_once():
    rng = np.random.default_rng(4)
    large, small = rng.normal(size=(70_001, 6)), rng.normal(size=7)
    ours, theirs = link()
    with ours, theirs:
        kept = share(ours, {"large": large, "small": small}, {})
        found = receive(theirs, {})
    for one in (kept, found):
        np.testing.assert_array_equal(one["large"], large)
        np.testing.assert_array_equal(one["small"], small)
    assert not np.shares_memory(kept["large"], large)
    # The same page of the same file under both addresses.
    places = [open_file_at(one["large"].__array_interface__["data"][0]) for one in (kept, found)]
    assert places[0] == places[1]


def open_file_at(address):
    """Inode of the file in memory that is mapped at an address, and the offset there."""
    for line in Path("/proc/self/maps").read_text().splitlines():
        span, _, offset, _, inode, *_ = line.split()
        begin, end = (int(text, 16) for text in span.split("-"))
        if begin <= address < end:
            assert int(inode) > 0
            return inode, int(offset, 16) + address - begin
    raise AssertionError("mapped nowhere")


def test_what_the_other_side_has_is_named():
    xyz = np.random.default_rng(2).normal(size=(100_000, 3)).astype(np.float32)
    cloud = PointCloud(xyz)
    own = PointCloud(xyz.copy())
    # Another view of the same data is the same; a part of it is not.
    again, part = handed(
        (PointCloud(cloud.xyz), cloud.xyz[1:]), {"xyz": cloud.xyz, "none": None}, {"xyz": own.xyz}
    )
    assert np.shares_memory(again.xyz, own.xyz)
    assert not np.shares_memory(part, own.xyz)
    np.testing.assert_array_equal(part, xyz[1:])


@dataclass(frozen=True, slots=True, eq=False)
class Frozen:
    values: np.ndarray


def test_records_arrive():
    found = handed(Frozen(np.arange(3)))
    assert found.values.tolist() == [0, 1, 2]


def test_nobody_there_is_told():
    ours, theirs = link()
    theirs.close()
    with ours, pytest.raises(BrokenPipeError):
        give(ours, 1, {})
    ours, theirs = link()
    waiting = threading.Timer(0.0, ours.close)
    waiting.start()
    with theirs, pytest.raises(EOFError):
        receive(theirs, {})
    waiting.join()


def test_a_segmenter_travels_as_its_model():
    image = np.random.default_rng(3).integers(0, 255, (96, 128, 3), dtype=np.uint8)
    first = Segmenter(model_bytes(None), threads=1)
    again = handed(first)
    assert again.info == first.info
    np.testing.assert_array_equal(again.probabilities(image), first.probabilities(image))
