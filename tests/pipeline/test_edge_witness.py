import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pipeline import cameras, edge_score, edge_witness, se3
from pipeline.edge_parameters import EdgeParameters
from pipeline.edge_witness import UNITS, EdgeFrame, EdgeWitnessParameters, batch_of, score, score_only, solve
from pipeline.edges import CELLS, Edges, find_edges
from pipeline.gradients import COUNTS, LEVELS, ORIENTATIONS, GradientPyramid, gradient_pyramid, sample
from pipeline.ground import fit_ground
from pipeline.records import CameraImage, CameraModel, PointCloud

P = EdgeWitnessParameters()
FLOOR = np.diag([0.002**2] * 3 + [0.04**2] * 3)
AXES = [(axis, sign) for axis in range(6) for sign in (1, -1)]


def frames_of(simulated, camera, T, turn=None, order=None):
    """What the witness keeps of simulated frames; LiDAR frame turned and points permuted if asked."""
    kept = []
    for number, frame in enumerate(simulated):
        cloud, turned = frame.cloud, np.eye(4) if turn is None else turn
        index = np.arange(len(cloud)) if order is None else order(len(cloud))
        xyz = se3.apply(turned, cloud.xyz)[index].astype(np.float32)
        cloud = PointCloud(xyz, cloud.intensity[index], cloud.ring[index])
        T_here = T @ se3.inverse(turned)
        ground = fit_ground(cloud, turned[:3, :3] @ [0.0, 0.0, 1.0], np.random.default_rng(number))
        edges = find_edges(cloud, ground, camera, T_here, EdgeParameters())
        kept.append(EdgeFrame(frame.image_stamp_ns, edges, gradient_pyramid(frame.image, camera)))
    return kept


@pytest.fixture(scope="module")
def window(drive, straight_frames):
    """Edges and gradients of three frames, with the camera and the true extrinsic."""
    p = drive.parameters
    return frames_of(straight_frames, p.camera, p.T_stored), p.camera, p.T_stored


@pytest.fixture(scope="module")
def solved(window):
    """The maximum from the true extrinsic itself."""
    frames, camera, T = window
    return solve(batch_of(frames, camera, P.most_edges), T, FLOOR, P, np.random.default_rng(1))


def error(T_true, T_stored, xi):
    """How far the estimate ends from the truth, degrees and metres."""
    off = se3.local(T_true, se3.retract(T_stored, xi))
    return np.degrees(off[:3]), off[3:]


def test_the_truth_is_kept(solved, window):
    angle, shift = error(window[2], window[2], solved.xi)
    assert np.abs(angle).max() < 0.1
    assert np.abs(shift).max() < 0.03
    assert solved.score >= solved.score_stored > 0
    assert solved.loss < 0.02
    assert solved.contrast > 0.5
    assert solved.frames == 3
    assert len(solved.block_gains) == 3


@pytest.mark.parametrize(("axis", "sign"), AXES)
def test_a_wrong_extrinsic_is_put_right(window, solved, axis, sign):
    frames, camera, T_true = window
    xi = sign * (math.radians(0.3) if axis < 3 else 0.05) * np.eye(6)[axis]
    T_stored = se3.retract(T_true, xi)
    found = solve(batch_of(frames, camera, P.most_edges), T_stored, FLOOR, P, np.random.default_rng(1))
    angle, shift = error(T_true, T_stored, found.xi)
    assert np.abs(angle).max() < 0.1
    assert np.abs(shift).max() < 0.03
    # Wherever it starts, it is the same maximum.
    again = se3.local(se3.retract(T_true, solved.xi), se3.retract(T_stored, found.xi))
    assert np.abs(again / UNITS).max() < 0.05


@pytest.mark.parametrize("axis", [1, 2])
def test_a_degree_is_bridged_by_the_coarser_levels_and_costs_score(window, axis):
    frames, camera, T_true = window
    T_stored = se3.retract(T_true, math.radians(1.2) * np.eye(6)[axis])
    found = solve(batch_of(frames, camera, P.most_edges), T_stored, FLOOR, P, np.random.default_rng(1))
    angle, shift = error(T_true, T_stored, found.xi)
    assert np.abs(angle).max() < 0.1
    assert np.abs(shift).max() < 0.04
    assert found.loss > 0.1
    assert min(found.block_gains) > 0


def test_covariance_is_one_and_scatter_is_of_its_size(solved, window):
    C = solved.covariance
    np.testing.assert_allclose(C, C.T, rtol=1e-9, atol=1e-18)
    assert np.linalg.eigvalsh(C / np.outer(UNITS, UNITS)).min() > 0
    off = se3.local(window[2], se3.retract(window[2], solved.xi))
    # Six axes of one window: chi-square, and not far too wide either.
    assert off @ np.linalg.solve(C, off) < 40
    assert (np.sqrt(np.diag(C)) < 2 * UNITS).all()


def test_more_frames_are_surer(window):
    frames, camera, T = window
    alone, together = (
        solve(batch_of(frames[:n], camera, P.most_edges), T, FLOOR, P, np.random.default_rng(1))
        for n in (1, 3)
    )
    shrunk = np.sqrt(np.diag(together.covariance) / np.diag(alone.covariance))
    assert shrunk.mean() < 0.9


def test_the_same_frame_thrice_is_one_witness(window):
    frames, camera, T = window
    once, thrice = (
        solve(batch_of(frames[:1] * n, camera, 10**6), T, FLOOR, P, np.random.default_rng(1)) for n in (1, 3)
    )
    np.testing.assert_allclose(thrice.covariance, once.covariance, rtol=0.1, atol=1e-9)
    far = [dataclasses.replace(frames[0], distance_m=d) for d in (0.0, 500.0, 1000.0)]
    apart = solve(batch_of(far, camera, 10**6), T, FLOOR, P, np.random.default_rng(1))
    np.testing.assert_allclose(np.diag(apart.covariance), np.diag(once.covariance) / 3, rtol=0.15, atol=1e-8)


def test_the_same_seed_gives_the_same_answer(window):
    frames, camera, T = window
    batch = batch_of(frames[:1], camera, P.most_edges)
    a, b = (solve(batch, T, FLOOR, P, np.random.default_rng(7)) for _ in range(2))
    for field in dataclasses.fields(a):
        if field.name != "trail":
            np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


@pytest.mark.parametrize("degrees", [90, -135])
def test_another_lidar_frame_with_shuffled_points_gives_the_same_answer(straight_frames, window, degrees):
    frames, camera, T = window
    turn = se3.transform(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), np.zeros(3))
    other = frames_of(straight_frames[:1], camera, T, turn, np.random.default_rng(3).permutation)
    T_wrong = se3.retract(T, math.radians(0.3) * np.eye(6)[1])
    a = solve(batch_of(frames[:1], camera, P.most_edges), T_wrong, FLOOR, P, np.random.default_rng(1))
    T_turned = T_wrong @ se3.inverse(turn)
    b = solve(batch_of(other, camera, P.most_edges), T_turned, FLOOR, P, np.random.default_rng(1))
    # xi acts in camera axes, which did not turn; the ground is another random one, so a few edges differ.
    assert np.abs((a.xi - b.xi) / UNITS).max() < 0.1


def test_chance_has_no_contrast(window):
    frames, camera, _ = window
    rng = np.random.default_rng(5)
    levels = frames[0].gradients.levels
    noise = CameraModel("pinhole", camera.K, np.zeros(0), camera.width, camera.height)
    pixels = rng.integers(0, 255, (camera.height, camera.width, 3)).astype(np.uint8)
    from_noise = gradient_pyramid(CameraImage(pixels), noise)
    assert [level.shape for level in from_noise.levels] == [level.shape for level in levels]
    unrelated = [dataclasses.replace(frame, gradients=from_noise) for frame in frames]
    found = solve(batch_of(unrelated, camera, P.most_edges), window[2], FLOOR, P, np.random.default_rng(1))
    assert found.contrast < 0.15


@pytest.fixture(scope="module")
def followed(window):
    """Two frames solved, then three with what the two left, at a stored extrinsic wrong by half a degree."""
    frames, camera, T_true = window
    T_stored = se3.retract(T_true, math.radians(0.5) * np.eye(6)[1])
    one = solve(batch_of(frames[:2], camera, 10**6), T_stored, FLOOR, P, np.random.default_rng(1))
    two = solve(
        batch_of(frames, camera, 10**6), T_stored, FLOOR, P, np.random.default_rng(2), trail=one.trail
    )
    return T_stored, one, two


def test_a_followed_window_gives_what_one_seen_for_the_first_time_gives(window, followed):
    frames, camera, _ = window
    T_stored, _, two = followed
    fresh = solve(batch_of(frames, camera, 10**6), T_stored, FLOOR, P, np.random.default_rng(1))
    sigma = np.sqrt(np.diag(fresh.covariance))
    assert (np.abs(two.xi - fresh.xi) < 0.2 * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diag(two.covariance)), sigma, rtol=0.2)
    for name, tolerance in (("score", 1e-4), ("loss", 0.01), ("contrast", 0.05), ("peak", 1.0)):
        assert getattr(two, name) == pytest.approx(getattr(fresh, name), abs=tolerance), name
    assert two.score_stored == fresh.score_stored


def test_what_a_frame_adds_is_worked_out_once_and_forgotten_with_it(window, followed):
    frames, camera, _ = window
    T_stored, one, two = followed
    stamps = [frame.stamp_ns for frame in frames]
    assert set(one.trail.shares) == set(stamps[:2])
    assert set(two.trail.shares) == set(stamps)
    for stamp in stamps[:2]:
        assert two.trail.shares[stamp].by_chance is one.trail.shares[stamp].by_chance
    last = solve(
        batch_of(frames[2:], camera, 10**6), T_stored, FLOOR, P, np.random.default_rng(1), trail=two.trail
    )
    assert set(last.trail.shares) == {stamps[2]}


def test_a_trail_against_another_extrinsic_says_nothing(window, followed):
    frames, camera, T_true = window
    batch = batch_of(frames[:1], camera, P.most_edges)
    a, b = (
        solve(batch, T_true, FLOOR, P, np.random.default_rng(1), trail=trail)
        for trail in (None, followed[2].trail)
    )
    np.testing.assert_array_equal(a.xi, b.xi)
    np.testing.assert_array_equal(a.covariance, b.covariance)


def test_curvatures_of_frames_add_up_to_that_of_the_score(window):
    frames, camera, T = window
    batch = batch_of(frames, camera, 3000)
    weights = batch.weights()
    H = np.tensordot(weights / weights.sum(), edge_score.curvatures(batch, T, P.difference), 1)
    expected = np.zeros((6, 6))
    for axis in range(6):
        step = P.difference * UNITS * np.eye(6)[axis]
        ahead, behind = (score(batch, se3.retract(T, sign * step), 0)[1] * UNITS for sign in (1, -1))
        expected[axis] = -(ahead - behind) / (2 * P.difference)
    np.testing.assert_allclose(H, 0.5 * (expected + expected.T), rtol=1e-6, atol=1e-9)


def test_mean_responses_are_those_of_each_frame_alone(window):
    frames, camera, T = window
    places = [T, se3.retract(T, 0.03 * np.ones(6))]
    batch = batch_of(frames, camera, 10**6)
    found = edge_score.mean_responses(batch, places)
    for k, frame in enumerate(frames):
        alone = batch_of([frame], camera, 10**6)
        np.testing.assert_allclose(found[k], [score(alone, place, 0)[0] for place in places], rtol=1e-9)
        picked = batch.of_frames([k])
        np.testing.assert_array_equal(picked.position, alone.position)
        assert score(picked, T, 0)[0] == pytest.approx(score(alone, T, 0)[0])


def test_edges_worked_on_in_parts_give_what_all_at_once_give(window, monkeypatch):
    frames, camera, T = window
    batch = batch_of(frames, camera, P.most_edges)
    places = [se3.retract(T, k * 0.3 * UNITS) for k in range(5)]

    def told():
        return (
            *score(batch, T, 0),
            score_only(batch, T, 1),
            edge_score.mean_responses(batch, places),
            edge_score.curvatures(batch, T, P.difference),
        )

    whole = told()
    monkeypatch.setattr(edge_score, "_BLOCK", 97)
    monkeypatch.setattr(edge_score, "_SEEN_AT_ONCE", 12 * len(frames[0].edges))
    for part, one in zip(told(), whole, strict=True):
        np.testing.assert_allclose(part, one, rtol=1e-12, atol=1e-12)


def test_information_of_a_frame_is_positive_and_grows_with_what_it_shows(window):
    frames, camera, T = window
    whole = edge_witness.information_of(frames[0], camera, T)
    np.testing.assert_allclose(whole, whole.T, rtol=1e-6, atol=1e-9 * np.abs(whole).max())
    assert np.linalg.eigvalsh(whole).min() >= 0
    left = frames[0].edges.cell % 16 < 5
    some = Edges(**{name: getattr(frames[0].edges, name)[left] for name in Edges.__slots__})
    part = edge_witness.information_of(dataclasses.replace(frames[0], edges=some), camera, T)
    assert np.linalg.slogdet(np.eye(6) + part)[1] < np.linalg.slogdet(np.eye(6) + whole)[1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_two_degrees_and_a_third_of_a_metre_on_every_axis_are_found_back(window, solved, seed):
    frames, camera, T_true = window
    signs = np.random.default_rng(seed).choice([-1, 1], 6)
    T_stored = se3.retract(T_true, signs * np.array([math.radians(2.0)] * 3 + [0.3] * 3))
    found = solve(batch_of(frames, camera, P.most_edges), T_stored, FLOOR, P, np.random.default_rng(1))
    again = se3.local(se3.retract(T_true, solved.xi), se3.retract(T_stored, found.xi))
    assert np.abs(again / UNITS).max() < 0.2


def wide_pyramid(seed, width=120, height=90):
    """Gradients of an image with features as wide as its pixels are small: smooth between them."""
    rng = np.random.default_rng(seed)
    levels, scales = [], []
    for level in range(LEVELS):
        h, w = height >> level, width >> level
        scale = (w / width, h / height)
        x, y = ((np.arange(n) + 0.5) / s - 0.5 for n, s in ((w, scale[0]), (h, scale[1])))
        waves = [
            1 + np.sin(rng.uniform(0.02, 0.06) * x[None, :] + rng.uniform(0.02, 0.06) * y[:, None] + k)
            for k in range(ORIENTATIONS)
        ]
        levels.append(np.round(0.5 * COUNTS * np.stack(waves)).astype(np.uint16))
        scales.append(scale)
    return GradientPyramid(tuple(levels), tuple(scales))


def random_batch(seed, camera, T, count=40):
    """Edges in front of the camera, each across a random direction."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(4, 40, count)
    uv = rng.uniform([20, 20], [camera.width - 20, camera.height - 20], (count, 2))
    rays = np.column_stack([(uv - camera.K[:2, 2]) / np.diag(camera.K)[:2], np.ones(count)])
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    edges = Edges(
        se3.apply(se3.inverse(T), rays * depth[:, None]),
        direction,
        rng.integers(0, 3, count).astype(np.uint8),
        rng.uniform(0.2, 1, count),
        rng.integers(0, CELLS, count),
    )
    return batch_of([EdgeFrame(0, edges, wide_pyramid(seed))], camera, 10**6)


SMALL = CameraModel(
    "plumb_bob",
    np.array([[100.0, 0, 59.5], [0, 100, 44.5], [0, 0, 1]]),
    np.array([0.05, -0.01, 1e-3, 1e-3, 0]),
    120,
    90,
)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, LEVELS - 1))
def test_gradient_of_the_score_is_that_of_its_differences(seed, level):
    rng = np.random.default_rng(seed)
    T = se3.retract(np.eye(4), rng.normal(size=6))
    batch = random_batch(seed, SMALL, T)
    total, gradient, share = score(batch, T, level)
    np.testing.assert_allclose(share.sum(axis=0), gradient, atol=1e-12)
    assert total == pytest.approx(score_only(batch, T, level).sum() / batch.weight.sum()) or level > 0
    # The gradient holds the direction across each edge: differences must hold it too, in the image.
    R = T[:3, :3]
    _, _, xy, A = cameras.project_with_slopes(SMALL, se3.apply(T, batch.position))
    along = batch.direction @ R.T
    step = np.einsum("nij,nj->ni", A, along[:, :2] - xy * along[:, 2:])
    angle = np.arctan2(step[:, 1], step[:, 0])

    def held(xi):
        uv, _ = cameras.project_unbounded(SMALL, se3.apply(se3.retract(T, xi), batch.position))
        value, _ = sample(batch.images[level], batch.slot, uv, angle, batch.scales[level])
        return float(batch.weight @ value) / float(batch.weight.sum())

    assert held(np.zeros(6)) == pytest.approx(total)
    size = 1e-6
    differences = [(held(size * e) - held(-size * e)) / (2 * size) for e in np.eye(6)]
    np.testing.assert_allclose(gradient, differences, rtol=2e-2, atol=2e-3 * np.abs(gradient).max())


def test_edges_behind_the_camera_score_nothing():
    T = np.eye(4)
    batch = random_batch(1, SMALL, T)
    total, gradient, _ = score(batch, se3.transform(np.diag([1.0, -1, -1]), np.zeros(3)), 0)
    assert total == 0
    np.testing.assert_array_equal(gradient, 0)


LENSES = [
    ("pinhole", []),
    ("plumb_bob", [-0.4, 0.2, 0.01, 0.01, -0.1]),
    ("rational_polynomial", [0.1, -0.2, 0, 0, 0, -0.9, 0.5, 0.1]),
    ("equidistant", [-0.1, 0.05, 0, 0]),
]


@pytest.mark.parametrize(("model", "D"), LENSES)
def test_edges_at_and_around_the_centre_of_the_camera_give_finite_scores(model, D):
    camera = dataclasses.replace(SMALL, model=model, D=np.array(D, float))
    odd = [
        [0, 0, 0],
        [1, 0, 0],
        [0, 0, 1e-12],
        [1e9, 0, 1e-3],
        [0, 1, -1],
        [1e9, 1e9, 1e9],
        [3, 3, 1],
        [0, 0, 5],
    ]
    count = len(odd)
    edges = Edges(
        np.array(odd, float),
        np.tile([0.0, 0, 1], (count, 1)),
        np.zeros(count, np.uint8),
        np.ones(count),
        np.arange(count),
    )
    batch = batch_of([EdgeFrame(0, edges, wide_pyramid(1))], camera, 100)
    for level in range(LEVELS):
        total, gradient, share = score(batch, np.eye(4), level)
        assert math.isfinite(total)
        assert np.isfinite(gradient).all()
        assert np.isfinite(share).all()


def test_a_batch_joins_frames_and_thins_them_evenly(window):
    frames, camera, _ = window
    far = [dataclasses.replace(f, distance_m=d) for f, d in zip(frames, (0.0, 100.0, 100.5), strict=True)]
    batch = batch_of(far, camera, 10**6)
    counts = [len(f.edges) for f in frames]
    assert len(batch) == sum(counts)
    np.testing.assert_array_equal(np.bincount(batch.slot), counts)
    np.testing.assert_array_equal(batch.position[: counts[0]], frames[0].edges.position)
    # The same cell of the image a new scene later is another witness.
    assert not set(batch.cell[batch.slot == 0].tolist()) & set(batch.cell[batch.slot == 1].tolist())
    few = batch_of(far, camera, 500)
    assert len(few) == 500
    assert np.bincount(few.slot).min() > 50
    thin = batch.thinned(3)
    np.testing.assert_array_equal(thin.position, batch.position[::3])
    assert len(thin.images) == LEVELS


def test_a_new_scene_begins_when_enough_way_is_driven(window):
    frames, camera, _ = window
    for way, shared in ((0.5 * edge_witness.NEW_SCENE_M, True), (1.5 * edge_witness.NEW_SCENE_M, False)):
        pair = [frames[0], dataclasses.replace(frames[0], distance_m=way)]
        batch = batch_of(pair, camera, 10**6)
        a, b = (set(batch.cell[batch.slot == k].tolist()) for k in range(2))
        assert bool(a & b) == shared
