"""Synthetic paint and poles: what is drawn is what is labelled, and nothing else changes."""

import numpy as np
import pytest

from models import composite
from pipeline import labels

GROUND = composite.Ground(u=224.0, v=60.0, focal=400.0)
SIZE = (256, 448)


def a_road():
    """A grey picture whose lower half is road, the rest buildings."""
    rng = np.random.default_rng(0)
    picture = np.clip(rng.normal(90.0, 3.0, (*SIZE, 3)), 0, 255).astype(np.uint8)
    label = np.full(SIZE, labels.CONSTRUCTION, np.uint8)
    label[80:] = labels.ROAD
    return picture, label


def test_paint_lies_on_the_road_only_and_is_brighter_than_it():
    picture, label = a_road()
    label[150:200, 100:300] = labels.VEHICLE
    painted = 0
    for seed in range(40):
        drawn, moved = composite.paint(picture, label, GROUND, np.random.default_rng(seed))
        lane = moved == labels.LANE
        changed = (drawn != picture).any(axis=2)
        assert (label[moved != label] == labels.ROAD).all()
        assert (label[changed] == labels.ROAD).all()
        painted += lane.sum() > 50
        if lane.sum() > 50:
            contrast = drawn[lane].max(axis=1).astype(float) - picture[lane].max(axis=1)
            assert np.median(contrast) > 5.0
    assert painted >= 30


def test_what_was_not_labelled_anew_looks_as_before():
    picture, label = a_road()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        for drawn, moved in (
            composite.paint(picture, label, GROUND, rng),
            composite.pole(picture, label, GROUND, rng),
        ):
            same = moved == label
            # A pixel keeps its label while less than a tenth of it is covered.
            assert np.abs(drawn[same].astype(int) - picture[same]).max() <= 0.1 * 255 + 1


def test_dashes_shrink_towards_the_horizon_as_the_square_of_the_distance():
    v = np.mgrid[0:256, 0:448][0].astype(np.float32)
    below = np.maximum(v - 60.0, 0.5)
    ahead = 400.0 / below
    cover = composite.within(ahead, 4.0, 5.0, below**2 / 400.0)
    # From 4 to 5 heights ahead: rows 60 + 400/5 to 60 + 400/4, whatever the column.
    assert cover[:, 7].sum() == pytest.approx(20.0, abs=0.6)
    assert np.flatnonzero(cover[:, 7] > 0.5)[[0, -1]].tolist() == pytest.approx([140, 160], abs=1)
    assert (cover == cover[:, :1]).all()


@pytest.mark.parametrize("wide", [2.0, 4.0, 9.0])
def test_a_stroke_covers_its_area(wide):
    cover = composite.stroke((200, 100), np.array([50.3, 180.0]), np.array([50.3, 60.0]), wide, wide)
    assert cover.sum() == pytest.approx(wide * 120.0, rel=0.02)
    assert cover[100].sum() == pytest.approx(wide, abs=0.02)
    assert (cover[100] * np.arange(100)).sum() / cover[100].sum() == pytest.approx(50.3, abs=0.02)


def test_a_hair_is_seen_faintly_and_never_labelled():
    cover = composite.stroke((200, 100), np.array([50.0, 180.0]), np.array([50.0, 60.0]), 0.3, 0.3)
    assert 0.0 < cover.max() < 0.5


def test_poles_are_labelled_where_they_stand_out():
    picture, label = a_road()
    posts = 0
    for seed in range(60):
        drawn, moved = composite.pole(picture, label, GROUND, np.random.default_rng(seed))
        post = moved == labels.POLE
        posts += post.sum() > 20
        if post.sum() > 20:
            rows, columns = np.nonzero(post)
            assert np.ptp(rows) > 0.3 * np.ptp(columns), seed
        assert set(np.unique(moved)) <= {
            labels.CONSTRUCTION, labels.ROAD, labels.POLE, labels.SIGN, labels.IGNORE
        }  # fmt: skip
        assert drawn.shape == picture.shape
    assert posts >= 40


def test_without_a_road_nothing_is_painted():
    picture, label = a_road()
    label[:] = labels.VEGETATION
    drawn, moved = composite.paint(picture, label, GROUND, np.random.default_rng(1))
    assert (drawn == picture).all()
    assert (moved == label).all()
    assert composite.highest_road(label) is None


def test_the_highest_road_is_where_it_begins():
    _, label = a_road()
    assert composite.highest_road(label) == 80.0
    label[70, :3] = labels.ROAD  # a speck is no road
    assert composite.highest_road(label) == 80.0


def test_the_same_seed_draws_the_same():
    picture, label = a_road()
    for step in (composite.paint, composite.pole):
        first = step(picture, label, GROUND, np.random.default_rng(5))
        second = step(picture, label, GROUND, np.random.default_rng(5))
        assert (first[0] == second[0]).all()
        assert (first[1] == second[1]).all()
