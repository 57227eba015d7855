"""The page of CRLF's experiments: tables take their places, and only those that were measured."""

import runpy
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "docs" / "crlf_page.py"
PAGE = """# Title

<!-- near -->
old near
<!-- end -->

between

<!-- recorded -->
<!-- end -->
after
"""
TABLES = """Head.

| a |
|---|
| 1 |

Error / sigma of each answer; in brackets: not observable.

| frame |
|---|
| x |

Times.
"""


@pytest.fixture
def renewed(tmp_path, monkeypatch):
    """The page after a run with some folders of results."""

    def run(*names):
        docs = tmp_path / "docs"
        docs.mkdir(exist_ok=True)
        if not (docs / "crlf.md").exists():
            (docs / "crlf.md").write_text(PAGE)
        for name in names:
            (tmp_path / "out" / name).mkdir(parents=True, exist_ok=True)
            (tmp_path / "out" / name / "dataset.md").write_text(TABLES)
            (tmp_path / "out" / name / "dataset.png").write_bytes(name.encode())
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), str(tmp_path / "out"), str(docs)])
        runpy.run_path(str(SCRIPT), run_name="__main__")
        return (docs / "crlf.md").read_text(), docs

    return run


def test_a_block_is_renewed_and_the_others_stay(renewed):
    text, docs = renewed("recorded")
    assert "old near" in text
    assert text.count("| x |") == 1
    assert (docs / "crlf_recorded.png").read_bytes() == b"recorded"
    assert not (docs / "crlf_near.png").exists()
    assert text.startswith("# Title")
    assert text.endswith("<!-- end -->\nafter\n")


def test_single_answers_are_shown_of_recordings_only(renewed):
    text, _ = renewed("near")
    assert "old near" not in text
    assert "| x |" not in text
    assert "Error / sigma" not in text
    assert [text.count(part) for part in ("Head.", "| 1 |", "Times.", "(crlf_near.png)")] == [1] * 4


def test_the_same_results_give_the_same_page(renewed):
    assert renewed("near", "recorded")[0] == renewed("near", "recorded")[0]
