"""Every format against the reference extrinsic of the same rig, or against scipy's rotations."""

import importlib
import json
import os
import pkgutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from monitor import extrinsic_formats
from monitor.commands.extrinsic import FORMATS
from monitor.extrinsic_file import rig_text
from monitor.extrinsic_formats import Choice, formats, load_document, recognised
from monitor.rig import load_rig, parse_rig
from pipeline.errors import CalibwatchError, InputError, RigError
from pipeline.se3 import inverse, transform
from tests.monitor.proposals import proposal

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[4] / "shared/data"))
recordings = pytest.mark.skipif(not DATA.is_dir(), reason="no recordings folder (CALIBWATCH_DATA)")
T = transform(Rotation.from_euler("zyx", [-1.5, 0.1, -1.6]).as_matrix(), np.array([0.3, -0.2, 1.5]))
OPTICAL = Rotation.from_euler("xyz", [-np.pi / 2, 0, -np.pi / 2]).as_matrix()
DAY = "kitti_raw_0009_a/2011_09_26"


def read(path, *, name=None, **choice):
    document = load_document(path)
    return recognised(document, name).read(document, Choice(**choice))


def written(tmp_path, text, name="file.yaml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def quaternion(M):
    x, y, z, w = Rotation.from_matrix(M[:3, :3]).as_quat().tolist()
    tx, ty, tz = M[:3, 3].tolist()
    return {
        "translation": {"x": tx, "y": ty, "z": tz},
        "rotation": {"w": w, "x": x, "y": y, "z": z},
    }


def test_every_module_offers_a_format_that_the_command_names():
    for module in pkgutil.iter_modules(extrinsic_formats.__path__):
        offered = hasattr(importlib.import_module(f"monitor.extrinsic_formats.{module.name}"), "FORMAT")
        assert offered != module.name.startswith("_")
    assert sorted(formats()) == sorted(FORMATS)


@recordings
@pytest.mark.recordings
@pytest.mark.parametrize(
    ("file", "choice", "reference", "read_as"),
    [
        ("opencalib_crlf/calib.json", {}, "opencalib_crlf", "T_cam_lidar"),
        (
            "opencalib_crlf/top_center_lidar-to-center_camera-extrinsic.json",
            {},
            "opencalib_crlf",
            "T_cam_lidar",
        ),
        (
            "opencalib_manual/top_center_lidar-to-center_camera-extrinsic.json",
            {},
            "opencalib_manual",
            "T_cam_lidar",
        ),
        ("opencalib_st1/calib.txt", {"size": (1920, 1200)}, "opencalib_st1", "T_cam_lidar"),
        (f"{DAY}/calib_velo_to_cam.txt", {}, "kitti_raw_0009_a", "T_cam_lidar"),
        (f"{DAY}/calib_cam_to_cam.txt", {}, "kitti_raw_0009_a", "T_cam_lidar"),
        ("kitti_singles/000001/calib.txt", {"size": (1242, 375)}, "kitti_singles/000001", "T_cam_lidar"),
        ("kitti_singles/000006/calib.txt", {"size": (1238, 374)}, "kitti_singles/000006", "T_cam_lidar"),
        ("rellis_os1/transforms.yaml", {}, "rellis_os1", "T_lidar_cam"),
        ("rellis_os1/transforms.yaml", {"direction": "T_lidar_cam"}, "rellis_os1", "T_lidar_cam"),
    ],
)
def test_what_is_imported_is_the_reference(file, choice, reference, read_as):
    reading = read(DATA / file, **choice)
    expected = load_rig(DATA / reference / "calib.json").pairs[0]
    np.testing.assert_allclose(reading.T_cam_lidar, expected.T_cam_lidar, atol=2e-6)
    assert reading.read_as.startswith(read_as)
    assert reading.read_as.endswith("inverted" if read_as == "T_lidar_cam" else "kept as it is")
    if "K" in reading.camera and "manual" not in file:  # the manual one states another height
        pair = parse_rig(tomllib.loads(rig_text(reading, "a", "b")), where="test").pairs[0]
        model, truth = pair.camera.model, expected.camera.model
        np.testing.assert_allclose(model.K, truth.K)
        assert (model.width, model.height) == (truth.width, truth.height)
        D, expected_D = (np.pad(camera.D, (0, 5 - len(camera.D))) for camera in (model, truth))
        np.testing.assert_allclose(D, expected_D)


@pytest.mark.parametrize("rows", [3, 4])
@pytest.mark.parametrize("style", ["plain", "json", "commented"])
def test_a_bare_matrix_needs_a_direction_and_obeys_it(tmp_path, rows, style):
    numbers = T[:rows].tolist()
    plain = "\n".join(" ".join(map(repr, row)) for row in numbers)
    text = {"plain": plain, "json": json.dumps(numbers), "commented": f"# a\n{plain}\n"}[style]
    path = written(tmp_path, text, "T.txt")
    with pytest.raises(InputError, match="which way"):
        read(path)
    np.testing.assert_allclose(read(path, direction="T_cam_lidar").T_cam_lidar, T, atol=1e-12)
    reading = read(path, direction="T_lidar_cam")
    np.testing.assert_allclose(reading.T_cam_lidar, inverse(T), atol=1e-12)
    assert reading.read_as == "T_lidar_cam (by --direction), inverted"


@pytest.mark.parametrize("camera_is_parent", [True, False])
def test_a_tf_message_states_its_direction(tmp_path, camera_is_parent):
    parent, child = ("cam_front", "lidar_top") if camera_is_parent else ("lidar_top", "cam_front")
    message = {
        "header": {"frame_id": parent, "stamp": {"sec": 1, "nanosec": 0}},
        "child_frame_id": child,
        "transform": quaternion(T),
    }
    path = written(tmp_path, json.dumps({"transforms": [message]}))
    reading = read(path)
    np.testing.assert_allclose(reading.T_cam_lidar, T if camera_is_parent else inverse(T), atol=1e-12)
    assert reading.read_as.split()[0] == ("T_cam_lidar" if camera_is_parent else "T_lidar_cam")
    assert (reading.camera["frame"], reading.lidar["frame"]) == ("cam_front", "lidar_top")
    with pytest.raises(RigError, match="--direction says"):
        read(path, direction="T_lidar_cam" if camera_is_parent else "T_cam_lidar")


def test_frames_whose_names_say_nothing_are_asked_for(tmp_path):
    path = written(
        tmp_path, json.dumps({"header": {"frame_id": "a"}, "child_frame_id": "b", "transform": quaternion(T)})
    )
    with pytest.raises(InputError, match="--camera"):
        read(path)
    np.testing.assert_allclose(read(path, camera="a").T_cam_lidar, T, atol=1e-12)
    np.testing.assert_allclose(read(path, camera="b").T_cam_lidar, inverse(T), atol=1e-12)
    np.testing.assert_allclose(read(path, lidar="a").T_cam_lidar, inverse(T), atol=1e-12)


def test_a_chain_of_transforms_is_composed_and_gives_the_vehicle_frame(tmp_path):
    T_base_cam, T_base_lidar = inverse(T), transform(np.eye(3), np.array([1.0, 2.0, 3.0]))
    entries = {"base_link-cam": quaternion(T_base_cam), "base_link-velodyne": quaternion(T_base_lidar)}
    reading = read(written(tmp_path, json.dumps(entries)))
    np.testing.assert_allclose(reading.T_cam_lidar, T @ T_base_lidar, atol=1e-12)
    np.testing.assert_allclose(reading.T_vehicle_lidar, T_base_lidar, atol=1e-12)
    with pytest.raises(RigError, match="chain"):
        read(tmp_path / "file.yaml", direction="T_cam_lidar")


@pytest.mark.parametrize("key", ["T_cam_lidar", "T_lidar_cam"])
def test_a_camchain_is_read_by_its_key(tmp_path, key):
    camera = {
        "camera_model": "pinhole",
        "intrinsics": [800.0, 810.0, 640.0, 360.0],
        "distortion_model": "equidistant",
        "distortion_coeffs": [0.1, 0.01, 0.0, 0.0],
        "resolution": [1280, 720],
        "rostopic": "/cam0/image_raw",
    }
    other = camera | {key: np.eye(4).tolist()}
    path = written(tmp_path, json.dumps({"cam0": other, "cam1": camera | {key: T.tolist()}}))
    with pytest.raises(InputError, match="cam0, cam1"):
        read(path)
    reading = read(path, camera="cam1")
    np.testing.assert_allclose(reading.T_cam_lidar, T if key == "T_cam_lidar" else inverse(T), atol=1e-12)
    pair = parse_rig(tomllib.loads(rig_text(reading, "a", "b")), where="test").pairs[0]
    assert pair.camera.model.model == "equidistant"
    assert pair.camera.model.K.tolist() == [[800, 0, 640], [0, 810, 360], [0, 0, 1]]
    assert pair.camera.topic == "/cam0/image_raw"


@pytest.mark.parametrize("frame", ["camera0/camera_link", "camera0/camera_optical_link"])
def test_a_sensor_kit_is_composed_of_urdf_angles(tmp_path, frame):
    kit = {
        frame: {"x": 0.4, "y": 0.1, "z": -0.2, "roll": 0.02, "pitch": -0.03, "yaw": 0.7},
        "velodyne_top_base_link": {"x": 0.0, "y": 0.2, "z": 0.0, "roll": 0.01, "pitch": 0.02, "yaw": 1.575},
        "gnss_link": {"x": 0.0, "y": 0.0, "z": 0.0, "roll": 0.0, "pitch": 0.0, "yaw": 0.0},
    }
    reading = read(written(tmp_path, json.dumps({"sensor_kit_base_link": kit})))
    camera, lidar = (
        transform(
            Rotation.from_euler("xyz", [kit[name][axis] for axis in ("roll", "pitch", "yaw")]).as_matrix(),
            np.array([kit[name][axis] for axis in "xyz"]),
        )
        for name in (frame, "velodyne_top_base_link")
    )
    turned = transform(OPTICAL if "optical" not in frame else np.eye(3), np.zeros(3))
    np.testing.assert_allclose(reading.T_cam_lidar, inverse(camera @ turned) @ lidar, atol=1e-12)
    assert ("turned" in reading.notes[0]) == ("optical" not in frame)


def test_two_formats_in_one_file_are_told(tmp_path):
    both = {"cam0": {"T_cam_lidar": T.tolist()}, "a-b": quaternion(T)}
    path = written(tmp_path, json.dumps(both))
    with pytest.raises(InputError, match=r"may be kalibr .* or ros"):
        read(path)
    np.testing.assert_allclose(read(path, name="kalibr").T_cam_lidar, T, atol=1e-12)


def test_a_proposal_is_taken_as_it_was_signed(tmp_path):
    document = proposal().document
    reading = read(written(tmp_path, document.to_json().decode(), "front.candidate.json"))
    np.testing.assert_allclose(reading.T_cam_lidar, np.array(document.T_cam_lidar), atol=1e-14)
    assert (reading.name, reading.camera) == ("front", {})
    assert document.hash in reading.notes[0]
    assert "the mount of van-17 has moved" in reading.notes[1]
    assert any("fewer than three windows" in note for note in reading.notes) == (not document.agreed)


def test_a_proposal_that_was_changed_is_refused(tmp_path):
    changed = json.loads(proposal().document.to_json())
    changed["T_cam_lidar"][0][3] += 0.01
    with pytest.raises(InputError, match="does not match its hash"):
        read(written(tmp_path, json.dumps(changed)))
    with pytest.raises(RigError, match="the file states T_cam_lidar"):
        read(written(tmp_path, proposal().document.to_json().decode()), direction="T_lidar_cam")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (json.dumps({"schema": "calibwatch.candidate/1"}), "no calibwatch.candidate/1"),
        ("", "no format"),
        ("1 2 3", "no format"),
        (json.dumps({"cam0": {"T_cam_lidar": [[1, 2], [3]]}}), "no table of numbers"),
        (json.dumps({"cam0": {"T_cam_lidar": (2 * T).tolist()}}), "last row"),
        (json.dumps({"cam0": {"T_cam_lidar": (2 * T[:3]).tolist()}}), "orthonormal"),
        (json.dumps({"cam0": {"T_cam_lidar": (T * [1, 1, -1, 1])[:3].tolist()}}), "mirrors"),
        ("cam-lidar: {q: {x: 0, y: 0, z: 0, w: 2}, t: {x: 0, y: 0, z: 0}}", "length 2"),
        ("cam-lidar: {q: {x: 0, y: 0, z: 0}, t: {x: 0, y: 0, z: 0}}", "quaternion"),
        ("cam-lidar: {q: [0, 0, 0, .nan], t: [0, 0, 0]}", "not finite"),
        ("P2: 1 0 0 0 0 1 0 0 0 0 1 0", "no Tr_velo_to_cam"),
        ("R: 1 0 0 0 1 0 0 0 1\nT: 0 0 0", "needs calib_cam_to_cam.txt beside it"),
        ("a: &a [1,1]\nb: &b [*a,*a]\nc: {T_cam_lidar: [*b,*b,*b]}", "no table of numbers"),
        ("[" * 5000, "no format"),
        ("a: {x: &x [*x]}", "no format"),
    ],
)
def test_bad_files_are_refused_in_one_clause(tmp_path, text, told):
    with pytest.raises(CalibwatchError, match=told):
        read(written(tmp_path, text))


def test_a_small_yaml_that_stands_for_billions_of_numbers_costs_nothing(tmp_path):
    layers = "\n".join(f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 9)}]" for i in range(1, 12))
    bomb = f"l0: &l0 [1, 1]\n{layers}\ncam0: {{T_cam_lidar: *l11}}"
    with pytest.raises(InputError, match="no table of numbers"):
        read(written(tmp_path, bomb))


MUTATED = json.dumps({"cam0": {"T_cam_lidar": T.tolist(), "intrinsics": [1, 1, 0, 0], "resolution": [9, 9]}})


@pytest.fixture(scope="module")
def scratch(tmp_path_factory):
    return tmp_path_factory.mktemp("formats") / "file"


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_any_text_ends_in_a_rig_or_an_error(scratch, data):
    start = data.draw(st.integers(0, len(MUTATED)))
    end = data.draw(st.integers(start, len(MUTATED)))
    text = MUTATED[:start] + data.draw(st.text(max_size=6)) + MUTATED[end:]
    scratch.write_bytes(text.encode("utf-8", "surrogatepass"))
    try:
        reading = read(scratch, direction="T_cam_lidar")
        parse_rig(tomllib.loads(rig_text(reading, "a", "b")), where="test")
    except CalibwatchError:
        return
