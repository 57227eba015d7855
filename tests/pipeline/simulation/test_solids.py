import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.se3 import exp_so3, transform
from pipeline.simulation.solids import CORNERS, Material, Shape, Solid, Solids, upright
from pipeline.simulation.surface import Rays

GRAIN = np.zeros((4, 4), dtype=np.float32)
WHOLE = (slice(None), slice(None))


def solid(shape, centre, axes, half, material=Material.PLAIN):
    return Solid(
        shape, np.array(centre, dtype=float), axes, np.array(half), 0, (0.5, 0.5, 0.5), 0.5, material
    )


def rays(origin, directions, time=0.0):
    x, y, z = (np.full((1, 1), v, dtype=np.float32) for v in origin)
    d = np.asarray(directions, dtype=np.float32).T[:, None, :].copy()
    return Rays((x, y, z), d, np.full((1, 1), time, dtype=np.float32))


def inside(shape, unit):
    if shape == Shape.BOX:
        return np.abs(unit).max(axis=-1) <= 1
    if shape == Shape.CYLINDER:
        return (np.hypot(unit[..., 0], unit[..., 1]) <= 1) & (np.abs(unit[..., 2]) <= 1)
    return np.linalg.norm(unit, axis=-1) <= 1


@given(st.sampled_from(list(Shape)), st.integers(0, 10_000))
def test_rays_enter_where_a_march_first_finds_the_inside(shape, seed):
    rng = np.random.default_rng(seed)
    thing = solid(shape, rng.uniform(3, 8, 3), exp_so3(rng.normal(0, 1, 3)), rng.uniform(0.3, 2.0, 3))
    toward = thing.centre + rng.normal(0, 1.2, (40, 3))
    directions = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    t = Solids.of([thing]).meet(0, rays(np.zeros(3), directions), WHOLE, GRAIN)[0]
    march = np.arange(0.0, 25.0, 0.01)
    points = march[None, :, None] * directions[:, None, :] - thing.centre
    within = inside(shape, points @ thing.axes / thing.half)
    for k in range(40):
        first = march[np.argmax(within[k])] if within[k].any() else math.inf
        if within[k, 0]:
            assert math.isinf(t[k])  # what starts inside meets no outside
        elif math.isfinite(first):
            assert t[k] == pytest.approx(first, abs=0.0105)
        elif math.isfinite(t[k]):
            # A graze shorter than the march's step.
            edge = (t[k] * directions[k] - thing.centre) @ thing.axes / thing.half
            assert inside(shape, edge * 0.999)


def test_a_thin_pole_far_away_is_met_to_a_millimetre():
    pole = solid(Shape.CYLINDER, (60.0, 3.0, 2.0), upright(0.3, (0.01, 0.02)), (0.04, 0.04, 3.0))
    bearing = math.atan2(3.0, 60.0) + np.linspace(-8.0e-4, 8.0e-4, 41)
    directions = np.column_stack([np.cos(bearing), np.sin(bearing), np.full(41, 2.0 / 60.0)])
    t = Solids.of([pole]).meet(0, rays((0.0, 0.0, 0.0), directions), WHOLE, GRAIN)[0]
    met = np.isfinite(t)
    assert 30 < met.sum() < 41
    unit = ((t[met][:, None] * directions[met]) - pole.centre) @ pole.axes / pole.half
    # 2 % of a radius of 4 cm.
    np.testing.assert_allclose(np.hypot(unit[:, 0], unit[:, 1]), 1.0, atol=0.02)


def test_motion_carries_the_solid_with_the_time_of_the_ray():
    box = Solids.of([solid(Shape.BOX, (0.0, 0.0, 0.0), np.eye(3), (1.0, 1.0, 1.0))])
    moved = box.moved(transform(upright(0.5), np.array([10.0, 0.0, 0.0])), np.array([-5.0, 0.0, 0.0]))
    straight = [[1.0, 0.0, 0.0]]
    now, later = (moved.meet(0, rays((0, 0, 0), straight, time), WHOLE, GRAIN)[0, 0] for time in (0.0, 0.2))
    assert now - later == pytest.approx(1.0, abs=1e-5)


def test_corners_hold_every_point_that_is_met():
    rng = np.random.default_rng(5)
    axes = exp_so3(rng.normal(0, 1, 3))
    thing = solid(Shape.ELLIPSOID, (5.0, 1.0, 0.0), axes, (0.5, 1.0, 2.0))
    stacked = Solids.of([thing])
    np.testing.assert_allclose(stacked.corners()[0], thing.centre + (CORNERS * thing.half) @ axes.T)


def test_leaves_let_rays_pass_at_the_rim_only():
    ball = solid(Shape.ELLIPSOID, (10.0, 0.0, 0.0), np.eye(3), (2.0, 2.0, 2.0), Material.LEAVES)
    bearing = np.linspace(-0.2, 0.2, 201)
    directions = np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(201)])
    stacked = Solids.of([ball])
    dense = np.isfinite(stacked.meet(0, rays((0, 0, 0), directions), WHOLE, GRAIN)[0])
    bare = np.isfinite(stacked.meet(0, rays((0, 0, 0), directions), WHOLE, np.ones((4, 4), np.float32))[0])
    assert (dense | ~bare).all()
    offset = 10.0 * np.sin(np.abs(bearing)) / 2.0
    assert bare[offset < 0.8].all()
    assert not bare[offset > 0.9].any()
    assert dense[offset < 0.98].all()


def wall_of_rays(count=400):
    """Rays along x that meet the plane x = 10 in a grid of 2 by 1.5 m about (10, 0, 1)."""
    y, z = np.meshgrid(np.linspace(-1.0, 1.0, count), np.linspace(0.0, 1.5, count))
    directions = np.column_stack([np.full(y.size, 10.0), y.ravel(), z.ravel() - 0.75])
    return rays((0.0, 0.0, 0.75), directions / 10.0)


def railing(kind, pitch=0.5, bar=0.5):
    """Share of the rays that a railing of 3 by 1.5 m stops; numbers 0..1 that its pattern follows from."""
    grain = np.full((64, 64), 0.5, dtype=np.float32)
    grain[0, :] = bar
    grain[0, 0], grain[0, 61] = kind, pitch
    axes = upright(math.pi / 2)
    fence = solid(Shape.BOX, (10.0, 0.0, 0.75), axes, (1.5, 0.01, 0.75), Material.RAILING)
    t = Solids.of([fence]).meet(0, wall_of_rays(), WHOLE, grain)
    return float(np.isfinite(t).mean())


def test_a_railing_stops_what_its_bars_and_rails_cover():
    # Uprights cover a share of the width, two rails 0.12 m of 1.5 m of the height.
    for bar in (0.0, 1.0):
        share = 0.12 + 0.25 * bar
        assert railing(0.9, bar=bar) == pytest.approx(share + (1.0 - share) * 0.12 / 1.5, abs=0.02)
    assert railing(0.4) == pytest.approx(0.84 + 0.16 * 0.08, abs=0.02)
    wires = 2.0 * 0.014 / 0.12
    assert railing(0.1) == pytest.approx(wires + 0.08, abs=0.04)


def test_a_canopy_is_dense_inside_and_torn_at_its_rim():
    grain = np.random.default_rng(1).permutation(256 * 256).reshape(256, 256).astype(np.float32) / 65536.0
    crown = solid(Shape.ELLIPSOID, (10.0, 0.0, 0.75), np.eye(3), (0.75, 0.75, 0.75), Material.CANOPY)
    ball = solid(Shape.ELLIPSOID, (10.0, 0.0, 0.75), np.eye(3), (0.75, 0.75, 0.75))
    both = Solids.of([crown, ball])
    grid = wall_of_rays()
    leaves, whole = (np.isfinite(both.meet(k, grid, WHOLE, grain)[0]) for k in range(2))
    assert not (leaves & ~whole).any()
    y, z = grid.direction[1, 0], grid.direction[2, 0]
    away = 10.0 * np.hypot(y, z) / 0.75
    assert leaves[away < 0.5].mean() > 0.85
    rim = whole & (away > 0.93)
    assert 0.1 < leaves[rim].mean() < 0.85
