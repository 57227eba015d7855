import numpy as np
import pytest

from pipeline.simulation.surface import KERB, RAISED, ROAD, SKY, STEP_M, Rays, RoadSurface, draw_surface


def flat(kerb_height=0.0):
    x = np.arange(-50.0, 200.0, STEP_M)
    zero = np.zeros(len(x))
    return RoadSurface(x, zero, zero, x, zero, -4.0, 4.0, kerb_height, 2.0)


def hilly(seed=3, kerb_height=0.12):
    rng = np.random.default_rng(seed)
    return draw_surface(
        rng,
        (-60.0, 250.0),
        curvature=0.004,
        grade=0.05,
        kerbs=(-6.0, 6.0),
        kerb_height=kerb_height,
        pavement=2.0,
    )


def rays_from(origins, directions):
    o = np.asarray(origins, dtype=np.float32)
    d = np.asarray(directions, dtype=np.float32)
    if o.ndim == 1:
        x, y, z = (np.full((1, 1), v, dtype=np.float32) for v in o)
    else:
        x, y, z = (o[None, :, k] for k in range(3))
    return Rays((x, y, z), d.T[:, None, :].copy(), np.zeros((1, 1), dtype=np.float32))


def directions(n, seed):
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(0, 2 * np.pi, n)
    elevation = -np.exp(rng.uniform(np.log(0.02), np.log(1.2), n))
    return np.column_stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])


def test_flat_ground_is_met_where_the_height_runs_out():
    d = directions(500, 1)
    t, what = flat().meet(rays_from([10.0, 0.5, 1.7], d))
    np.testing.assert_allclose(t[0], -1.7 / d[:, 2], rtol=2e-5)
    y = 0.5 + t[0] * d[:, 1]
    assert ((what[0] == ROAD) == (np.abs(y) <= 4.0)).all()


def test_rays_that_rise_meet_nothing():
    d = directions(50, 2) * [1, 1, -1]
    t, what = flat(0.1).meet(rays_from([0.0, 0.0, 1.7], d))
    assert np.isinf(t).all()
    assert (what == SKY).all()


def test_hills_and_kerbs_agree_with_a_march_along_the_ray():
    surface = hilly()
    origin, _, _ = surface.pose(20.0, -2.0)
    origin = origin + np.array([0.0, 0.0, 1.7])
    d = directions(300, 4)
    t, what = surface.meet(rays_from(origin, d))
    march = np.arange(0.2, 90.0, 0.002)
    seen = set()
    for k, direction in enumerate(d):
        p = origin + march[:, None] * direction
        lateral = surface.lateral(p[:, 0].astype(np.float32), p[:, 1].astype(np.float32))
        road = np.interp(p[:, 0], surface.x, surface.height)
        ground = road + np.where((lateral > 6.0) | (lateral < -6.0), surface.kerb_height, 0.0)
        below = np.flatnonzero(p[:, 2] <= ground)
        if not below.size:
            assert t[0, k] > march[-1] - 0.01
            continue
        # The face of a kerb is upright: the march is right to a step, the closed form to its curve.
        assert t[0, k] == pytest.approx(march[below[0]], abs=0.01)
        seen.add(int(what[0, k]))
    assert seen >= {ROAD, RAISED, KERB}


def test_a_crest_hides_what_lies_behind_it():
    surface = hilly(seed=5)
    x = np.arange(-50.0, 200.0, STEP_M)
    zero = np.zeros(len(x))
    surface = RoadSurface(x, zero, zero, x, 3.0 * np.exp(-(((x - 60.0) / 15.0) ** 2)), -4.0, 4.0, 0.0, 2.0)
    t, _ = surface.meet(rays_from([0.0, 0.0, 1.7], [[1.0, 0.0, 0.0]]))
    # The first of the two places where the hill reaches the sensor's height.
    assert t[0, 0] == pytest.approx(60.0 - 15.0 * np.sqrt(np.log(3.0 / 1.7)), abs=0.01)


def test_rays_that_start_apart_are_each_right():
    surface = hilly()
    arcs = np.linspace(10.0, 12.0, 200)
    origins, _, _ = surface.pose(arcs, -2.0)
    origins[:, 2] += 1.7
    d = directions(200, 6)
    together, _ = surface.meet(rays_from(origins, d))
    for k in range(0, 200, 7):
        alone, _ = surface.meet(rays_from(origins[k], d[k : k + 1]))
        if alone[0, 0] < 80.0:
            assert together[0, k] == pytest.approx(alone[0, 0], rel=2e-4, abs=2e-4)


def test_places_beside_the_road_have_their_road_coordinates():
    surface = hilly()
    for left in (-5.0, 0.0, 3.0):
        place, heading, grade = surface.pose(np.array([15.0, 90.0, 160.0]), left)
        s, d = surface.road_coordinates(place[:, 0].astype(np.float32), place[:, 1].astype(np.float32))
        # The cosine rule is exact on straights; on a bend it is off by offset squared times curvature.
        np.testing.assert_allclose(d, left, atol=0.08)
        np.testing.assert_allclose(s, [15.0, 90.0, 160.0], atol=0.15)
        assert (np.abs(heading) < 0.8).all()
        assert (np.abs(grade) < 0.06).all()


def test_the_centre_line_turns_with_its_heading_and_its_arc_is_its_length():
    surface = hilly(seed=9)
    way = np.hypot(np.diff(surface.x), np.diff(surface.y))
    np.testing.assert_allclose(np.cumsum(way), surface.arc[1:] - surface.arc[0], atol=0.02)
    np.testing.assert_allclose(np.arctan2(np.diff(surface.y), STEP_M), surface.heading[:-1], atol=3e-3)
