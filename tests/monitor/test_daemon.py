"""The loop around engines, with hand-made messages and ticks: staleness, restarts, the account of frames."""

import dataclasses
import itertools
import threading

import pytest

from monitor.daemon import extrinsic_hash, mount_of, watch, watching
from monitor.events import EndEvent, FrameEvent, ProposalEvent, StatusEvent
from monitor.injection import parse_inject
from monitor.messages import Message
from monitor.outputs import Outputs
from monitor.preparation import prepare
from monitor.sources import Losses, Tick
from pipeline.errors import InputError, RigError
from pipeline.parameters import Parameters
from tests import drives
from tests.drives import CLOUD_TOPIC, IMAGE_TOPIC

SECOND = 1_000_000_000


class Watchmaker:
    """A clock that moves a millisecond whenever it is asked."""

    now_ns = 0

    def monotonic_ns(self):
        self.now_ns += 1_000_000
        return self.now_ns

    def wall_ns(self):
        raise AssertionError("stamps of the data decide")


class Told:
    """An output that remembers."""

    lost = None

    def __init__(self, fails_at=None):
        self.events = []
        self._fails_at = fails_at

    def handle(self, event):
        self.events.append(event)
        if len(self.events) == self._fails_at:
            raise OSError(28, "No space left on device")

    def close(self):
        pass

    @property
    def statuses(self):
        return [event.status for event in self.events if isinstance(event, StatusEvent)]

    @property
    def end(self):
        assert isinstance(self.events[-1], EndEvent)
        return self.events[-1]


@pytest.fixture
def rig(cut):
    return prepare(str(cut(5)), None, parse_inject("yaw=1")).rig


def items(recorded):
    return [Message(m.topic, m.type, "cdr", m.data, m.log_ns) for m in recorded]


def watched(rig, stream, *, told=None, stop=None, losses=None, segmenter=None):
    told, said = told or Told(), []
    under = watching(rig, segmenter, Parameters(), Outputs([("told", told)]), Watchmaker(), said.append)
    state = watch(under, stream, losses or Losses(), stop or threading.Event())
    return state, told, said


def states(told):
    """Runs of equal states."""
    found = []
    for status in told.statuses:
        if not found or found[-1] != status.state:
            found.append(status.state)
    return found


def test_inputs_that_stop_are_stale_and_a_drift_told_before_stands_after(rig, messages):
    first = drives.first_frames(messages, 14)
    end_ns = max(message.log_ns for message in first)
    later = [m for m in drives.first_frames(messages, 20) if m.sequence >= 14]
    later = [dataclasses.replace(m, log_ns=m.log_ns + 60 * SECOND) for m in later]
    later = [drives.stamped(m, drives.stamp_of(m) + 60 * SECOND) for m in later]
    ticks = [Tick(end_ns + step * SECOND // 2) for step in range(1, 11)]
    state, told, _ = watched(rig, [*items(first), *ticks, *items(later)])
    assert states(told) == ["starting", "suspect", "drifted", "stale", "drifted"]
    assert state == "drifted"
    # The last pair is decided when another frame comes.
    last_pair_ns = max(drives.stamp_of(m) for m in first if (m.topic, m.sequence) == (IMAGE_TOPIC, 12))
    stale = next(status for status in told.statuses if status.state == "stale")
    assert 2 * SECOND <= stale.stamp_ns - last_pair_ns < 2.6 * SECOND
    assert stale.severity == "major"
    back = told.statuses[-1]
    assert back.code == "drift_confirmed"
    assert back.window.frames <= 6  # nothing of before the silence


def test_a_short_silence_is_not_stale(rig, messages):
    first = drives.first_frames(messages, 3)
    end_ns = max(message.log_ns for message in first)
    _, told, _ = watched(rig, [*items(first), Tick(end_ns + SECOND), Tick(end_ns + 17 * SECOND // 10)])
    assert "stale" not in states(told)


def test_a_bus_on_which_nothing_comes_is_stale_and_refused_at_its_end(rig):
    told = Told()
    with pytest.raises(InputError, match="no sweep and no image came"):
        watched(rig, [Tick(step * SECOND // 2) for step in range(10)], told=told)
    assert states(told) == ["starting", "stale"]


def test_one_sensor_alone_is_stale(rig, messages):
    clouds = [m for m in drives.first_frames(messages, 30) if m.topic == CLOUD_TOPIC]
    told = Told()
    with pytest.raises(InputError):
        watched(rig, items(clouds), told=told)
    assert states(told) == ["starting", "stale"]
    assert told.statuses[-1].frames.used == 0


def test_a_status_a_second_and_one_at_each_change(rig, messages):
    _, told, _ = watched(rig, items(drives.first_frames(messages, 20)))
    statuses = told.statuses
    assert [status.seq for status in statuses] == list(range(len(statuses)))
    for before, after in itertools.pairwise(statuses):
        changed = (before.state, before.code) != (after.state, after.code)
        assert changed or after is statuses[-1] or after.stamp_ns - before.stamp_ns >= SECOND
        assert after.stamp_ns - before.stamp_ns <= 1.2 * SECOND
    last = statuses[-1]
    assert last.frames.model_dump() == {"received": 40, "used": 40, "dropped": {}}
    assert last.rates.lidar_hz == pytest.approx(10.0, abs=0.01)
    assert last.rates.gap_ms == pytest.approx(53.0, abs=0.1)
    assert last.extrinsic.hash == extrinsic_hash(rig.pairs[0].T_cam_lidar)
    # Every stage asks the clock twice; the frame contains its stages.
    assert last.timing_ms["edges"].p50 == pytest.approx(1.0)
    assert last.timing_ms["frame"].p50 > last.timing_ms["edges"].p50
    frames = [event for event in told.events if isinstance(event, FrameEvent)]
    assert [frame.stamp_ns for frame in frames] == sorted({frame.stamp_ns for frame in frames})
    assert len(frames) == 20


def test_a_stop_ends_the_watch_and_the_end_says_so(rig, messages):
    stop = threading.Event()

    def stream():
        yield from items(drives.first_frames(messages, 3))
        stop.set()
        yield Tick(0)
        raise AssertionError("read on after the stop")

    _, told, _ = watched(rig, stream(), stop=stop)
    assert told.end.complete is False
    assert told.end.note.startswith("interrupted")


def test_what_was_lost_is_told_at_once_and_at_the_end(rig, messages):
    losses = Losses({"damaged_chunk": 1}, ["drive.mcap: a chunk is damaged"])
    bad = drives.changed(
        drives.first_frames(messages, 4),
        IMAGE_TOPIC,
        lambda m: dataclasses.replace(m, data=m.data[:300]) if m.sequence == 1 else m,
    )
    _, told, said = watched(rig, items(bad), losses=losses)
    assert len(said) == 1
    assert IMAGE_TOPIC in said[0]
    damaged, undecodable, dropped = told.end.warnings
    assert damaged == losses.notes[0]
    assert undecodable == said[0]
    assert "1 undecodable" in dropped


def test_an_output_that_fails_is_told_and_the_watch_goes_on(rig, messages):
    failing = Told(fails_at=3)
    state, _, said = watched(rig, items(drives.first_frames(messages, 12)), told=failing)
    assert state == "drifted"
    assert said == ["output lost: told: [Errno 28] No space left on device"]
    assert len(failing.events) == 3


def test_a_mount_needs_intrinsics_and_an_extrinsic(rig):
    pair = rig.pairs[0]
    with pytest.raises(RigError, match="pair camera has no extrinsic"):
        mount_of(dataclasses.replace(pair, T_cam_lidar=None))
    camera = dataclasses.replace(pair.camera, model=None)
    with pytest.raises(RigError, match="pair camera has no intrinsics"):
        mount_of(dataclasses.replace(pair, camera=camera))


def test_two_pairs_that_drift_alike_end_with_proposals_and_a_moved_lidar(rig, messages):
    (front,) = rig.pairs
    both = dataclasses.replace(rig, pairs=(front, dataclasses.replace(front, name="second")))
    state, told, _ = watched(both, items(drives.first_frames(messages, 18)))
    assert state == "drifted"
    proposals = {event.pair: event for event in told.events if isinstance(event, ProposalEvent)}
    assert proposals.keys() == {front.name, "second"}
    for name, event in proposals.items():
        assert event.document is not None, event.reason
        assert (event.document.pair, event.document.replaces.hash) == (
            name,
            extrinsic_hash(front.T_cam_lidar),
        )
        assert event.document.drift.yaw == pytest.approx(1.0, abs=0.3)
    (parts,) = told.end.parts
    assert (parts.lidar, parts.pairs) == (CLOUD_TOPIC, (front.name, "second"))
    assert parts.hypotheses[0].kind == "lidar"
