"""The command line as a whole: light to start, one line for what goes wrong, codes that scripts may trust."""

import os
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


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("evaluate", "drifts"), "no command 'drifts' (did you mean 'drift'?"),
        (("extrinsic", "show"), "no command 'show' ("),
        (("replay", "x", "--images-hz", "nan"), "'--images-hz': nan is no number"),
        (("replay", "x", "--images-hz", "inf"), "'--images-hz': inf is no number"),
        (("run", "--rig", "x", "--images-hz", "nan"), "'--images-hz': nan is no number"),
        (("calibrate", "x", "--prior-sigma", "nan", "1"), "'--prior-sigma': nan is no number"),
        (("evaluate", "dataset", "x", "--rotation", "nan"), "'--rotation': nan is no number"),
        (("evaluate", "drift", "x", "--limits", "0.5", "nan"), "'--limits': nan is no number"),
        (
            ("evaluate", "drift", "x", "--reference-sigma", "nan", "0"),
            "--reference-sigma': nan is no",
        ),
        (("evaluate", "run-length", "--hours", "nan"), "'--hours': nan is no number"),
        (("demo", "--seed", "-1"), "-1 is not in the range"),
        (("demo", "--seed", "9" * 30), "is not in the range"),
        (("extrinsic", "import", "x", "--out", "y.toml", "--size", "0x375"), "as in 1920x1200"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_what_can_not_be_meant_is_named_before_anything_is_read(calibwatch, arguments, told):
    code, out, err = calibwatch(*arguments)
    assert (code, out) == (2, "")
    assert told in err


@pytest.mark.parametrize("command", ["inspect", "replay", "calibrate"])
def test_an_empty_name_is_not_the_present_folder(calibwatch, command, cut, monkeypatch, tmp_path):
    (tmp_path / "drive.mcap").symlink_to(cut(5))
    monkeypatch.chdir(tmp_path)
    code, _, err = calibwatch(command, "")
    assert (code, err) == (1, "calibwatch: the name of the recording is empty (name a file or a folder)\n")


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


def run_into(stream, *arguments, broken):
    """Our program where nothing can be written to stdout or stderr: exit code, the other stream."""
    other = "stderr" if stream == "stdout" else "stdout"
    ran = subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "-c", "from monitor.cli import main; main()", *map(str, arguments)],
        check=False,
        text=True,
        **{stream: broken, other: subprocess.PIPE},
    )
    return ran.returncode, getattr(ran, other)


@pytest.fixture
def left():
    """The end to write to of a pipe whose reader has gone."""
    reader, writer = os.pipe()
    os.close(reader)
    yield writer
    os.close(writer)


@pytest.mark.parametrize("arguments", [("--help",), ("--version",), ("inspect",)], ids=" ".join)
def test_a_reader_that_left_is_not_answered(left, cut, arguments):
    recording = [cut(5)] if arguments == ("inspect",) else []
    assert run_into("stdout", *arguments, *recording, broken=left) == (1, "")


@pytest.mark.parametrize(("arguments", "code"), [(("replay",), 2), (("inspect", "absent"), 1)])
def test_the_code_stands_where_nobody_reads_why(left, arguments, code):
    assert run_into("stderr", *arguments, broken=left) == (code, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("arguments", [("--help",), ("inspect",)], ids=" ".join)
def test_output_that_finds_no_room_is_one_line(cut, arguments):
    recording = [cut(5)] if arguments == ("inspect",) else []
    with open("/dev/full", "w") as full:  # noqa: PTH123 - a device
        code, err = run_into("stdout", *arguments, *recording, broken=full)
    assert code == 1
    assert err.splitlines() == ["calibwatch: the output can not be written: No space left on device"]


def test_a_pipe_that_breaks_inside_is_a_fault_of_ours(calibwatch, monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    failing(monkeypatch, BrokenPipeError(32, "Broken pipe"))
    code, _, err = calibwatch("inspect")
    assert code == 1
    assert "internal error" in err
    assert "Broken pipe" in Path(err.partition("trace in ")[2].rstrip(")\n")).read_text()


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
    import signal  # noqa: PLC0415 - signals are sent here only

    before = signal.getsignal(signal.SIGTERM)
    with commands.stop_on_signal() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.wait(5)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) == before
