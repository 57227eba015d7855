import numpy as np
import pytest
from hypothesis import given

from monitor.messages import Message, decode
from monitor.messages.camera_info import encode_camera_info
from pipeline.errors import InputError
from tests import strategies
from tests.monitor.messages import wire

K = [700.0, 0, 320, 0, 710, 240, 0, 0, 1]
P = [650.0, 0, 300, -45, 0, 655, 230, 0, 0, 0, 1, 0]
D = [-0.3, 0.1, 0.001, -0.002, 0.01]


@pytest.mark.parametrize("transport", wire.WIRES)
def test_raw_is_k_and_d_and_rectified_is_p_without_its_shift(transport):
    (decoded,) = decode(wire.camera_info(K, D, P, wire=transport))
    raw, rectified = decoded.value.raw, decoded.value.rectified
    assert (decoded.stamp_ns, decoded.frame) == (wire.STAMP_NS, "cam")
    assert (raw.model, raw.width, raw.height) == ("plumb_bob", 640, 480)
    assert raw.K.tolist() == np.reshape(K, (3, 3)).tolist()
    assert raw.D.tolist() == D
    assert (rectified.model, len(rectified.D), rectified.width) == ("pinhole", 0, 640)
    assert rectified.K.tolist() == [[650, 0, 300], [0, 655, 230], [0, 0, 1]]


def test_a_camera_that_was_never_rectified_has_no_rectified_reading():
    assert decode(wire.camera_info(K, D, [0.0] * 12))[0].value.rectified is None


@pytest.mark.parametrize(
    ("name", "coefficients", "model", "kept"),
    [
        ("", [], "pinhole", 0),
        ("", D, "plumb_bob", 5),
        ("none", [], "pinhole", 0),
        ("plumb_bob", [0.0] * 5, "pinhole", 0),
        ("plumb_bob", D[:4], "plumb_bob", 4),
        ("rational_polynomial", [*D, 0.1, 0.2, 0.3], "rational_polynomial", 8),
        ("rational_polynomial", [*D, 0.1, 0.2, 0.3, 0, 0, 0, 0], "rational_polynomial", 8),
        ("equidistant", D[:4], "equidistant", 4),
        ("equidistant", [0.0] * 4, "equidistant", 4),
        ("fisheye", D[:4], "equidistant", 4),
        ("kannala_brandt", D[:4], "equidistant", 4),
    ],
)
def test_models_by_their_names(name, coefficients, model, kept):
    raw = decode(wire.camera_info(K, coefficients, P, model=name))[0].value.raw
    assert (raw.model, raw.D.tolist()) == (model, list(coefficients[:kept]))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"K": [0.0] * 9}, "no positive focal length"),
        ({"K": [np.nan, *K[1:]]}, "no positive focal length"),
        ({"D": [np.nan]}, "not finite"),
        ({"P": [0.0, *P[1:]]}, "no positive focal length"),
        ({"model": "fisheye62"}, "'fisheye62' is not known"),
        ({"model": "plumb_bob", "D": [*D, 0.1]}, "has 5 coefficients, D has 6"),
        ({"model": "rational_polynomial", "D": [0.1] * 12}, "has 8 coefficients"),
        ({"size": (0, 480)}, "not positive"),
        ({"roi": (600, 0, 480, 100)}, "leaves the sensor"),
        ({"binning": (1000, 1)}, "not positive"),
    ],
)
def test_what_is_no_camera_is_refused(change, said):
    with pytest.raises(InputError, match=said):
        decode(wire.camera_info(**({"K": K, "D": D, "P": P} | change)))


def test_region_and_binning_move_the_principal_point():
    message = wire.camera_info(K, D, P, binning=(2, 2), roi=(100, 40, 400, 500))
    raw = decode(message)[0].value.raw
    assert (raw.width, raw.height) == (250, 200)
    for sensor in (
        np.array([320.0, 240]),
        np.array([100.5, 40.5]),
    ):  # centre of four px = a px of the binned image
        ray = np.linalg.solve(np.reshape(K, (3, 3)), [*sensor, 1])
        binned = (sensor - [100, 40] - 0.5) / 2
        assert (raw.K @ ray)[:2] == pytest.approx(binned)


def test_k_belongs_to_the_value():
    message = wire.camera_info(K, D, P)
    info = decode(message)[0].value
    transport = np.frombuffer(message.data, np.uint8)
    for array in (info.raw.K, info.raw.D, info.rectified.K):
        assert not np.shares_memory(array, transport)


@given(strategies.cameras(), strategies.stamps_ns, strategies.frames)
def test_what_is_written_is_read_back(camera, stamp_ns, frame):
    data = encode_camera_info(camera, stamp_ns, frame)
    (decoded,) = decode(Message("/t", "sensor_msgs/msg/CameraInfo", "cdr", data, 0))
    raw = decoded.value.raw
    assert (decoded.stamp_ns, decoded.frame) == (stamp_ns, frame)
    assert (raw.model, raw.width, raw.height) == (camera.model, camera.width, camera.height)
    assert np.array_equal(raw.K, camera.K)
    assert np.array_equal(raw.D, camera.D)
    assert (decoded.value.rectified is None) == (camera.model != "pinhole")
