"""Fig. 5 and 6: boxes in closed form, starts that are wrong as stated, solvers that hold half of the pose."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import plk_scenes as scenes
from pipeline import plk_starts as starts
from pipeline import se3


def test_box_of_known_quartiles():
    one = starts.box(np.array([0.0, 1, 2, 3, 4, 5, 6, 7, 100, -50]))
    # Quartiles of the ten sorted values by linear interpolation.
    assert (one.q1, one.median, one.q3) == (1.25, 3.5, 5.75)
    assert (one.low, one.high) == (0.0, 7.0)
    assert one.outside == (-50.0, 100.0)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40))
def test_box_holds_every_value_in_or_beside_it(values):
    one = starts.box(np.array(values))
    assert one.low <= one.median <= one.high
    inside = sum(one.low <= value <= one.high for value in values)
    assert inside + len(one.outside) == len(values)


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000), st.sampled_from(starts.SURROUNDINGS))
def test_drawn_lines_are_in_the_image_and_at_their_depth(seed, where):
    lines = scenes.drawn_scene(where.near, where.far, 6, np.random.default_rng(seed))
    middle = 0.5 * (lines.start + lines.end)[:, 2]
    assert ((middle >= where.near) & (middle <= where.far)).all()
    for points in (lines.start, lines.end):
        uv = scenes.pixels(points)
        assert ((uv >= 0) & (uv <= scenes.IMAGE_SIZE)).all()


def test_turned_start_turns_about_the_lidars_z_axis_and_keeps_the_camera_in_place():
    start = starts.offset_start("rotation", 0.5)
    turn = scenes.TRUTH[:3, :3].T @ start[:3, :3]
    np.testing.assert_allclose(turn, se3.exp_so3(np.array([0, 0, 0.5])), atol=1e-12)
    np.testing.assert_allclose(se3.inverse(start)[:3, 3], se3.inverse(scenes.TRUTH)[:3, 3], atol=1e-12)


def test_shifted_start_shifts_along_the_lidars_y_axis_and_turns_nothing():
    start = starts.offset_start("translation", 2.0)
    np.testing.assert_array_equal(start[:3, :3], scenes.TRUTH[:3, :3])
    shift = scenes.TRUTH[:3, :3].T @ (start[:3, 3] - scenes.TRUTH[:3, 3])
    np.testing.assert_allclose(shift, [0, 2, 0], atol=1e-12)


def test_matches_are_the_longest_image_lines_that_the_start_puts_into_the_image():
    rng = np.random.default_rng(5)
    pairs = scenes.observed(scenes.drawn_scene(3, 8, 10, rng), 1.0, rng)
    kept = starts.matched(pairs, scenes.TRUTH)
    length = np.linalg.norm(pairs.image_end - pairs.image_start, axis=1)
    np.testing.assert_allclose(
        np.sort(np.linalg.norm(kept.image_end - kept.image_start, axis=1)), np.sort(length)[5:]
    )
    away = starts.offset_start("rotation", math.pi)
    assert starts.matched(pairs, away) is None


@pytest.mark.parametrize(("half", "offset"), [("rotation", math.radians(20)), ("translation", 2.0)])
def test_the_half_that_is_sought_is_found_from_far_off(half, offset):
    rng = np.random.default_rng(6)
    found = [starts.fig6_once(half, offset, rng) for _ in range(8)]
    for method in scenes.METHODS:
        assert np.nanmedian([one[method] for one in found]) < starts.SUCCESS[half]
    assert np.nanmedian([one["ours"] for one in found]) < 0.5 * starts.SUCCESS[half]


def test_far_off_starts_lose_the_lines_and_say_so():
    found = [starts.fig6_once("rotation", math.pi, np.random.default_rng(i)) for i in range(3)]
    assert all(math.isnan(value) for one in found for value in one.values())


def test_ours_is_no_worse_than_either_method_in_the_box_plots():
    rng = np.random.default_rng(7)
    found = [starts.fig5_once(starts.SURROUNDINGS[1], rng) for _ in range(8)]
    median = {
        method: np.median([scenes.errors(one[method]) for one in found], axis=0) for method in scenes.METHODS
    }
    np.testing.assert_allclose(median["ours"], median["I"], rtol=1e-6)
    assert (median["ours"] < median["II"]).all()
