"""The bus as a source, on real sessions: what is dropped is counted, what is published finds its type."""

import struct
import subprocess
import sys
import threading

import pytest
import zenoh
import zenoh.ext

from monitor import bus
from monitor.bus import BusSettings, Origin, listening_at, open_session
from monitor.bus_samples import Subscription
from monitor.messages import Message
from monitor.rig import parse_rig
from monitor.sources import Losses, Tick, zenoh_live
from monitor.sources.zenoh_live import INBOX, RING, SOURCE, Inbox, ZenohLive, subscriptions

GID = bytes(range(16))
TYPED = zenoh.Encoding.APPLICATION_CDR.with_schema("sensor_msgs/msg/PointCloud2")


@pytest.fixture
def sessions():
    """A listening peer and one that is connected to it."""
    with (
        open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",))) as here,
        open_session(BusSettings(mode="peer", connect=listening_at(here))) as there,
    ):
        yield here, there


def live(session, *wanted, now_ns=lambda: 7, period_s=5.0, stop=None):
    return ZenohLive(session, wanted, now_ns=now_ns, stop=stop or threading.Event(), period_s=period_s)


def matched(session, key):
    """Returns when the session knows that somebody listens to a key."""
    with session.declare_publisher(key) as publisher:
        while not publisher.matching_status.matching:
            pass


def put(session, key, sequence, *, encoding=TYPED, data=b"x"):
    session.put(key, data, encoding=encoding, attachment=Origin(sequence, 5, GID).to_bytes())


def delivered(here, there):
    """Returns when everything that ``there`` published before has been delivered to the rings of ``here``."""
    with here.declare_subscriber("barrier") as barrier:
        matched(there, "barrier")
        there.put("barrier", b"")
        barrier.recv()


def test_a_slow_reader_loses_the_oldest_and_the_count_is_the_truth(sessions):
    here, there = sessions
    with live(here, Subscription("/points", ("points",))) as source:
        items = iter(source)
        matched(there, "points")
        put(there, "points", 0)
        received = [next(items)]
        total = 1
        # Until the inbox has lost some too: how many the ring before it loses depends on how the threads run.
        while total < 200 or "queue_overflow" not in source.losses.counts:
            put(there, "points", total)
            total += 1
        delivered(here, there)
        while received[-1].sequence != total - 1:
            received.append(next(items))
    numbers = [message.sequence for message in received]
    assert numbers == sorted(set(numbers))
    assert len(received) <= 1 + INBOX + RING + 1
    lost = source.losses.counts["queue_overflow"] + source.losses.counts.get("bus_gap", 0)
    assert len(received) + lost == total
    assert source.losses.counts["queue_overflow"] > 0


def test_what_the_ring_overwrites_shows_as_a_gap(sessions):
    here, there = sessions
    taken, go_on = threading.Event(), threading.Event()

    def now_ns():
        # The thread asks for the time while it has the first sample in hand: hold it there.
        taken.set()
        go_on.wait()
        return 0

    with live(here, Subscription("/points", ("points",)), now_ns=now_ns) as source:
        matched(there, "points")
        put(there, "points", 0)
        taken.wait()
        for i in range(1, 100):
            put(there, "points", i)
        delivered(here, there)
        go_on.set()
        items = iter(source)
        received = [next(items).sequence]
        while received[-1] != 99:
            received.append(next(items).sequence)
    assert received == [0, *range(100 - RING, 100)] or source.losses.counts.get("queue_overflow", 0) == 1
    assert source.losses.counts["bus_gap"] == 100 - 1 - RING


def test_one_slow_topic_leaves_the_others_alone():
    losses = Losses()
    inbox = Inbox(losses, per_topic=2)
    for i in range(5):
        inbox.put(message("/fast", i))
    inbox.put(message("/slow", 9))
    assert [inbox.take(0).sequence for _ in range(3)] == [3, 4, 9]
    assert losses.counts == {"queue_overflow": 3}
    assert inbox.take(0) is None
    inbox.close()
    assert inbox.take(60) is None


def test_a_bus_that_invents_topics_and_faults_fills_no_memory():
    losses = Losses()
    inbox = Inbox(losses)
    for i in range(2000):
        inbox.put(message(f"/{i}", 0))
        inbox.lose("undecodable", note=f"fault {i}")
    assert losses.counts == {"undecodable": 2000, "too_many_topics": 2000 - 1024}
    assert len(inbox.describe({})) == 1024
    assert len(losses.notes) == 64


def message(topic, sequence):
    return Message(topic, "sensor_msgs/msg/Imu", "cdr", b"", 0, sequence=sequence)


@pytest.mark.parametrize(
    ("key", "wanted", "encoding", "expected"),
    [
        (
            "points",
            Subscription("/points", ("points",)),
            str(TYPED),
            ("/points", "sensor_msgs/msg/PointCloud2", "cdr"),
        ),
        (
            "0/lidar/points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_91",
            Subscription("/lidar/points", bus.keys_of("/lidar/points")),
            None,
            ("/lidar/points", "sensor_msgs/msg/PointCloud2", "cdr"),
        ),
        (
            "3/ns/cam/sensor_msgs::msg::dds_::Image_/any",
            Subscription(None, ("**",)),
            None,
            ("/ns/cam", "sensor_msgs/msg/Image", "cdr"),
        ),
        (
            "points",
            Subscription("/points", ("points",), type="sensor_msgs/msg/PointCloud2"),
            None,
            ("/points", "sensor_msgs/msg/PointCloud2", "cdr"),
        ),
        (
            "cam",
            Subscription("cam", ("cam",)),
            "application/protobuf;foxglove.CompressedImage",
            ("cam", "foxglove.CompressedImage", "protobuf"),
        ),
        (
            "cam",
            Subscription("cam", ("cam",), type="foxglove.RawImage"),
            None,
            ("cam", "foxglove.RawImage", "protobuf"),
        ),
        (
            "p",
            Subscription("p", ("p",)),
            "application/cdr;sensor_msgs::msg::dds_::PointCloud2_",
            ("p", "sensor_msgs/msg/PointCloud2", "cdr"),
        ),
    ],
)
def test_where_the_type_comes_from(sessions, key, wanted, encoding, expected):
    here, there = sessions
    with live(here, wanted) as source:
        matched(there, key)
        there.put(key, b"data", encoding=encoding)
        heard = next(iter(source))
        assert (heard.topic, heard.type, heard.encoding) == expected
        assert (heard.data, heard.log_ns, heard.sequence, heard.stamp_ns) == (b"data", 7, None, None)
        (topic,) = source.describe()
        assert (topic.name, topic.type, topic.count) == (*expected[:2], 1)


def test_the_token_of_a_bridge_tells_the_type(sessions):
    here, there = sessions
    announced = "@/abc/@ros2_lv/MP/van§points/sensor_msgs§msg§PointCloud2/:::"
    with (
        there.liveliness().declare_token(announced),
        live(here, Subscription("pts", ("van/points",))) as source,
    ):
        matched(there, "van/points")
        there.put("van/points", b"1")
        assert next(iter(source)).type == "sensor_msgs/msg/PointCloud2"


def test_a_type_that_nothing_tells_is_counted_and_told_once(sessions):
    here, there = sessions
    with live(here, Subscription("/points", ("points",))) as source:
        matched(there, "points")
        for _ in range(3):
            there.put("points", b"1")
        there.put("points", b"2", encoding=TYPED)
        assert next(iter(source)).data == b"2"
    assert source.losses.counts == {"undecodable": 3}
    (note,) = source.losses.notes
    assert "nothing tells the type" in note
    assert "lidar.type" in note


def test_a_sample_that_is_too_large_is_counted(sessions, monkeypatch):
    monkeypatch.setattr("monitor.bus_samples.LARGEST_PAYLOAD", 10)
    here, there = sessions
    with live(here, Subscription("/points", ("points",))) as source:
        matched(there, "points")
        put(there, "points", 0, data=b"x" * 11)
        put(there, "points", 1, data=b"x" * 10)
        assert next(iter(source)).sequence == 1
    assert source.losses.counts == {"undecodable": 1}


def test_transforms_that_were_published_before_are_asked_for(sessions):
    here, there = sessions
    key = "0/tf_static/tf2_msgs::msg::dds_::TFMessage_/RIHS01_e3"
    cache = zenoh.ext.CacheConfig(max_samples=10)
    publisher = zenoh.ext.declare_advanced_publisher(there, key, cache=cache, publisher_detection=True)
    publisher.put(b"early")
    rig = parse_rig(
        {"pairs": [{"name": "a", "lidar": {"topic": "/p"}, "camera": {"topic": "/c"}}]}, where="x"
    )
    with live(here, *subscriptions(rig)) as source:
        heard = next(iter(source))
        assert (heard.topic, heard.type, heard.data) == ("/tf_static", "tf2_msgs/msg/TFMessage", b"early")
        assert {topic.name for topic in source.describe() if topic.count == 0} == {"/p", "/c", "/tf"}
    publisher.undeclare()


def test_the_number_of_an_advanced_publisher_tells_gaps(sessions):
    here, there = sessions
    detection = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None)
    publisher = zenoh.ext.declare_advanced_publisher(there, "points", sample_miss_detection=detection)
    with here.declare_subscriber("points") as heard:
        matched(there, "points")
        for _ in range(4):
            publisher.put(b"1", encoding=TYPED)
        samples = [heard.recv() for _ in range(4)]
    reader = zenoh_live.SampleReader(here, Subscription("/points", ("points",)), lambda: 0)
    assert [reader.lost_before(s, reader.message(s)) for s in (samples[0], samples[1], samples[3])] == [
        (0, False),
        (0, False),
        (1, False),
    ]
    publisher.undeclare()


def test_without_numbers_gaps_are_estimated_from_the_stamps(sessions):
    here, there = sessions
    reader = zenoh_live.SampleReader(here, Subscription("/points", ("points",)), lambda: 0)
    stamps = [100 * i for i in range(60) if i not in (30, 40, 41)] + [0]
    with here.declare_subscriber("points") as heard:
        matched(there, "points")
        for ms in stamps:
            cdr = b"\0\1\0\0" + struct.pack("<iII", ms // 1000, ms % 1000 * 1_000_000, 1) + b"\0" * 64
            there.put("points", cdr, encoding=TYPED)
        samples = [heard.recv() for _ in stamps]
    found = [reader.lost_before(sample, reader.message(sample)) for sample in samples]
    assert sum(missing for missing, _ in found) == 3
    assert {estimated for _, estimated in found} == {True}


def test_a_publisher_that_starts_again_is_no_loss(sessions):
    here, there = sessions
    with live(here, Subscription("/points", ("points",))) as source:
        items = iter(source)
        matched(there, "points")
        for sequence in (5, 6, 0, 1, 1 << 60, 2):
            put(there, "points", sequence)
            assert next(items).sequence == sequence
    assert source.losses.counts == {}


def test_silence_gives_ticks_and_stop_ends(sessions):
    stop = threading.Event()
    with live(sessions[0], Subscription("/points", ("points",)), period_s=0.01, stop=stop) as source:
        items = iter(source)
        first = next(items)
        assert isinstance(first, Tick)
        assert first.now_ns == 7
        stop.set()
        assert list(items) == []


def listeners():
    return [thread for thread in threading.enumerate() if thread.name.startswith("zenoh ")]


def test_leaving_ends_the_threads_and_undeclares(sessions):
    with live(sessions[0], Subscription("/points", bus.keys_of("/points"))) as source:
        assert listeners()
    assert not listeners()
    assert list(source) == []


def test_a_fault_in_a_thread_is_told_and_ends_its_input_alone(sessions, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("broken")

    monkeypatch.setattr(zenoh_live.SampleReader, "lost_before", broken)
    here, there = sessions
    noticed = threading.Event()
    # The thread reports to the inbox last of all: what it told there is then seen.
    reported = Inbox.lose
    monkeypatch.setattr(Inbox, "lose", lambda *args, **kw: (reported(*args, **kw), noticed.set()))
    with live(here, Subscription("/points", ("points",))) as source:
        matched(there, "points")
        put(there, "points", 0)
        assert noticed.wait(10)
    assert source.losses.counts == {"input_ended": 1}
    assert "zenoh points ended: broken" in source.losses.notes[0]


def test_a_router_that_starts_again_is_found_again():
    first = open_session(BusSettings(mode="router", listen=("tcp/127.0.0.1:0",)))
    endpoints = listening_at(first)
    with (
        open_session(BusSettings(connect=endpoints)) as session,
        live(session, Subscription("/points", ("points",))) as source,
    ):
        items = iter(source)
        first.close()
        with (
            open_session(BusSettings(mode="router", listen=endpoints)),
            open_session(BusSettings(connect=endpoints)) as other,
        ):
            matched(other, "points")
            put(other, "points", 3)
            assert next(items).sequence == 3


def test_an_endpoint_is_a_source(sessions):
    here, there = sessions
    (endpoint,) = listening_at(here)
    assert SOURCE.matches(endpoint)
    assert not SOURCE.matches("/recordings/tcp/x")
    assert not SOURCE.matches("tcp")
    with SOURCE.open(endpoint) as source:
        items = iter(source)
        matched(here, "any/key")
        here.put("any/key", b"late", encoding=TYPED)
        while isinstance(item := next(items), Tick):
            pass
        assert (item.topic, item.type) == ("any/key", "sensor_msgs/msg/PointCloud2")
    del there


@pytest.mark.parametrize(("ending", "code"), [("raise SystemExit(5)", 5), ("1 / 0", 1), ("", 0)])
def test_a_process_that_ends_inside_the_source_is_not_held_back(ending, code):
    script = f"""
import threading
from monitor.bus import BusSettings, open_session
from monitor.bus_samples import Subscription
from monitor.sources.zenoh_live import ZenohLive
with open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",))) as session:
    wanted = (Subscription("/a", ("a",)),)
    with ZenohLive(session, wanted, now_ns=lambda: 0, stop=threading.Event()):
        {ending or "pass"}
"""
    done = subprocess.run(  # noqa: S603 - our own interpreter on the script above
        [sys.executable, "-c", script], timeout=60, capture_output=True, check=False
    )
    assert done.returncode == code, done.stderr.decode()
