import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from monitor.messages import Message, decode
from monitor.messages.tf import encode_tf
from pipeline.errors import InputError
from tests import strategies
from tests.monitor.messages import wire

HALF = math.sqrt(0.5)
QUARTER_LEFT = (0.0, 0.0, HALF, HALF)  # x of the child points along y of the parent


@pytest.mark.parametrize("transport", wire.WIRES)
def test_a_transform_maps_points_of_the_child_into_the_parent(transport):
    message = wire.tf(
        [("base", "lidar", (1, 2, 3), QUARTER_LEFT), ("base", "cam", (0, 0, 1), (0, 0, 0, 1))], wire=transport
    )
    first, second = decode(message)
    assert (first.stamp_ns, first.frame) == (wire.STAMP_NS, "base")
    assert (first.value.parent, first.value.child, first.value.static) == ("base", "lidar", False)
    assert first.value.T_parent_child @ [1, 0, 0, 1] == pytest.approx([1, 3, 3, 1])
    assert second.value.T_parent_child[:3, 3].tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("topic", "static"),
    [("/tf", False), ("/tf_static", True), ("robot/tf_static", True), ("/tf_static/x", False)],
)
def test_the_topic_tells_what_is_static(topic, static):
    message = wire.tf([("a", "b", (0, 0, 0), (0, 0, 0, 1))], topic=topic)
    assert decode(message)[0].value.static is static


def test_the_older_type_and_slashes_of_ros_1():
    message = wire.tf([("/a", "/b", (0, 0, 0), (0, 0, 0, 1))], name="tf/msg/tfMessage", wire="ros1")
    (decoded,) = decode(message)
    assert (decoded.value.parent, decoded.value.child) == ("a", "b")


def test_a_quaternion_is_normalised():
    (decoded,) = decode(wire.tf([("a", "b", (0, 0, 0), (0, 0, 0.02, 0.02))]))
    R = decoded.value.T_parent_child[:3, :3]
    assert pytest.approx(np.eye(3)) == R @ R.T
    assert R[1, 0] == pytest.approx(1)


def test_no_transforms_are_no_values():
    assert decode(wire.tf([])) == ()


@pytest.mark.parametrize(
    ("translation", "quaternion"),
    [
        ((0, 0, 0), (0, 0, 0, 0)),
        ((0, 0, 0), (0, 0, 0, math.nan)),
        ((0, 0, 0), (0, 0, 0, math.inf)),
        ((0, 0, 0), (1e308, 1e308, 1e308, 1e308)),
        ((math.nan, 0, 0), (0, 0, 0, 1)),
        ((0, math.inf, 0), (0, 0, 0, 1)),
    ],
)
def test_what_is_no_motion_is_refused_with_its_frames(translation, quaternion):
    with pytest.raises(InputError, match="transform 'a' -> 'b'"):
        decode(wire.tf([("a", "b", translation, quaternion)]))


@given(st.lists(strategies.transforms(), max_size=4), strategies.stamps_ns)
def test_what_is_written_is_read_back(transforms, stamp_ns):
    decoded = decode(Message("/tf", "tf2_msgs/msg/TFMessage", "cdr", encode_tf(transforms, stamp_ns), 0))
    assert len(decoded) == len(transforms)
    for back, transform in zip(decoded, transforms, strict=True):
        assert (back.stamp_ns, back.value.parent, back.value.child) == (
            stamp_ns,
            transform.parent,
            transform.child,
        )
        assert back.value.T_parent_child == pytest.approx(transform.T_parent_child, abs=1e-9)
