"""rosbag2 and ROS 1 recordings, written by rosbags and read back, whole and damaged."""

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from monitor.messages import decode
from monitor.sources import open_source, ros1_bag, rosbag2_folder
from pipeline.errors import InputError

COUNT = 30
TYPE = "tf2_msgs/msg/TFMessage"


def payloads():
    """A transform each, stamped 0, 1, 2, ... ns, in CDR."""
    store = get_typestore(Stores.ROS2_JAZZY)
    make = {name.rsplit("/", 1)[-1]: kind for name, kind in store.types.items()}
    motion = make["Transform"](make["Vector3"](1.0, 2.0, 3.0), make["Quaternion"](0.0, 0.0, 0.0, 1.0))
    headers = [make["Header"](make["Time"](0, i), "a") for i in range(COUNT)]
    messages = [make["TFMessage"]([make["TransformStamped"](header, "b", motion)]) for header in headers]
    return [bytes(store.serialize_cdr(message, TYPE)) for message in messages]


def rosbag2(folder, plugin, *, compressed=None):
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer2(folder, version=9, storage_plugin=plugin)
    if compressed is not None:
        writer.set_compression(compressed, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/tf_static", TYPE, typestore=store)
        for i, data in enumerate(payloads()):
            writer.write(connection, 100 * i, data)
    return folder


def ros1(path):
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer1(path) as writer:
        connection = writer.add_connection("/tf_static", TYPE, typestore=store)
        for i, data in enumerate(payloads()):
            raw = store.cdr_to_ros1(data, TYPE)
            writer.write(connection, 100 * i, bytes(raw))
    return path


def check(source, encoding):
    with source:
        (topic,) = source.describe()
        assert (topic.name, topic.type, topic.count, topic.understood) == ("/tf_static", TYPE, COUNT, True)
        assert topic.rate_hz == pytest.approx(1e7, rel=0.01)
        messages = list(source)
        assert source.rig_document() is None
    assert [message.log_ns for message in messages] == [100 * i for i in range(COUNT)]
    assert {(m.topic, m.type, m.encoding) for m in messages} == {("/tf_static", TYPE, encoding)}
    assert [decode(message)[0].stamp_ns for message in messages] == list(range(COUNT))
    assert source.losses.counts == {}


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("compressed", [None, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_rosbag2_comes_back(tmp_path, plugin, compressed):
    if plugin is StoragePlugin.MCAP and compressed is CompressionMode.FILE:
        pytest.skip("rosbags does not write it")
    check(open_source(str(rosbag2(tmp_path / "bag", plugin, compressed=compressed))), "cdr")


def test_a_lone_database_and_a_folder_without_metadata(tmp_path):
    folder = rosbag2(tmp_path / "bag", StoragePlugin.SQLITE3)
    check(open_source(str(next(folder.glob("*.db3")))), "cdr")
    (folder / "metadata.yaml").unlink()
    check(open_source(str(folder)), "cdr")


def test_ros1_comes_back_with_the_type_names_of_ros2(tmp_path):
    check(open_source(str(ros1(tmp_path / "a.bag"))), "ros1")


def series(folder, parts=12):
    """A recording split into files of two messages, as `ros2 bag record --max-bag-size` leaves it."""
    folder.mkdir()
    for part in range(parts):
        with (folder / f"bag_{part}.mcap").open("wb") as file:
            writer = McapWriter(file)
            writer.start("ros2")
            schema = writer.register_schema(TYPE, "ros2msg", b"")
            channel = writer.register_channel("/tf", "cdr", schema)
            for i in range(2):
                writer.add_message(channel, log_time=2 * part + i, data=b"x", publish_time=0)
            writer.finish()
    listed = "".join(f"    - bag_{part}.mcap\n" for part in range(parts))
    head = "rosbag2_bagfile_information:\n  storage_identifier: mcap\n  relative_file_paths:\n"
    (folder / "metadata.yaml").write_text(head + listed)
    return folder


def test_a_series_of_files_is_read_in_the_order_of_their_numbers(tmp_path):
    with open_source(str(series(tmp_path / "bag"))) as source:
        assert [(t.name, t.count) for t in source.describe()] == [("/tf", 24)]
        assert [message.log_ns for message in source] == list(range(24))
    assert source.losses.notes == []


def test_files_of_a_series_that_are_missing_or_empty_are_told_and_the_rest_is_read(tmp_path):
    folder = series(tmp_path / "bag")
    (folder / "bag_3.mcap").unlink()
    (folder / "bag_5.mcap").write_bytes(b"")
    with open_source(str(folder)) as source:
        assert len(list(source)) == 20
    assert source.losses.counts == {"unreadable_file": 2}
    assert sorted(note.split("/")[-1] for note in source.losses.notes) == [
        "bag_3.mcap is missing",
        "bag_5.mcap is empty",
    ]


def test_damage_inside_one_file_of_a_series_is_passed_on(tmp_path):
    folder = series(tmp_path / "bag")
    raw = (folder / "bag_2.mcap").read_bytes()
    (folder / "bag_2.mcap").write_bytes(raw[: len(raw) - 20])
    with open_source(str(folder)) as source:
        assert len(list(source)) == 24
    assert (
        "bag_2.mcap: 2 messages read; the summary at its end is missing or damaged" in source.losses.notes[0]
    )


def test_a_series_without_any_readable_file(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"")
    with pytest.raises(InputError, match=r"no readable \.mcap file"):
        rosbag2_folder.SOURCE.open(str(tmp_path))


def outcomes(build, good, path, *, step):
    """Reads every ``step``-th prefix and byte flip of a good file: messages of the truth, or InputError."""
    raw = good.read_bytes()
    rng = np.random.default_rng(1)
    for size in range(0, len(raw), step):
        for damaged in (raw[:size], flipped(raw, int(rng.integers(len(raw))))):
            path.write_bytes(damaged)
            try:
                with build(str(path)) as source:
                    messages = list(source)
            except InputError as error:
                yield None, str(error)
                continue
            yield messages, source.losses


def flipped(raw, at):
    damaged = bytearray(raw)
    damaged[at] ^= 0x10
    return bytes(damaged)


def test_damaged_ros1_bags_end_in_a_count_or_an_input_error(tmp_path):
    good = ros1(tmp_path / "good.bag")
    seen = list(outcomes(ros1_bag.SOURCE.open, good, tmp_path / "bad.bag", step=137))
    assert any(messages is None for messages, _ in seen)
    for messages, told in seen:
        if messages is not None and len(messages) < COUNT:
            assert told.counts
            assert told.notes


def test_damaged_databases_end_in_a_count_or_an_input_error(tmp_path):
    good = next(rosbag2(tmp_path / "bag", StoragePlugin.SQLITE3).glob("*.db3"))
    seen = list(outcomes(rosbag2_folder.SOURCE.open, good, tmp_path / "bad.db3", step=997))
    assert any(messages is None for messages, _ in seen)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.bag", b"", "a.bag is empty"),
        ("a.bag", b"no bag at all", "a.bag is no ROS 1 bag"),
        ("a.db3", b"", "a.db3 can not be read"),
        ("a.db3", b"no database" * 100, "a.db3 can not be read"),
    ],
)
def test_files_that_are_no_recording(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words):
        open_source(str(tmp_path / name))


@pytest.mark.parametrize("name", ["absent.bag", "absent.db3"])
def test_missing_files(name):
    with pytest.raises(InputError, match=f"{name} does not exist"):
        open_source(name)


def test_metadata_that_is_no_metadata(tmp_path):
    folder = rosbag2(tmp_path / "bag", StoragePlugin.SQLITE3)
    for text in ("{", "a: [", "rosbag2_bagfile_information: 5", "x: &a [*a, *a]"):
        (folder / "metadata.yaml").write_text(text)
        with pytest.raises(InputError, match="can not be read"):
            open_source(str(folder))
