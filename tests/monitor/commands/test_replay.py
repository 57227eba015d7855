"""``calibwatch replay`` from the recording to the verdict: what is told of known drifts, and of bad input."""

import dataclasses
import json
import struct

import numpy as np
import pytest

from monitor.messages import Message, decode
from monitor.messages.point_cloud2 import encode_point_cloud2
from pipeline.records import PointCloud
from tests import drives
from tests.drives import CLOUD_TOPIC, IMAGE_TOPIC, INFO_TOPIC, TF_TOPIC
from tests.oracles.onnx_bytes import block_means

AXES = ("roll", "pitch", "yaw", "forward", "left", "up")


def statuses(folder):
    return [json.loads(line) for line in (folder / "status.jsonl").read_bytes().splitlines()]


# What is told of a drive.


def test_a_healthy_drive_is_not_drifted_and_its_files_are_whole(replayed, cut, tmp_path):
    code, err, summary = replayed(cut(20))
    assert (code, err) == (4, "")
    assert summary["state"] == "unobservable"
    assert summary["complete"]
    assert summary["warnings"] == []
    pair = summary["pairs"]["camera"]
    assert pair["last"]["code"] == "too_short"
    assert all(change["state"] in ("starting", "unobservable") for change in pair["timeline"])
    assert pair["frames"] == {"received": 40, "used": 40, "dropped": {}}
    assert abs(pair["last"]["drift"]["yaw"]["value"]) < 0.2
    files = {"recording.rrd", "report.html", "status.jsonl", "summary.json"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == files


@pytest.mark.parametrize(
    ("axis", "amount", "within"),
    [("yaw", 1.0, 0.15), ("yaw", -1.0, 0.15), ("pitch", 1.0, 0.5), ("pitch", -1.0, 0.5), ("roll", -2.0, 0.8)],
)
def test_an_injected_drift_is_told_with_axis_sign_and_size(replayed, cut, axis, amount, within):
    code, err, summary = replayed(cut(12), "--inject", f"{axis}={amount}")
    assert (code, err, summary["state"]) == (3, "", "drifted")
    last = summary["pairs"]["camera"]["last"]
    assert last["drift"]["axes"] == "vehicle"
    assert last["drift"][axis]["value"] == pytest.approx(amount, abs=within)
    excess = {name: abs(last["drift"][name]["value"]) / last["drift"][name]["alert_limit"] for name in AXES}
    assert max(excess, key=excess.get) == axis
    assert axis in last["reason"]
    assert f"{amount:+.2f}"[0] in last["reason"]
    assert last["severity"] == "major"
    assert f"a drift of {axis} {amount:+g} deg is true" in summary["note"]
    assert summary["complete"]


def test_exit_zero_turns_the_verdicts_code_off_and_json_prints_the_summary(calibwatch, cut, tmp_path):
    code, out, err = calibwatch(
        "replay", cut(12), "--inject", "yaw=1", "--out", tmp_path, "--exit-zero", "--json"
    )
    assert (code, err) == (0, "")
    assert json.loads(out) == json.loads((tmp_path / "summary.json").read_bytes())
    assert json.loads(out)["state"] == "drifted"


def test_a_mount_that_slips_is_told_after_it_slipped(replayed, drive):
    code, _, summary = replayed(drive)
    assert code == 3
    pair = summary["pairs"]["camera"]
    told = [change for change in pair["timeline"] if change["state"] == "drifted"]
    assert len(told) == 1
    assert drives.SLIP_NS < told[0]["stamp_ns"] < drives.SLIP_NS + 4_000_000_000
    assert all(
        change["stamp_ns"] > drives.SLIP_NS for change in pair["timeline"] if change["state"] == "suspect"
    )
    assert pair["last"]["drift"]["yaw"]["value"] == pytest.approx(drives.SLIP_DEG, abs=0.15)
    onset = pair["last"]["onset"]
    assert onset["from_ns"] <= drives.SLIP_NS <= onset["to_ns"]


def test_the_same_recording_says_the_same_twice_and_over_zenoh(calibwatch, cut, tmp_path):
    told = []
    for name, options in (("first", ()), ("second", ()), ("bus", ("--over-zenoh",))):
        out = tmp_path / name
        code, _, err = calibwatch("replay", cut(12), "--inject", "yaw=1", "--out", out, *options)
        assert (code, err) == (3, "")
        told.append([{**status, "timing_ms": None} for status in statuses(out)])
    assert len(told[0]) >= 4
    assert told[0][-1]["state"] == "drifted"
    assert told[1] == told[0]
    assert told[2] == told[0]


@pytest.mark.parametrize("shift_ns", [3600 * 10**9, -drives.START_NS])
def test_the_clock_of_the_recorder_decides_nothing(replayed, messages, tmp_path, shift_ns):
    first = drives.first_frames(messages, 12)
    shifted = [dataclasses.replace(message, log_ns=message.log_ns + shift_ns) for message in first]
    _, _, summary = replayed(drives.write(tmp_path / "shifted.mcap", shifted), "--inject", "yaw=1")
    pair = summary["pairs"]["camera"]
    assert pair["state"] == "drifted"
    span = range(drives.START_NS, drives.SLIP_NS)
    assert all(pair["last"]["onset"][key] in span for key in ("stamp_ns", "from_ns", "to_ns"))
    assert pair["last"]["since_ns"] in span


# Input that is partly bad: what is good is judged, and one line says what is not.


def image_lost(message):
    return dataclasses.replace(message, data=message.data[:200] + bytes(500))


def test_one_undecodable_image_is_a_drop_that_is_told_once(replayed, messages, tmp_path):
    first = drives.first_frames(messages, 5)
    bad = [
        image_lost(message) if (message.topic, message.sequence) == (IMAGE_TOPIC, 2) else message
        for message in first
    ]
    code, err, summary = replayed(drives.write(tmp_path / "bad.mcap", bad))
    assert (code, summary["state"], summary["complete"]) == (4, "unobservable", True)
    frames = summary["pairs"]["camera"]["frames"]
    assert frames["dropped"]["undecodable"] == 1
    assert frames["received"] == frames["used"] + sum(frames["dropped"].values()) == 10
    lines = err.splitlines()
    assert len(lines) == 2
    assert f"topic {IMAGE_TOPIC}: the bytes are no sensor_msgs/msg/CompressedImage" in lines[0]
    assert "2 of 10 frames dropped (1 gap_too_large, 1 undecodable)" in lines[1]


def test_a_cloud_without_intensity_works_and_says_what_it_costs(replayed, messages, tmp_path):
    def bare(message):
        cloud = decode(Message(message.topic, message.type, "cdr", message.data, 0))[0].value
        cloud = PointCloud(cloud.xyz, None, cloud.ring, cloud.time)
        data = encode_point_cloud2(cloud, drives.stamp_of(message), "lidar")
        return dataclasses.replace(message, data=data)

    first = drives.changed(drives.first_frames(messages, 12), CLOUD_TOPIC, bare)
    code, err, summary = replayed(drives.write(tmp_path / "bare.mcap", first), "--inject", "yaw=1")
    assert (code, summary["pairs"]["camera"]["frames"]["used"]) == (3, 24)
    assert err == f"warning: topic {CLOUD_TOPIC} has no intensity: its clouds show no lane markings\n"


def test_of_a_truncated_file_what_is_whole_is_judged(replayed, cut, tmp_path):
    data = cut(5).read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[: len(data) * 6 // 10])
    code, err, summary = replayed(path)
    assert (code, summary["complete"]) == (4, True)
    assert 2 <= summary["pairs"]["camera"]["frames"]["used"] < 10
    assert err.splitlines()[0].startswith("warning: cut.mcap: ")
    assert "the rest is missing or damaged after byte" in err.splitlines()[0]


def test_a_flipped_bit_costs_its_chunk_and_is_told(replayed, messages, tmp_path):
    path = drives.write(tmp_path / "flip.mcap", drives.first_frames(messages, 5), chunk_bytes=100_000)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    code, err, summary = replayed(path)
    assert (code, summary["complete"]) == (4, True)
    assert summary["pairs"]["camera"]["frames"]["used"] >= 6
    assert "1 damaged chunks, the first after byte" in err.splitlines()[0]


def test_stamps_that_run_backwards_are_dropped_and_told(replayed, messages, tmp_path):
    def back(message):
        return drives.stamped(message, drives.stamp_of(message) - 200_000_000 * message.sequence)

    first = drives.first_frames(messages, 4)
    ran_back = drives.changed(drives.changed(first, IMAGE_TOPIC, back), CLOUD_TOPIC, back)
    code, err, summary = replayed(drives.write(tmp_path / "back.mcap", ran_back))
    assert (code, summary["state"]) == (4, "unobservable")
    assert "(6 stamp_backwards)" in err


def test_stamps_that_jump_start_a_new_window(replayed, messages, tmp_path):
    hour = 3600 * 10**9

    def jump(message):
        return drives.stamped(message, drives.stamp_of(message) + (hour if message.sequence >= 4 else 0))

    first = drives.first_frames(messages, 18)
    jumped = drives.changed(drives.changed(first, IMAGE_TOPIC, jump), CLOUD_TOPIC, jump)
    code, err, summary = replayed(drives.write(tmp_path / "jump.mcap", jumped), "--inject", "yaw=1")
    pair = summary["pairs"]["camera"]
    assert (code, err) == (3, "warning: pair camera: stamps of its inputs jump 2 times\n")
    assert pair["frames"] == {"received": 36, "used": 36, "dropped": {}}
    told = next(change for change in pair["timeline"] if change["state"] == "drifted")
    # Four frames before the jump are too few; none of them may count after it.
    assert told["stamp_ns"] > drives.START_NS + hour + 800_000_000


# Input that can not be used: one line, exit 1, and nothing that looks whole.


def refused(result, tmp_path, *parts):
    code, err, summary = result
    assert code == 1
    assert len(err.splitlines()) == 1, err
    assert err.startswith("calibwatch: ")
    assert "internal error" not in err
    for part in parts:
        assert part in err
    assert summary is None
    out = tmp_path / "out"
    names = {path.name for path in out.iterdir()} if out.exists() else set()
    assert names <= {"recording.partial.rrd", "status.jsonl.partial"}


def test_a_file_that_is_not_there(replayed, tmp_path):
    refused(replayed(tmp_path / "nothing.mcap"), tmp_path, "nothing.mcap does not exist")


@pytest.mark.parametrize(("content", "told"), [(b"", "is empty"), (b"hello" * 99, "is no MCAP file")])
def test_a_file_that_is_no_recording(replayed, tmp_path, content, told):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    refused(replayed(path), tmp_path, f"x.mcap {told}")


def test_a_folder_and_a_text_that_are_no_recording(replayed, tmp_path):
    (tmp_path / "folder").mkdir()
    refused(replayed(tmp_path / "folder"), tmp_path, "understood: .mcap")
    (tmp_path / "a.txt").write_text("hello")
    refused(replayed(tmp_path / "a.txt"), tmp_path, "understood: .mcap")


def test_a_bus_is_no_recording(replayed, tmp_path):
    refused(replayed("tcp/127.0.0.1:1"), tmp_path, "calibwatch run watches a bus")


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (
            ("/lidar/points", "/lidar/pionts"),
            ("has no topic /lidar/pionts", "did you mean '/lidar/points'?", IMAGE_TOPIC, TF_TOPIC),
        ),
        (
            ("/lidar/points", "/tf_static"),
            (
                "topic /tf_static (pair front) carries tf2_msgs/msg/TFMessage, not a point cloud",
                CLOUD_TOPIC,
            ),
        ),
        (
            (IMAGE_TOPIC, CLOUD_TOPIC),
            ("carries sensor_msgs/msg/PointCloud2, not an image (an image is in: " + IMAGE_TOPIC,),
        ),
        (("camera =", "camra ="), ("rig.toml: pairs[0].camra is not a known key (did you mean 'camera'?",)),
        (("[[pairs]]", "[[pairs"), ("rig.toml is not TOML",)),
        (
            (f'info = "{INFO_TOPIC}"', "width = 640, height = 203, K = [[0,0,0],[0,0,0],[0,0,1]]"),
            ("pairs[0].camera: camera matrix K", "no positive focal length"),
        ),
        (
            (f'info = "{INFO_TOPIC}"', "width = 1280, height = 406, K = [[854,0,639],[0,854,193],[0,0,1]]"),
            ("images are 640x203 px, the rig says 1280x406 (give the intrinsics for this size)",),
        ),
        (
            ('vehicle = "van-1"', 'vehicle = "van 1"'),
            ("rig.toml: vehicle",),
        ),
    ],
)
def test_a_rig_that_does_not_fit(replayed, cut, tmp_path, change, parts):
    assert drives.RIG.count(change[0]) == 1
    rig = tmp_path / "rig.toml"
    rig.write_text(drives.RIG.replace(*change))
    refused(replayed(cut(5), "--rig", rig), tmp_path, *parts)


def test_an_extrinsic_that_is_no_rigid_motion(replayed, cut, tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text(
        drives.RIG + "[pairs.extrinsic]\nT_cam_lidar = [[1,0,0.2,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]\n"
    )
    refused(replayed(cut(5), "--rig", rig), tmp_path, "T_cam_lidar: the rotation is not orthonormal (off by")


def test_a_rig_that_is_not_there(replayed, cut, tmp_path):
    refused(replayed(cut(5), "--rig", tmp_path / "no.toml"), tmp_path, "no.toml can not be read")


def without(messages, topic):
    return [message for message in drives.first_frames(messages, 3) if message.topic != topic]


@pytest.mark.parametrize(
    ("topic", "told"),
    [
        (CLOUD_TOPIC, "no topic with point clouds"),
        (IMAGE_TOPIC, "no topic with images"),
        (INFO_TOPIC, "no CameraInfo for " + IMAGE_TOPIC),
        (TF_TOPIC, "no transforms (tf_static)"),
    ],
)
def test_a_recording_without_a_topic_that_is_needed(replayed, messages, tmp_path, topic, told):
    path = drives.write(tmp_path / "less.mcap", without(messages, topic))
    refused(replayed(path), tmp_path, told, "--rig")


@pytest.mark.parametrize("with_rig", [False, True])
@pytest.mark.parametrize("topic", [IMAGE_TOPIC, CLOUD_TOPIC])
def test_a_topic_of_which_nothing_can_be_decoded(replayed, messages, tmp_path, topic, with_rig):
    rig = tmp_path / "rig.toml"
    # What the recording would tell of frames and transforms is in the rig: nothing is decoded before the run.
    rig.write_text(
        drives.RIG.replace(f'info = "{INFO_TOPIC}"', drives.INTRINSICS)
        + "[pairs.extrinsic]\nT_cam_lidar = [[0,-1,0,0],[0,0,-1,0],[1,0,0,0],[0,0,0,1]]\n"
    )
    bad = drives.changed(drives.first_frames(messages, 3), topic, image_lost)
    path = drives.write(tmp_path / "bad.mcap", bad)
    refused(replayed(path, *(("--rig", rig) if with_rig else ())), tmp_path, f"topic {topic}", "bytes")


def test_intrinsics_of_zeros_in_the_recording(replayed, messages, tmp_path):
    def zeroed(message):
        focal = struct.pack("<d", drives.FOCAL)
        assert focal in message.data
        return dataclasses.replace(message, data=message.data.replace(focal, bytes(8)))

    bad = drives.changed(drives.first_frames(messages, 3), INFO_TOPIC, zeroed)
    path = drives.write(tmp_path / "zero.mcap", bad)
    refused(replayed(path), tmp_path, INFO_TOPIC, "no positive focal length")


def test_clocks_that_are_an_hour_apart(replayed, messages, tmp_path):
    def late(message):
        return drives.stamped(message, drives.stamp_of(message) + 3600 * 10**9)

    bad = drives.changed(drives.first_frames(messages, 3), IMAGE_TOPIC, late)
    path = drives.write(tmp_path / "hour.mcap", bad)
    refused(replayed(path), tmp_path, "camera stamps are +3600.0", "synchronise the clocks")


def test_clouds_without_points_are_a_verdict_of_nothing(replayed, messages, tmp_path):
    def empty(message):
        cloud = PointCloud(np.zeros((0, 3), np.float32))
        data = encode_point_cloud2(cloud, drives.stamp_of(message), "lidar")
        return dataclasses.replace(message, data=data)

    bad = drives.changed(drives.first_frames(messages, 3), CLOUD_TOPIC, empty)
    code, _, summary = replayed(drives.write(tmp_path / "empty.mcap", bad))
    assert (code, summary["pairs"]["camera"]["last"]["code"]) == (4, "no_pairs")
    assert summary["pairs"]["camera"]["frames"]["dropped"]["empty_cloud"] >= 4


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (None, ("model.onnx can not be read", "--model wants a .onnx file")),
        (b"not onnx" * 50, ("no readable ONNX model",)),
        (block_means({}), ("the model's metadata has no 'class_names'",)),
        (block_means({"class_names": "sky"}), ("the model's class_names is 'sky', wanted",)),
    ],
    ids=["missing", "damaged", "no contract", "other classes"],
)
def test_a_model_that_is_missing_or_of_another_contract(replayed, cut, tmp_path, content, parts):
    model = tmp_path / "model.onnx"
    if content is not None:
        model.write_bytes(content)
    refused(replayed(cut(5), "--model", model), tmp_path, *parts)


@pytest.mark.parametrize("place", ["file/below", "taken"])
def test_a_place_that_can_not_be_written_to(calibwatch, cut, tmp_path, place):
    (tmp_path / "file").write_text("")
    (tmp_path / "taken" / "summary.json").mkdir(parents=True)
    code, out, err = calibwatch("replay", cut(5), "--out", tmp_path / place)
    assert (code, out) == (1, "")
    assert len(err.splitlines()) == 1
    assert f"{tmp_path / place} can not be written to" in err
    assert "name another folder with --out" in err


@pytest.mark.parametrize(
    ("inject", "told"), [("yow=1", "did you mean 'yaw'?"), ("yaw=much", "'much' is no number for yaw")]
)
def test_a_wrong_axis_is_wrong_usage(calibwatch, tmp_path, inject, told):
    code, _, err = calibwatch("replay", "drive.mcap", "--inject", inject, "--out", tmp_path / "out")
    assert code == 2
    assert told in err
    assert not (tmp_path / "out").exists()


def test_files_of_an_earlier_run_do_not_pass_for_those_of_one_that_failed(replayed, cut, messages, tmp_path):
    assert replayed(cut(5))[2]["complete"]
    bad = drives.changed(drives.first_frames(messages, 3), IMAGE_TOPIC, lambda m: drives.stamped(m, 1))
    refused(replayed(drives.write(tmp_path / "bad.mcap", bad)), tmp_path)
