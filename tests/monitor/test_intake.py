"""Messages in, pairs out: each frame is accounted for, each trouble told once."""

import dataclasses

import pytest

from monitor.intake import Intake
from monitor.messages import Message
from monitor.rig import parse_rig
from tests import drives
from tests.drives import CLOUD_TOPIC, IMAGE_TOPIC, INFO_TOPIC

PAIR = {
    "name": "front",
    "lidar": {"topic": CLOUD_TOPIC},
    "camera": {"topic": IMAGE_TOPIC},
    "extrinsic": {"T_cam_lidar": [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]},
}


def intake(*pairs):
    return Intake(parse_rig({"pairs": [PAIR | pair for pair in pairs or ({},)]}, where="test"))


def message(recorded):
    return Message(recorded.topic, recorded.type, "cdr", recorded.data, recorded.log_ns)


@pytest.fixture
def four(messages):
    return drives.first_frames(messages, 4)


def test_frames_become_pairs_of_their_stamps_and_nothing_is_left(four):
    taking = intake()
    pairs = [pair for recorded in four for pair in taking.take(message(recorded))]
    pairs += taking.flush()
    assert [pair.pair for pair in pairs] == ["front"] * 4
    images = [drives.stamp_of(m) for m in four if m.topic == IMAGE_TOPIC]
    clouds = [drives.stamp_of(m) for m in four if m.topic == CLOUD_TOPIC]
    assert [pair.image_stamp_ns for pair in pairs] == images
    assert [pair.cloud_stamp_ns for pair in pairs] == clouds
    assert pairs[0].image.size == (drives.WIDTH, drives.HEIGHT)
    assert taking.account("front") == (8, {})
    assert taking.notes == []
    assert taking.offset_ns("front") is not None


def test_a_camera_that_serves_two_pairs_serves_both(four):
    taking = intake({}, {"name": "again"})
    pairs = [pair for recorded in four for pair in taking.take(message(recorded))]
    pairs += taking.flush()
    assert sorted(pair.pair for pair in pairs) == ["again"] * 4 + ["front"] * 4
    assert taking.account("front") == taking.account("again") == (8, {})


def test_topics_of_no_pair_cost_nothing(four):
    taking = intake()
    other = Message("/imu", "sensor_msgs/msg/Imu", "cdr", b"\x00", 0)
    assert taking.take(other) == []
    assert taking.take(message(next(m for m in four if m.topic == INFO_TOPIC))) == []
    assert taking.account("front") == (0, {})


def test_what_can_not_be_decoded_is_counted_each_time_and_told_once(four):
    taking = intake()
    for recorded in four:
        bad = recorded.topic == IMAGE_TOPIC and recorded.sequence != 0
        data = recorded.data[:100] if bad else recorded.data
        taking.take(message(dataclasses.replace(recorded, data=data)))
    taking.flush()
    received, dropped = taking.account("front")
    assert received == 8
    assert dropped["undecodable"] == 3
    assert dropped.total() == 6  # and three sweeps without an image
    assert len(taking.notes) == 1
    assert IMAGE_TOPIC in taking.notes[0]


def test_another_type_than_the_pair_needs_is_counted_and_told_once(four):
    taking = intake({"lidar": {"topic": IMAGE_TOPIC}, "camera": {"topic": CLOUD_TOPIC}})
    for recorded in four:
        assert taking.take(message(recorded)) == []
    assert taking.account("front") == (8, {"wrong_type": 8})
    assert sorted(taking.notes) == [
        f"topic {IMAGE_TOPIC} carries sensor_msgs/msg/CompressedImage, not a point cloud",
        f"topic {CLOUD_TOPIC} carries sensor_msgs/msg/PointCloud2, not an image",
    ]


def test_a_message_without_a_stamp_counts_from_when_it_was_recorded(four):
    taking = intake()
    pairs = [
        pair
        for recorded in four
        for pair in taking.take(
            message(drives.stamped(recorded, 0) if recorded.topic == IMAGE_TOPIC else recorded)
        )
    ]
    assert pairs
    logged = [m.log_ns for m in four if m.topic == IMAGE_TOPIC]
    assert all(pair.image_stamp_ns in logged for pair in pairs)
