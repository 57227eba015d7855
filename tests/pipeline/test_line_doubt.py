import importlib.util
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from pipeline import plk, se3
from pipeline.line_doubt import (
    WRONG_SHARE,
    Belief,
    Quadratic,
    doubted,
    odds_wrong,
    posterior,
    quadratic,
    without_each,
)

_spec = importlib.util.spec_from_file_location(
    "line_scenes", Path(__file__).parents[1] / "oracles" / "line_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)

PRIOR = Belief(np.zeros(6), np.diag(np.array([*np.radians([1.0] * 3), 0.15, 0.15, 0.15]) ** -2.0))


def observed(rng, groups=4, rows=3):
    """Linear observations r = e + J x of groups, whitened, and their quadratic form."""
    J = rng.normal(0, [*[60.0] * 3, *[8.0] * 3], (groups, rows, 6))
    r = rng.normal(0, 1, (groups, rows))
    terms = Quadratic(np.einsum("gki,gkj->gij", J, J), np.einsum("gki,gk->gi", J, r), (r**2).sum(axis=1))
    return J, r, terms


def test_quadratic_is_the_squared_whitened_distance_near_the_place():
    rng = np.random.default_rng(1)
    cloud, image = scenes.line_sets(rng)
    pairs = plk.stack([_pair(line, other) for line, other in zip(cloud, image, strict=True)])
    terms = quadratic(pairs, np.array([0, 0, 1, 1, 2, 2, 3, 3]), scenes.CAMERA.K, scenes.TRUTH)
    xi = rng.normal(0, [*[1e-4] * 3, *[1e-3] * 3])
    moved = se3.retract(scenes.TRUTH, xi)
    r = plk.residuals(pairs, scenes.CAMERA.K, moved)
    distances = np.einsum("ni,ni->n", r, np.linalg.solve(pairs.covariance, r[..., None])[..., 0])
    wanted = distances.reshape(4, 2).sum(axis=1)
    stated = terms.cost + 2 * terms.slope @ xi + np.einsum("i,gij,j->g", xi, terms.information, xi)
    np.testing.assert_allclose(stated, wanted, rtol=1e-3, atol=1e-4)


def _pair(line, other):
    return plk.LinePairs(
        line.start[None],
        line.end[None],
        other.start[None],
        other.end[None],
        np.array([[[4.0, 0.5], [0.5, 5.0]]]) * 100,
    )


def test_posterior_is_that_of_the_stacked_normal_equations():
    rng = np.random.default_rng(2)
    J, r, terms = observed(rng)
    prior = Belief(rng.normal(0, 0.01, 6), PRIOR.precision)
    stacked = np.concatenate([J.reshape(-1, 6), np.sqrt(PRIOR.precision)])
    right = np.concatenate([-r.ravel(), np.sqrt(PRIOR.precision) @ prior.mean])
    np.testing.assert_allclose(
        posterior(terms, prior).mean, np.linalg.lstsq(stacked, right, rcond=None)[0], rtol=1e-9, atol=1e-12
    )
    for g, belief in enumerate(without_each(terms, prior)):
        rest = [k for k in range(4) if k != g]
        alone = Quadratic(terms.information[rest], terms.slope[rest], terms.cost[rest])
        again = posterior(alone, prior)
        np.testing.assert_allclose(belief.mean, again.mean, rtol=1e-7, atol=1e-10)
        np.testing.assert_allclose(belief.precision, again.precision, rtol=1e-7, atol=1e-4)


def test_odds_are_the_ratio_of_the_densities_that_foretell_the_distances():
    rng = np.random.default_rng(3)
    J, r, terms = observed(rng)
    labels = ["lane", "pole", "structure", "lane"]
    found = odds_wrong(terms, labels, PRIOR)
    for g, belief in enumerate(without_each(terms, PRIOR)):
        densities = [
            multivariate_normal(J[g] @ b.mean, np.eye(3) + J[g] @ np.linalg.inv(b.precision) @ J[g].T).logpdf(
                -r[g]
            )
            for b in (PRIOR, belief)
        ]
        share = WRONG_SHARE[labels[g]]
        wanted = np.log(share / (1 - share)) + densities[0] - densities[1]
        assert found[g] == pytest.approx(wanted, rel=1e-6, abs=1e-6)


def test_a_group_that_the_others_contradict_is_told():
    rng = np.random.default_rng(4)
    J, r, _ = observed(rng, groups=5, rows=6)
    r[2] += J[2] @ (3.0 / np.sqrt(np.diag(PRIOR.precision)) * [1, 0, 0, 0, 0, 0])
    terms = Quadratic(np.einsum("gki,gkj->gij", J, J), np.einsum("gki,gk->gi", J, r), (r**2).sum(axis=1))
    odds = odds_wrong(terms, ["lane"] * 5, PRIOR)
    assert odds.argmax() == 2
    assert odds[2] > 2.0
    rest = [0, 1, 3, 4]
    left = Quadratic(terms.information[rest], terms.slope[rest], terms.cost[rest])
    assert (odds_wrong(left, ["lane"] * 4, PRIOR) < 0.0).all()


def test_what_one_group_says_alone_is_left_to_the_prior():
    """However sharp it is: the chance that it is wrong keeps a ninth of the prior's variance."""
    J = np.zeros((1, 1, 6))
    J[0, 0, 2] = 1e5
    terms = Quadratic(np.einsum("gki,gkj->gij", J, J), np.zeros((1, 6)), np.zeros(1))
    odds = odds_wrong(terms, ["pole"], PRIOR)
    assert odds[0] == pytest.approx(np.log(0.15 / 0.85))
    kept = np.linalg.inv(doubted(terms, PRIOR, odds).precision)[2, 2] * PRIOR.precision[2, 2]
    assert 1 / 9 < kept < 0.2


def test_groups_that_bear_each_other_out_are_believed():
    J = np.zeros((3, 2, 6))
    J[:, 0, 2] = J[:, 1, 1] = 2e3
    terms = Quadratic(np.einsum("gki,gkj->gij", J, J), np.zeros((3, 6)), np.zeros(3))
    odds = odds_wrong(terms, ["lane"] * 3, PRIOR)
    assert (odds < -5.0).all()
    sigma = np.sqrt(np.linalg.inv(doubted(terms, PRIOR, odds).precision)[2, 2])
    assert sigma < 1.3 / (2e3 * np.sqrt(3))
