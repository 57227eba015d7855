"""Commands over real sessions; the engine's side is a thread that takes what waits."""

import json
import threading

import pytest

from monitor.bus import BusSettings, TlsFiles, command_refusal, listening_at, open_session
from monitor.command_bus import CommandBus, acknowledge
from monitor.requests import Acknowledgement, Note, Requests, note_of
from pipeline.errors import InputError, TransportError

NOTE = Note(by="Ada", reason="bracket tightened")
KEY = "calibwatch/van-1/front/cmd/acknowledge"


@pytest.fixture
def vehicle():
    with open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",))) as session:
        yield session


@pytest.fixture
def person(vehicle):
    with open_session(BusSettings(connect=listening_at(vehicle))) as session:
        yield session


class Watch:
    """Answers every request with what ``refusal`` says, in a thread of its own, as the daemon does."""

    def __init__(self, refusal):
        self.requests, self.heard = Requests(), []
        self._refusal, self._came, self._ended = refusal, threading.Event(), False
        put = self.requests.put
        self.requests.put = lambda request: (put(request), self._came.set())
        self._thread = threading.Thread(target=self._run)

    def _run(self):
        while not self._ended:
            self._came.wait()
            self._came.clear()
            for request in self.requests.take():
                self.heard.append((request.pair, request.note))
                request.answer(self._refusal)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self._ended = True
        self._came.set()
        self._thread.join()


def test_what_is_acknowledged_reaches_the_watch_and_is_answered(vehicle, person):
    with Watch(None) as watch, CommandBus(vehicle, "van-1", ("front", "rear"), watch.requests, None):
        acknowledge(person, "van-1", "rear", NOTE)
        assert watch.heard == [("rear", NOTE)]
        reply = next(iter(person.get(KEY, payload=NOTE.model_dump_json(), timeout=10.0)))
        assert json.loads(reply.ok.payload.to_bytes()) == {"acknowledged": True}


def test_a_refusal_is_told_with_its_reason(vehicle, person):
    with (
        Watch("no drift is told") as watch,
        CommandBus(vehicle, "van-1", ("front",), watch.requests, None),
        pytest.raises(TransportError, match="van-1/front was not acknowledged: no drift is told"),
    ):
        acknowledge(person, "van-1", "front", NOTE)


def test_without_the_right_to_nothing_reaches_the_watch(vehicle, person):
    requests = Requests()
    with (
        CommandBus(vehicle, "van-1", ("front",), requests, "commands are refused"),
        pytest.raises(TransportError, match="commands are refused"),
    ):
        acknowledge(person, "van-1", "front", NOTE)
    assert list(requests.take()) == []


def test_nobody_answers_for_an_unknown_pair(vehicle, person):
    with (
        CommandBus(vehicle, "van-1", ("front",), Requests(), None),
        pytest.raises(TransportError, match="nobody answers for van-1/side"),
    ):
        acknowledge(person, "van-1", "side", NOTE)


@pytest.mark.parametrize(
    ("selector", "payload", "why"),
    [
        ("calibwatch/van-1/*/cmd/acknowledge", NOTE.model_dump_json(), "for one pair"),
        (KEY, None, "no note of who and why"),
        (KEY, b"\xff\xfe", "no note of who and why"),
        (KEY, '{"by": "Ada"}', "no note of who and why"),
        (KEY, '{"by": "Ada", "reason": "a\\nb"}', "no note of who and why"),
        (KEY, b"[" * 5000, "5000 bytes"),
    ],
)
def test_bad_requests_are_answered_with_what_would_be_accepted(vehicle, person, selector, payload, why):
    requests = Requests()
    with CommandBus(vehicle, "van-1", ("front",), requests, None):
        replies = list(person.get(selector, payload=payload, timeout=10.0))
    assert [why in reply.err.payload.to_string() for reply in replies] == [True]
    assert list(requests.take()) == []


def test_who_waits_when_the_watch_ends_is_told(vehicle, person):
    requests, came = Requests(), threading.Event()
    put = requests.put
    requests.put = lambda request: (put(request), came.set())
    with CommandBus(vehicle, "van-1", ("front",), requests, None):
        replies = person.get(KEY, payload=NOTE.model_dump_json(), timeout=10.0)
        assert came.wait(10.0)
    assert [reply.err.payload.to_string() for reply in replies] == ["the watch has ended"]


def test_requests_beyond_the_bound_are_refused_at_once():
    requests, answers = Requests(), []
    for _ in range(20):
        requests.put(Acknowledgement("front", NOTE, answers.append))
    assert len(list(requests.take())) == 16
    assert answers == ["too many requests wait; ask again"] * 4


def test_a_closed_session_ends_with_one_line(vehicle):
    with open_session(BusSettings(connect=listening_at(vehicle))) as session:
        pass
    with pytest.raises(TransportError, match="could not be asked"):
        acknowledge(session, "van-1", "front", NOTE)


def test_notes_are_one_line_each():
    assert note_of(b'{"by": " Ada ", "reason": "ok"}') == Note(by="Ada", reason="ok")
    for bad in (b'{"by": "", "reason": "ok"}', b'{"by": "A", "reason": "ok", "x": 1}', b"null"):
        with pytest.raises(InputError, match="no note"):
            note_of(bad)


FILES = TlsFiles(*["x"] * 3)


@pytest.mark.parametrize(
    ("settings", "allowed"),
    [
        (BusSettings(mode="peer", listen=("tcp/127.0.0.1:7448",)), True),
        (BusSettings(mode="peer", listen=("tcp/[::1]:7448", "unixsock-stream//run/x")), True),
        (BusSettings(mode="peer", listen=("tcp/localhost:0",)), True),
        (BusSettings(mode="peer", listen=("tcp/0.0.0.0:7448",)), False),
        (BusSettings(mode="peer", listen=("tcp/[::]:7448",)), False),
        (BusSettings(mode="peer", listen=("tcp/127.0.0.1:1", "tcp/192.168.0.4:1")), False),
        (BusSettings(mode="peer", listen=("tcp/127.0.0.1.example.org:1",)), False),
        (BusSettings(connect=("tcp/127.0.0.1:7447",)), False),
        (BusSettings(connect=("tls/hub:7447",), tls=FILES), True),
        (BusSettings(connect=("tls/hub:7447",)), False),
        (BusSettings(mode="peer", connect=("tls/hub:1",), listen=("tcp/0.0.0.0:1",), tls=FILES), False),
    ],
)
def test_only_who_is_on_this_machine_or_known_may_command(settings, allowed):
    assert (command_refusal(settings, allowed=False) is None) == allowed
    assert command_refusal(settings, allowed=True) is None
