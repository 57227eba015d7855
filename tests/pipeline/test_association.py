import importlib.util
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import plk, se3
from pipeline.association import associate, associate_all, pairs_on_overlap
from pipeline.records import CloudLine, ImageLine

_spec = importlib.util.spec_from_file_location(
    "line_scenes", Path(__file__).parents[1] / "oracles" / "line_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)

PRIOR = np.diag([np.radians(1.0) ** 2] * 3 + [0.15**2] * 3)
TIGHT = np.diag([np.radians(0.1) ** 2] * 3 + [0.03**2] * 3)


def indices(association, cloud, image):
    return [
        (
            next(k for k, line in enumerate(cloud) if line is match.cloud),
            next(k for k, line in enumerate(image) if line is match.image),
        )
        for match in association.matches
    ]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.randoms(use_true_random=False))
def test_pairs_are_right_whatever_the_prior_draws(seed, shuffler):
    rng = np.random.default_rng(seed)
    cloud, image = scenes.line_sets(rng)
    order = list(range(len(image)))
    shuffler.shuffle(order)
    shuffled = [image[k] for k in order]
    believed = se3.retract(scenes.TRUTH, 0.7 * rng.multivariate_normal(np.zeros(6), PRIOR))
    for i, j in indices(associate(cloud, shuffled, scenes.CAMERA, believed, PRIOR), cloud, shuffled):
        assert order[j] == i


def test_all_pairs_are_found_near_the_truth():
    cloud, image = scenes.line_sets(np.random.default_rng(1))
    association = associate(cloud, image, scenes.CAMERA, scenes.TRUTH, TIGHT)
    assert sorted(indices(association, cloud, image)) == [(k, k) for k in range(8)]
    assert len(association.pairs) == 8


@pytest.mark.parametrize("together", [1, 40, 20_000])
def test_frames_together_give_what_each_gives_alone(monkeypatch, together):
    monkeypatch.setattr("pipeline.association.MOST_TOGETHER", together)
    sets = [scenes.line_sets(np.random.default_rng(seed)) for seed in range(5)]
    frames = [sets[0], ([], []), *sets[1:3], (sets[3][0], []), ([], sets[3][1]), sets[4]]
    found = associate_all(frames, scenes.CAMERA, scenes.TRUTH, TIGHT)
    assert sum(len(one.matches) for one in found) > 20
    for one, (cloud, image) in zip(found, frames, strict=True):
        alone = associate(cloud, image, scenes.CAMERA, scenes.TRUTH, TIGHT)
        assert indices(one, cloud, image) == indices(alone, cloud, image)
        np.testing.assert_allclose(one.pairs.start, alone.pairs.start, rtol=1e-9)
        np.testing.assert_allclose(one.pairs.covariance, alone.pairs.covariance, rtol=1e-9)
    assert associate_all([], scenes.CAMERA, scenes.TRUTH, TIGHT) == []


def test_lane_and_pole_are_never_paired():
    cloud, image = scenes.line_sets(np.random.default_rng(2))
    relabelled = [
        ImageLine("lane" if line.label == "pole" else "pole", line.start, line.end, line.sigma_px)
        for line in image
    ]
    assert associate(cloud, relabelled, scenes.CAMERA, scenes.TRUTH, TIGHT).matches == ()


@pytest.mark.parametrize("which", ["cloud", "image"])
def test_twins_are_dropped_while_the_prior_can_not_tell_them_apart(which):
    rng = np.random.default_rng(3)
    poles = [(15.0, 5.0), (15.0, 5.4)]
    cloud, image = scenes.line_sets(rng, lanes=[], poles=poles)
    both = associate(cloud, image, scenes.CAMERA, scenes.TRUTH, TIGHT)
    assert sorted(indices(both, cloud, image)) == [(0, 0), (1, 1)]
    assert associate(cloud, image, scenes.CAMERA, scenes.TRUTH, PRIOR).matches == ()
    # One of the twins unseen by one sensor: still nobody knows whose partner is left.
    if which == "cloud":
        cloud = cloud[:1]
    else:
        image = image[:1]
    assert associate(cloud, image, scenes.CAMERA, scenes.TRUTH, PRIOR).matches == ()


def test_two_pieces_of_one_image_line_are_no_rivals():
    rng = np.random.default_rng(4)
    cloud, image = scenes.line_sets(rng, lanes=[(1.8, 6.5)], poles=[], sigma_px=0.3)
    (line,) = image
    cut = line.start + 0.6 * (line.end - line.start)
    pieces = [
        ImageLine("lane", line.start, cut, 0.3),
        ImageLine("lane", cut + 0.05 * (line.end - line.start), line.end, 0.3),
    ]
    association = associate(cloud, pieces, scenes.CAMERA, scenes.TRUTH, PRIOR)
    assert len(association.matches) == 2
    # Of two that lie on each other the likelier speaks for both.
    doubled = [line, ImageLine("lane", line.start + 0.3, line.end + 0.3, 0.3)]
    assert len(associate(cloud, doubled, scenes.CAMERA, scenes.TRUTH, PRIOR).matches) == 1


def test_no_lines_no_pairs():
    cloud, image = scenes.line_sets(np.random.default_rng(5))
    for lines in ((cloud, []), ([], image), ([], [])):
        association = associate(*lines, scenes.CAMERA, scenes.TRUTH, PRIOR)
        assert association.matches == ()
        assert len(association.pairs) == 0


def test_lines_behind_the_camera_and_outside_the_image_line_give_no_pair():
    rng = np.random.default_rng(6)
    cloud, image = scenes.line_sets(rng)
    behind = CloudLine(
        "lane", cloud[0].start - [40, 0, 0], cloud[0].end - [40, 0, 0], cloud[0].points, 0.03, 9.0
    )
    assert len(pairs_on_overlap([behind], image[:1], scenes.CAMERA, scenes.TRUTH)[0]) == 0
    far = np.array([50.0, 0.0, 0.0])
    beyond = CloudLine("lane", cloud[0].start + far, cloud[0].end + far, cloud[0].points, 0.03, 9.0)
    assert len(pairs_on_overlap([beyond], image[:1], scenes.CAMERA, scenes.TRUTH)[0]) == 0


def test_a_lane_that_begins_behind_the_camera_is_cut_to_what_it_sees():
    rng = np.random.default_rng(7)
    start, end = np.array([-20.0, 1.8, -scenes.HEIGHT]), np.array([30.0, 1.8, -scenes.HEIGHT])
    cloud = scenes.fitted("lane", start, end, 80, 0.01, rng)
    image = scenes.imaged("lane", np.array([6.5, 1.8, -scenes.HEIGHT]), end, 0.1, rng)
    _, pair = pairs_on_overlap([cloud], [image], scenes.CAMERA, scenes.TRUTH)
    assert np.abs(plk.residuals(pair, scenes.CAMERA.K, scenes.TRUTH)).max() < 3
    nodes = np.linalg.norm(pair.image_end - pair.image_start) * np.sqrt(3.0)
    assert nodes > 0.9 * np.linalg.norm(image.end - image.start)


def test_covariance_of_the_end_distances_is_that_of_repeated_fits(monkeypatch):
    """FORMULAS D1 against Monte Carlo: noise of both lines, the same true line."""
    # The floor of the model is no noise that the simulation has.
    monkeypatch.setattr("pipeline.association.MODEL_M", 0.0)
    rng = np.random.default_rng(8)
    start, end = scenes.lane_ends()[0]
    residuals, stated = [], []
    for _ in range(3000):
        cloud = scenes.fitted("lane", start, end, 40, 0.05, rng)
        image = scenes.imaged("lane", start, end, 0.5, rng)
        _, pair = pairs_on_overlap([cloud], [image], scenes.CAMERA, scenes.TRUTH)
        residuals.append(plk.residuals(pair, scenes.CAMERA.K, scenes.TRUTH)[0])
        stated.append(pair.covariance[0])
    measured = np.cov(np.array(residuals).T)
    np.testing.assert_allclose(np.mean(stated, axis=0), measured, rtol=0.1, atol=0.08)


def test_a_neighbouring_lane_is_not_taken_for_one_that_the_image_does_not_show():
    rng = np.random.default_rng(9)
    cloud, _ = scenes.line_sets(rng, lanes=[(1.8, 6.5)], poles=[])
    _, image = scenes.line_sets(rng, lanes=[(5.4, 6.5), (-1.8, 6.5)], poles=[])
    assert associate(cloud, image, scenes.CAMERA, scenes.TRUTH, PRIOR).matches == ()


def test_the_lines_of_a_double_line_are_dropped_until_the_belief_tells_them_apart():
    rng = np.random.default_rng(10)
    cloud, image = scenes.line_sets(
        rng, lanes=[(1.8, 6.5), (2.05, 6.5)], poles=[], sigma_px=0.3, sigma_m=0.01
    )
    assert associate(cloud, image, scenes.CAMERA, scenes.TRUTH, PRIOR).matches == ()
    sure = associate(cloud, image, scenes.CAMERA, scenes.TRUTH, TIGHT / 9)
    assert sorted(indices(sure, cloud, image)) == [(0, 0), (1, 1)]


@pytest.mark.parametrize("seed", range(8))
def test_accepted_lanes_keep_their_order_from_left_to_right(seed):
    rng = np.random.default_rng(seed)
    lanes = [(y, 6.5) for y in np.sort(rng.uniform(-9, 9, 7))]
    cloud, image = scenes.line_sets(rng, lanes=lanes, poles=[])
    believed = se3.retract(scenes.TRUTH, rng.multivariate_normal(np.zeros(6), PRIOR))
    kept = [k for k in range(7) if rng.random() < 0.7]
    pairs = indices(
        associate(cloud, [image[k] for k in kept], scenes.CAMERA, believed, PRIOR),
        cloud,
        [image[k] for k in kept],
    )
    order = [kept[j] for _, j in sorted(pairs)]
    assert order == sorted(order)


def test_a_line_found_twice_in_the_cloud_pairs_no_more_than_once():
    rng = np.random.default_rng(11)
    cloud, image = scenes.line_sets(rng, lanes=[(1.8, 6.5)], poles=[])
    assert len(associate([*cloud, *cloud], image, scenes.CAMERA, scenes.TRUTH, TIGHT).matches) <= 1


def structure(line):
    if isinstance(line, CloudLine):
        return CloudLine(
            "structure", line.start, line.end, line.points, line.sigma_m, line.spread, line.mean_m
        )
    return ImageLine("structure", line.start, line.end, line.sigma_px)


def test_structure_waits_for_a_belief_that_tells_edges_apart():
    rng = np.random.default_rng(12)
    cloud, image = scenes.line_sets(rng, lanes=[])
    cloud, image = [structure(line) for line in cloud], [structure(line) for line in image]
    assert associate(cloud, image, scenes.CAMERA, scenes.TRUTH, PRIOR).matches == ()
    assert len(associate(cloud, image, scenes.CAMERA, scenes.TRUTH, TIGHT).matches) == 4
