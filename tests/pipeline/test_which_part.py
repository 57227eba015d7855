"""Which part has moved, on simulated drifts with known truth."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from pipeline import se3, which_part
from pipeline.errors import InputError
from pipeline.which_part import MOVED_RATE, MOVED_SCALES, MOVED_SIGMA, PairDrift

C = np.diag([math.radians(0.1) ** 2] * 3 + [0.04**2] * 3)
HEADINGS = {"front": 0.0, "left": 70.0, "right": -70.0}


def extrinsic(heading_deg):
    R = Rotation.from_euler("z", heading_deg, degrees=True).as_matrix() @ se3.AXES_CAM_IN_VEHICLE
    centre = Rotation.from_euler("z", heading_deg, degrees=True).apply([1.0, 0.2, -0.3])
    return se3.inverse(se3.transform(R, centre))


def rig(rng, moved=(), *, names=tuple(HEADINGS), turn_deg=1.0, shift_m=0.1, noise=True, covariance=C):
    """Pairs of which the named parts ("lidar" or a camera) have moved by a random motion."""
    motions = {part: random_motion(rng, turn_deg, shift_m) for part in moved}
    pairs = []
    for name in names:
        T = extrinsic(HEADINGS[name])
        now = T @ motions.get("lidar", np.eye(4))
        now = motions.get(name, np.eye(4)) @ now
        if noise:
            now = se3.retract(now, rng.multivariate_normal(np.zeros(6), covariance))
        pairs.append(PairDrift(name, T, now, covariance, np.zeros(6)))
    return pairs


def random_motion(rng, turn_deg, shift_m):
    turn, shift = rng.normal(size=3), rng.normal(size=3)
    turn *= math.radians(turn_deg) / np.linalg.norm(turn)
    return se3.transform(se3.exp_so3(turn), shift * shift_m / np.linalg.norm(shift))


def best(pairs):
    first = which_part.which_part(pairs).hypotheses[0]
    return first.kind, first.pair


@pytest.mark.parametrize("names", [("front", "left"), ("front", "left", "right")])
def test_the_part_that_moved_is_named(names):
    rng = np.random.default_rng(1)
    for _ in range(30):
        assert best(rig(rng, ["lidar"], names=names)) == ("lidar", None)
        for name in names:
            assert best(rig(rng, [name], names=names)) == ("camera", name)
        assert best(rig(rng, names=names)) == ("nothing", None)


def test_two_parts_that_moved_are_several():
    rng = np.random.default_rng(2)
    told = [best(rig(rng, moved)) for moved in (["front", "left"], ["lidar", "right"]) for _ in range(20)]
    assert told.count(("several", None)) == len(told)


def test_odds_hold_what_they_promise():
    # Motions drawn as the prior says: of all statements made at a probability, that share is right.
    rng = np.random.default_rng(3)
    promised, kept = [], []
    for _ in range(400):
        names = ("front", "left")
        parts = ("lidar", *names)
        moved = parts[rng.integers(3)]
        pairs = []
        motion = rng.normal(size=6) * MOVED_SIGMA * 0.4 * rng.choice(MOVED_SCALES[:2])
        for name in names:
            T = extrinsic(HEADINGS[name])
            D = se3.retract(np.eye(4), motion)
            now = T @ D if moved == "lidar" else D @ T if moved == name else T
            now = se3.retract(now, rng.multivariate_normal(np.zeros(6), C))
            pairs.append(PairDrift(name, T, now, C, np.zeros(6)))
        told = which_part.which_part(pairs)
        share = {(h.kind, h.pair): h.probability for h in told.hypotheses}
        single = {key: value for key, value in share.items() if key[0] in ("lidar", "camera")}
        total = sum(single.values())
        truth = ("lidar", None) if moved == "lidar" else ("camera", moved)
        for key, value in single.items():
            promised.append(value / total)
            kept.append(key == truth)
    promised, kept = np.array(promised), np.array(kept)
    for low, high in ((0.0, 0.1), (0.1, 0.5), (0.5, 0.9), (0.9, 1.0)):
        inside = (promised >= low) & (promised <= high)
        sigma = math.sqrt(0.25 / max(1, inside.sum()))
        assert kept[inside].mean() == pytest.approx(promised[inside].mean(), abs=max(0.08, 3 * sigma))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.permutations(list(range(3))))
def test_the_order_of_the_pairs_does_not_matter(seed, order):
    rng = np.random.default_rng(seed)
    pairs = rig(rng, ["front"] if seed % 2 else ["lidar"], turn_deg=0.3)
    a = {(h.kind, h.pair): h.probability for h in which_part.which_part(pairs).hypotheses}
    shuffled = which_part.which_part([pairs[k] for k in order])
    for h in shuffled.hypotheses:
        assert h.probability == pytest.approx(a[h.kind, h.pair], rel=1e-6, abs=1e-12)
    assert sum(a.values()) == pytest.approx(1.0)


def test_the_likelihood_is_that_of_the_normal_distribution():
    rng = np.random.default_rng(4)
    pairs = rig(rng, ["lidar"], names=("front", "left"), turn_deg=0.2, shift_m=0.03)
    y, S = [], np.zeros((12, 12))
    for index, pair in enumerate(pairs):
        back = np.linalg.inv(pair.T_expected)
        D = back @ pair.T_estimated
        y += [*se3.log_so3(D[:3, :3]), *D[:3, 3]]
        Ad = np.block(
            [[back[:3, :3], np.zeros((3, 3))], [se3.skew(back[:3, 3]) @ back[:3, :3], back[:3, :3]]]
        )
        S[6 * index : 6 * index + 6, 6 * index : 6 * index + 6] = Ad @ pair.covariance @ Ad.T
    P = np.tile(np.diag(MOVED_SIGMA**2), (2, 2))
    nothing = multivariate_normal.pdf(y, cov=S)
    lidar = np.mean([multivariate_normal.pdf(y, cov=S + k**2 * P) for k in MOVED_SCALES]) * MOVED_RATE
    told = {h.kind: h.probability for h in which_part.which_part(pairs).hypotheses if h.kind != "camera"}
    assert told["lidar"] / told["nothing"] == pytest.approx(lidar / nothing, rel=1e-6)


def test_a_direction_that_nobody_sees_decides_nothing():
    # Both cameras know nothing of the shift along their axes, and the LiDAR moved: the rest decides.
    rng = np.random.default_rng(5)
    wide = C.copy()
    wide[5, 5] = 100.0
    wide[2, 2] = 1.0
    for _ in range(20):
        pairs = rig(rng, ["lidar"])
        blind = [dataclasses.replace(pair, covariance=wide) for pair in pairs]
        assert best(blind) == ("lidar", None)
    flat = [
        dataclasses.replace(pair, covariance=np.outer([1, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0]))
        for pair in pairs
    ]
    shares = [h.probability for h in which_part.which_part(flat).hypotheses]
    assert np.isfinite(shares).all()
    assert sum(shares) == pytest.approx(1.0)


def test_a_camera_that_sees_nothing_leaves_the_question_open():
    rng = np.random.default_rng(6)
    pairs = rig(rng, ["lidar"], names=("front", "left"))
    pairs[1] = dataclasses.replace(pairs[1], covariance=np.diag([1.0] * 3 + [100.0] * 3))
    told = which_part.which_part(pairs)
    assert {(h.kind, h.pair) for h in told.hypotheses[:2]} == {("lidar", None), ("camera", "front")}
    assert told.odds < 3.0


def test_an_error_in_time_that_all_cameras_share_is_no_moved_lidar():
    # The sweep is late by two sigma: every camera sees the same forward shift, and each knows its share.
    late = np.array([0.0, 0.0, 0.0, 0.10, 0.0, 0.0])
    rng = np.random.default_rng(7)
    pairs = rig(rng, noise=False)
    fooled, warned = [], []
    for pair in pairs:
        T = pair.T_expected
        now = T @ se3.transform(np.eye(3), 2.0 * late[3:])
        feigned = np.concatenate([np.zeros(3), T[:3, :3] @ late[3:]])
        fooled.append(dataclasses.replace(pair, T_estimated=now))
        warned.append(dataclasses.replace(pair, T_estimated=now, feigned=feigned))
    assert best(fooled) == ("lidar", None)
    assert best(warned) == ("nothing", None)


def test_one_pair_can_not_tell_and_names_must_differ():
    rng = np.random.default_rng(8)
    pairs = rig(rng, ["lidar"])
    assert which_part.which_part(pairs[:1]) is None
    assert which_part.which_part([]) is None
    with pytest.raises(InputError, match="one name"):
        which_part.which_part([pairs[0], pairs[0]])
