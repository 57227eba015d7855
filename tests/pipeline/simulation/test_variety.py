import numpy as np
import pytest

from pipeline import labels
from pipeline.cameras import project
from pipeline.simulation import variety
from pipeline.simulation.variety import SIZES, draw_camera, draw_variety, picture


@pytest.fixture(scope="module")
def drawn():
    return [draw_variety(np.random.default_rng(k)) for k in range(60)]


@pytest.fixture(scope="module")
def shown():
    return [picture(draw_variety(rng), rng)[0] for rng in (np.random.default_rng([11, k]) for k in range(3))]


def test_cameras_are_of_many_kinds(drawn):
    assert {(v.camera.width, v.camera.height) for v in drawn} <= set(SIZES)
    assert len({v.camera.width / v.camera.height for v in drawn}) > 4
    assert {v.camera.model for v in drawn} == {"pinhole", "plumb_bob"}
    focal = np.array([v.camera.K[0, 0] / v.camera.width for v in drawn])
    assert focal.min() < 0.6
    assert focal.max() > 1.6
    height = np.array([v.height for v in drawn])
    assert height.min() < 1.1
    assert height.max() > 2.4
    for one in drawn[::20]:
        assert np.isfinite(one.optics.rays).all()


def test_towns_and_country_days_and_nights_dry_and_wet_are_drawn(drawn):
    assert 0.5 < np.mean([v.parameters.town for v in drawn]) < 0.85
    assert 0.02 < np.mean([v.weather.night > 0.0 for v in drawn]) < 0.3
    assert 0.02 < np.mean([v.weather.wet > 0.0 for v in drawn]) < 0.3
    assert any(v.weather.sight < 260.0 for v in drawn)
    assert any(v.snow > 0.0 for v in drawn)
    assert any(v.screen.bonnet > 0.0 for v in drawn)
    for one in drawn:
        assert abs(np.linalg.norm(one.light.sun) - 1.0) < 1e-9
        assert one.light.sun[2] > 0.0
        assert one.light.ambient > 0.0


def test_a_lens_that_folds_is_drawn_again(monkeypatch):
    lenses, tried = variety.draw_lens, []

    def folding_first(rng):
        lens = lenses(rng)
        tried.append(lens)
        if len(tried) > 1:
            return lens
        strong = np.array([-0.9, 0.0, 0.0, 0.0, 0.0])
        wide = np.diag([0.4 * lens.width, 0.4 * lens.width, 1.0]) + np.outer(lens.K[:, 2], [0.0, 0.0, 1.0])
        wide[2, 2] = 1.0
        return type(lens)("plumb_bob", wide, strong, lens.width, lens.height)

    monkeypatch.setattr(variety, "draw_lens", folding_first)
    optics = draw_camera(np.random.default_rng(3))
    assert len(tried) == 2
    assert optics.camera is tried[1]
    assert project(optics.camera, np.array([[0.0, 0.0, 5.0]]))[1].all()


def test_pictures_show_every_class_in_sane_shares(shown):
    known = {*range(len(labels.NAMES)), labels.IGNORE}
    shares = np.zeros(len(labels.NAMES))
    for one in shown:
        assert set(np.unique(one.labels).tolist()) <= known
        assert one.labels.shape == one.image.pixels.shape[:2]
        assert 25.0 < one.image.pixels.mean() < 215.0
        assert one.image.pixels.std() > 15.0
        shares += [(one.labels == k).mean() / len(shown) for k in range(len(labels.NAMES))]
    assert (shares > 0.0).all()
    assert 0.002 < shares[labels.LANE] < 0.08
    assert 0.002 < shares[labels.POLE] < 0.08
    assert 0.1 < shares[labels.ROAD] < 0.6


def test_a_seed_gives_one_picture(shown):
    rng = np.random.default_rng([11, 0])
    again, _ = picture(draw_variety(rng), rng)
    np.testing.assert_array_equal(again.image.pixels, shown[0].image.pixels)
    np.testing.assert_array_equal(again.labels, shown[0].labels)
