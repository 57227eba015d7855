"""spec.md has a line for everything that the code reads, says and writes."""

import ast
import pkgutil
import re
from pathlib import Path
from typing import get_args, get_origin

import pytest
from pydantic import BaseModel

import monitor
from monitor import extrinsic_formats, messages, outputs, sources
from monitor.bus import COMMANDS, REPLAY_ROOT, ROOT
from monitor.extrinsic_formats import formats
from monitor.messages import codecs
from monitor.outputs.status_log import FILE_NAME as LOG
from monitor.outputs.summary import FILE_NAME as SUMMARY
from monitor.outputs.summary import SCHEMA as SUMMARY_SCHEMA
from monitor.rig_document import RigDocument
from monitor.status import EXIT_CODES, PRECEDENCE, SCHEMA
from monitor.sync import DROP_REASONS
from pipeline import watch
from pipeline.verdict import CODES

PACKAGE = Path(monitor.__file__).parent
SPEC = (PACKAGE / "spec.md").read_text(encoding="utf-8")


def section(title):
    """The text below a heading, up to the next one."""
    return re.split(r"^## ", SPEC.split(f"\n## {title}\n", 1)[1], maxsplit=1, flags=re.MULTILINE)[0]


def rows(title):
    """First cell of each row of the tables of a section -> the whole row."""
    lines = [line for line in section(title).splitlines() if line.startswith("|")]
    return {line.split("|")[1].strip().strip("`"): line for line in lines}


def modules(package):
    return sorted(m.name for m in pkgutil.iter_modules(package.__path__) if not m.name.startswith("_"))


def strings_given_to(paths, *names):
    """First arguments of calls ``x.name("...")`` and keys of ``x.name["..."]``, read off the source."""
    found = set()
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Call(func=ast.Attribute(attr=name), args=[ast.Constant(value=str(text)), *_]):
                    wanted = name in names
                case ast.Subscript(value=ast.Attribute(attr=name), slice=ast.Constant(value=str(text))):
                    wanted = name in names
                case _:
                    continue
            if wanted:
                found.add(text)
    return found


@pytest.mark.parametrize(
    ("package", "title"), [(sources, "Sources"), (messages, "Messages"), (outputs, "Outputs")]
)
def test_every_module_has_a_row(package, title):
    assert set(modules(package)) <= rows(title).keys()


def test_no_row_is_left_of_a_module_that_is_gone():
    for package, title in ((sources, "Sources"), (messages, "Messages"), (outputs, "Outputs")):
        assert rows(title).keys() - {"module", "---"} <= set(modules(package))


def test_every_type_of_message_is_named():
    for name in codecs():
        assert f"`{name}`" in section("Messages")


def test_every_format_of_extrinsics_has_a_row():
    assert extrinsic_formats.__doc__
    found = rows("Formats that `calibwatch extrinsic import` reads").keys() - {"name", "---"}
    assert found == formats().keys()


def test_every_code_has_a_row_with_its_state():
    found = rows("States")
    for code, state in CODES.items():
        assert f"`{state}`" in found[code]
    assert found.keys() - {"code", "---"} == CODES.keys()
    assert ", ".join(f"`{state}`" for state in PRECEDENCE) in section("States")


def test_every_reason_of_a_drop_has_a_row():
    intake = strings_given_to([PACKAGE / "intake.py"], "dropped")
    assert intake
    known = {*DROP_REASONS, *get_args(watch.DropReason), *intake}
    assert rows("Status").keys() - {"reason", "---"} == known


def test_every_loss_of_a_source_is_named():
    found = strings_given_to((PACKAGE / "sources").glob("*.py"), "add", "lose")
    assert "rest_of_file" in found
    for reason in found:
        assert f"`{reason}`" in section("Sources")


def fields(model, prefix=""):
    """Every key of the rig file with its default."""
    for name, field in model.model_fields.items():
        inner = [t for t in (field.annotation, *get_args(field.annotation)) if isinstance(t, type)]
        sub = next((t for t in inner if get_origin(t) is None and issubclass(t, BaseModel)), None)
        if sub is None:
            yield f"{prefix}{name}", field.default
        else:
            listed = get_origin(field.annotation) is list
            yield from fields(sub, f"{prefix}{name}{'[]' if listed else ''}.")


def test_every_key_of_the_rig_file_has_a_row_with_its_default():
    found = rows("Rig file")
    keys = dict(fields(RigDocument))
    assert "pairs[].limits.up_m" in keys
    assert found.keys() - {"key", "---"} == keys.keys()
    for key, default in keys.items():
        if isinstance(default, float | str) and default:
            assert f"`{default}`" in found[key].split("|")[3], key
        if isinstance(default, list):
            assert all(f"`{item}`" in found[key] for item in default), key


def test_keys_files_and_schemas_are_named():
    for text in (
        f"`{ROOT}/<vehicle>/<pair>/status`",
        f"`{ROOT}/<vehicle>/alive`",
        f"`{REPLAY_ROOT}/<run>/feed/topic/<topic>`",
        f"`{ROOT}/<vehicle>/<pair>/cmd/acknowledge`",
        f"cmd/{{{','.join(name for name in COMMANDS if name != 'acknowledge')}}}",
        f"`{LOG}`",
        f"`{SUMMARY}`",
        f"`{SUMMARY_SCHEMA}`",
        f"`{SCHEMA}`",
        "`calibwatch.inspection/1`",
        "`monitor/status.schema.json`",
    ):
        assert text in SPEC


def test_every_exit_code_has_a_row():
    found = rows("Exit codes")
    assert {str(code) for code in EXIT_CODES.values()} | {"2", "130"} == found.keys() - {"code", "---"}
    for state, code in EXIT_CODES.items():
        if code in (0, 3, 4):
            assert f"`{state}`" in found[str(code)]
