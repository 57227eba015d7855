import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pipeline.height_maps import height_map, height_maps
from pipeline.records import CameraModel, Masks


def distances(mask):
    """City-block distance of each px to the nearest px of the other kind, by looking at all of them."""
    where = np.argwhere(np.ones_like(mask)).reshape(*mask.shape, 2)
    out = np.full(mask.shape, np.inf)
    for kind in (True, False):
        other = np.argwhere(mask != kind)
        if len(other) and (mask == kind).any():
            out[mask == kind] = np.abs(where[mask == kind][:, None] - other).sum(axis=2).min(axis=1)
    return out


@given(arrays(np.bool_, st.tuples(st.integers(1, 14), st.integers(1, 17))), st.floats(0.5, 0.95))
@settings(max_examples=60, deadline=None)
def test_all_modes_agree_with_brute_force(mask, gamma0):
    gamma1 = 0.98
    d = distances(mask)
    expected = {
        "printed": np.where(mask, gamma0**d, gamma1**d),
        "plateau": np.where(mask, 1.0, gamma1**d),
        "ridge": np.where(mask, 1 - gamma0 ** (d - 0.5) / 2, gamma1 ** (d - 0.5) / 2),
    }
    for mode, heights in expected.items():
        found = height_map(mask, mode, gamma0=gamma0, gamma1=gamma1)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, heights if mask.any() else np.zeros(mask.shape), atol=1e-6)


def best_shifts(width, points, mode, gamma0, gamma1=0.98):
    """Shifts at which points on a stripe of some px score highest, and J over all shifts."""
    mask = np.zeros((1, 401), dtype=bool)
    mask[0, 200 - width // 2 : 200 + width // 2 + 1] = True
    heights = height_map(mask, mode, gamma0=gamma0, gamma1=gamma1)[0]
    shifts = np.arange(-60, 61)
    J = np.array([heights[200 + shift + np.asarray(points)].mean() for shift in shifts])
    return set(np.abs(shifts[np.isclose(J, J.max(), atol=1e-6)]).tolist()), J[60:]


@pytest.mark.parametrize(("width", "shift"), [(5, 5), (9, 9), (15, 14), (31, 29)])
def test_the_printed_map_pulls_points_to_the_edges(width, shift):
    """FORMULAS B (8): figures of a stripe of some px."""
    spread = np.arange(-(width // 2), width // 2 + 1)
    best, J = best_shifts(width, [0], "printed", 0.98)
    # The innermost px outside and the outermost inside are equally near to the contour.
    assert best == {(width - 1) // 2, (width + 1) // 2}
    assert J[: (width + 1) // 2].argmin() == 0
    # Spread over the width: no information at all where both gammas agree, a wrong answer where they do not.
    _, J = best_shifts(width, spread, "printed", 0.98)
    np.testing.assert_allclose(J[: (width + 1) // 2 + 1], J[0], atol=1e-6)
    assert best_shifts(width, spread, "printed", 0.8)[0] == {shift}


@pytest.mark.parametrize("width", [5, 9, 15, 31])
def test_plateau_and_ridge_are_highest_in_the_middle(width):
    spread = np.arange(-(width // 2), width // 2 + 1)
    assert best_shifts(width, spread, "plateau", 0.8)[0] == {0}
    assert best_shifts(width, [0], "plateau", 0.8)[0] == set(range((width - 1) // 2 + 1))
    assert best_shifts(width, spread, "ridge", 0.8)[0] == {0}
    assert best_shifts(width, [0], "ridge", 0.8)[0] == {0}
    # The ridge falls on all the way out and has no step at the contour.
    _, J = best_shifts(width, [0], "ridge", 0.8)
    assert (np.diff(J) < 0).all()
    assert -np.diff(J).min() < 0.13


def drawn(scale, focal=720.0):
    """A slanted stroke on grids of different size of one image, for cameras of different focal length."""
    zoom = focal / 720.0
    height, width = round(300 * zoom * scale), round(400 * zoom * scale)
    v, u = np.mgrid[:height, :width]
    u, v = ((x + 0.5) / scale / zoom for x in (u, v))
    lane = (np.abs(u - 150 - 0.4 * v) < 6) & (v > 100) & (v < 250)
    pole = (np.abs(u - 300) < 5) & (v > 20) & (v < 200)
    masks = Masks(lane, pole, lane.astype(np.float32), pole.astype(np.float32), scale, scale)
    K = np.array([[focal, 0, 200 * zoom], [0, focal, 150 * zoom], [0, 0, 1]])
    return masks, CameraModel("pinhole", K, np.zeros(0), round(400 * zoom), round(300 * zoom))


@pytest.mark.parametrize("mode", ["plateau", "ridge"])
@pytest.mark.parametrize(("scale", "focal"), [(0.5, 720.0), (1.0, 1440.0)])
def test_heights_are_those_of_angles_whatever_the_grid(mode, scale, focal):
    fine = height_maps(*drawn(1.0), mode)
    other = height_maps(*drawn(scale, focal), mode)
    assert (other.scale_x, other.scale_y) == (scale, scale)
    step = scale * focal / 720.0
    for a, b in ((fine.lane, other.lane), (fine.pole, other.pole)):
        near = np.rint((np.arange(a.shape[1]) + 0.5) * step - 0.5).astype(int)
        rows = np.rint((np.arange(a.shape[0]) + 0.5) * step - 0.5).astype(int)
        again = b[np.clip(rows, 0, len(b) - 1)][:, np.clip(near, 0, b.shape[1] - 1)]
        # Outside: 2 % a px, and a px of the coarser grid more or less.
        outside = a < 0.45
        assert np.abs(again - a)[outside].max() < 0.05
        assert np.corrcoef(again.ravel(), a.ravel())[0, 1] > 0.99


def test_lanes_and_poles_do_not_mix():
    masks, camera = drawn(1.0)
    maps = height_maps(masks, camera, "plateau")
    assert (maps.lane[masks.lane] == 1).all()
    assert (maps.pole[masks.pole] == 1).all()
    assert maps.pole[masks.lane].max() < 1
    assert not maps.lane.flags.writeable
