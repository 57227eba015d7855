import dataclasses
import math

import numpy as np
import pytest

from pipeline import edge_witness, se3
from pipeline.edge_parameters import EdgeParameters
from pipeline.edge_witness import UNITS, EdgeFrame, batch_of
from pipeline.edges import CELLS, find_edges
from pipeline.frame_modes import ModeParameters, Prior, evened, find_tops, joined_by, shrunk_moments, weighed
from pipeline.gradients import gradient_pyramid
from pipeline.ground import fit_ground
from pipeline.records import CameraImage

P = ModeParameters()
PRIOR = Prior()
GHOST_PX, STRIP_PX = 24, 120


def kept(drive, frame, image=None):
    """What a calibration keeps of a simulated frame, its image replaced if asked."""
    camera, T = drive.parameters.camera, drive.parameters.T_stored
    ground = fit_ground(frame.cloud, np.array([0.0, 0.0, 1.0]), np.random.default_rng(1))
    edges = find_edges(frame.cloud, ground, camera, T, EdgeParameters())
    return EdgeFrame(0, edges, gradient_pyramid(image or frame.image, camera))


@pytest.fixture(scope="module")
def batch(drive, straight_frames):
    """One simulated frame."""
    return evened(batch_of([kept(drive, straight_frames[1])], drive.parameters.camera, 10_000))


@pytest.fixture(scope="module")
def doubled(drive, straight_frames):
    """The same frame; in every second strip of its image everything stands some px further right."""
    pixels = straight_frames[1].image.pixels
    moved, strip = np.roll(pixels, GHOST_PX, axis=1), np.arange(pixels.shape[1]) // STRIP_PX
    image = CameraImage(np.where((strip % 2 == 0)[None, :, None], pixels, moved))
    frame = kept(drive, straight_frames[1], image)
    return evened(batch_of([frame], drive.parameters.camera, 10_000))


def off(T_true, T_guess, xi):
    """Error of an answer in alert units of 0.25 deg and 5 cm."""
    return se3.local(T_true, se3.retract(T_guess, xi)) / UNITS


@pytest.mark.parametrize("seed", range(4))
def test_the_truth_is_the_highest_fit_from_anywhere_within_the_prior(batch, drive, seed):
    T_true = drive.parameters.T_stored
    rng = np.random.default_rng(seed)
    T_guess = se3.retract(T_true, rng.uniform(-2.0, 2.0, 6) * PRIOR.sigma)
    tops = find_tops(batch, T_guess, PRIOR, P, np.random.default_rng(1))
    assert np.abs(off(T_true, T_guess, tops[0][0])).max() < 0.8
    heights = [score for _, score in tops]
    assert heights == sorted(heights, reverse=True)
    assert all(
        np.linalg.norm((a - b) / UNITS) >= P.apart for k, (a, _) in enumerate(tops) for b, _ in tops[:k]
    )


def test_a_guess_beyond_whose_reach_every_fit_lies_stands_for_itself(batch, drive):
    narrow = Prior(sigma_rad=math.radians(0.05), sigma_m=0.01)
    T_guess = se3.retract(drive.parameters.T_stored, np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]))
    assert len(find_tops(batch, T_guess, narrow, P, np.random.default_rng(1))) >= 1


def test_a_clear_fit_is_sure_and_its_errors_are_of_the_stated_size(batch, drive):
    T = drive.parameters.T_stored
    tops = find_tops(batch, T, PRIOR, P, np.random.default_rng(1))
    found = weighed(batch, T, tops, PRIOR, P, np.random.default_rng(2))
    assert found.shares.sum() == pytest.approx(1.0)
    assert found.shares[0] > 0.9
    assert found.peak > 5.0
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.all(sigma > 0)
    assert np.all(sigma < 2.0 * UNITS)
    # The floor of systematic errors apart, an error of four sigma would be a wrong sigma.
    assert np.all(np.abs(found.tops[0][0]) < 4.0 * np.hypot(sigma, 0.3 * UNITS))


def test_where_parts_of_the_picture_disagree_neither_answer_is_claimed(batch, doubled, drive):
    T, K = drive.parameters.T_stored, drive.parameters.camera.K
    ghost = GHOST_PX / K[0, 0]
    clear = weighed(
        batch, T, find_tops(batch, T, PRIOR, P, np.random.default_rng(1)), PRIOR, P, np.random.default_rng(2)
    )
    tops = find_tops(doubled, T, PRIOR, P, np.random.default_rng(1))
    found = weighed(doubled, T, tops, PRIOR, P, np.random.default_rng(2))
    turns = np.array([xi[1] + xi[3] / 15.0 for xi, _ in found.tops])
    # Both answers are found: the truth, and the turn to the side that fits the other strips.
    assert np.abs(turns).min() < 0.15 * ghost
    assert np.abs(turns - ghost).min() < 0.15 * ghost
    assert found.shares[0] < 0.95
    # Second moment about the answer: at least what the modes on the other side contribute.
    bearing = np.array([0.0, 1.0, 0.0, 1.0 / 15.0, 0.0, 0.0])
    other = np.abs(turns - turns[0]) > 0.7 * ghost
    assert bearing @ found.covariance @ bearing > found.shares[other].sum() * (0.7 * ghost) ** 2 > 0.0
    assert bearing @ found.covariance @ bearing > 4.0 * bearing @ clear.covariance @ bearing


def test_another_judge_decides_between_fits_that_the_edges_leave_open(doubled, drive):
    T, K = drive.parameters.T_stored, drive.parameters.camera.K
    ghost = GHOST_PX / K[0, 0]
    tops = find_tops(doubled, T, PRIOR, P, np.random.default_rng(1))
    bearing = np.array([0.0, 1.0, 0.0, 1.0 / 15.0, 0.0, 0.0])

    def heard(wanted):
        def judge(T_all, rng):
            del rng
            turn = np.array([bearing @ se3.local(T, one) for one in T_all])
            return np.where(np.abs(turn - wanted) < 0.3 * ghost, 1.0, 1e-3)

        found = weighed(doubled, T, tops, PRIOR, P, np.random.default_rng(2), judge)
        return bearing @ found.tops[0][0], found.shares[0]

    for wanted in (0.0, ghost):
        turn, share = heard(wanted)
        assert abs(turn - wanted) < 0.15 * ghost
        assert share > 0.5


def test_climbs_from_where_another_witness_fits_add_what_they_find(batch, drive):
    T = drive.parameters.T_stored
    T_guess = se3.retract(T, np.array([1.5, -1.5, 1.5, 1.0, -1.0, 1.0]) * PRIOR.sigma)
    near = se3.retract(T, 0.2 * UNITS)
    poor = [(np.zeros(6), 0.0)]
    none = np.zeros((0, 4, 4))
    assert joined_by(none, none, batch, T_guess, poor, PRIOR, P) == poor
    for summits, places in ((near[None], none), (none, near[None])):
        joined = joined_by(summits, places, batch, T_guess, poor, PRIOR, P)
        assert len(joined) == 2
        assert np.abs(off(T, T_guess, joined[1][0])).max() < 0.8
    far = se3.retract(T_guess, 6.0 * PRIOR.sigma)[None]
    assert len(joined_by(far, none, batch, T_guess, poor, PRIOR, P)) == 1


def test_chance_correlations_are_shrunk_and_sigmas_kept():
    rng = np.random.default_rng(1)
    L = np.eye(6) * UNITS
    alone = shrunk_moments(rng.normal(size=(24, 6)) @ L)
    D = rng.normal(size=(24, 6)) @ L
    assert np.allclose(np.diag(shrunk_moments(D)), np.mean(D**2, axis=0))
    r = np.corrcoef(D.T)
    left = alone / np.sqrt(np.outer(np.diag(alone), np.diag(alone)))
    assert np.abs(left - np.eye(6)).max() < 0.15 < np.abs(r - np.eye(6)).max()
    # Turn and shift that trade for each other stay one direction.
    D[:, 3] = D[:, 1] * UNITS[3] / UNITS[1]
    kept = shrunk_moments(D)
    assert kept[1, 3] > 0.6 * np.sqrt(kept[1, 1] * kept[3, 3])
    assert np.array_equal(shrunk_moments(np.zeros((24, 6))), np.zeros((6, 6)))


def test_the_first_guess_decides_between_equal_fits(doubled, drive):
    T, K = drive.parameters.T_stored, drive.parameters.camera.K
    turn = np.array([0.0, GHOST_PX / K[0, 0], 0.0, 0.0, 0.0, 0.0])
    prior = Prior(sigma_rad=math.radians(0.5), sigma_m=0.15)
    tops = find_tops(doubled, T, prior, P, np.random.default_rng(1))
    near = weighed(doubled, T, tops, prior, P, np.random.default_rng(2))
    assert np.linalg.norm(near.tops[0][0] / UNITS) < np.linalg.norm((near.tops[0][0] - turn) / UNITS)
    T_ghost = se3.retract(T, turn)
    tops = find_tops(doubled, T_ghost, prior, P, np.random.default_rng(1))
    far = weighed(doubled, T_ghost, tops, prior, P, np.random.default_rng(2))
    assert np.linalg.norm(far.tops[0][0] / UNITS) < np.linalg.norm((far.tops[0][0] + turn) / UNITS)


def test_one_part_of_a_picture_can_not_tell_how_sure_it_is(batch, drive):
    T = drive.parameters.T_stored
    whole = dataclasses.replace(batch, cell=np.zeros_like(batch.cell))
    xi, score = edge_witness.ascend(whole, T, np.zeros(6), 0, P.edge_witness)
    found = weighed(whole, T, [(xi, score)], PRIOR, P, np.random.default_rng(2))
    # Weights of one part only scale the score: nothing moves.
    assert np.abs(np.sqrt(np.diag(found.covariance)) / UNITS).max() < 0.05


def test_the_same_stretch_seen_twice_is_no_surer_and_two_stretches_are(drive, straight_frames):
    T, camera = drive.parameters.T_stored, drive.parameters.camera
    frame = kept(drive, straight_frames[1])
    apart = dataclasses.replace(frame, distance_m=100.0)

    def sigma(frames):
        joined = evened(batch_of(frames, camera, 100_000))
        found = weighed(joined, T, [(np.zeros(6), 0.0)], PRIOR, P, np.random.default_rng(2))
        return math.sqrt(np.linalg.det(found.covariance)) ** (1 / 6)

    assert sigma([frame, frame]) == pytest.approx(sigma([frame]), rel=0.1)
    # Draws of 24 weights tell a sigma to a seventh.
    assert sigma([frame, apart]) < 0.95 * sigma([frame])


def test_weights_are_even_within_a_cell_and_kind_and_fewer_weigh_more_each(batch):
    group = batch.cell * 3 + batch.kind
    for one in np.unique(group):
        assert np.ptp(batch.weight[group == one]) == 0.0
    _, index, count = np.unique(group, return_inverse=True, return_counts=True)
    by_count = batch.weight * np.sqrt(count[index])
    assert np.ptp(by_count) < 1e-12 * by_count.max() * CELLS
    assert batch.weight.mean() == pytest.approx(1.0)


def test_the_same_seed_gives_the_same_answer(batch, drive):
    T_guess = se3.retract(drive.parameters.T_stored, 0.5 * PRIOR.sigma)

    def once():
        tops = find_tops(batch, T_guess, PRIOR, P, np.random.default_rng(3))
        return weighed(batch, T_guess, tops, PRIOR, P, np.random.default_rng(4))

    first, second = once(), once()
    assert np.array_equal(first.covariance, second.covariance)
    assert np.array_equal(first.tops[0][0], second.tops[0][0])
