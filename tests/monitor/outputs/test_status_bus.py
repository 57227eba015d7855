import contextlib
import json
import queue

import pytest
import zenoh
import zenoh.ext

from monitor.events import EndEvent, StatusEvent
from monitor.outputs.status_bus import StatusBus
from monitor.status import Status
from pipeline.errors import TransportError

WAIT_S = 10


def config(mode, **endpoints):
    """No multicast, no gossip: sessions of tests that run side by side never meet."""
    document = {
        "mode": mode,
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "adminspace": {"enabled": True},
    } | {name: {"endpoints": [endpoint]} for name, endpoint in endpoints.items()}
    return zenoh.Config.from_json5(json.dumps(document))


@pytest.fixture
def sessions():
    """(the vehicle's session, a function that opens another that is connected to it)."""
    with contextlib.ExitStack() as stack:
        vehicle = stack.enter_context(zenoh.open(config("peer", listen="tcp/127.0.0.1:0")))
        admin = next(iter(vehicle.get(f"@/{vehicle.zid()}/peer")))
        locator = json.loads(bytes(admin.ok.payload))["locators"][0]
        yield vehicle, lambda: stack.enter_context(zenoh.open(config("client", connect=locator)))


def replies(session, selector):
    return list(session.get(selector, timeout=WAIT_S))


def texts(session, selector):
    return [json.loads(bytes(reply.ok.payload)) for reply in replies(session, selector)]


def test_a_subscriber_gets_each_status_as_it_is_said(sessions, drive):
    vehicle, connect = sessions
    bus = StatusBus(vehicle, "van-17")
    received, ready = queue.SimpleQueue(), queue.SimpleQueue()
    vehicle.liveliness().declare_subscriber("ready", ready.put, history=True)
    reader = connect()
    reader.declare_subscriber("calibwatch/van-17/front/status", received.put)
    # What one session declares arrives in order: with the token the subscriber is known.
    token = reader.liveliness().declare_token("ready")
    assert ready.get(timeout=WAIT_S).kind == zenoh.SampleKind.PUT
    bus.handle(StatusEvent(drive().status(0)))
    first = received.get(timeout=WAIT_S)
    assert Status.model_validate_json(bytes(first.payload)) == drive().status(0)
    assert first.encoding == zenoh.Encoding.APPLICATION_JSON
    bus.handle(StatusEvent(drive().status(40, seq=1)))
    assert Status.model_validate_json(bytes(received.get(timeout=WAIT_S).payload)).state == "drifted"
    token.undeclare()
    bus.close()


def test_a_late_joiner_gets_the_history_in_order(sessions, drive):
    vehicle, connect = sessions
    bus = StatusBus(vehicle, "van-17")
    for seq in range(5):
        bus.handle(StatusEvent(drive().status(seq, seq=seq)))
    received = queue.SimpleQueue()
    late = zenoh.ext.declare_advanced_subscriber(
        connect(),
        "calibwatch/van-17/front/status",
        received.put,
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=3),
    )
    seen = [json.loads(bytes(received.get(timeout=WAIT_S).payload))["seq"] for _ in range(3)]
    assert seen == [2, 3, 4]
    late.undeclare()
    bus.close()


def test_a_query_gives_the_last_status_of_each_pair_asked_for(sessions, drive):
    vehicle, connect = sessions
    bus = StatusBus(vehicle, "van-17")
    asker = connect()
    assert texts(asker, "calibwatch/van-17/*/status") == []
    for seq in range(3):
        bus.handle(StatusEvent(drive().status(seq, seq=seq)))
    bus.handle(StatusEvent(drive(pair="rear").status(9, seq=7)))
    assert [said["seq"] for said in texts(asker, "calibwatch/van-17/front/status")] == [2]
    assert {(said["pair"], said["seq"]) for said in texts(asker, "calibwatch/van-17/*/status")} == {
        ("front", 2),
        ("rear", 7),
    }
    assert texts(asker, "calibwatch/van-18/*/status") == []
    bus.close()


def test_what_was_missed_is_asked_for_by_sequence_number(sessions, drive):
    vehicle, connect = sessions
    bus = StatusBus(vehicle, "van-17")
    for seq in range(8):
        bus.handle(StatusEvent(drive().status(seq, seq=seq)))
    asker = connect()
    (missed,) = texts(asker, "calibwatch/van-17/front/status?from_seq=5")
    assert [said["seq"] for said in missed] == [5, 6, 7]
    assert texts(asker, "calibwatch/van-17/front/status?from_seq=8") == [[]]
    bus.close()


@pytest.mark.parametrize("asked", ["x", "-1", "1.5", "9" * 4000, "", "²"], ids=lambda text: text[:4])
def test_a_query_that_is_wrong_is_answered_with_what_would_be_right(sessions, drive, asked):
    vehicle, connect = sessions
    bus = StatusBus(vehicle, "van-17")
    bus.handle(StatusEvent(drive().status(0)))
    (reply,) = replies(connect(), f"calibwatch/van-17/front/status?from_seq={asked}")
    assert reply.ok is None
    assert bytes(reply.err.payload) == b"from_seq must be a sequence number, as in from_seq=120"
    bus.close()


def test_the_token_lives_from_open_to_close(sessions):
    vehicle, connect = sessions
    bus = StatusBus(vehicle, "van-17")
    seen = queue.SimpleQueue()
    connect().liveliness().declare_subscriber("calibwatch/*/alive", seen.put, history=True)
    alive = seen.get(timeout=WAIT_S)
    assert (str(alive.key_expr), alive.kind) == ("calibwatch/van-17/alive", zenoh.SampleKind.PUT)
    bus.close()
    assert seen.get(timeout=WAIT_S).kind == zenoh.SampleKind.DELETE


def test_after_close_nobody_answers(sessions, drive):
    vehicle, connect = sessions
    bus = StatusBus(vehicle, "van-17")
    bus.handle(StatusEvent(drive().status(0)))
    bus.handle(EndEvent(complete=True))
    asker = connect()
    assert len(replies(asker, "calibwatch/van-17/front/status")) == 1
    bus.close()
    assert replies(asker, "calibwatch/van-17/front/status") == []


def test_a_session_that_was_closed_is_an_error_of_ours(drive):
    session = zenoh.open(config("peer"))
    bus = StatusBus(session, "van-17")
    session.close()
    with pytest.raises(TransportError, match=r"could not be put on calibwatch/van-17/front/status"):
        bus.handle(StatusEvent(drive().status(0)))
    with pytest.raises(TransportError, match="can not be declared"):
        StatusBus(session, "van-17")
