"""``--inject``: what is read, what is refused, and that the drift is then true."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from monitor.injection import inject, injected_text, parse_inject
from monitor.rig import parse_rig
from pipeline.errors import RigError
from pipeline.se3 import mount_drift, transform, vehicle_axes

T = transform(Rotation.from_euler("xyz", [-1.2, 0.1, -1.5]).as_matrix(), np.array([0.1, -0.3, 0.2]))


def pair_of(**fields):
    document = {"pairs": [{"name": "front", **fields}]}
    return parse_rig(document, where="x").pairs[0]


def test_degrees_and_metres_are_read():
    assert parse_inject("yaw=0.5, up=-0.05") == pytest.approx([0, 0, math.radians(0.5), 0, 0, -0.05])


def test_the_largest_that_can_be_meant_is_read():
    largest = parse_inject("roll=45,pitch=-45,forward=5,left=-5")
    assert largest == pytest.approx([math.pi / 4, -math.pi / 4, 0, 5, -5, 0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("jaw=1", "no axis is called 'jaw'.*did you mean 'yaw'"),
        ("yaw", "'' is no number"),
        ("yaw=much", "'much' is no number"),
        ("yaw=nan", "yaw is nan"),
        ("up=-inf", "up is -inf"),
        ("yaw=1e400", "yaw is 1e400"),
        ("yaw=1,yaw=2", "yaw is named twice"),
        ("", "no axis is called ''"),
        ("yaw=1,", "no axis is called ''"),
        ("yaw=1000", "yaw=1000 is more than a mount can move .degrees, at most 45"),
        ("pitch=-45.1", "pitch=-45.1 is more than a mount can move"),
        ("up=10", "up=10 is more than a mount can move .metres, at most 5"),
    ],
)
def test_nonsense_is_refused(text, words):
    with pytest.raises(RigError, match=words):
        parse_inject(text)


@given(st.lists(st.floats(-3, 3), min_size=6, max_size=6), st.booleans())
def test_injected_drift_is_what_the_mount_then_drifted(values, with_vehicle):
    drift = np.array([*np.radians(values[:3]), *(0.1 * np.array(values[3:]))])
    T_vehicle_lidar = transform(Rotation.from_euler("z", 1.1).as_matrix(), np.ones(3))
    extra = {"T_vehicle_lidar": T_vehicle_lidar.tolist()} if with_vehicle else {}
    pair = pair_of(extrinsic={"T_cam_lidar": T.tolist()}, **extra)
    stored = inject(pair, drift).T_cam_lidar
    R_vehicle_cam = vehicle_axes(stored, pair.T_vehicle_lidar)
    assert mount_drift(stored, pair.T_cam_lidar, R_vehicle_cam) == pytest.approx(drift, abs=1e-9)


def test_it_needs_an_extrinsic():
    with pytest.raises(RigError, match="no extrinsic to alter"):
        inject(pair_of(), np.zeros(6))


def test_a_reader_of_the_verdict_is_told_what_was_injected():
    told = injected_text(parse_inject("yaw=1,up=-0.05"))
    assert "a drift of yaw +1 deg, up -0.05 m is true" in told
    assert "a drift of 0 is true" in injected_text(np.zeros(6))
