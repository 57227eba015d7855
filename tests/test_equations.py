"""docs/equations.md against the docstrings that it points to."""

import importlib
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "equations.md"
ROWS = re.findall(r"^\| ((?:CRLF|PLK) \(\d+\)) \|.*\| `([\w.]+)` \|$", PAGE.read_text(), re.MULTILINE)


def named(where):
    """The module, or the function of a module."""
    try:
        return importlib.import_module(where)
    except ModuleNotFoundError:
        module, _, name = where.rpartition(".")
        return getattr(importlib.import_module(module), name)


def test_every_equation_of_both_papers_has_a_row():
    wanted = [f"CRLF ({k})" for k in range(1, 17)] + [f"PLK ({k})" for k in range(1, 15)]
    assert [equation for equation, _ in ROWS] == wanted


@pytest.mark.parametrize(("equation", "where"), ROWS)
def test_the_docstring_names_the_equation(equation, where):
    paper, number = equation.split()
    said = " ".join(named(where).__doc__.split())
    # "CRLF (5), (6)" names both; a number belongs to the paper named last before it.
    assert re.search(rf"{paper} (?:\(\d+\)(?:,| and|-) ?)*{re.escape(number)}", said)
