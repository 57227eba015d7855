"""The page of the verdict's experiments: tables take their places, and only those that were measured."""

import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "docs" / "drift_page.py"
PAGE = """# Title

<!-- simulated -->
old simulated
<!-- end -->

between

<!-- recorded -->
old recorded
<!-- end -->
after
"""


@pytest.fixture
def renewed(tmp_path, monkeypatch):
    """The page after a run with some folders of results."""

    def run(*names):
        docs = tmp_path / "docs"
        docs.mkdir(exist_ok=True)
        if not (docs / "drift.md").exists():
            (docs / "drift.md").write_text(PAGE)
        for name in names:
            (tmp_path / "out" / name).mkdir(parents=True, exist_ok=True)
            (tmp_path / "out" / name / "drift.md").write_text(f"| new {name} |\n")
            for picture in ("calling", "stanford"):
                (tmp_path / "out" / name / f"drift_{picture}.png").write_bytes(name.encode())
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), str(tmp_path / "out"), str(docs)])
        runpy.run_path(str(SCRIPT), run_name="__main__")
        return (docs / "drift.md").read_text(), docs

    return run


def test_a_block_is_renewed_and_the_others_stay(renewed):
    text, docs = renewed("simulated")
    assert "| new simulated |" in text
    assert "old simulated" not in text
    assert "old recorded" in text
    assert (docs / "drift_calling.png").read_bytes() == b"simulated"
    assert "(drift_stanford.png)" in text
    assert "(drift_axes.png)" not in text
    assert text.startswith("# Title")
    assert text.endswith("<!-- end -->\nafter\n")


def test_pictures_of_recordings_stay_where_they_are(renewed):
    text, docs = renewed("recorded")
    assert "| new recorded |" in text
    assert ".png" not in text
    assert not list(docs.glob("*.png"))


def test_the_same_results_give_the_same_page(renewed):
    assert renewed("simulated", "recorded")[0] == renewed("simulated", "recorded")[0]


def test_the_page_has_a_place_for_what_the_make_target_measures():
    recipe = (ROOT / "Makefile").read_text().partition("\nfigures-drift:")[2].partition("\n\n")[0]
    page = (ROOT / "docs" / "drift.md").read_text()
    places = [part.partition(" -->")[0] for part in page.split("<!-- ")[1:]]
    assert set(places) - {"end"} == {
        part.split()[0].rstrip(")") for part in recipe.split("$(OUT)/drift/")[1:]
    }
