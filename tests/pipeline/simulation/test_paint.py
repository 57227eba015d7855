import numpy as np

from pipeline.simulation.paint import Line, Paint, Patch, arrow, crossing


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
