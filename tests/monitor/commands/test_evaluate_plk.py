"""``calibwatch evaluate plk-*`` through the command line, with few runs."""

import json
import math

import cv2
import numpy as np
import pytest

from monitor import charts
from pipeline.plk_scenes import METHODS, SCENES
from pipeline.plk_starts import Box


@pytest.fixture(scope="module")
def runs():
    return 3


@pytest.fixture
def table(calibwatch, runs):
    """Table I as JSON: exit code, document."""
    code, out, err = calibwatch("evaluate", "plk-table1", "--runs", runs, "--json")
    assert err == ""
    return code, json.loads(out)


def pixels(path):
    return cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)


def test_table_says_what_is_solved_and_exits_by_the_bar(table, runs):
    code, found = table
    rows = {(row["scene"], row["sigma_px"]): row for row in found["rows"]}
    assert rows.keys() == {(name, sigma) for name in SCENES for sigma in (0.3, 1.0)}
    for (name, _), row in rows.items():
        degenerate = name in ("c", "d", "corner")
        assert row["ranks"] == {str(5 if degenerate else 6): runs}
        assert row["methods"]["II"]["answers"] == (0 if degenerate else runs)
        assert (row["methods"]["II"]["rotation_rad"] is None) is degenerate
        assert row["methods"]["ours"]["answers"] == runs
        assert (row["held_deg"] is None) is not degenerate
        assert not degenerate or row["held_deg"] < 1e-6
    assert rows["a", 0.3]["gap"] < 1e-9 < rows["e", 0.3]["gap"]
    # The same noise, more than three times as strong.
    ratio = rows["e", 1.0]["seen_rotation_rad"] / rows["e", 0.3]["seen_rotation_rad"]
    assert 1 < ratio < 12
    assert code == (0 if all(demand["met"] for row in rows.values() for demand in row["demands"]) else 1)


def test_a_missed_bar_is_said_and_exits_with_one(calibwatch, tmp_path):
    """One run is no median: some row misses for this seed, and the text says which."""
    code, out, err = calibwatch("evaluate", "plk-table1", "--runs", 1, "--seed", 3, "--out", tmp_path)
    assert (code, err) == (1, "")
    missed = [line for line in out.splitlines() if line.startswith("|") and "MISSED" in line]
    assert f"The bar is MISSED: {len(missed)} of " in out
    assert missed
    assert "says: not to be solved" in out
    assert (tmp_path / "plk-table1.md").read_text(encoding="utf-8") == out
    document = json.loads((tmp_path / "plk-table1.json").read_bytes())
    assert sum(not one["met"] for row in document["rows"] for one in row["demands"]) == len(missed)


def test_the_same_seed_gives_the_same_table_and_another_one_does_not(calibwatch):
    first, again, other = (
        calibwatch("evaluate", "plk-fig5", "--runs", 2, "--json", "--seed", seed)[1] for seed in (5, 5, 6)
    )
    assert first == again != other


def test_box_plots_are_drawn_and_told(calibwatch, tmp_path):
    code, out, err = calibwatch("evaluate", "plk-fig5", "--runs", 4, "--out", tmp_path)
    assert (code, err) == (0, "")
    document = json.loads((tmp_path / "plk-fig5.json").read_bytes())
    for methods in document["surroundings"].values():
        assert methods.keys() == set(METHODS)
        assert len(methods["ours"]["rotation_deg"]) == 4
        assert max(methods["ours"]["rotation_deg"]) < 2
        median = np.median(methods["ours"]["translation_m"])
        assert f"{median:.3g} [" in out
    image = pixels(tmp_path / "plk-fig5.png")
    for colour in charts.COLOURS[: len(METHODS)]:
        assert (image == colour).all(axis=2).sum() > 300


def test_offsets_are_drawn_and_told(calibwatch, tmp_path):
    code, out, err = calibwatch("evaluate", "plk-fig6", "--runs", 1, "--out", tmp_path)
    assert (code, err) == (0, "")
    halves = json.loads((tmp_path / "plk-fig6.json").read_bytes())["halves"]
    for half, last in (("translation", 5), ("rotation", 46)):
        points = halves[half]["methods"]["ours"]
        assert (points[0]["offset"], points[-1]["offset"]) == (0, pytest.approx(last))
        assert points[0]["success"] == 1.0
    assert out.count("\n| ") == 11 + 24 + 2
    assert pixels(tmp_path / "plk-fig6.png").shape == (860, 1240, 3)


@pytest.mark.parametrize("name", ["plk-table1", "plk-fig5", "plk-fig6"])
def test_bad_input_is_refused_in_one_line_before_anything_runs(calibwatch, tmp_path, name):
    assert calibwatch("evaluate", name, "--runs", 0)[0] == 2
    (tmp_path / "file").touch()
    code, out, err = calibwatch("evaluate", name, "--out", tmp_path / "file" / "x")
    assert (code, out) == (1, "")
    assert err.count("\n") == 1
    assert "--out" in err


def coloured(data, channel):
    """Where a picture is drawn in a colour whose strongest channel is this one; thin lines are pale."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return (np.ptp(image, axis=2) > 40) & (image.argmax(axis=2) == channel)


def test_axes_place_values():
    line = charts.steps(0.0, 5.0, 1.0, "m")
    assert [line.place(x) for x in (-1, 0, 2.5, 5, 9)] == [0, 0, 0.5, 1, 1]
    assert [name for _, name in line.ticks] == ["0", "1", "2", "3", "4", "5"]
    logarithmic = charts.decades([0.02, 0.5, 7.0], "m")
    assert [name for _, name in logarithmic.ticks] == ["0.01", "0.1", "1", "10"]
    assert logarithmic.place(math.sqrt(0.1)) == pytest.approx(0.5)
    assert logarithmic.place(0.0) == 0.0


def test_marks_are_drawn_where_their_values_are():
    """A curve and a box in an empty panel: the rows and columns of their colours are those of the values."""
    x, y = charts.steps(0.0, 10.0, 5.0, "x"), charts.steps(0.0, 1.0, 0.5, "y")
    curve = charts.Curve(0, (0.0, 10.0), (0.5, 0.5))
    box = charts.PlacedBox(1, 5.0, 2.0, Box(0.1, 0.2, 0.3, 0.4, 0.45, ()))
    data = charts.png([charts.Panel("t", x, y, (curve, box))], (), 1)
    left, right, top, bottom = 84, 620 - 14, 64, 430 - 56
    rows, columns = np.nonzero(coloured(data, 0))
    assert np.median(rows) == pytest.approx(bottom - 0.5 * (bottom - top), abs=1)
    assert (columns.min(), columns.max()) == (pytest.approx(left, abs=6), pytest.approx(right, abs=6))
    rows, columns = np.nonzero(coloured(data, 2))
    assert rows.max() == pytest.approx(bottom - 0.1 * (bottom - top), abs=2)
    assert rows.min() == pytest.approx(bottom - 0.45 * (bottom - top), abs=2)
    assert columns.min() == pytest.approx(left + 0.4 * (right - left), abs=2)
    assert columns.max() == pytest.approx(left + 0.6 * (right - left), abs=2)


def test_a_gap_in_a_curve_stays_a_gap():
    x, y = charts.steps(0.0, 4.0, 1.0, "x"), charts.steps(0.0, 1.0, 1.0, "y")
    whole, gap = ((0.5,) * 5, (0.5, 0.5, None, 0.5, 0.5))
    counts = []
    for values in (whole, gap):
        data = charts.png([charts.Panel("t", x, y, (charts.Curve(2, tuple(range(5)), values),))], (), 1)
        counts.append(int(coloured(data, 1)[:, 215:475].any(axis=0).sum()))
    assert counts[0] > 250
    assert counts[1] < 30
