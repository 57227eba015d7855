import numpy as np
import pytest

from pipeline.simulation.roadway import Blot, Ribbon, Roadway
from pipeline.simulation.textures import draw_textures

TEXTURES = draw_textures(np.random.default_rng(2))


def marked(roadway, s, d):
    s, d = np.broadcast_arrays(np.asarray(s, dtype=np.float32), np.asarray(d, dtype=np.float32))
    albedo = np.ones((3, s.size), dtype=np.float32)
    roadway.mark(albedo, s.ravel(), d.ravel(), np.ones(s.size, dtype=np.float32), TEXTURES)
    return albedo.reshape(3, *s.shape)


def test_a_plain_road_bears_nothing():
    assert (marked(Roadway(), np.linspace(0.0, 90.0, 500), 1.0) == 1.0).all()
    assert (Roadway().worn(np.zeros(5, np.float32), np.zeros(5, np.float32), TEXTURES) == 1.0).all()
    snowed = Roadway().snowed(np.zeros(5, np.float32), np.zeros(5, np.float32), TEXTURES, edge=3.0)
    assert not snowed.any()


def test_a_repair_covers_its_rectangle_and_its_rim_is_tar():
    roadway = Roadway(blots=(Blot((10.0, -1.0), (2.0, 0.5), 0.7, sealed=True),))
    seen = marked(roadway, [10.0, 10.0, 10.0, 10.0, 13.0, 12.03], [-1.0, -0.52, -0.47, 0.0, -1.0, -1.0])[0]
    np.testing.assert_allclose(seen, [0.7, 0.28, 0.4, 1.0, 1.0, 0.4], atol=1e-6)


def test_a_manhole_is_round():
    roadway = Roadway(blots=(Blot((5.0, 0.0), (0.35, 0.35), 0.5, sealed=False, round=True),))
    s, d = np.meshgrid(np.linspace(4.5, 5.5, 400), np.linspace(-0.5, 0.5, 400))
    share = (marked(roadway, s, d)[0] < 0.9).mean()
    assert share == pytest.approx(np.pi * 0.35**2, abs=0.01)


@pytest.mark.parametrize("gain", [0.4, 2.0])
def test_a_seam_is_as_wide_as_it_says_and_ends(gain):
    roadway = Roadway(ribbons=(Ribbon(1.0, 0.1, gain, 0.15, (0.0, 50.0)),))
    s, d = np.meshgrid(np.linspace(1.0, 49.0, 300), np.linspace(0.0, 2.0, 4001), indexing="ij")
    hit = marked(roadway, s, d)[0] != 1.0
    np.testing.assert_allclose(hit.sum(axis=1) * 2.0 / 4000, 0.1, atol=2e-3)
    middle = (hit * d).sum(axis=1) / hit.sum(axis=1)
    assert 0.02 < middle.std() < 0.3
    assert np.abs(np.diff(middle)).max() < 0.2
    assert (marked(roadway, 50.5, d[:1]) == 1.0).all()


@pytest.mark.parametrize("wear", [0.15, 0.5, 0.75])
def test_wear_takes_about_its_share(wear):
    rng = np.random.default_rng(4)
    s, d = rng.uniform(0.0, 200.0, (2, 20_000)).astype(np.float32)
    left = Roadway(wear=wear).worn(s, d, TEXTURES)
    assert ((left >= 0.0) & (left <= 1.0)).all()
    assert 1.0 - left.mean() == pytest.approx(wear, abs=0.15)


def test_snow_lies_at_the_edges_first():
    d = np.linspace(-8.0, 8.0, 321, dtype=np.float32)
    s = np.linspace(0.0, 60.0, 100, dtype=np.float32)
    ss, dd = (a.ravel() for a in np.meshgrid(s, d))
    shares = []
    for depth in (0.2, 0.9):
        seen = Roadway(snow=depth).snowed(dd, ss, TEXTURES, edge=8.0).reshape(321, 100).mean(axis=1)
        assert seen[0] > 0.5
        assert seen[-1] > 0.5
        shares.append(seen[100:220].mean())
    assert shares[0] < 0.1
    assert shares[1] > shares[0]


def test_stones_and_joints_darken_what_lies_between():
    s, d = np.meshgrid(np.linspace(0.0, 12.0, 2401), np.linspace(-2.0, 2.0, 101), indexing="ij")
    slabs = marked(Roadway(joint=5.0), s, d)[0]
    rows = slabs.min(axis=1) < 1.0
    assert (slabs[(s % 5.0 > 0.04) & ((d + 0.4) % 3.5 > 0.03)] == 1.0).all()
    assert rows.any()
    stones = marked(Roadway(cobbles=True), s, d)[0]
    assert stones[s % 0.11 < 0.01].mean() < 0.7 * stones[(s % 0.11 > 0.03) & (s % 0.11 < 0.1)].mean()
