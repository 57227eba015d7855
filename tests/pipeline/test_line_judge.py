import math

import numpy as np
import pytest

from pipeline import se3
from pipeline.cameras import project
from pipeline.line_judge import LineJudge, LineJudgeParameters, judged_frame
from pipeline.records import CameraModel, CloudLine, Masks, PointCloud

CAMERA = CameraModel(
    "pinhole", np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]), np.zeros(0), 640, 480
)
TRUTH = se3.retract(np.eye(4), np.array([0.02, -0.01, 0.03, 0.1, -0.05, 0.2]))
SIGMA = np.array([math.radians(1.0)] * 3 + [0.15] * 3)
PLACES = [("lane", -1.8, 1.6), ("lane", 1.7, 1.6)] + [("pole", x, 0.0) for x in (-4.0, 3.5, -2.5)]


def rod(label, x, y, z):
    """Points of a lane ahead or of a pole, in a LiDAR frame whose axes are the camera's."""
    along = np.linspace(0.0, 1.0, 40)[:, None]
    ends = ((x, y, 6.0), (x, y, 25.0)) if label == "lane" else ((x, 1.5, z), (x, -2.0, z))
    return np.array(ends[0]) * (1 - along) + np.array(ends[1]) * along


def scene(places=PLACES, drawn=None, copies=1):
    """A judge of lines whose masks are drawn where the truth sees them; ``drawn``: only of these."""
    rods = [(label, rod(label, x, y, 10.0 + 2 * k)) for k, (label, x, y) in enumerate(places)]
    masks = {"lane": np.zeros((480, 640), dtype=bool), "pole": np.zeros((480, 640), dtype=bool)}
    for k, (label, xyz) in enumerate(rods):
        if drawn is not None and k not in drawn:
            continue
        fine = xyz[0] + np.linspace(0.0, 1.0, 3000)[:, None] * (xyz[-1] - xyz[0])
        px, seen = project(CAMERA, se3.apply(TRUTH, fine))
        for u, v in np.rint(px[seen]).astype(int):
            masks[label][max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3] = True
    points = np.concatenate([xyz for _, xyz in rods]) if rods else np.zeros((0, 3))
    cloud = PointCloud(points.astype(np.float32))
    lines = [
        CloudLine(label, xyz[0], xyz[-1], np.arange(40 * k, 40 * k + 40), 0.02, 1.0)
        for k, (label, xyz) in enumerate(rods)
    ]
    lane, pole = masks["lane"], masks["pole"]
    both = Masks(lane, pole, lane.astype(np.float32), pole.astype(np.float32), 1.0, 1.0)
    frame = judged_frame(cloud, lines, both, CAMERA)
    return LineJudge((frame,) * copies, CAMERA)


def off(axis, by):
    """The truth turned or shifted."""
    return se3.retract(TRUTH, by * np.eye(6)[axis])


def test_each_line_is_highest_where_it_lies_on_its_mask():
    heights = scene().heights(np.stack([TRUTH, off(0, 0.03), off(1, 0.03)]))
    assert heights.shape == (5, 3)
    assert np.all(heights[:, 0] > 0.98)
    # A turn about the image's x axis slides poles along themselves, but for their ends.
    assert np.all(heights[:2, 1] < 0.9)
    assert np.all(heights[2:, 1] > heights[:2, 1].max())
    assert np.all(heights[:, 2] < 0.85)


def test_the_right_fit_of_two_gets_the_odds_and_a_third_like_it_shares_them():
    rng = np.random.default_rng(1)
    odds = scene().odds(np.stack([TRUTH, off(1, 0.04)]), rng)
    assert odds.sum() == pytest.approx(1.0)
    assert odds[0] > 0.95
    shared = scene().odds(np.stack([TRUTH, off(1, 0.04), off(1, 1e-4)]), rng)
    assert shared[0] == pytest.approx(shared[2], abs=0.1)
    assert shared[1] < 0.02


def test_a_frame_whose_every_line_may_be_wrong_leaves_the_share_of_that_chance():
    p = LineJudgeParameters()
    one = scene(PLACES[2:3]).odds(np.stack([TRUTH, off(1, 0.06)]), np.random.default_rng(1))
    assert one[1] == pytest.approx(0.5 * p.wrong, abs=0.01)
    assert one[0] > 0.85


def test_one_line_that_contradicts_four_does_not_win():
    # The mask of the first pole is missing: it is as far off everywhere.
    odds = scene(drawn=(0, 1, 3, 4)).odds(np.stack([TRUTH, off(1, 0.04)]), np.random.default_rng(1))
    assert odds[0] > 0.8


def test_the_same_lines_seen_again_make_it_no_surer():
    T = np.stack([TRUTH, off(1, 0.008)])
    once = scene().odds(T, np.random.default_rng(1))
    again = scene(copies=4).odds(T, np.random.default_rng(1))
    assert 0.6 < once[0] < 0.9
    assert again[0] == pytest.approx(once[0], abs=0.08)


def test_without_lines_or_beside_the_image_every_fit_is_as_likely():
    T = np.stack([TRUTH, off(1, 0.04)])
    for judge in (LineJudge((), CAMERA), scene(()), scene()):
        seen = T if not judge.frames or not judge.frames[0].lines else np.stack([TRUTH, off(1, math.pi)])
        assert judge.odds(seen, np.random.default_rng(1)).tolist() == [0.5, 0.5]


def test_starts_lie_where_the_lines_lie_on_their_masks():
    judge, rng = scene(), np.random.default_rng(1)
    T_guess = se3.retract(TRUTH, np.array([1.0, -1.2, 0.8, 0.7, -0.9, 1.1]) * SIGMA)
    summits, places = judge.starts(T_guess, T_guess, SIGMA, rng)
    p = judge.parameters
    assert (summits.shape, places.shape) == ((p.searches, 4, 4), (p.picked, 4, 4))
    at_guess = judge.heights(T_guess[None]).mean()
    assert np.all(judge.heights(summits).mean(axis=0) > max(at_guess + 0.05, 0.93))
    assert np.all(judge.heights(places).mean(axis=0) > at_guess)
    xi = np.array([se3.local(T_guess, T) for T in places])
    assert np.all(np.abs(xi) <= 2.0 * SIGMA + 1e-9)


def test_there_is_nowhere_to_start_where_no_line_is_seen():
    away = off(1, math.pi)
    for judge in (LineJudge((), CAMERA), scene(())):
        summits, places = judge.starts(TRUTH, TRUTH, SIGMA, np.random.default_rng(1))
        assert len(summits) == len(places) == 0
    assert len(scene().starts(TRUTH, away, SIGMA, np.random.default_rng(1))[0]) == 0
