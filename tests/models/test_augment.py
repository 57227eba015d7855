import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import augment
from pipeline import labels

STEPS = [step for step, _ in augment.CHANCES]


@settings(max_examples=40, deadline=None)
@given(
    u=st.floats(60, 140),
    v=st.floats(40, 80),
    scale_u=st.floats(0.5, 2.0),
    scale_v=st.floats(0.5, 2.0),
    flip=st.booleans(),
)
def test_cut_moves_a_thing_to_where_the_map_says_in_picture_and_label(u, v, scale_u, scale_v, flip):
    picture = np.zeros((120, 200, 3), np.uint8)
    label = np.zeros((120, 200), np.uint8)
    picture[50:70, 90:110] = 255
    label[50:70, 90:110] = labels.POLE
    size = (400, 600)
    crop, moved = augment.cut(picture, label, (u, v), (scale_u, scale_v), size, flip=flip)
    assert crop.shape == (*size, 3)
    assert moved.shape == size
    expected_u = 299.5 + (-1 if flip else 1) * scale_u * (99.5 - u)
    expected_v = 199.5 + scale_v * (59.5 - v)
    for weight in (crop[..., 0].astype(float), (moved == labels.POLE).astype(float)):
        rows, columns = np.mgrid[0 : size[0], 0 : size[1]]
        assert (columns * weight).sum() / weight.sum() == pytest.approx(expected_u, abs=0.6)
        assert (rows * weight).sum() / weight.sum() == pytest.approx(expected_v, abs=0.6)


def test_outside_the_picture_nothing_is_labelled():
    picture = np.full((20, 20, 3), 7, np.uint8)
    crop, moved = augment.cut(
        picture, np.zeros((20, 20), np.uint8), (0.0, 0.0), (1.0, 1.0), (32, 32), flip=False
    )
    assert (crop == 7).all()
    assert (moved[:15] == labels.IGNORE).all()
    assert (moved[17:, 17:] == 0).all()


def test_a_coarser_crop_averages_what_it_can_not_show():
    stripes = np.zeros((128, 128, 3), np.uint8)
    stripes[:, ::2] = 200
    crop, _ = augment.cut(stripes, np.zeros((128, 128), np.uint8), (64, 64), (0.4, 0.4), (32, 32), flip=False)
    assert np.ptp(crop.astype(int)) < 40


@pytest.mark.parametrize("step", STEPS)
def test_each_step_changes_a_picture_and_keeps_its_form(step):
    rng = np.random.default_rng(8)
    picture = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    before = picture.copy()
    changed = 0
    for _ in range(10):
        out = step(picture, rng)
        assert (out.shape, out.dtype) == (picture.shape, np.uint8)
        changed += not np.array_equal(out, picture)
    assert np.array_equal(picture, before)
    assert changed >= 9


@pytest.mark.parametrize("step", STEPS)
def test_each_step_bears_black_and_white(step):
    rng = np.random.default_rng(9)
    for level in (0, 255):
        step(np.full((32, 32, 3), level, np.uint8), rng)


def test_shadow_and_night_only_take_light_away():
    rng = np.random.default_rng(10)
    picture = np.full((64, 96, 3), 200, np.uint8)
    for _ in range(10):
        assert augment.shadow(picture, rng).max() <= 200
        assert augment.night(picture, rng).mean() < 200


def test_the_same_seed_gives_the_same_picture():
    picture = np.random.default_rng(11).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    one, two = (augment.photometric(picture, np.random.default_rng(12)) for _ in range(2))
    assert np.array_equal(one, two)
