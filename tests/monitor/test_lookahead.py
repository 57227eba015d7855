"""Pairs looked at ahead of their turn: everything that is told is what one pair after the other gives."""

import dataclasses
import os
import signal
import subprocess
import sys
import threading
from contextlib import closing

import cv2
import numpy as np
import pytest

from monitor.daemon import watch, watching
from monitor.events import EndEvent, FrameEvent, ProposalEvent, StatusEvent
from monitor.injection import parse_inject
from monitor.intake import Intake
from monitor.lookahead import Forerunner, arrivals
from monitor.lookout import Lookout
from monitor.messages import Message
from monitor.outputs import Outputs
from monitor.preparation import prepare
from monitor.sources import Losses, Tick
from pipeline.errors import InputError
from pipeline.frame_evidence import Scout
from pipeline.parameters import Parameters
from tests import drives
from tests.drives import CLOUD_TOPIC

SECOND = 1_000_000_000


class Counting:
    """A clock that counts its questions; two threads ask it."""

    now_ns = 0

    def monotonic_ns(self):
        self.now_ns += 1
        return self.now_ns

    def wall_ns(self):
        raise AssertionError("stamps of the data decide")


class Told:
    """An output that remembers, and may press a button."""

    lost = None

    def __init__(self, stop=None, at=None):
        self.events = []
        self._stop, self._at = stop, at

    def handle(self, event):
        self.events.append(event)
        if len(self.events) == self._at:
            self._stop.set()

    def close(self):
        pass


@pytest.fixture(autouse=True)
def at_once(monkeypatch):
    """Short streams are looked at ahead, too, from their second pair on."""
    monkeypatch.setattr("monitor.lookahead._WORTH_A_PROCESS", 1)
    monkeypatch.setattr("monitor.lookout._PATIENCE_S", 60.0)


@pytest.fixture
def looked_at(monkeypatch):
    """Pairs that this very process has looked at."""
    pairs = []
    look = Scout.look

    def noted(self, pair, *arguments):
        pairs.append(pair)
        return look(self, pair, *arguments)

    monkeypatch.setattr(Scout, "look", noted)
    return pairs


@pytest.fixture
def rig(cut):
    return prepare(str(cut(5)), None, parse_inject("yaw=1")).rig


def items(recorded):
    return [Message(m.topic, m.type, "cdr", m.data, m.log_ns) for m in recorded]


def later(recorded, seconds):
    """The same frames, measured and sent later."""
    moved = [dataclasses.replace(m, log_ns=m.log_ns + seconds * SECOND) for m in recorded]
    return [drives.stamped(m, drives.stamp_of(m) + seconds * SECOND) for m in moved]


def told_of(rig, stream, ahead, told=None, stop=None, expected=None):
    """What is told of a stream: plain values, but for what stages cost."""
    told = told or Told()
    under = watching(rig, None, Parameters(), Outputs([("told", told)]), Counting())
    with closing(Forerunner(ahead, expected)) as forerunner:
        watch(under, stream, Losses(), stop or threading.Event(), ahead=forerunner if ahead else None)
    return [plain(event) for event in told.events]


def plain(event):
    if isinstance(event, StatusEvent):
        return event.status.model_dump(exclude={"timing_ms"})
    if isinstance(event, FrameEvent):
        estimated = None if event.T_estimated is None else event.T_estimated.tolist()
        return event.stamp_ns, event.points.tobytes(), event.edge_points.tobytes(), estimated
    if isinstance(event, ProposalEvent):
        return event.pair, None if event.document is None else event.document.model_dump(), event.reason
    assert isinstance(event, EndEvent)
    return event


def stories(messages):
    """Streams with everything that makes a watch forget."""
    first = drives.first_frames(messages, 9)
    end_ns = max(message.log_ns for message in first)
    ticks = [Tick(end_ns + step * SECOND // 2) for step in range(1, 8)]
    rest = [m for m in drives.first_frames(messages, 16) if m.sequence >= 9]
    broken = [dataclasses.replace(m, data=m.data[:9]) if m.topic == CLOUD_TOPIC else m for m in rest[:6]]
    return {
        "in order": items(first),
        "a silence": [*items(first), *ticks, *items(later(rest, 60))],
        "a gap": [*items(first), *items(later(rest, 60))],
        "a clock that runs back": [*items(later(first, 60)), *items(rest)],
        "undecodable": [*items(first), *items(broken), *items(rest)],
    }


@pytest.mark.parametrize("story", ["in order", "a silence", "a gap", "a clock that runs back", "undecodable"])
def test_all_that_is_told_is_the_same(rig, messages, story):
    stream = stories(messages)[story]
    plainly = told_of(rig, stream, 0)
    assert sum(isinstance(event, tuple) for event in plainly) >= 8
    assert told_of(rig, stream, 5) == plainly


def test_what_is_found_ahead_is_used(rig, messages, looked_at):
    told_of(rig, stories(messages)["in order"], 5)
    # The first pair is judged while the process begins; the last is decided when the recording ends.
    assert len(looked_at) == 2


@pytest.mark.parametrize(("expected", "there"), [(None, False), (24, False), (25, True)])
def test_a_recording_that_will_be_worth_it_has_its_process_at_once(monkeypatch, expected, there):
    monkeypatch.setattr("monitor.lookahead._WORTH_A_PROCESS", 25)
    started = []

    class Noted(Lookout):
        def __init__(self):
            super().__init__()
            started.append(self)

    monkeypatch.setattr("monitor.lookahead.Lookout", Noted)
    threads = cv2.getNumThreads()
    with closing(Forerunner(6, expected)):
        assert bool(started) == there
        assert cv2.getNumThreads() == (1 if there else threads)
    assert cv2.getNumThreads() == threads


@pytest.mark.parametrize("story", ["in order", "a clock that runs back"])
def test_a_process_that_is_there_at_once_looks_at_all_pairs(rig, messages, looked_at, story):
    stream = stories(messages)[story]
    plainly = told_of(rig, stream, 0)
    looked_at.clear()
    assert told_of(rig, stream, 5, expected=25) == plainly
    # The last is decided when the recording ends, and where the clock runs back one is looked at anew.
    assert len(looked_at) == {"in order": 1, "a clock that runs back": 2}[story]


def test_the_process_loads_what_it_needs_only():
    program = (
        "import sys, monitor.lookout; print(*({'scipy.stats', 'rerun', 'zenoh', 'mcap'} & set(sys.modules)))"
    )
    ran = subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert ran.stdout.split() == []


def test_a_process_that_dies_is_done_without(rig, messages, looked_at, monkeypatch):
    stream = stories(messages)["in order"]
    plainly = told_of(rig, stream, 0)
    alone = len(looked_at)
    looked_at.clear()
    answer = Lookout.answer

    def killed(self, number):
        if number == 4:
            os.kill(self._process.pid, signal.SIGKILL)
            self._process.wait()
        return answer(self, number)

    monkeypatch.setattr(Lookout, "answer", killed)
    assert told_of(rig, stream, 5) == plainly
    assert 2 < len(looked_at) < alone


def test_a_process_that_can_not_be_started_is_done_without(rig, messages, looked_at, monkeypatch):
    stream = stories(messages)["in order"]
    plainly = told_of(rig, stream, 0)
    alone = len(looked_at)

    def refused(*_, **__):
        raise BlockingIOError

    monkeypatch.setattr("monitor.lookout.subprocess.Popen", refused)
    assert told_of(rig, stream, 5) == plainly
    assert len(looked_at) == 2 * alone


def test_what_a_process_fails_at_is_met_here(rig, messages, looked_at, monkeypatch):
    stream = stories(messages)["in order"]
    plainly = told_of(rig, stream, 0)
    looked_at.clear()
    ask = Lookout.ask

    def spoilt(self, pair):
        # A pair that no scout can look at arrives over there.
        give = dataclasses.replace(pair, cloud_stamp_ns=None) if self._count == 3 else pair
        _, number = ask(self, give)
        self._asked[-1] = (number, pair)
        return pair, number

    monkeypatch.setattr(Lookout, "ask", spoilt)
    assert told_of(rig, stream, 5) == plainly
    assert len(looked_at) == 3


def test_a_run_that_is_stopped_tells_what_was_judged(rig, messages):
    stream = items(drives.first_frames(messages, 12))
    stops = [threading.Event(), threading.Event()]
    plainly, ahead = (
        told_of(rig, stream, most, Told(stop, 6), stop) for most, stop in zip((0, 5), stops, strict=True)
    )
    assert ahead == plainly
    assert not ahead[-1].complete


class Failing:
    """A source that fails after some messages."""

    def __init__(self, stream):
        self._stream = stream

    def __iter__(self):
        yield from self._stream
        raise InputError("the rest is not there")


def test_a_source_that_fails_does_so_after_what_came_before(rig, messages):
    stream = items(drives.first_frames(messages, 9))
    found = []
    for ahead in (0, 5):
        told = Told()
        with pytest.raises(InputError, match="not there"):
            told_of(rig, Failing(stream), ahead, told)
        found.append([plain(event) for event in told.events])
    assert found[0] == found[1]
    assert len(found[0]) >= 8


def test_arrivals_keep_their_order_and_their_accounts(rig, messages):
    stream = [*items(drives.first_frames(messages, 9)), Tick(5)]
    live, shown = Intake(rig), []

    def noted(pair, notes):
        notes.append(pair)
        return pair

    plainly = [
        (one.arrival_ns, one.pairs, one.accounts, one.notes)
        for one in arrivals(stream, live, 0, lambda pair: noted(pair, shown))
    ]
    assert [arrival_ns for arrival_ns, *_ in plainly] == [*(message.log_ns for message in stream[:-1]), 5]
    seen, ahead, most = [], [], 0
    for arrival in arrivals(stream, Intake(rig), 4, lambda pair: noted(pair, seen)):
        ahead.append(arrival)
        most = max(most, len(seen) - sum(len(one.pairs) for one in ahead[:-1]))
    assert [one.arrival_ns for one in ahead] == [arrival_ns for arrival_ns, *_ in plainly]
    assert [one.accounts for one in ahead] == [accounts for _, _, accounts, _ in plainly]
    assert most == 4
    for one, (_, pairs, _, _) in zip(ahead, plainly, strict=True):
        assert [pair.image_stamp_ns for pair in one.pairs] == [pair.image_stamp_ns for pair in pairs]
    assert np.array_equal(seen[0].cloud.xyz, shown[0].cloud.xyz)


def test_a_sensor_that_is_missing_does_not_fill_the_memory(rig):
    read = 0

    def ticking():
        nonlocal read
        for stamp in range(20_000):
            read += 1
            yield Tick(stamp)

    for number, arrival in enumerate(arrivals(ticking(), Intake(rig), 4, lambda pair: pair)):
        assert arrival.arrival_ns == number
        assert read - number < 5000
    assert read == 20_000
