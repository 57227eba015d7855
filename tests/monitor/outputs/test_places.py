import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.outputs._places import best_places, within

WIDTH, HEIGHT = 600, 200


def column(u, number=40):
    """Points down a column of the image."""
    return np.column_stack([np.full(number, float(u)), np.linspace(40, 160, number)])


def moved(points, pixels):
    return points + np.array([pixels, 0.0])


def leaves_and_a_pole():
    """Noise on the left, on the right a dark pole, 6 px wide, before a bright wall."""
    rng = np.random.default_rng(3)
    image = np.full((HEIGHT, WIDTH, 3), 180, dtype=np.uint8)
    image[:, :300] = rng.integers(0, 255, (HEIGHT, 300, 1), dtype=np.uint8)
    image[:, 447:453] = 30
    return image


@pytest.mark.parametrize("right", ["stored", "estimated"])
def test_a_pole_is_chosen_over_leaves_whichever_extrinsic_fits(right):
    fits = np.concatenate([column(147), column(447)])
    other = moved(fits, 12.0)
    pair = (fits, other) if right == "stored" else (other, fits)
    first, *_ = best_places(leaves_and_a_pole(), *pair, 2)
    assert first.left < 450 < first.left + first.width


def test_of_two_poles_the_one_that_moves_more_is_chosen():
    image = leaves_and_a_pole()
    image[:, :300] = 180
    image[:, 147:153] = 30
    stored = np.concatenate([column(147), column(447)])
    shift = np.repeat([[3.0, 0.0], [14.0, 0.0]], 40, axis=0)
    places = best_places(image, stored, stored + shift, 2)
    assert [place.apart_px for place in places] == pytest.approx([14.0, 3.0])


def test_points_stand_in_the_middle_of_their_place():
    stored = column(447) * (1.0, 0.3) + (0.0, 50.0)  # rows 62 to 98
    (place,) = best_places(leaves_and_a_pole(), stored, moved(stored, 10.0), 1)
    assert place.left + 0.5 * place.width == pytest.approx(452, abs=1)
    assert place.top + 0.5 * place.height == pytest.approx(80, abs=1)


@pytest.mark.parametrize("number", [0, 1, 5])
def test_too_few_points_give_no_place(number):
    stored = column(447, max(number, 1))[:number]
    assert best_places(leaves_and_a_pole(), stored, moved(stored, 10.0), 3) == ()


def test_extrinsics_that_agree_are_shown_at_clear_edges_too():
    stored = np.concatenate([column(147), column(447)])
    first, *_ = best_places(leaves_and_a_pole(), stored, stored, 2)
    assert first.left < 450 < first.left + first.width
    assert first.apart_px == 0.0


@settings(max_examples=25)  # a tenth of a second each
@given(st.integers(0, 2**32 - 1), st.integers(0, 4))
def test_places_lie_in_the_image_apart_from_each_other_and_tell_the_truth(seed, most):
    rng = np.random.default_rng(seed)
    stored = rng.uniform(0, (WIDTH - 1, HEIGHT - 1), (120, 2))
    estimated = np.clip(stored + rng.normal(0, 8, (120, 2)), 0, (WIDTH - 1, HEIGHT - 1))
    places = best_places(leaves_and_a_pole(), stored, estimated, most)
    assert len(places) <= most
    for index, place in enumerate(places):
        window = (place.left, place.top, place.width, place.height)
        assert min(place.left, place.top) >= 0
        assert place.left + place.width <= WIDTH
        assert place.top + place.height <= HEIGHT
        inside = within(stored, *window) & within(estimated, *window)
        assert place.points == inside.sum() >= 6
        assert place.apart_px == pytest.approx(np.median(np.hypot(*(stored - estimated)[inside].T)))
        for other in places[:index]:
            assert abs(place.left - other.left) >= place.width or abs(place.top - other.top) >= place.height
