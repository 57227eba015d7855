import math

import numpy as np
import pytest

from pipeline.simulation import marks
from pipeline.simulation.marks import draw_flaws, draw_paint
from pipeline.simulation.paint import WHITE, YELLOW, Paint
from pipeline.simulation.scene import SceneParameters


@pytest.mark.parametrize("lanes", [1, 2, 3, 6])
def test_marks_lie_on_the_road(lanes):
    p = SceneParameters(lanes=lanes)
    edge = lanes * p.lane_width / 2
    s, d = (
        a.ravel().astype(np.float32) for a in np.meshgrid(np.arange(0, 200, 0.4), np.arange(-20, 20, 0.1))
    )
    for seed in range(8):
        paint = draw_paint(p, [40.0, 130.0], np.random.default_rng(seed))
        on = paint.covers(s, d)
        assert 0.0 < on[np.abs(d) < edge].mean() < 0.3
        # Parking bays lie beside the lanes, merging lanes reach over by one.
        assert not on[np.abs(d) > edge + max(p.lane_width, 2.5)].any()


def test_some_roads_have_yellow_lines():
    colours = [
        {line.colour for line in draw_paint(SceneParameters(), [], np.random.default_rng(k)).lines}
        for k in range(40)
    ]
    assert any(YELLOW in c for c in colours)
    assert sum(c == {WHITE} for c in colours) > 20


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_letters_are_read_by_who_drives_towards_them(way):
    """An L has its foot near the driver and its bar to the right of the stem."""
    strokes = marks.lettering("L", (50.0, 0.0), way, WHITE, np.random.default_rng(1))
    paint = Paint((), (), tuple(strokes))
    s, d = np.meshgrid(np.linspace(44.0, 56.0, 600), np.linspace(-1.0, 1.0, 400), indexing="ij")
    on = paint.covers(s.ravel().astype(np.float32), d.ravel().astype(np.float32)).reshape(s.shape)
    ahead, right = way * (s - 50.0), -way * d
    tall = ahead[on].max()
    foot = on & (ahead < 0.1 * tall)
    head = on & (ahead > 0.5 * tall)
    assert right[foot].max() > right[head].max() + 0.2
    assert right[foot].min() == pytest.approx(right[head].min(), abs=0.1)


def test_an_arrow_ahead_ends_in_its_tip():
    for seed in range(20):
        patches, strokes = marks.lane_arrow(10.0, 0.0, 1.0, np.random.default_rng(seed))
        s, d = np.meshgrid(np.linspace(9.0, 17.0, 400), np.linspace(-1.5, 1.5, 300), indexing="ij")
        on = Paint((), tuple(patches), tuple(strokes)).covers(
            s.ravel().astype(np.float32), d.ravel().astype(np.float32)
        )
        assert on.any()
        assert s.ravel()[on].min() == pytest.approx(10.0, abs=0.05)
        assert s.ravel()[on].max() < 16.1


def test_roads_are_made_in_many_ways():
    made = [draw_flaws(SceneParameters(), 9.6, 0.0, np.random.default_rng(k)) for k in range(120)]
    assert any(math.isfinite(r.joint) for r in made)
    assert any(r.cobbles for r in made)
    assert any(not r.grassy for r in made)
    assert 0.15 < np.mean([r.wear > 0.0 for r in made]) < 0.6
    assert all(0.05 < r.kerb < 0.9 and 0.0 <= r.cracks <= 1.0 for r in made)
    assert all(r.gain > 0.0 and r.width > 0.0 for one in made for r in one.ribbons)
    assert all(b.gain > 0.0 and min(b.half) > 0.0 for one in made for b in one.blots)
    assert draw_flaws(SceneParameters(), 9.6, 0.7, np.random.default_rng(1)).snow == 0.7
