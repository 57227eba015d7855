"""Rig files: what is read, what is refused, and in which words."""

import contextlib
import json
import math
import tomllib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from monitor import rig as rigs
from monitor.messages import CameraInfo
from monitor.rig import bind, camera_from_info, load_rig, parse_rig
from monitor.sources import TopicInfo
from pipeline.errors import InputError, RigError
from pipeline.records import AXES, CameraModel
from pipeline.se3 import transform

T = transform(Rotation.from_euler("xyz", [-1.2, 0.1, -1.5]).as_matrix(), np.array([0.1, -0.3, 0.2]))

TOML = """
vehicle = "van-17"
[[pairs]]
name = "front"
lidar = { topic = "/lidar/points", frame = "lidar_top", spin = "ccw", stamp = "start" }
camera = { topic = "/cam_front/image/compressed", info = "/cam_front/camera_info", frame = "cam_front" }
max_gap_ms = 40
[pairs.extrinsic]
T_cam_lidar = [[1,0,0,0.1],[0,0,-1,0],[0,1,0,0],[0,0,0,1]]
sigma_deg = 0.2
sigma_m = 0.01
[pairs.limits]
yaw_deg = 0.25
up_m = 0.05
"""


def document(**pair):
    return {"vehicle": "v", "pairs": [{"name": "front", **pair}]}


def test_the_example_of_the_specification(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(TOML)
    rig = load_rig(path)
    (pair,) = rig.pairs
    assert (rig.vehicle, pair.name, pair.lidar.topic) == ("van-17", "front", "/lidar/points")
    assert (pair.lidar.spin, pair.lidar.stamp, pair.camera.info) == ("ccw", "start", "/cam_front/camera_info")
    assert pair.max_gap_ns == 40_000_000
    assert pair.sigma_rad == pytest.approx(math.radians(0.2))
    assert pair.limits == pytest.approx([*np.radians([0.75, 0.5, 0.25]), 0.20, 0.15, 0.05])
    assert pair.required == ("pitch", "yaw")
    assert pair.T_cam_lidar[:3, 3] == pytest.approx([0.1, 0, 0])
    assert pair.camera.model is None
    assert pair.T_vehicle_lidar is None


def test_everything_but_the_name_has_a_default():
    (pair,) = parse_rig(document(), where="x").pairs
    assert pair.T_cam_lidar is None
    assert pair.store is None
    assert pair.max_gap_ns == 50_000_000
    assert pair.pairing == "stamps"


def test_the_same_rig_as_json(tmp_path):
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(document(extrinsic={"T_cam_lidar": T.tolist()})))
    assert load_rig(path).pairs[0].T_cam_lidar == pytest.approx(T)


def test_an_extrinsic_from_the_store():
    assert parse_rig(document(extrinsic="store:front"), where="x").pairs[0].store == "front"


def test_calib_json_is_a_rig_of_one_pair():
    calib = {
        "camera": {
            "width": 64,
            "height": 48,
            "K": [[50, 0, 32], [0, 51, 24], [0, 0, 1]],
            "distortion_model": "none",
            "D": [],
        },
        "T_cam_lidar": T.tolist(),
        "source": "a note",
        "frames": [],
    }
    (pair,) = parse_rig(calib, where="calib.json").pairs
    assert pair.camera.model.model == "pinhole"
    assert pair.camera.model.K[1, 1] == 51
    assert pair.T_cam_lidar == pytest.approx(T)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"lidar": {"tpoic": "/a"}}, r"pairs\[0\].lidar.tpoic is not a known key.*did you mean 'topic'"),
        ({"limits": {"yaw": 1}}, r"pairs\[0\].limits.yaw is not a known key.*did you mean 'yaw_deg'"),
        ({"extrinsic": {"T_lidar_cam": []}}, r"extrinsic.T_lidar_cam is not.*did you mean 'T_cam_lidar'"),
        ({"max_gap": 1}, r"pairs\[0\].max_gap is not a known key.*did you mean 'max_gap_ms'"),
        ({"zzzzzz": 1}, r"zzzzzz is not a known key.*known: name, lidar, camera"),
        ({"name": "a/b"}, r"pairs\[0\].name"),
        ({"name": ""}, r"pairs\[0\].name"),
        ({"name": "x" * 65}, r"pairs\[0\].name"),
        ({"name": "front\n"}, r"pairs\[0\].name"),
        ({"lidar": {"spin": "left"}}, r"lidar.spin is 'left'.*'cw' or 'ccw'"),
        ({"max_gap_ms": -1}, r"max_gap_ms"),
        ({"max_gap_ms": float("nan")}, r"max_gap_ms"),
        ({"limits": {"up_m": 0}}, r"limits.up_m"),
        ({"required": ["jaw"]}, r"required\[0\]"),
        ({"extrinsic": "file:front"}, r"extrinsic.*store:NAME"),
        ({"extrinsic": {"T_cam_lidar": np.eye(3).tolist()}}, r"T_cam_lidar"),
        ({"extrinsic": {"T_cam_lidar": np.diag([1, 1, -1, 1]).tolist()}}, r"rotation mirrors"),
        ({"extrinsic": {"T_cam_lidar": np.diag([1, 1, 1.01, 1]).tolist()}}, r"not orthonormal \(off by 0.01"),
        ({"extrinsic": {"T_cam_lidar": T.T.tolist()}}, r"last row"),
        ({"T_vehicle_lidar": np.diag([2, 1, 1, 1]).tolist()}, r"T_vehicle_lidar: the rotation is not"),
        (
            {"camera": {"K": np.zeros((3, 3)).tolist(), "width": 4, "height": 4}},
            r"pairs\[0\].camera: camera matrix K",
        ),
        ({"camera": {"K": np.eye(3).tolist()}}, r"no width and height"),
        (
            {"camera": {"K": np.eye(3).tolist(), "width": 4, "height": 4, "model": "fish"}},
            r"'fish' is not known",
        ),
    ],
)
def test_what_is_wrong_is_refused_by_name(change, words):
    with pytest.raises(RigError, match=words):
        parse_rig(document(**change), where="rig.toml")


def test_a_misspelt_key_at_the_top():
    with pytest.raises(RigError, match=r"rig.toml: vehical is not a known key.*did you mean 'vehicle'"):
        parse_rig({**document(), "vehical": "v"}, where="rig.toml")


leaves = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.sampled_from([0, -1, 1e308, 10**400, "", "store:", "store:a", "a/b", [], {}, [[]], [[1, 2], [3]]]),
    st.floats(),
    st.text(max_size=5),
    st.lists(st.integers(), max_size=4),
)


@given(st.data(), st.sampled_from(["rig", "calib"]))
def test_any_value_in_any_place_gives_a_rig_or_a_rig_error(data, kind):
    K = [[50, 0, 32], [0, 50, 24], [0, 0, 1]]
    camera = {"width": 64, "height": 48, "K": K, "D": [0.1, 0, 0, 0, 0]}
    if kind == "calib":
        whole = {
            "camera": {**camera, "distortion_model": "plumb_bob"},
            "T_cam_lidar": T.tolist(),
            "camera_name": "a",
        }
    else:
        whole = tomllib.loads(TOML)
        whole["pairs"][0]["camera"] |= camera
    place, key = whole, data.draw(st.sampled_from(sorted(whole)))
    while isinstance(place[key], dict | list) and place[key] and data.draw(st.booleans()):
        place = place[key]
        key = data.draw(st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place))))
    place[key] = data.draw(leaves)
    with contextlib.suppress(RigError):
        assert parse_rig(whole, where="x").pairs


def test_no_pairs_and_repeated_names_are_refused():
    with pytest.raises(RigError, match="pairs"):
        parse_rig({"vehicle": "v", "pairs": []}, where="x")
    with pytest.raises(RigError, match="two pairs are called 'front'"):
        parse_rig({"pairs": [{"name": "front"}, {"name": "front"}]}, where="x")


def test_store_and_matrix_together_are_refused():
    with pytest.raises(RigError, match="'store' and 'T_cam_lidar'"):
        parse_rig(document(extrinsic={"store": "a", "T_cam_lidar": T.tolist()}), where="x")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("rig.toml", "vehicle = ", "is not TOML"),
        ("rig.json", "{", "is not JSON"),
        ("rig.json", "[1]", "holds no table"),
        ("rig.json", "[" * 100_000, "is not JSON"),
    ],
)
def test_files_that_are_no_rig(tmp_path, name, text, words):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(RigError, match=words):
        load_rig(path)


def test_files_that_can_not_be_read(tmp_path):
    with pytest.raises(RigError, match="can not be read"):
        load_rig(tmp_path / "absent.toml")
    (tmp_path / "a.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RigError, match="is not text"):
        load_rig(tmp_path / "a.toml")


def test_six_digits_are_made_orthonormal_again():
    rounded = np.round(T, 6)
    assert np.abs(rounded[:3, :3] @ rounded[:3, :3].T - np.eye(3)).max() > 1e-9
    R = (
        parse_rig(document(extrinsic={"T_cam_lidar": rounded.tolist()}), where="x")
        .pairs[0]
        .T_cam_lidar[:3, :3]
    )
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-14
    assert np.abs(R - T[:3, :3]).max() < 2e-6


TOPICS = (
    TopicInfo("/lidar", "sensor_msgs/msg/PointCloud2", 5, 10.0, understood=True),
    TopicInfo("/cam/image_raw", "sensor_msgs/msg/Image", 5, 10.0, understood=True),
    TopicInfo("/imu", "sensor_msgs/msg/Imu", 5, 10.0, understood=False),
)


def test_a_topic_that_is_not_named_is_the_only_one():
    rig = bind(parse_rig(document(), where="x"), TOPICS, where="a.mcap")
    assert (rig.pairs[0].lidar.topic, rig.pairs[0].camera.topic) == ("/lidar", "/cam/image_raw")


def test_several_candidates_are_listed():
    more = (*TOPICS, TopicInfo("/rear", "foxglove.PointCloud", 5, 10.0, understood=True))
    with pytest.raises(InputError, match=r"2 point cloud topics.*does not say which: /lidar, /rear"):
        bind(parse_rig(document(), where="x"), more, where="a.mcap")


def test_a_topic_that_does_not_exist_lists_those_that_do():
    rig = parse_rig(document(lidar={"topic": "/lidra"}), where="x")
    with pytest.raises(
        InputError, match=r"a.mcap has no topic /lidra.*did you mean '/lidar'.*/cam/image_raw"
    ):
        bind(rig, TOPICS, where="a.mcap")


def lens(f, D=()):
    K = np.array([[f, 0, 32], [0, f, 24], [0, 0, 1.0]])
    return CameraModel("plumb_bob" if D else "pinhole", K, np.array(D, dtype=float), 64, 48)


@pytest.mark.parametrize(
    ("raw", "rectified", "said", "topic", "focal", "words"),
    [
        (lens(50, (0.1, 0, 0, 0, 0)), lens(45), None, "/cam/image_raw", 50, "nothing says"),
        (lens(50, (0.1, 0, 0, 0, 0)), lens(45), None, "/cam/image_rect_color", 45, "topic's name"),
        (lens(50, (0.1, 0, 0, 0, 0)), lens(45), None, "/direct/image_unrectified", 50, "nothing says"),
        (lens(50, (0.1, 0, 0, 0, 0)), lens(45), True, "/cam/image_raw", 45, "the rig says rectified"),
        (lens(50, (0.1, 0, 0, 0, 0)), lens(45), False, "/cam/image_rect", 50, "not rectified"),
        (lens(50), lens(50), None, "/kitti/camera/image_raw", 50, "D is zero and P holds the same K"),
        (lens(50), None, None, "/cam/image_rect", 50, "nothing says"),
    ],
)
def test_which_intrinsics_hold(raw, rectified, said, topic, focal, words):
    camera, why = camera_from_info(CameraInfo(raw, rectified), rectified=said, topic=topic)
    assert camera.K[0, 0] == focal
    assert words in why


def test_a_rig_that_says_rectified_needs_a_projection():
    with pytest.raises(RigError, match="no P"):
        camera_from_info(CameraInfo(lens(50), None), rectified=True, topic="/a")


def test_axes_are_those_of_the_records():
    assert set(rigs.PairSection.model_fields["required"].default) <= set(AXES)
