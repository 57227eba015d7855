import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pipeline.gradients import COUNTS, LEVELS, ORIENTATIONS, gradient_pyramid, sample
from pipeline.records import CameraImage, CameraModel

WIDTH, HEIGHT = 320, 240


def camera(focal=720.0, width=WIDTH, height=HEIGHT):
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return CameraModel("pinhole", K, np.zeros(0), width, height)


def step_image(degrees, *, width=WIDTH, height=HEIGHT, low=60, high=160, at=0.0):
    """Two grey halves; the step goes up along ``degrees`` (u right, v down), ``at`` px beyond the middle."""
    v, u = np.mgrid[:height, :width]
    angle = math.radians(degrees)
    along = (u - (width - 1) / 2) * math.cos(angle) + (v - (height - 1) / 2) * math.sin(angle) - at
    grey = low + (high - low) * np.clip(along + 0.5, 0, 1)
    return CameraImage(np.repeat(np.round(grey).astype(np.uint8)[..., None], 3, axis=2))


def look(pyramid, uv, degrees, level=0):
    """Response at image px (N,2) to a step along ``degrees``."""
    uv = np.atleast_2d(np.asarray(uv, float))
    angle = np.broadcast_to(np.radians(degrees), len(uv))
    slot = np.zeros(len(uv), dtype=np.int64)
    return sample(pyramid.levels[level][None], slot, uv, angle, pyramid.scales[level])


MIDDLE = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)


def grating(degrees, period=14.0):
    """Waves along ``degrees``: a street full of borders, where one does not stand out from the mean."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    angle = math.radians(degrees)
    along = (u - MIDDLE[0]) * math.cos(angle) + (v - MIDDLE[1]) * math.sin(angle)
    grey = 120 + 80 * np.sin(2 * math.pi * along / period)
    return CameraImage(np.repeat(np.round(grey).astype(np.uint8)[..., None], 3, axis=2))


@pytest.mark.parametrize("degrees", [0, 30, 45, 60, 90, 120, 135, 170])
def test_a_border_answers_to_its_own_direction(degrees):
    pyramid = gradient_pyramid(grating(degrees), camera())
    own = look(pyramid, MIDDLE, degrees)[0][0]
    # All directions count alike, to what a squared cosine between knots of 45 degrees allows.
    reference = look(gradient_pyramid(grating(0), camera()), MIDDLE, 0)[0][0]
    assert own == pytest.approx(reference, rel=0.15)
    across = look(pyramid, MIDDLE, degrees + 90)[0][0]
    assert across < (0.01 if degrees % 45 == 0 else 0.5) * own
    assert look(pyramid, MIDDLE, degrees + 180)[0][0] == pytest.approx(own)


def test_a_step_up_is_a_step_down():
    rising, falling = (
        gradient_pyramid(step_image(30, low=low, high=220 - low), camera()) for low in (60, 160)
    )
    for degrees in range(0, 180, 15):
        one, other = (look(pyramid, MIDDLE, degrees)[0][0] for pyramid in (rising, falling))
        assert one == pytest.approx(other, rel=0.02, abs=1e-3)


@pytest.mark.parametrize("knot", range(ORIENTATIONS))
def test_knots_are_multiples_of_45_degrees(knot):
    pyramid = gradient_pyramid(step_image(45 * knot), camera())
    answers = [look(pyramid, MIDDLE, 45 * k)[0][0] for k in range(ORIENTATIONS)]
    assert int(np.argmax(answers)) == knot
    beside = [answers[(knot + side) % ORIENTATIONS] for side in (-1, 1)]
    assert beside[0] == pytest.approx(beside[1], rel=0.05)


@pytest.mark.parametrize("level", range(LEVELS))
@pytest.mark.parametrize("at", [0.0, 7.3, -20.6])
@pytest.mark.parametrize("size", [(320, 240), (317, 211)])
def test_the_answer_is_highest_on_the_border(level, at, size):
    width, height = size
    pyramid = gradient_pyramid(
        step_image(0, width=width, height=height, at=at), camera(width=width, height=height)
    )
    along = np.linspace(-12, 12, 481)
    uv = np.column_stack([(width - 1) / 2 + at + along, np.full(481, (height - 1) / 2)])
    value, _ = look(pyramid, uv, 0, level)
    # Bilinear interpolation puts the maximum on a grid point: weigh the upper half of the hill instead.
    hill = np.maximum(value - 0.5 * value.max(), 0)
    assert np.sum(hill * along) / hill.sum() == pytest.approx(0, abs=0.15 * 2**level)
    assert value[0] < 0.1 * value.max() or level > 0


def test_widths_are_angles():
    widths = []
    for focal, width in ((360.0, 160), (720.0, 320), (1440.0, 640), (2880.0, 1280)):
        shape = {"width": width, "height": width * 3 // 4}
        pyramid = gradient_pyramid(step_image(0, **shape), camera(focal, **shape))
        along = np.linspace(-0.03, 0.03, 2001)
        uv = np.column_stack([(width - 1) / 2 + focal * along, np.full(2001, width * 3 / 8)])
        value, _ = look(pyramid, uv, 0)
        widths.append(np.sum(value > 0.5 * value.max()) * (along[1] - along[0]))
    assert max(widths) / min(widths) < 1.3
    assert widths[2] == pytest.approx(widths[1], rel=0.08)


def test_large_images_are_shrunk_and_small_ones_left():
    small = gradient_pyramid(step_image(0), camera(890.0))
    assert small.levels[0].shape == (ORIENTATIONS, HEIGHT, WIDTH)
    large = gradient_pyramid(step_image(0, width=1280, height=800), camera(1440.0, 1280, 800))
    assert [level.shape[1:] for level in large.levels] == [(400, 640), (200, 320), (100, 160)]
    np.testing.assert_allclose(large.scales, [(0.5, 0.5), (0.25, 0.25), (0.125, 0.125)])


def test_a_dark_street_counts_like_a_sunny_one():
    bright = gradient_pyramid(step_image(0, low=40, high=240), camera())
    dim = gradient_pyramid(step_image(0, low=24, high=144), camera())
    assert look(dim, MIDDLE, 0)[0][0] == pytest.approx(look(bright, MIDDLE, 0)[0][0], rel=0.15)
    # One grey level is noise.
    faint = gradient_pyramid(step_image(0, low=100, high=101), camera())
    assert look(faint, MIDDLE, 0)[0][0] < 0.05 * look(bright, MIDDLE, 0)[0][0]


def test_flat_images_answer_nothing():
    for grey in (0, 127, 255):
        pyramid = gradient_pyramid(CameraImage(np.full((HEIGHT, WIDTH, 3), grey, np.uint8)), camera())
        assert all(level.max() == 0 for level in pyramid.levels)


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(st.integers(1, 90), st.integers(1, 90)).flatmap(
        lambda size: hnp.arrays(np.uint8, (*size, 3), elements=st.sampled_from([0, 255]))
    ),
    st.sampled_from([5.0, 200.0, 720.0, 3000.0, 50_000.0]),
)
def test_any_image_stays_in_range(pixels, focal):
    height, width = pixels.shape[:2]
    pyramid = gradient_pyramid(CameraImage(pixels), camera(focal, width, height))
    assert len(pyramid.levels) == len(pyramid.scales) == LEVELS
    for level, scale in zip(pyramid.levels, pyramid.scales, strict=True):
        assert level.dtype == np.uint16
        assert level.max() <= 1.5 * COUNTS
        assert min(scale) > 0
        value, slope = sample(level[None], np.zeros(3, np.int64), np.eye(3, 2) * width, np.ones(3), scale)
        assert np.isfinite(value).all()
        assert np.isfinite(slope).all()


rng_seeds = st.integers(0, 10_000)


def stack_of(seed, frames=3, shape=(9, 11)):
    return np.random.default_rng(seed).integers(0, 60_001, (frames, ORIENTATIONS, *shape)).astype(np.uint16)


def by_hand(stack, slot, u, v, angle, scale):
    """Bilinear in place, linear between the two nearest of four orientations."""
    h, w = stack.shape[2:]
    x = min(max((u + 0.5) * scale[0] - 0.5, 0), w - 1)
    y = min(max((v + 0.5) * scale[1] - 0.5, 0), h - 1)
    turn = (angle % math.pi) / (math.pi / 4)
    total = 0.0
    for k in range(5):
        for j in range(h):
            for i in range(w):
                weight = max(0, 1 - abs(x - i)) * max(0, 1 - abs(y - j)) * max(0, 1 - abs(turn - k))
                total += weight * stack[slot, k % 4, j, i] / COUNTS
    return total


@settings(max_examples=60, deadline=None)
@given(rng_seeds, st.sampled_from([(1.0, 1.0), (0.5, 0.49), (2.0, 3.0)]))
def test_sample_is_bilinear_interpolation(seed, scale):
    rng = np.random.default_rng(seed)
    stack, count = stack_of(seed), 6
    slot = np.sort(rng.integers(0, 3, count))
    uv = rng.uniform([-4, -4], [11 / scale[0] + 4, 9 / scale[1] + 4], (count, 2))
    angle = rng.uniform(-10, 10, count)
    value, _ = sample(stack, slot, uv, angle, scale)
    expected = [by_hand(stack, s, u, v, a, scale) for s, (u, v), a in zip(slot, uv, angle, strict=True)]
    np.testing.assert_allclose(value, expected, atol=4e-3)  # the last thousandth of a px is cut off


@settings(max_examples=60, deadline=None)
@given(rng_seeds, st.sampled_from([(1.0, 1.0), (0.5, 0.49), (2.0, 3.0)]))
def test_slope_is_the_derivative_inside_and_nothing_outside(seed, scale):
    rng = np.random.default_rng(seed)
    stack, count = stack_of(seed), 40
    slot, angle = np.sort(rng.integers(0, 3, count)), rng.uniform(-10, 10, count)
    xy = rng.integers([-3, -3], [14, 12], (count, 2)) + rng.uniform(0.1, 0.9, (count, 2))
    uv = (xy + 0.5) / np.array(scale) - 0.5
    _, slope = sample(stack, slot, uv, angle, scale)
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = 0.02 / scale[axis]
        ahead, behind = (sample(stack, slot, uv + sign * step, angle, scale)[0] for sign in (1, -1))
        np.testing.assert_allclose(slope[:, axis], (ahead - behind) / (2 * step[axis]), atol=1e-9)


def test_whole_turns_and_negative_angles_are_the_same_direction():
    stack = stack_of(1)
    uv, slot = np.full((4, 2), 3.3), np.zeros(4, np.int64)
    tiny = -1e-18  # its remainder rounds up to pi itself
    value, _ = sample(stack, slot, uv, np.array([0.0, math.pi, -math.pi, tiny]), (1.0, 1.0))
    np.testing.assert_allclose(value, value[0])
