"""The daemon on real sessions: sensors as rmw_zenoh publishes them, statuses as anyone may ask for them."""

import json
import queue
import threading

import pytest
import zenoh
import zenoh.ext

from monitor import live
from monitor.bus import BusSettings, Origin, listening_at, open_session
from monitor.clock import SystemClock
from monitor.command_bus import acknowledge
from monitor.injection import parse_inject
from monitor.preparation import prepare
from monitor.requests import Note
from pipeline.errors import RigError, TransportError
from tests import drives
from tests.drives import CLOUD_TOPIC, IMAGE_TOPIC, INFO_TOPIC, TF_TOPIC

PATIENCE_S = 45  # of a test that would hang otherwise; nothing waits as long
GID = bytes(range(16))


def rmw_key(message):
    package, _, name = message.type.split("/")
    return f"0/{message.topic[1:]}/{package}::msg::dds_::{name}_/RIHS01_{'0' * 64}"


def put(session, message):
    origin = Origin(message.sequence + 1, message.log_ns, GID)
    # Twelve sweeps at once are more than a link takes; a ring and the inbox hold as many.
    block = zenoh.CongestionControl.BLOCK
    session.put(rmw_key(message), message.data, attachment=origin.to_bytes(), congestion_control=block)


def latch(session, message):
    """As rmw_zenoh publishes what is transient local: late subscribers ask for it."""
    publisher = zenoh.ext.declare_advanced_publisher(
        session, rmw_key(message), cache=zenoh.ext.CacheConfig(max_samples=1), publisher_detection=True
    )
    publisher.put(message.data, attachment=Origin(1, message.log_ns, GID).to_bytes())
    return publisher


def matched(session, key):
    with session.declare_publisher(key) as publisher:
        while not publisher.matching_status.matching:
            pass


@pytest.fixture
def hub():
    with open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",))) as session:
        yield session


@pytest.fixture
def daemon(hub):
    """Starts :func:`live.run` in a thread; it is stopped and joined at the end of the test."""
    stop = threading.Event()
    threads = []

    def start(rig_file, out=None, *, allow_commands=False):
        ready, ended = threading.Event(), queue.Queue()
        settings = BusSettings(connect=listening_at(hub))

        def body():
            try:
                state = live.run(
                    rig_file,
                    settings,
                    out,
                    model=None,
                    images_hz=1.0,
                    stop=stop,
                    clock=SystemClock(),
                    ready=ready.set,
                    allow_commands=allow_commands,
                )
                ended.put(state)
            except BaseException as error:  # noqa: BLE001 - handed to the test
                ended.put(error)
                ready.set()

        threads.append(threading.Thread(target=body))
        threads[-1].start()
        return ready, stop, ended

    yield start
    stop.set()
    for thread in threads:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def statuses(session):
    """Everything that is said on the key of the status, as it comes."""
    said = queue.Queue()
    subscriber = session.declare_subscriber(
        "calibwatch/van-1/front/status", lambda sample: said.put(json.loads(sample.payload.to_bytes()))
    )
    return said, subscriber


def until(said, wanted):
    """The first status of which ``wanted`` holds; what came before is told where none does."""
    before = []
    for _ in range(30):  # one a second
        before.append(said.get(timeout=PATIENCE_S))
        if wanted(before[-1]):
            return before[-1]
    pytest.fail("; ".join(f"{s['state']} {s['frames']} {s['reason']}" for s in before))


def rig_with(path, recording, drift):
    """A rig file that leaves nothing open, wrong by ``drift``."""
    pair = prepare(str(recording), None, parse_inject(drift)).rig.pairs[0]
    path.write_text(
        drives.RIG.replace(f'info = "{INFO_TOPIC}"', drives.INTRINSICS)
        + f"T_vehicle_lidar = {pair.T_vehicle_lidar.tolist()}\n"
        + f"[pairs.extrinsic]\nT_cam_lidar = {pair.T_cam_lidar.tolist()}\n"
    )
    return path


def test_a_drift_is_told_on_the_bus_and_the_watch_ends_when_it_is_told_to(
    hub, daemon, cut, messages, tmp_path
):
    said, subscriber = statuses(hub)
    rig = rig_with(tmp_path / "rig.toml", cut(5), "yaw=1")
    ready, stop, ended = daemon(rig, tmp_path / "out", allow_commands=True)
    assert ready.wait(PATIENCE_S)
    frames = [m for m in drives.first_frames(messages, 12) if m.topic in (CLOUD_TOPIC, IMAGE_TOPIC)]
    for topic in (CLOUD_TOPIC, IMAGE_TOPIC):
        matched(hub, rmw_key(next(m for m in frames if m.topic == topic)))
    for message in frames:
        put(hub, message)
    status = until(said, lambda status: status["state"] == "drifted")
    assert status["drift"]["yaw"]["value"] == pytest.approx(1.0, abs=0.15)
    assert status["stamp_ns"] in range(drives.START_NS, drives.SLIP_NS)
    replies = [reply.ok for reply in hub.get("calibwatch/van-1/*/status")]
    assert len(replies) == 1
    answer = json.loads(replies[0].payload.to_bytes())
    assert (answer["vehicle"], answer["pair"]) == ("van-1", "front")
    assert answer["seq"] >= status["seq"]
    tokens = [reply.ok for reply in hub.liveliness().get("calibwatch/van-1/alive")]
    assert len(tokens) == 1
    acknowledge(hub, "van-1", "front", Note(by="Ada", reason="bracket tightened"))
    assert until(said, lambda status: status["seq"] > answer["seq"] and status["severity"] is None)
    with pytest.raises(TransportError, match="no drift is told"):
        acknowledge(hub, "van-1", "front", Note(by="Ada", reason="once more"))
    stop.set()
    # Nothing came after the frames: by the time of the stop the inputs may be stale already.
    assert ended.get(timeout=PATIENCE_S) in ("unobservable", "stale")
    subscriber.undeclare()
    summary = json.loads((tmp_path / "out" / "summary.json").read_bytes())
    assert summary["complete"] is False
    told = [change["state"] for change in summary["pairs"]["front"]["timeline"]]
    assert "drifted" in told
    frames = summary["pairs"]["front"]["frames"]
    assert 14 <= frames["used"] <= frames["received"] <= 24


def test_what_the_rig_leaves_open_comes_from_the_bus(hub, daemon, messages, tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text(drives.RIG)
    said, subscriber = statuses(hub)
    first = {topic: next(m for m in messages if m.topic == topic) for topic in (TF_TOPIC, INFO_TOPIC)}
    latched = [latch(hub, message) for message in first.values()]
    ready, _, _ = daemon(rig)
    frames = [m for m in drives.first_frames(messages, 8) if m.topic in (CLOUD_TOPIC, IMAGE_TOPIC)]
    for message in frames:
        # Listened to twice: first for frame names, then in earnest.
        if message.sequence == 0:
            matched(hub, rmw_key(message))
            put(hub, message)
    assert ready.wait(PATIENCE_S)
    with pytest.raises(TransportError, match="--allow-commands"):
        acknowledge(hub, "van-1", "front", Note(by="Ada", reason="without the right to"))
    for topic in (CLOUD_TOPIC, IMAGE_TOPIC):
        matched(hub, rmw_key(next(m for m in frames if m.topic == topic)))
    for message in frames:
        put(hub, message)
    status = until(said, lambda status: status["drift"]["yaw"]["value"] is not None)
    assert abs(status["drift"]["yaw"]["value"]) < 0.3
    assert status["drift"]["axes"] == "vehicle"
    for publisher in latched:
        publisher.undeclare()
    subscriber.undeclare()


def test_a_rig_without_topics_is_refused_before_the_bus_is_opened(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text(drives.RIG.replace(f'topic = "{CLOUD_TOPIC}"', ""))
    with pytest.raises(RigError, match="pair front does not name its topics"):
        live.run(
            rig,
            BusSettings(connect=("tcp/127.0.0.1:1",)),
            None,
            model=None,
            images_hz=1.0,
            stop=threading.Event(),
            clock=SystemClock(),
        )
