import numpy as np
import pytest

from pipeline.simulation.paint import WHITE, YELLOW, Line, Paint, Patch, Stroke, arrow, crossing


def covered(paint, s, d):
    return paint.covers(np.asarray(s, dtype=np.float32), np.asarray(d, dtype=np.float32))


def test_a_dashed_line_covers_its_share_of_its_strip():
    paint = Paint((Line(1.5, 0.15, 3.0, 6.0, 0.4),), ())
    rng = np.random.default_rng(1)
    s, d = rng.uniform(0, 900, 200_000), rng.uniform(1.3, 1.7, 200_000)
    inside = covered(paint, s, d)
    assert abs(inside.mean() - (0.15 / 0.4) * (3.0 / 9.0)) < 0.003
    assert (np.abs(d[inside] - 1.5) <= 0.0751).all()
    assert (((s[inside] - 0.4) % 9.0) <= 3.001).all()


def test_a_solid_line_has_no_gaps():
    paint = Paint((Line(-2.0, 0.12),), ())
    assert covered(paint, np.linspace(-50, 300, 999), np.full(999, -1.95)).all()
    assert not covered(paint, np.linspace(-50, 300, 999), np.full(999, -1.93)).any()


def test_an_arrow_points_along_the_way():
    forward, back = (Paint((), arrow(10.0, 0.0, forward=way)) for way in (True, False))
    assert covered(forward, [13.3, 14.9], [0.35, 0.35]).tolist() == [True, False]
    assert covered(back, [11.7, 10.1], [0.35, 0.35]).tolist() == [True, False]
    assert covered(forward, [10.5, 10.5], [0.0, 0.2]).tolist() == [True, False]


def test_a_crossing_is_half_paint():
    paint = Paint((), crossing(20.0, -5.0, 5.0))
    s, d = np.meshgrid(np.linspace(20.01, 22.99, 50), np.linspace(-5, 5, 2001))
    assert abs(covered(paint, s.ravel(), d.ravel()).mean() - 0.5) < 0.01


def test_a_patch_ends_at_its_ends():
    paint = Paint((), (Patch((5.0, 5.4), -1.0, (1.5, 1.5)),))
    assert covered(paint, [4.99, 5.2, 5.41, 5.2], [-1.0, -2.4, -1.0, 0.6]).tolist() == [
        False,
        True,
        False,
        False,
    ]


def test_a_stroke_is_a_turned_rectangle():
    paint = Paint((), (), (Stroke((10.0, -1.0), (13.0, 3.0), 0.2, YELLOW),))
    rng = np.random.default_rng(2)
    s, d = rng.uniform(9.0, 14.0, 300_000), rng.uniform(-2.0, 4.0, 300_000)
    on = covered(paint, s, d)
    assert on.mean() * 30.0 == pytest.approx(5.0 * 0.2, abs=0.04)
    across = np.abs((s - 10.0) * 0.8 - (d + 1.0) * 0.6)
    along = (s - 10.0) * 0.6 + (d + 1.0) * 0.8
    np.testing.assert_array_equal(on, (across < 0.1) & (along > 0.0) & (along < 5.0))
    colours = paint.colours(s.astype(np.float32), d.astype(np.float32))
    assert set(colours.tolist()) == {0, YELLOW}


def test_many_patches_cover_what_each_covers_alone():
    rng = np.random.default_rng(3)
    patches = [
        Patch((a, a + b), float(c), (float(e), float(e)))
        for a, b, c, e in rng.uniform((0, 0.5, -5, 0.1), (80, 5, 5, 1), (40, 4))
    ]
    strokes = [
        Stroke(tuple(q[:2]), tuple(q[2:4]), 0.3) for q in rng.uniform((0, -5, 0, -5), (80, 5, 80, 5), (15, 4))
    ]
    s, d = rng.uniform(-5.0, 85.0, 20_000), rng.uniform(-6.0, 6.0, 20_000)
    one_by_one = np.zeros(20_000, dtype=bool)
    for patch in patches:
        one_by_one |= covered(Paint((), (patch,)), s, d)
    for stroke in strokes:
        one_by_one |= covered(Paint((), (), (stroke,)), s, d)
    np.testing.assert_array_equal(covered(Paint((), tuple(patches), tuple(strokes)), s, d), one_by_one)


def test_what_is_painted_later_lies_on_top():
    paint = Paint((Line(0.0, 1.0),), (), (Stroke((0.0, 0.0), (5.0, 0.0), 0.2, YELLOW),))
    s, d = np.array([2.0, 2.0, 2.0], np.float32), np.array([0.0, 0.3, 0.9], np.float32)
    assert paint.colours(s, d).tolist() == [YELLOW, WHITE, 0]
