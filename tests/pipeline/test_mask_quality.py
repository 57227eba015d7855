"""Counts against brute force, ratios and intervals against closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom

from pipeline import labels
from pipeline.errors import InputError
from pipeline.labels import group_table
from pipeline.mask_quality import (
    COUNTS,
    RATIOS,
    Truth,
    count,
    intervals,
    ratios,
    reliability,
    slack_px,
    stated,
    truth_of,
)

PLAIN = group_table()


def named(row):
    return dict(zip(COUNTS, row.tolist(), strict=True))


def ratio(row, name):
    return float(ratios(row)[RATIOS.index(name)])


def stripe(first, last, size=(40, 200)):
    mask = np.zeros(size, bool)
    mask[:, first:last] = True
    return mask


def everywhere(present):
    return Truth(np.ones(present.shape, bool), present)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.tuples(st.integers(1, 14), st.integers(1, 14)),
    dense=st.floats(0.0, 0.6),
    slack=st.sampled_from([1.0, 2.0, 2.5, 3.0]),
)
def test_counts_are_those_of_brute_force(seed, size, dense, slack):
    rng = np.random.default_rng(seed)
    mask, label = rng.random(size) < dense, np.where(rng.random(size) < dense, labels.POLE, labels.ROAD)
    label[rng.random(size) < 0.2] = labels.IGNORE
    truth = truth_of(label.astype(np.uint8), PLAIN, labels.POLE)
    seen = [(v, u) for v, u in np.argwhere(mask).tolist() if label[v, u] != labels.IGNORE]
    poles = np.argwhere(label == labels.POLE).tolist()

    def beside(a, others):
        return any((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 <= slack**2 for b in others)

    assert named(count(mask, truth, slack)) == {
        "hit": sum(label[v, u] == labels.POLE for v, u in seen),
        "masked": len(seen),
        "near": sum(beside(a, poles) for a in seen),
        "found": sum(beside(a, seen) for a in poles),
        "labelled": len(poles),
        "known": int((label != labels.IGNORE).sum()),
    }


@pytest.mark.parametrize(
    ("moved", "precision"), [(0, 1.0), (1, 1.0), (2, 1.0), (3, 0.75), (4, 0.5), (9, 0.0)]
)
def test_a_mask_beside_its_label_is_forgiven_two_pixels_and_no_more(moved, precision):
    """A stripe of 4 px moved by m has m - 2 columns that lie further than 2 px from the label."""
    row = count(stripe(100 + moved, 104 + moved), everywhere(stripe(100, 104)), 2.0)
    assert ratio(row, "precision") == pytest.approx(precision)
    assert ratio(row, "recall") == pytest.approx(precision)
    assert ratio(row, "f") == pytest.approx(precision)
    assert ratio(row, "iou") == pytest.approx(max(0, 4 - moved) / (4 + min(moved, 4)))
    assert ratio(row, "covered") == pytest.approx(4 / 200)


def test_the_slack_grows_with_the_image_and_is_never_below_a_pixel():
    assert [slack_px(width) for width in (1280, 2560, 1920, 640, 100)] == [2.0, 4.0, 3.0, 1.0, 1.0]


def test_ignored_pixels_count_for_nothing():
    label = np.full((10, 30), labels.IGNORE, np.uint8)
    label[:, :10], label[:, 10:20] = labels.LANE, labels.ROAD
    truth = truth_of(label, PLAIN, labels.LANE)
    all_of_it, lane_alone = np.ones(label.shape, bool), label == labels.LANE
    assert named(count(all_of_it, truth, 1.0)) == {
        "hit": 100, "masked": 200, "near": 110, "found": 100, "labelled": 100, "known": 200,
    }  # fmt: skip
    unknown = ~truth.known
    assert np.array_equal(count(lane_alone | unknown, truth, 1.0), count(lane_alone, truth, 1.0))


def test_a_value_that_may_be_the_class_or_another_says_nothing_of_it():
    label = np.array([[0, 1, 2, 3, 4, 255, 77]], np.uint8)
    groups = group_table({3: [3, 1], 0: [0, 2, 4]})
    lane = truth_of(label, groups, labels.LANE)
    assert lane.known.tolist() == [[True, True, True, False, True, False, False]]
    assert lane.present.tolist() == [[False, True, False, False, False, False, False]]
    pole = truth_of(label, groups, labels.POLE)
    assert pole.known.tolist() == [[False, True, True, True, True, False, False]]
    assert pole.present.tolist() == [[False, False, True, False, False, False, False]]


def test_a_drawn_class_whose_own_value_may_be_another_is_not_known_where_it_is_drawn():
    label = np.array([[0, 1, 3]], np.uint8)
    lane = truth_of(label, group_table({1: [1, 3]}), labels.LANE)
    assert lane.known.tolist() == [[True, False, True]]
    assert not lane.present.any()


def test_ratios_without_a_denominator_are_told_apart_from_zero():
    nothing = count(stripe(0, 0), everywhere(stripe(0, 0)), 2.0)
    assert dict(zip(RATIOS, ratios(nothing).tolist(), strict=True)) == pytest.approx(
        {"iou": np.nan, "precision": np.nan, "recall": np.nan, "f": np.nan, "covered": 0.0}, nan_ok=True
    )
    missed = count(stripe(0, 0), everywhere(stripe(5, 9)), 2.0)
    assert (ratio(missed, "iou"), ratio(missed, "recall"), ratio(missed, "f")) == (0.0, 0.0, 0.0)
    assert np.isnan(ratio(missed, "precision"))
    false = count(stripe(5, 9), everywhere(stripe(0, 0)), 2.0)
    assert (ratio(false, "iou"), ratio(false, "precision")) == (0.0, 0.0)
    assert np.isnan([ratio(false, "recall"), ratio(false, "f")]).all()


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(InputError, match=r"\(40, 199\)"):
        count(np.zeros((40, 199), bool), everywhere(stripe(1, 2)), 1.0)


@pytest.mark.parametrize(("images", "right"), [(30, 21), (100, 60)])
def test_the_interval_of_images_that_are_found_or_not_is_binomial(images, right):
    """Each image has one labelled pixel, found or not: a resample finds Binomial(n, right / n) of n."""
    rows = np.tile([0.0, 1.0, 1.0, 0.0, 1.0, 9.0], (images, 1))
    rows[:right, COUNTS.index("found")] = 1.0
    ends = intervals(rows, np.random.default_rng(1), 4000)
    expected = binom.ppf([0.025, 0.975], images, right / images) / images
    assert ends[:, RATIOS.index("recall")] == pytest.approx(expected, abs=1.01 / images)
    assert ends[:, RATIOS.index("precision")].tolist() == [1.0, 1.0]
    assert np.array_equal(ends, intervals(rows, np.random.default_rng(1), 4000))
    narrow = intervals(rows, np.random.default_rng(1), 4000, share=0.5)[:, RATIOS.index("recall")]
    assert narrow == pytest.approx(
        binom.ppf([0.25, 0.75], images, right / images) / images, abs=1.01 / images
    )


def test_one_image_has_no_interval_and_a_ratio_that_is_never_there_neither():
    row = count(stripe(5, 9), everywhere(stripe(5, 9)), 2.0)[None]
    assert np.isnan(intervals(row, np.random.default_rng(1), 50)).all()
    empty = np.repeat(count(stripe(0, 0), everywhere(stripe(0, 0)), 2.0)[None], 3, axis=0)
    ends = intervals(empty, np.random.default_rng(1), 50)
    assert np.isnan(ends[:, RATIOS.index("recall")]).all()
    assert ends[:, RATIOS.index("covered")].tolist() == [0.0, 0.0]


def test_what_was_stated_is_held_against_what_was_so():
    probability = np.full((10, 10), 0.05, np.float32)
    probability[0] = 0.72
    probability[1] = 1.0
    present = np.zeros((10, 10), bool)
    present[0, :5] = present[1] = True
    truth = everywhere(present)
    truth.known[9] = False
    table = stated(probability, truth) + stated(probability, truth)
    rows, error = reliability(table)
    assert table[0].tolist() == [140, 0, 0, 0, 0, 0, 0, 20, 0, 20]
    assert rows[0][[0, 7, 9]] == pytest.approx([0.05, 0.72, 1.0])
    assert rows[1][[0, 7, 9]] == pytest.approx([0.0, 0.5, 1.0])
    assert np.isnan(rows[:, 1:7]).all()
    assert error == pytest.approx((0.05 * 140 + 0.22 * 20 + 0.0) / 180)


def test_honest_probabilities_are_reliable():
    rng = np.random.default_rng(5)
    probability = rng.random((400, 400)).astype(np.float32)
    rows, error = reliability(stated(probability, everywhere(rng.random((400, 400)) < probability)))
    assert np.abs(rows[0] - rows[1]).max() < 0.02
    assert error < 0.01
    assert np.isnan(reliability(np.zeros((3, 10)))[1])
