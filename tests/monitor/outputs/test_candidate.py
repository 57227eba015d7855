"""A proposed extrinsic in its file, on the bus, in summary and report; and taken back."""

import contextlib
import json
import queue

import pytest
import zenoh

from monitor.bus import BusSettings, listening_at, open_session
from monitor.candidate_file import verified
from monitor.commands.replay import tell
from monitor.events import EndEvent, ProposalEvent, StatusEvent
from monitor.outputs.candidate import CandidateFiles
from monitor.outputs.candidate_bus import CandidateBus
from monitor.outputs.report import Report
from monitor.outputs.summary import Summary, SummaryFile
from monitor.parts import Parts, PartShare
from pipeline.errors import TransportError
from tests.monitor.proposals import proposal

WAIT_S = 10
NOTHING = ProposalEvent("front", None, "The frames held out show another extrinsic.")


def test_the_file_is_there_while_the_proposal_stands(tmp_path):
    files = CandidateFiles(tmp_path)
    path = tmp_path / "front.candidate.json"
    files.handle(NOTHING)
    assert not path.exists()
    files.handle(proposal())
    files.handle(proposal("rear"))
    assert verified(path.read_bytes(), "file") == proposal().document
    files.handle(NOTHING)
    files.handle(EndEvent(complete=True))
    files.close()
    assert [file.name for file in tmp_path.iterdir()] == ["rear.candidate.json"]


@pytest.fixture
def sessions():
    """The vehicle's session, and another that is connected to it."""
    with contextlib.ExitStack() as stack:
        vehicle = stack.enter_context(open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",))))
        reader = BusSettings(mode="client", connect=listening_at(vehicle))
        yield vehicle, stack.enter_context(open_session(reader))


def test_the_bus_hears_of_it_asks_for_it_and_hears_that_it_is_void(sessions):
    vehicle, reader = sessions
    bus = CandidateBus(vehicle, "van-17")
    received, ready = queue.SimpleQueue(), queue.SimpleQueue()
    vehicle.liveliness().declare_subscriber("ready", ready.put, history=True)
    reader.declare_subscriber("calibwatch/van-17/*/candidate", received.put)
    token = reader.liveliness().declare_token("ready")
    assert ready.get(timeout=WAIT_S).kind == zenoh.SampleKind.PUT
    bus.handle(NOTHING)
    bus.handle(proposal())
    sample = received.get(timeout=WAIT_S)
    assert (str(sample.key_expr), sample.kind) == ("calibwatch/van-17/front/candidate", zenoh.SampleKind.PUT)
    assert verified(sample.payload.to_bytes(), "sample") == proposal().document
    (reply,) = reader.get("calibwatch/van-17/front/candidate", timeout=WAIT_S)
    assert verified(reply.ok.payload.to_bytes(), "reply") == proposal().document
    assert list(reader.get("calibwatch/van-17/rear/candidate", timeout=WAIT_S)) == []
    bus.handle(NOTHING)
    assert received.get(timeout=WAIT_S).kind == zenoh.SampleKind.DELETE
    assert list(reader.get("calibwatch/van-17/*/candidate", timeout=WAIT_S)) == []
    token.undeclare()
    bus.close()


def test_a_closed_session_is_told():
    session = open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",)))
    bus = CandidateBus(session, "van-17")
    session.close()
    with pytest.raises(TransportError):
        bus.handle(proposal())


PARTS = Parts(
    lidar="/top",
    pairs=("front", "left"),
    hypotheses=(
        PartShare(kind="lidar", pair=None, probability=0.9),
        PartShare(kind="several", pair=None, probability=0.1),
    ),
    odds=9.0,
    sentence="The LiDAR has moved (9:1 against several parts).",
)


def told(output, drive, event, state="drifted"):
    output.handle(StatusEvent(drive().status(40, state=state)))
    output.handle(event)
    output.handle(EndEvent(complete=True, parts=(PARTS,)))


@pytest.mark.parametrize("event", [proposal(), NOTHING])
def test_the_summary_names_the_file_or_the_reason_and_the_command_how_to_take_it(
    tmp_path, drive, event, capsys
):
    told(SummaryFile(tmp_path, "van-17"), drive, event)
    summary = Summary.model_validate_json((tmp_path / "summary.json").read_bytes())
    proposed = summary.pairs["front"].candidate
    assert proposed.reason == event.reason
    assert proposed.hash == (event.document.hash if event.document else None)
    assert proposed.file == ("front.candidate.json" if event.document else None)
    assert summary.parts == (PARTS,)
    json.loads((tmp_path / "summary.json").read_text())
    tell(summary, tmp_path, images_hz=2.0)
    file = tmp_path / "front.candidate.json"
    assert (f"calibwatch extrinsic import {file} --out" in capsys.readouterr().out) == bool(event.document)


@pytest.mark.parametrize(
    ("event", "says"),
    [
        (proposal(), "made from one window only"),
        (proposal(windows=2), "made from 2 windows only"),
        (proposal(windows=3), "made from 3 windows of different places that agree. "),
        (proposal(lines=(0.4, 30.0, 6.0)), "misfit 6.0, under the stored one 30.0 (p = 0.4)"),
        (NOTHING, "None is proposed: The frames held out show another extrinsic."),
    ],
)
def test_the_report_says_what_it_rests_on(tmp_path, drive, event, says):
    told(Report(tmp_path, "van-17"), drive, event)
    page = (tmp_path / "report.html").read_text()
    assert says in page
    assert "The LiDAR has moved (9:1 against several parts)." in page
    assert ("it scores 0.410, the stored one 0.250 (p = 0.0001)" in page) == (event.document is not None)
