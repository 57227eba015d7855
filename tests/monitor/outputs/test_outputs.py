import pkgutil

import pytest

import monitor.outputs as package
from monitor.events import EndEvent, StatusEvent
from monitor.outputs import OutputKind, Outputs, Surroundings, kinds, open_outputs, write_whole
from pipeline.errors import InputError, TransportError


class Listener:
    """Remembers what it was given; fails from the n-th event on."""

    def __init__(self, fails_at=None, error=None, *, fails_to_close=False):
        self.events = []
        self.closed = 0
        self.lost = None
        self._fails_at, self._error, self._fails_to_close = fails_at, error, fails_to_close

    def handle(self, event):
        if len(self.events) == self._fails_at:
            raise self._error
        self.events.append(event)

    def close(self):
        self.closed += 1
        if self._fails_to_close:
            raise OSError("close failed")


def test_every_module_offers_an_output_under_its_own_name():
    modules = {module.name for module in pkgutil.iter_modules(package.__path__) if module.name[0] != "_"}
    assert set(kinds()) == modules
    assert all(isinstance(kind, OutputKind) for kind in kinds().values())


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), TransportError("bus gone")])
def test_an_output_that_fails_is_lost_alone(error, drive):
    good, bad = Listener(), Listener(fails_at=1, error=error)
    outputs = Outputs([("bad", bad), ("good", good)])
    events = [StatusEvent(drive().status(seq, seq=seq)) for seq in range(3)]
    for event in events:
        outputs.handle(event)
    assert good.events == events
    assert bad.events == events[:1]
    assert bad.closed == 1
    assert list(outputs.losses) == ["bad"]
    assert outputs.lost == f"bad: {error}"
    outputs.close()
    assert (good.closed, bad.closed) == (1, 1)


def test_an_error_that_nobody_foresaw_is_not_hidden():
    outputs = Outputs([("bad", Listener(fails_at=0, error=ZeroDivisionError()))])
    with pytest.raises(ZeroDivisionError):
        outputs.handle(EndEvent(complete=True))


def test_a_loss_that_an_output_tells_by_itself_is_passed_on():
    quiet = Listener()
    outputs = Outputs([("recording", quiet)])
    assert outputs.lost is None
    quiet.lost = "the disk is full"
    assert outputs.losses == {"recording": "the disk is full"}


def test_a_loss_at_closing_is_told_and_the_others_are_closed():
    last = Listener()
    outputs = Outputs([("first", Listener(fails_to_close=True)), ("last", last)])
    outputs.close()
    assert outputs.losses == {"first": "close failed"}
    assert last.closed == 1


def test_outputs_are_opened_by_name(tmp_path, drive):
    outputs = open_outputs(["status_log", "summary"], Surroundings("van-17", tmp_path))
    outputs.handle(StatusEvent(drive().status(5)))
    outputs.handle(EndEvent(complete=True))
    outputs.close()
    assert {path.name for path in tmp_path.iterdir()} == {"status.jsonl", "summary.json"}
    assert outputs.lost is None


def test_an_unknown_output_is_refused_before_any_is_opened(tmp_path):
    with pytest.raises(InputError, match=r"output 'sumary' is not known \(known: .*summary"):
        open_outputs(["status_log", "sumary"], Surroundings("van-17", tmp_path))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", sorted(kinds()))
def test_an_output_says_what_it_misses(kind):
    wanted = "was given no folder" if kinds()[kind].needs == "folder" else "was given no session"
    with pytest.raises(InputError, match=wanted):
        open_outputs([kind], Surroundings("van-17"))


@pytest.mark.parametrize("kind", sorted(name for name, kind in kinds().items() if kind.needs == "folder"))
def test_a_folder_that_is_not_there_is_an_error_of_the_system(kind, tmp_path):
    def run():
        outputs = open_outputs([kind], Surroundings("van-17", tmp_path / "missing"))
        outputs.handle(EndEvent(complete=True))
        raise OSError(outputs.lost)  # those that write at the end only

    with pytest.raises(OSError, match="No such file"):
        run()


def test_one_that_can_not_be_opened_closes_those_before(tmp_path):
    with pytest.raises(InputError, match="session"):
        open_outputs(["status_log", "status_bus"], Surroundings("van-17", tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["status.jsonl.partial"]


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path, small_files):
    path = tmp_path / "x.json"
    write_whole(path, b"first")
    with small_files(10), pytest.raises(OSError, match="too large"):
        write_whole(path, b"second, longer than ten bytes")
    assert path.read_bytes() == b"first"
    assert [file.name for file in tmp_path.iterdir()] == ["x.json"]
    write_whole(path, b"third")
    assert path.read_bytes() == b"third"
    assert [file.name for file in tmp_path.iterdir()] == ["x.json"]
