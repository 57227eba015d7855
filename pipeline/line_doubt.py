"""Wrong pairs of lines: which are left out, and how much doubt the rest leave in an answer.

A pair that passes the gate is wrong now and then: the neighbouring lane, the next pole, a trunk. Whether it
is told by the others: each group of pairs that would be wrong together is judged by how well the others
foretell it, against the model that it speaks of any extrinsic of the prior. The covariance of the answer is
that of the mixture of 'all are right' and 'this one group is wrong': what rests on one group alone is known
no better than the prior and the chance of a wrong pair allow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline import plk
from pipeline.records import Floats, LineLabel

WRONG_SHARE: Mapping[LineLabel, float] = {"lane": 0.15, "pole": 0.15, "structure": 0.5}
"""Chance that a group of accepted pairs is wrong. Lanes and poles: 0.1 on simulated streets, with the
network's masks; structure: 0.35 there, 0.5 on real streets, under a prior of 1 deg. Above 1/9, so that what a
single group says alone stays above a third of the prior's sigma."""


@dataclass(frozen=True, slots=True, eq=False)
class Quadratic:
    """Squared whitened distances of G groups of pairs, to second order in the extrinsic around one place.

    For xi against that place group g costs ``cost + 2 slope . xi + xi . information . xi``.

    Attributes:
        information: float64 (G,6,6).
        slope: float64 (G,6).
        cost: float64 (G,).
    """

    information: Floats
    slope: Floats
    cost: Floats

    def scaled(self, factor: float) -> "Quadratic":
        """The same with each distance worth ``factor`` of one."""
        return Quadratic(factor * self.information, factor * self.slope, factor * self.cost)


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """A Gaussian over the extrinsic: mean (6,) against the place of linearisation, precision (6,6)."""

    mean: Floats
    precision: Floats


def quadratic(pairs: plk.LinePairs, group: NDArray[np.int64], K: Floats, T_cam_lidar: Floats) -> Quadratic:
    """The groups' squared distances around an extrinsic, Huber weights as in method I.

    Args:
        pairs: N pairs.
        group: int64 (N,), group of each pair, 0..G-1.
        K: float64 (3,3), px.
        T_cam_lidar: float64 (4,4), the place.
    """
    whitening = np.linalg.inv(np.linalg.cholesky(pairs.covariance))
    r = np.einsum("nij,nj->ni", whitening, plk.residuals(pairs, K, T_cam_lidar))
    J = whitening @ plk.jacobians(pairs, K, T_cam_lidar)
    weight = np.minimum(1.0, plk.HUBER / np.maximum(np.hypot(r[:, 0], r[:, 1]), 1e-12))
    count = int(group.max()) + 1
    information, slope, cost = np.zeros((count, 6, 6)), np.zeros((count, 6)), np.zeros(count)
    np.add.at(information, group, np.einsum("n,nki,nkj->nij", weight, J, J))
    np.add.at(slope, group, np.einsum("n,nki,nk->ni", weight, J, r))
    np.add.at(cost, group, weight * (r**2).sum(axis=1))
    return Quadratic(information, slope, cost)


def posterior(groups: Quadratic, prior: Belief) -> Belief:
    """The belief after all groups."""
    H = prior.precision + groups.information.sum(axis=0)
    return Belief(np.linalg.solve(H, prior.precision @ prior.mean - groups.slope.sum(axis=0)), H)


def without_each(groups: Quadratic, prior: Belief) -> list[Belief]:
    """The beliefs after all groups but one, for each."""
    H = prior.precision + groups.information.sum(axis=0)
    pull = prior.precision @ prior.mean - groups.slope.sum(axis=0)
    return [
        Belief(np.linalg.solve(H - one, pull + slope), H - one)
        for one, slope in zip(groups.information, groups.slope, strict=True)
    ]


def odds_wrong(groups: Quadratic, labels: Sequence[LineLabel], prior: Belief) -> Floats:
    """Log odds (G,) that each group is wrong: foretold by the prior alone against by the others.

    Args:
        groups: The groups.
        labels: Class of each.
        prior: The belief without any.
    """
    share = np.array([WRONG_SHARE[label] for label in labels])
    against = [
        _evidence(groups, g, prior) - _evidence(groups, g, belief)
        for g, belief in enumerate(without_each(groups, prior))
    ]
    return np.asarray(np.log(share / (1.0 - share)) + against)


def _evidence(groups: Quadratic, g: int, belief: Belief) -> float:
    """Log density of a group's distances under a belief, up to a constant of the group."""
    information, m = groups.information[g], belief.mean
    slope = groups.slope[g] + information @ m
    cost = groups.cost[g] + 2.0 * float(groups.slope[g] @ m) + float(m @ information @ m)
    H = information + belief.precision
    volume = float(np.linalg.slogdet(H)[1] - np.linalg.slogdet(belief.precision)[1])
    return float(-0.5 * (cost - slope @ np.linalg.solve(H, slope) + volume))


def doubted(groups: Quadratic, prior: Belief, log_odds: Floats) -> Belief:
    """The belief after all groups with the precision that doubt leaves.

    The covariance is the mean squared distance, from the answer of all, under 'all are right' and 'this one
    group is wrong', weighed by their odds.
    """
    whole = posterior(groups, prior)
    beliefs = [whole, *without_each(groups, prior)]
    weight = np.exp(np.concatenate([[0.0], np.minimum(log_odds, 0.0)]))
    weight /= weight.sum()
    apart = np.stack([belief.mean for belief in beliefs]) - whole.mean
    covariances = np.linalg.inv(np.stack([belief.precision for belief in beliefs]))
    C = np.einsum("h,hij->ij", weight, covariances) + np.einsum("h,hi,hj->ij", weight, apart, apart)
    return Belief(whole.mean, np.linalg.inv(0.5 * (C + C.T)))
