"""Pairing against brute force: every pair and every drop reason of small random streams."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.rig import parse_rig
from monitor.sync import (
    DROP_REASONS,
    JUMP_NS,
    WAITING_FRAMES,
    SequencePairing,
    StampPairing,
    middle_ns,
    pairer_for,
)
from pipeline.records import PointCloud

MS = 1_000_000


def nearest(stamp, others):
    return min(others, key=lambda other: (abs(other - stamp), other), default=None)


def by_brute_force(lidar, camera, limit):
    """Pairs and drop reasons by the definition alone, from the whole streams."""
    pairs = [
        (a, b)
        for a, b in itertools.product(lidar, camera)
        if nearest(a, camera) == b and nearest(b, lidar) == a and abs(a - b) <= limit
    ]
    reasons = {}
    for side, own, others in (("lidar", lidar, camera), ("camera", camera, lidar)):
        for stamp in own:
            if any(stamp == pair[side == "camera"] for pair in pairs):
                continue
            partner = nearest(stamp, others)
            far = partner is not None and abs(partner - stamp) > limit
            key = (side, "gap_too_large" if far else "no_partner")
            reasons[key] = reasons.get(key, 0) + 1
    return pairs, reasons


def feed(pairing, arrivals):
    found = []
    for side, stamp in arrivals:
        push = pairing.push_lidar if side == "lidar" else pairing.push_camera
        found += push(stamp, (side, stamp))
    return found + pairing.flush()


def merged(lidar, camera, rng):
    """Arrivals that keep the order within each sensor and mix the sensors at random."""
    sides = ["lidar"] * len(lidar) + ["camera"] * len(camera)
    rng.shuffle(sides)
    streams = {"lidar": iter(lidar), "camera": iter(camera)}
    return [(side, next(streams[side])) for side in sides]


stamps = st.sets(st.integers(0, 60), max_size=14).map(sorted)


@settings(max_examples=400, deadline=None)
@given(stamps, stamps, st.integers(0, 12), st.randoms(use_true_random=False))
def test_pairs_and_reasons_are_those_of_the_definition(lidar, camera, limit, rng):
    pairing = StampPairing(limit)
    found = feed(pairing, merged(lidar, camera, rng))
    pairs, reasons = by_brute_force(lidar, camera, limit)
    assert sorted((pair.lidar_ns, pair.camera_ns) for pair in found) == pairs
    assert {key: n for key, n in pairing.dropped.items() if n} == reasons
    assert all(pair.lidar == ("lidar", pair.lidar_ns) for pair in found)
    assert all(pair.camera == ("camera", pair.camera_ns) for pair in found)


anything = st.lists(
    st.tuples(
        st.sampled_from(["lidar", "camera"]),
        st.one_of(st.integers(0, 500), st.integers(0, 20).map(lambda i: i * JUMP_NS)),
    ),
    max_size=60,
)


@settings(max_examples=200, deadline=None)
@given(anything, st.integers(1, 4))
def test_every_frame_is_paired_once_or_dropped_with_a_known_reason(arrivals, waiting):
    pairing = StampPairing(30, waiting=waiting)
    found = feed(pairing, arrivals)
    for side in ("lidar", "camera"):
        dropped = sum(n for (owner, _), n in pairing.dropped.items() if owner == side)
        assert pairing.received[side] == len(found) + dropped
    assert {reason for _, reason in pairing.dropped} <= set(DROP_REASONS)
    assert all(abs(pair.lidar_ns - pair.camera_ns) <= 30 for pair in found)


def test_a_pair_is_given_when_the_next_frame_of_the_same_sensor_shows_that_it_stands():
    pairing = StampPairing(50 * MS)
    assert pairing.push_lidar(0, "cloud 0") == []
    assert pairing.push_camera(10 * MS, "image 0") == []
    (pair,) = pairing.push_lidar(100 * MS, "cloud 1")
    assert (pair.lidar, pair.camera) == ("cloud 0", "image 0")


def test_equal_stamps_are_paired_at_once():
    pairing = StampPairing(0)
    pairing.push_lidar(5, "cloud")
    assert len(pairing.push_camera(5, "image")) == 1


def test_a_partner_never_serves_twice():
    pairing = StampPairing(50 * MS)
    found = feed(pairing, [("lidar", 0), ("camera", 10), ("lidar", 20), ("lidar", 30)])
    assert len(found) == 1
    assert pairing.dropped["lidar", "no_partner"] == 2


def test_a_stamp_that_runs_back_a_little_is_refused_and_the_stream_goes_on():
    pairing = StampPairing(10 * MS)
    found = feed(
        pairing,
        [
            ("lidar", 100 * MS),
            ("lidar", 90 * MS),
            ("camera", 100 * MS),
            ("lidar", 200 * MS),
            ("camera", 200 * MS),
        ],
    )
    assert [pair.lidar_ns for pair in found] == [100 * MS, 200 * MS]
    assert pairing.dropped["lidar", "stamp_backwards"] == 1
    assert pairing.clock_jumps == 0


def test_a_recording_that_starts_again_is_paired_anew():
    lap = [(side, i * 100 * MS) for i in range(40) for side in ("lidar", "camera")]
    pairing = StampPairing(10 * MS)
    found = feed(pairing, lap + lap)
    assert pairing.clock_jumps == 2
    assert len(found) == 80


def test_one_wild_stamp_costs_no_more_than_the_frames_around_it():
    arrivals = [(side, i * 100 * MS) for i in range(50) for side in ("lidar", "camera")]
    arrivals[40] = ("lidar", 3600 * 1000 * MS)
    pairing = StampPairing(10 * MS)
    found = feed(pairing, arrivals)
    assert pairing.clock_jumps == 2
    assert len(found) >= 47


def test_clocks_an_hour_apart_pair_nothing_and_the_offset_is_told():
    hour = 3_600_000 * MS
    pairing = StampPairing(50 * MS)
    arrivals = [
        frame
        for i in range(200)
        for frame in (("lidar", i * 100 * MS), ("camera", hour + i * 100 * MS + 7 * MS))
    ]
    assert feed(pairing, arrivals) == []
    assert pairing.offset_ns is not None
    assert abs(pairing.offset_ns - hour) <= 100 * MS
    assert pairing.dropped.total() == 400
    assert pairing.dropped["lidar", "gap_too_large"] > 100


def test_a_silent_sensor_fills_no_memory():
    pairing = StampPairing(50 * MS)
    for i in range(1000):
        assert pairing.push_camera(i * 33 * MS, i) == []
    assert pairing.dropped["camera", "queue_overflow"] == 1000 - WAITING_FRAMES


def test_no_offset_before_both_sensors_came():
    pairing = StampPairing(1)
    pairing.push_camera(5, None)
    assert pairing.offset_ns is None


def test_sequence_numbers_pair_whatever_the_stamps_say():
    pairing = SequencePairing()
    order = [("lidar", n) for n in range(10)] + [("camera", n) for n in range(10)]
    order = [order[i] for i in np.random.default_rng(3).permutation(len(order))]
    found = []
    for side, n in order:
        push = pairing.push_lidar if side == "lidar" else pairing.push_camera
        found += push(1000 * MS * (n if side == "lidar" else -n), n, n)
    assert sorted((pair.lidar, pair.camera) for pair in found) == [(n, n) for n in range(10)]
    assert pairing.flush() == []
    assert pairing.dropped.total() == 0


def test_sequence_numbers_without_partner_are_counted():
    pairing = SequencePairing(waiting=2)
    pairing.push_lidar(0, "a", None)
    for n in range(4):
        pairing.push_camera(n, n, n)
    pairing.push_camera(9, "again", 3)
    pairing.flush()
    assert pairing.dropped == {
        ("lidar", "no_partner"): 1,
        ("camera", "queue_overflow"): 2,
        ("camera", "no_partner"): 3,
    }


@pytest.mark.parametrize(("convention", "expected"), [("start", 150), ("middle", 100), ("end", 50)])
def test_the_middle_of_a_sweep_of_known_duration(convention, expected):
    cloud = PointCloud(np.zeros((2, 3), np.float32))
    assert middle_ns(100 * MS, cloud, 0.1, convention) == expected * MS


def test_times_per_point_win_over_the_duration_and_the_convention():
    cloud = PointCloud(np.zeros((3, 3), np.float32), time=np.array([-0.05, 0.0, 0.03], np.float32))
    assert middle_ns(100 * MS, cloud, 0.1, "start") == pytest.approx(90 * MS, abs=10)


def test_a_sweep_of_unknown_duration_is_compared_by_its_stamp():
    assert middle_ns(7, PointCloud(np.zeros((0, 3), np.float32)), None) == 7


def test_the_rig_chooses_the_way_of_pairing():
    def of(pairing):
        return pairer_for(parse_rig({"pairs": [{"name": "a", "pairing": pairing}]}, where="test").pairs[0])

    assert isinstance(of("stamps"), StampPairing)
    assert isinstance(of("sequence"), SequencePairing)
