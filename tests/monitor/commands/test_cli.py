"""The command line as a whole: light to start, one line for what goes wrong, codes that scripts may trust."""

import subprocess
import sys
from pathlib import Path

import click
import pytest

from monitor import cli, commands
from monitor.status import STATES

HEAVY = ("numpy", "scipy", "cv2", "rerun", "onnxruntime", "zenoh", "mcap", "torch")
PROGRAM = """
import sys
from monitor.cli import main
try:
    main(sys.argv[2:])
except SystemExit as ended:
    print("ended", ended.code, *(name for name in sys.argv[1].split(",") if name in sys.modules))
"""


def modules_after(*arguments, of=HEAVY):
    ran = subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "-c", PROGRAM, ",".join(of), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=True,
    )
    return ran.stdout.splitlines()[-1]


@pytest.mark.parametrize(
    "command", [(), *((name,) for name in sorted(cli.COMMANDS)), ("extrinsic", "import")], ids=" ".join
)
def test_help_is_there_and_imports_nothing_heavy(command, calibwatch):
    assert modules_after(*command, "--help") == "ended 0"
    code, out, _ = calibwatch(*command, "--help")
    assert code == 0
    if command != ("extrinsic",):
        assert out.partition("Examples: ")[2].count("calibwatch ") >= 1


@pytest.mark.parametrize("command", ["inspect", "calibrate"])
def test_what_shows_nothing_does_not_load_the_viewer(command, cut):
    assert modules_after(command, cut(5), of=("rerun", "torch")) == "ended 0"


@pytest.mark.parametrize(
    ("name", "told"),
    [("reply", "did you mean 'replay'?"), ("zzz", "known: acknowledge, baseline, calibrate, demo,")],
)
def test_an_unknown_command_names_the_nearest(calibwatch, name, told):
    code, _, err = calibwatch(name)
    assert code == 2
    assert told in err


def test_a_command_without_its_argument_is_wrong_usage(calibwatch):
    code, _, err = calibwatch("replay")
    assert code == 2
    assert "RECORDING" in err


def test_the_version_is_told(calibwatch):
    code, out, _ = calibwatch("--version")
    assert code == 0
    assert out.startswith("calibwatch, version ")


def failing(monkeypatch, error):
    @click.command()
    def command():
        raise error

    monkeypatch.setattr("monitor.commands.inspect.command", command)


def test_a_fault_of_ours_is_one_line_and_a_trace_that_can_be_sent(calibwatch, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    failing(monkeypatch, ValueError("two\nlines"))
    code, _, err = calibwatch("inspect")
    assert code == 1
    assert len(err.splitlines()) == 1
    assert "internal error: ValueError" in err
    trace = Path(err.partition("trace in ")[2].rstrip(")\n"))
    assert trace.parent == tmp_path
    assert "raise error" in trace.read_text()


def test_an_interrupt_is_130(calibwatch, monkeypatch):
    failing(monkeypatch, KeyboardInterrupt())
    code, out, err = calibwatch("inspect")
    assert (code, out, err.strip()) == (130, "", "interrupted")


@pytest.mark.parametrize("state", STATES)
def test_only_healthy_reads_zero(state):
    from monitor.commands.replay import exit_code  # noqa: PLC0415 - beside what it tests

    assert (exit_code(state, exit_zero=False) == 0) == (state == "healthy")
    assert exit_code(state, exit_zero=True) == (1 if state == "fault" else 0)


def test_a_signal_sets_the_stop_and_the_second_interrupts():
    import os  # noqa: PLC0415 - signals are sent here only
    import signal  # noqa: PLC0415 - likewise

    before = signal.getsignal(signal.SIGTERM)
    with commands.stop_on_signal() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(5)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) == before
