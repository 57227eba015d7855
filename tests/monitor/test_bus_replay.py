"""Recordings over the bus: the same messages come out, in the same order, however slow the reader is."""

import os
import threading
from pathlib import Path

import pytest

from monitor import bus_replay
from monitor.bus import BusSettings, listening_at, open_session
from monitor.bus_replay import WINDOW, OverBus, Pace, ReplayReader, ReplayWriter
from monitor.intake import Intake
from monitor.messages import Message
from monitor.preparation import prepare
from monitor.sources import Losses, Tick, TopicInfo, open_source
from pipeline.errors import InputError, TransportError

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[3] / "shared" / "data"))
KINDS = (
    ("/lidar/points", "sensor_msgs/msg/PointCloud2", "cdr"),
    ("/cam", "foxglove.CompressedImage", "protobuf"),
    ("/old", "sensor_msgs/msg/Image", "ros1"),
    ("image_02", "file/png", "file"),
    ("a b*%/?#", "file/pcd.bin", "file"),
)


def recording(count):
    """Messages of every encoding, with and without what only folders know."""
    for i in range(count):
        topic, kind, encoding = KINDS[i % len(KINDS)]
        extra = {"stamp_ns": 10**18 + i, "sweep_s": 0.1 / 3, "sequence": i} if i % 2 else {}
        yield Message(
            topic, kind, encoding, bytes([i % 256]) * (i * 37 % 5000), 1000 + 10_000_000 * i, **extra
        )


class Recording:
    """A source that counts what was taken from it."""

    def __init__(self, count, fails_after=None):
        self.losses = Losses({"damaged_chunk": 2}, ["2 chunks are damaged"])
        self.taken = 0
        self.closed = False
        self._count = count
        self._fails_after = fails_after

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.closed = True

    def __iter__(self):
        yield Tick(0)
        for message in recording(self._count):
            if self.taken == self._fails_after:
                raise InputError("the disk is gone")
            self.taken += 1
            yield message

    def describe(self):
        return (TopicInfo("/cam", "foxglove.CompressedImage", self._count, None, understood=True),)

    def rig_document(self):
        return {"pairs": []}


def fields(message):
    return tuple(getattr(message, name) for name in Message.__slots__)


@pytest.fixture
def sessions():
    with (
        open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",))) as here,
        open_session(BusSettings(mode="peer", connect=listening_at(here))) as there,
    ):
        yield here, there


def test_every_message_comes_out_as_it_went_in_and_in_order():
    source = Recording(300)
    with OverBus(source, "test") as over:
        received = list(over)
        assert over.describe() == source.describe()
        assert over.rig_document() == {"pairs": []}
    assert [fields(m) for m in received] == [fields(m) for m in recording(300)]
    assert over.losses.counts == {"damaged_chunk": 2}
    assert over.losses.notes == ["2 chunks are damaged"]
    assert source.closed


@pytest.mark.recordings
@pytest.mark.skipif(not DATA.is_dir(), reason="no recordings folder (CALIBWATCH_DATA)")
@pytest.mark.parametrize(
    "name", ["kitti_raw_0009_mcap/kitti_0009.mcap", "kitti_raw_0005_a", "nuscenes_mmdet3d"]
)
def test_a_real_recording_gives_the_same_pairs_over_the_bus(name):
    rig = prepare(str(DATA / name), None, None).rig

    def pairs(opened):
        intake = Intake(rig)
        with opened as source:
            found = [pair for message in source for pair in intake.take(message)] + intake.flush()
        return [
            (p.pair, p.cloud_stamp_ns, p.image_stamp_ns, p.cloud.xyz.tobytes(), p.image.pixels.tobytes())
            for p in found
        ]

    direct = pairs(open_source(str(DATA / name)))
    assert len(direct) > 5
    assert pairs(OverBus(open_source(str(DATA / name)), "test")) == direct


def test_the_writer_never_runs_ahead_of_what_the_reader_has_used():
    source = Recording(100)
    ahead = []
    with OverBus(source, "test") as over:
        for used, _ in enumerate(over):
            ahead.append(source.taken - used)
    # One more than in flight was taken from the source: the one that waits for its turn.
    assert max(ahead) <= WINDOW + 1
    assert len(ahead) == 100


def test_a_recording_that_fails_is_told_as_it_failed():
    with (
        OverBus(Recording(50, fails_after=20), "test") as over,
        pytest.raises(InputError, match="disk is gone"),
    ):
        list(over)


def test_leaving_early_ends_the_writer():
    with OverBus(Recording(10_000), "test") as over:
        items = iter(over)
        for _ in range(5):
            next(items)
    names = {thread.name for thread in threading.enumerate()}
    assert "replay writer" not in names
    assert not any(name.startswith("zenoh ") for name in names)


def test_a_writer_without_reader(sessions, monkeypatch):
    monkeypatch.setattr(bus_replay, "READER_S", 0.05)
    with pytest.raises(TransportError, match="nobody reads calibwatch-replay/run"):
        ReplayWriter(sessions[0], "run", stop=threading.Event()).publish(Recording(3))


def test_a_writer_that_stops_before_the_end_is_noticed(sessions):
    stop = threading.Event()

    class Stopping(Recording):
        def __iter__(self):
            for i, message in enumerate(super().__iter__()):
                if i == 5:
                    stop.set()
                yield message

    writer = ReplayWriter(sessions[0], "run", stop=stop)
    with ReplayReader(sessions[1], "run", stop=threading.Event()) as reader:
        thread = threading.Thread(target=writer.publish, args=(Stopping(50),))
        thread.start()
        with pytest.raises(TransportError, match="ended after 4 messages, before its recording did"):
            list(reader)
        thread.join()


def test_a_reader_that_goes_away_is_noticed(sessions):
    writer = ReplayWriter(sessions[0], "run", stop=threading.Event())
    failures = []

    def publish():
        try:
            writer.publish(Recording(1000))
        except TransportError as error:
            failures.append(str(error))

    thread = threading.Thread(target=publish)
    with ReplayReader(sessions[1], "run", stop=threading.Event()) as reader:
        thread.start()
        next(iter(reader))
    thread.join()
    assert len(failures) == 1
    assert "went away" in failures[0]


def test_a_paced_replay_ends_although_the_reader_lost_messages(sessions):
    class Forgetful(ReplayWriter):
        def _put(self, message):
            if message.log_ns == 1000:
                super()._put(message)

    pace = Pace(factor=1e9, monotonic_s=lambda: 0.0)
    writer = Forgetful(sessions[0], "run", stop=Recorded(), pace=pace)
    with ReplayReader(sessions[1], "run", stop=threading.Event()) as reader:
        thread = threading.Thread(target=writer.publish, args=(Recording(50),))
        thread.start()
        assert len(list(reader)) == 1
    thread.join()
    assert "1 of 50 replayed messages came over the bus" in reader.losses.notes


class Recorded(threading.Event):
    """An event that notes how long it was asked to wait, and does not wait."""

    def __init__(self):
        super().__init__()
        self.waits = []

    def wait(self, timeout=None):
        self.waits.append(timeout)
        return self.is_set()


def test_a_paced_replay_waits_as_the_recording_did(sessions):
    stop = Recorded()
    writer = ReplayWriter(sessions[0], "run", stop=stop, pace=Pace(factor=4.0, monotonic_s=lambda: 100.0))
    with ReplayReader(sessions[1], "run", stop=threading.Event()) as reader:
        thread = threading.Thread(target=writer.publish, args=(Recording(6),))
        thread.start()
        received = list(reader)
        thread.join()
    assert len(received) == 6
    assert stop.waits == pytest.approx([0.01 * i / 4 for i in range(1, 6)])
