"""Basins of one frame, on roads whose lines, masks and truth are known."""

import numpy as np
import pytest

from pipeline import basin, se3
from pipeline.association import associate
from pipeline.basin import METHODS, OFFSETS, BasinScene, answers, drift_of, succeeded
from pipeline.height_maps import height_maps
from tests.oracles import semantic_scenes as road


@pytest.fixture(scope="module")
def scene():
    """A scene and its truth."""
    rng = np.random.default_rng(8)
    truth = road.truth_of(rng)
    strips, posts = road.road(rng)
    cloud, image = road.lines_of(rng, truth, strips, posts, sigma_px=0.3, sigma_m=0.01)
    known = associate(cloud, image, road.CAMERA, truth, np.diag([0.003**2] * 3 + [0.05**2] * 3))
    masks = road.masks_of(truth, strips, posts)
    maps = [height_maps(masks, road.CAMERA, mode) for mode in ("plateau", "ridge")]
    return BasinScene(road.CAMERA, known.pairs, road.points_of(rng, strips, posts), *maps), truth


def off(truth, sweep, offset, seed=0):
    """A start that is off by an offset of a sweep."""
    rng = np.random.default_rng(seed)
    return se3.stored_before(truth, drift_of(sweep, offset, rng), None)


@pytest.mark.parametrize(
    ("sweep", "place"), [("rotation", 0), ("rotation", 3), ("translation", 3), ("both", 2)]
)
def test_every_method_finds_back_from_near_by(scene, sweep, place):
    one, truth = scene
    assert len(one.pairs) >= 4
    found = answers(one, off(truth, sweep, OFFSETS[sweep][place]), np.random.default_rng(1))
    assert found.keys() == set(METHODS)
    for method, T in found.items():
        assert succeeded(sweep, se3.pose_error(truth, T)), method


def test_known_matches_reach_farther_than_the_semantic_cost(scene):
    one, truth = scene
    found = answers(one, off(truth, "rotation", OFFSETS["rotation"][-1]), np.random.default_rng(1))
    good = {m for m, T in found.items() if T is not None and succeeded("rotation", se3.pose_error(truth, T))}
    assert good == {"method I", "method II", "I from II"}


def test_without_lines_or_points_there_is_no_answer(scene):
    one, truth = scene
    few = BasinScene(
        one.camera,
        basin.plk.select(one.pairs, np.arange(len(one.pairs)) < 2),
        one.points,
        one.plateau,
        one.ridge,
    )
    found = answers(few, truth, np.random.default_rng(0))
    assert {method for method, T in found.items() if T is None} == {"method I", "method II", "I from II"}
    backward = se3.retract(truth, np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    found = answers(one, backward, np.random.default_rng(0))
    assert found["Algorithm 1"] is None
    assert found["evolution"] is None


@pytest.mark.parametrize("seed", range(5))
def test_starts_are_off_by_their_offset(seed):
    rng = np.random.default_rng(seed)
    turned, shifted = drift_of("rotation", 0.4, rng), drift_of("translation", 2.0, rng)
    assert np.flatnonzero(turned).tolist() == [2]
    assert np.flatnonzero(shifted).tolist() == [4]
    assert abs(turned[2]) == 0.4
    assert abs(shifted[4]) == 2.0
    both = np.array([drift_of("both", np.radians(6.0), rng) for _ in range(400)])
    assert np.abs(both).max(axis=0) == pytest.approx([np.radians(6.0)] * 3 + [1.0] * 3, rel=0.05)
    assert np.abs(both).mean(axis=0) == pytest.approx([np.radians(3.0)] * 3 + [0.5] * 3, rel=0.2)


def test_success_asks_for_the_half_that_was_wrong():
    near, far = (0.1, 0.001), (1.0, 0.1)
    mixed = (far[0], near[1]), (near[0], far[1])
    assert [succeeded("rotation", error) for error in (near, far, *mixed)] == [True, False, True, False]
    assert [succeeded("translation", error) for error in (near, far, *mixed)] == [True, False, False, True]
    assert [succeeded("both", error) for error in (near, far, *mixed)] == [True, False, False, False]
