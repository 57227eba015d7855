"""Every command in the documents exists with the options that are shown, and every file that they name."""

import importlib
import re
import shlex
from pathlib import Path

import click
import pytest

from monitor.cli import COMMANDS

ROOT = Path(__file__).parents[1]
DOCUMENTS = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "monitor/spec.md")]


def shown():
    """Command lines in code blocks, and commands named in the text."""
    for document in DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL):
            for line in block.splitlines():
                words = shlex.split(line, comments=True)
                if words and words[0].endswith("calibwatch"):
                    yield document.name, tuple(words[1:])
        for inline in re.findall(r"`calibwatch ([^`]+)`", text):
            yield document.name, tuple(shlex.split(inline))


def test_commands_are_shown():
    assert len(set(shown())) > 8


@pytest.mark.parametrize(("document", "words"), sorted(set(shown())), ids=str)
def test_a_command_that_is_shown_exists_with_its_options(document, words):
    del document
    if words[0] == "--help":
        return
    assert words[0] in COMMANDS
    command = importlib.import_module(f"monitor.commands.{words[0]}").command
    rest = words[1:]
    if isinstance(command, click.Group) and rest:
        command, rest = command.commands[rest[0]], rest[1:]
    known = {option for parameter in command.params for option in parameter.opts}
    options = {word.partition("=")[0] for word in rest if word.startswith("--")}
    assert options <= known


def test_targets_of_make_that_are_shown_exist():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for document in DOCUMENTS:
        for target in re.findall(r"^make ([a-z-]+)", document.read_text(encoding="utf-8"), re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), target


def test_paths_in_backticks_exist():
    for document in DOCUMENTS:
        for path in re.findall(
            r"`((?:monitor|pipeline|models|tests)/[\w/.]+)`", document.read_text(encoding="utf-8")
        ):
            assert (ROOT / path).exists() or Path(path).stem == "x", path
