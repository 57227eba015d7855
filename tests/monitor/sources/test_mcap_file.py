"""MCAP files against what was written into them: whole, cut anywhere, with any byte flipped."""

import struct
import tracemalloc

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import breakup_chunk
from mcap.writer import CompressionType, Writer

from monitor.messages import Message
from monitor.sources.mcap_file import MAGIC, SOURCE, ros_type
from pipeline.errors import InputError

COUNT = 60
CODECS = [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD]


def written(path, *, compression=CompressionType.ZSTD, chunked=True, shuffle=False, encoding="cdr"):
    """A recording of two topics; gives the truth as (topic, log_ns, data)."""
    rng = np.random.default_rng(5)
    stamps = np.arange(COUNT) * 100
    if shuffle:
        stamps = stamps + rng.integers(-250, 250, COUNT)
    truth = []
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=2000, compression=compression, use_chunking=chunked)
        writer.start(profile="ros2")
        schema = writer.register_schema("sensor_msgs/msg/PointCloud2", "ros2msg", b"")
        other = writer.register_schema("sensor_msgs/Imu", "ros1msg", b"")
        channels = [
            writer.register_channel("/a", encoding, schema),
            writer.register_channel("/b", encoding, other),
        ]
        for i, stamp in enumerate(stamps):
            data = rng.integers(0, 8, int(rng.integers(0, 300))).astype(np.uint8).tobytes()
            log_ns = int(stamp) + 10_000
            writer.add_message(channels[i % 2], log_time=log_ns, data=data, publish_time=0, sequence=i)
            truth.append(("/a" if i % 2 == 0 else "/b", log_ns, data))
        writer.finish()
    return truth


def headless_lz4(data):
    """LZ4 that does not say how much it holds."""
    return lz4.frame.compress(data, store_size=False)


def read(path):
    with SOURCE.open(str(path)) as source:
        messages = list(source)
    assert all(isinstance(message, Message) for message in messages)
    return [(message.topic, message.log_ns, message.data) for message in messages], source.losses


def chunk_offsets(path):
    with path.open("rb") as file:
        return sorted(entry.chunk_start_offset for entry in make_reader(file).get_summary().chunk_indexes)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("mcap") / "good.mcap"
    return path, written(path)


@pytest.mark.parametrize("compression", CODECS)
@pytest.mark.parametrize("chunked", [True, False])
def test_everything_comes_back(tmp_path, compression, chunked):
    truth = written(tmp_path / "a.mcap", compression=compression, chunked=chunked)
    messages, losses = read(tmp_path / "a.mcap")
    assert messages == truth
    assert losses.counts == {}
    assert losses.notes == []


def test_messages_come_in_the_order_of_log_time_whatever_the_file_says(tmp_path):
    truth = written(tmp_path / "a.mcap", shuffle=True)
    assert truth != sorted(truth, key=lambda message: message[1])
    messages, _ = read(tmp_path / "a.mcap")
    assert [m[1] for m in messages] == sorted(m[1] for m in truth)
    assert sorted(messages) == sorted(truth)


def test_a_message_comes_before_the_rest_of_the_file_is_unpacked(recording, monkeypatch):
    unpacked = []

    def counting(chunk, *, validate_crc):
        unpacked.append(chunk)
        return breakup_chunk(chunk, validate_crc=validate_crc)

    monkeypatch.setattr("monitor.sources.mcap_file.breakup_chunk", counting)
    with SOURCE.open(str(recording[0])) as source:
        ahead = [len(unpacked) for _ in source]
    assert ahead[0] <= 2
    assert ahead[COUNT // 2] <= len(unpacked) / 2 + 2


def test_a_flipped_summary_is_not_believed(recording, tmp_path):
    path, _ = recording
    raw = path.read_bytes()
    with path.open("rb") as file:
        start = make_reader(file).get_summary().chunk_indexes[-1]
        first = start.chunk_start_offset + start.chunk_length
    bad = tmp_path / "bad.mcap"
    for at in range(first + start.message_index_length, len(raw)):
        bad.write_bytes(raw[:at] + bytes([raw[at] ^ 0x01]) + raw[at + 1 :])
        with SOURCE.open(str(bad)) as source:
            assert [(topic.name, topic.count) for topic in source.describe()] == [("/a", 30), ("/b", 30)], at


def test_topics_are_told_with_counts_and_rates(recording):
    with SOURCE.open(str(recording[0])) as source:
        a, b = source.describe()
        assert (a.name, a.type, a.count, a.understood) == ("/a", "sensor_msgs/msg/PointCloud2", 30, True)
        assert (b.name, b.type, b.count, b.understood) == ("/b", "sensor_msgs/msg/Imu", 30, False)
        assert a.rate_hz == pytest.approx(29 / (59 * 100e-9))
        assert source.rig_document() is None


@settings(max_examples=120, deadline=None)
@given(st.data())
def test_a_file_that_is_cut_gives_what_is_whole_and_says_so(recording, tmp_path_factory, data):
    path, truth = recording
    raw = path.read_bytes()
    size = data.draw(st.integers(len(MAGIC), len(raw) - 1))
    cut = tmp_path_factory.mktemp("cut") / "cut.mcap"
    cut.write_bytes(raw[:size])
    messages, losses = read(cut)
    assert messages == truth[: len(messages)]
    assert any(f"{len(messages)} messages read" in note for note in losses.notes)
    with SOURCE.open(str(cut)) as source:
        assert sum(topic.count for topic in source.describe()) == len(messages)


def test_a_cut_costs_no_chunk_before_it(recording, tmp_path):
    path, truth = recording
    raw = path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(raw[: len(raw) * 3 // 5])
    messages, losses = read(tmp_path / "cut.mcap")
    assert len(messages) > len(truth) // 3
    assert losses.counts["rest_of_file"] == 1
    assert f"of {len(raw) * 3 // 5}" in losses.notes[0]


@settings(max_examples=250, deadline=None)
@given(st.data())
def test_a_flipped_bit_never_gives_a_wrong_message_and_what_is_lost_is_counted(
    recording, tmp_path_factory, data
):
    path, truth = recording
    raw = bytearray(path.read_bytes())
    raw[data.draw(st.integers(len(MAGIC), len(raw) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    flipped = tmp_path_factory.mktemp("flip") / "flip.mcap"
    flipped.write_bytes(raw)
    messages, losses = read(flipped)
    assert sorted(set(messages) - set(truth)) == []
    assert len(messages) == len(set(messages))
    if len(messages) < len(truth):
        assert losses.counts
        assert losses.notes


def test_one_bad_chunk_costs_its_own_messages_and_is_told_with_its_place(recording, tmp_path):
    path, truth = recording
    raw = bytearray(path.read_bytes())
    offsets = chunk_offsets(path)
    raw[offsets[2] + 60] ^= 0xFF
    (tmp_path / "bad.mcap").write_bytes(raw)
    messages, losses = read(tmp_path / "bad.mcap")
    lost = len(truth) - len(messages)
    assert 0 < lost < len(truth) / 2
    assert losses.counts == {"damaged_chunk": 1, "damaged_message": lost}
    (note,) = losses.notes
    assert f"{len(messages)} of {len(truth)} messages read" in note
    assert f"after byte {offsets[2]}" in note


def test_a_chunk_that_claims_to_be_huge_is_refused_before_it_is_unpacked(recording, tmp_path):
    path, _ = recording
    raw = bytearray(path.read_bytes())
    first = chunk_offsets(path)[0]
    # Opcode and length, then start time, end time, uncompressed size.
    struct.pack_into("<Q", raw, first + 9 + 16, 1 << 60)
    (tmp_path / "huge.mcap").write_bytes(raw)
    _, losses = read(tmp_path / "huge.mcap")
    assert losses.counts["damaged_chunk"] == 1


@pytest.mark.parametrize(
    ("compression", "pack"),
    [("lz4", lz4.frame.compress), ("zstd", zstandard.compress), ("lz4", headless_lz4)],
)
@pytest.mark.parametrize("declared", [1000, 1 << 28])
def test_a_small_chunk_that_unpacks_to_a_huge_one_takes_no_memory(tmp_path, compression, pack, declared):
    packed = pack(bytes(1 << 27))
    head = struct.pack("<QQQII", 0, 1, declared, 0, len(compression)) + compression.encode()
    body = head + struct.pack("<Q", len(packed)) + packed
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + struct.pack("<BQ", 6, len(body)) + body)
    tracemalloc.start()
    messages, losses = read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert messages == []
    assert losses.counts["damaged_chunk"] == 1
    if declared == 1000:
        assert peak < 32 << 20


def test_a_record_that_claims_to_be_longer_than_the_file_ends_the_reading(tmp_path):
    path = tmp_path / "long.mcap"
    path.write_bytes(MAGIC + struct.pack("<BQ", 6, 1 << 62) + b"x" * 100)
    messages, losses = read(path)
    assert messages == []
    assert losses.counts == {"rest_of_file": 1}


def test_encodings_that_are_not_understood_are_counted_and_told_once_per_topic(tmp_path):
    written(tmp_path / "json.mcap", encoding="json")
    messages, losses = read(tmp_path / "json.mcap")
    assert messages == []
    assert losses.counts["encoding_not_understood"] == COUNT
    assert len([note for note in losses.notes if "encoding 'json'" in note]) == 2


@pytest.mark.parametrize(
    ("content", "words"),
    [(b"", "is empty"), (b"junk" * 100, "is no MCAP file"), (MAGIC[:5], "is no MCAP file")],
)
def test_files_that_are_no_mcap(tmp_path, content, words):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    assert SOURCE.matches(str(path))
    with pytest.raises(InputError, match=rf"x.mcap {words}"):
        SOURCE.open(str(path))


def test_a_missing_file():
    with pytest.raises(InputError, match=r"absent\.mcap does not exist"):
        SOURCE.open("absent.mcap")


def test_a_file_is_known_by_its_first_bytes_too(recording, tmp_path):
    copy = tmp_path / "recording.dat"
    copy.write_bytes(recording[0].read_bytes())
    assert SOURCE.matches(str(copy))
    assert not SOURCE.matches(str(tmp_path))


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("sensor_msgs/PointCloud2", "sensor_msgs/msg/PointCloud2"),
        ("sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/PointCloud2"),
        ("sensor_msgs::msg::dds_::PointCloud2_", "sensor_msgs/msg/PointCloud2"),
        ("", ""),
    ],
)
def test_type_names_of_all_ros_releases(name, expected):
    assert ros_type(name) == expected
