"""``calibwatch run`` as a process: it says that it watches, ends on a signal, and refuses in one line."""

import os
import signal
import subprocess
import sys

import pytest

from monitor.bus import BusSettings, listening_at, open_session
from tests import drives

PATIENCE_S = 45
RIG = (
    drives.RIG.replace(f'info = "{drives.INFO_TOPIC}"', drives.INTRINSICS)
    + "[pairs.extrinsic]\nT_cam_lidar = [[0,-1,0,0],[0,0,-1,0],[1,0,0,0],[0,0,0,1]]\n"
)


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_watch(rig, tmp_path, number):
    with open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",))) as hub:
        options = ("--rig", str(rig), "--out", str(tmp_path / "out"), "--connect", listening_at(hub)[0])
        with subprocess.Popen(  # noqa: S603 - our own program
            [sys.executable, "-c", "from monitor.cli import main; main()", "run", *options],
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        ) as process:
            try:
                assert process.stderr.readline() == "watching\n"
                tokens = hub.liveliness().get("calibwatch/van-1/alive")
                assert [reply.ok is not None for reply in tokens] == [True]
                process.send_signal(number)
                assert process.wait(PATIENCE_S) == 0
                assert process.stderr.read() == ""
            finally:
                process.kill()
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert "summary.json" in names
    assert '"complete": false' in (tmp_path / "out" / "summary.json").read_text()


def test_a_bus_that_is_not_there(calibwatch, rig):
    code, out, err = calibwatch("run", "--rig", rig, "--connect", "tcp/127.0.0.1:1")
    assert (code, out) == (1, "")
    assert err.startswith("calibwatch: no session with tcp/127.0.0.1:1 within")
    assert len(err.splitlines()) == 1


def test_a_bus_must_be_named(calibwatch, rig):
    code, _, err = calibwatch("run", "--rig", rig)
    assert code == 2
    assert "--connect ENDPOINT or --listen ENDPOINT" in err


@pytest.mark.parametrize("endpoint", ["127.0.0.1:7447", "tpc/127.0.0.1:7447"])
def test_an_endpoint_that_is_none(calibwatch, rig, endpoint):
    code, _, err = calibwatch("run", "--rig", rig, "--connect", endpoint)
    assert code == 1
    assert len(err.splitlines()) == 1
    assert endpoint in err


def test_a_place_that_can_not_be_written_to(calibwatch, rig, tmp_path):
    (tmp_path / "file").write_text("")
    with open_session(BusSettings(mode="peer", listen=("tcp/127.0.0.1:0",))) as hub:
        code, _, err = calibwatch(
            "run", "--rig", rig, "--connect", listening_at(hub)[0], "--out", tmp_path / "file" / "below"
        )
    assert code == 1
    assert len(err.splitlines()) == 1
    assert "file/below can not be" in err
