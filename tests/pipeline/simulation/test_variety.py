import numpy as np

from pipeline import labels
from pipeline.simulation.camera import optics_of
from pipeline.simulation.variety import SIZES, draw_variety, picture


def test_cameras_of_all_kinds_have_whole_lenses():
    drawn = [draw_variety(np.random.default_rng(k)) for k in range(60)]
    assert {(v.camera.width, v.camera.height) for v in drawn} == set(SIZES)
    assert {v.camera.model for v in drawn} == {"pinhole", "plumb_bob"}
    assert {v.parameters.town for v in drawn} == {True, False}
    for variety in drawn[::5]:
        optics_of(variety.camera)


def test_every_class_is_shown_and_paint_stands_out():
    shares = np.zeros(len(labels.NAMES))
    contrasts = []
    for seed in range(6):
        rng = np.random.default_rng([11, seed])
        shown, _ = picture(draw_variety(rng), rng)
        shares += [(shown.labels == k).mean() for k in range(len(labels.NAMES))]
        grey = shown.image.pixels.mean(axis=2)
        assert 60.0 < grey.mean() < 150.0
        lane, road = shown.labels == labels.LANE, shown.labels == labels.ROAD
        if lane.sum() > 500:
            contrasts.append(grey[lane].mean() - grey[road].mean())
    assert (shares > 0).all()
    assert shares[labels.LANE] / 6 > 0.003
    assert shares[labels.POLE] / 6 > 0.002
    assert np.median(contrasts) > 20.0
