"""Lines that are broken, too many, alike or degenerate: no solver fails or claims what they do not tell."""

import importlib.util
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import p3l, plk, se3
from pipeline.association import MOST_CLOUD_LINES, MOST_IMAGE_LINES, associate, pairs_on_overlap
from pipeline.coarse import CoarseSolution, NoCoarse, coarse_extrinsic
from pipeline.errors import InputError
from pipeline.height_maps import HeightMaps, height_maps
from pipeline.line_witness import PRIOR_SIGMA, solve_lines
from pipeline.observability import observable
from pipeline.semantic_cost import (
    EvolutionParameters,
    RandomSearchParameters,
    SemanticPoints,
    evolution_search,
    random_search,
    semantic_cost,
)


def _oracle(name):
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[1] / "oracles" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


scenes, roads, bad = _oracle("line_scenes"), _oracle("semantic_scenes"), _oracle("bad_lines")
CAMERA, TRUTH, K = scenes.CAMERA, scenes.TRUTH, scenes.CAMERA.K
PRIOR = np.diag(PRIOR_SIGMA**2)
LIMITS = np.array([*np.radians([0.75, 0.5, 0.5]), 0.20, 0.15, 0.15])


@pytest.fixture(scope="module")
def good():
    return scenes.line_sets(np.random.default_rng(8))


def names(association, cloud, image):
    """Which lines were paired, by their places in the lists."""
    return [
        (next(i for i, a in enumerate(cloud) if a is match.cloud), _place(image, match.image))
        for match in association.matches
    ]


def _place(lines, line):
    return next(j for j, other in enumerate(lines) if other is line)


@pytest.mark.parametrize("label", ["lane", "pole", "structure"])
def test_broken_lines_take_no_part(good, label):
    cloud, image = good
    more_cloud = [*bad.broken_cloud_lines(label), *cloud]
    more_image = [*bad.broken_image_lines(label), *image]
    alone = associate(cloud, image, CAMERA, TRUTH, PRIOR)
    among = associate(more_cloud, more_image, CAMERA, TRUTH, PRIOR)
    assert len(alone.matches) == len(cloud)
    assert [(m.cloud, m.image) for m in among.matches] == [(m.cloud, m.image) for m in alone.matches]
    assert np.array_equal(among.pairs.covariance, alone.pairs.covariance)
    found = solve_lines([bad.line_frame(more_cloud, more_image)], CAMERA, TRUTH).estimate
    assert np.array_equal(found.xi, solve_lines([bad.line_frame(cloud, image)], CAMERA, TRUTH).estimate.xi)


@pytest.mark.parametrize("label", ["lane", "pole"])
def test_broken_lines_alone_say_nothing(label):
    frame = bad.line_frame(bad.broken_cloud_lines(label), bad.broken_image_lines(label))
    estimate = solve_lines([frame], CAMERA, TRUTH).estimate
    assert estimate.features == 0
    assert not estimate.information.any()


def test_an_image_line_that_is_there_three_times_is_evidence_once(good):
    cloud, image = good
    once, thrice = (associate(cloud, image * n, CAMERA, TRUTH, PRIOR) for n in (1, 3))
    assert len(once.matches) == len(cloud)
    assert names(thrice, cloud, image) == names(once, cloud, image)


def test_a_cloud_line_that_is_there_twice_tells_of_no_image_line(good):
    """Which of the two the image shows nobody knows; they may differ by less than tells them apart."""
    cloud, image = good
    assert not associate([*cloud, *cloud], image, CAMERA, TRUTH, PRIOR).matches


def test_order_of_lines_does_not_matter(good):
    cloud, image = good
    estimate = solve_lines([bad.line_frame(cloud, image)], CAMERA, TRUTH).estimate
    backwards = solve_lines([bad.line_frame(cloud[::-1], image[::-1])], CAMERA, TRUTH).estimate
    assert backwards.xi == pytest.approx(estimate.xi, abs=1e-7)
    assert backwards.information == pytest.approx(estimate.information, rel=1e-4, abs=1.0)


@pytest.mark.parametrize("kind", ["anywhere", "alike"])
def test_a_thousand_lines_cost_bounded_time_and_memory(good, kind):
    cloud, image = good
    if kind == "alike":
        cloud, image = [cloud[0]] * 1000, [image[0]] * 1000
    else:
        more = bad.thousand_lines(np.random.default_rng(0))
        cloud, image = cloud + more[0], image + more[1]
    tracemalloc.start()
    rows, pairs = pairs_on_overlap(cloud, image, CAMERA, TRUTH)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(rows) == len(pairs) <= 2 * MOST_CLOUD_LINES * MOST_IMAGE_LINES
    assert peak < 300e6
    # Among so many neighbours hardly a pair is unambiguous.
    assert len(associate(cloud, image, CAMERA, TRUTH, PRIOR).matches) <= 5


def test_the_longest_of_too_many_lines_are_kept(good):
    cloud, image = good
    short = [bad.cloud_line("lane", (10, k / 50, -1.7), (11, k / 50, -1.7)) for k in range(300)]
    specks = [bad.image_line("lane", (k, 300), (k + 20, 320)) for k in range(600)]
    rows, _ = pairs_on_overlap([*short, *cloud], [*specks, *image], CAMERA, TRUTH)
    assert {(300 + k, 600 + k) for k in range(len(cloud))} <= set(map(tuple, rows.tolist()))


@pytest.mark.parametrize("figure", [{"mean_m": np.nan}, {"mean_m": np.inf}, {"spread": np.nan}])
def test_a_line_whose_noise_is_no_number_is_left_out(good, figure):
    cloud, image = good
    odd = bad.cloud_line("lane", cloud[0].start, cloud[0].end, **figure)
    assert not associate([odd], image[:1], CAMERA, TRUTH, PRIOR).matches
    assert len(associate([odd, *cloud[1:]], image, CAMERA, TRUTH, PRIOR).matches) == len(cloud) - 1


def test_lines_behind_the_camera_and_through_its_centre_give_no_pair(good):
    cloud, image = good
    behind = [bad.cloud_line(a.label, a.start * (-1, 1, 1), a.end * (-1, 1, 1)) for a in cloud]
    centre = se3.inverse(TRUTH)[:3, 3]
    sideways = [np.array([2, k, 1]) for k in range(-3, 4)]
    through = [bad.cloud_line("lane", centre - step, centre + step) for step in sideways]
    onwards = [bad.cloud_line("pole", centre, centre + 10 * step) for step in sideways]
    sights = [bad.image_line("lane", (600 + k, 100), (600 + k, 300)) for k in range(-30, 30, 10)]
    assert not associate([*behind, *through, *onwards], [*image, *sights], CAMERA, TRUTH, PRIOR).matches
    both = associate([*cloud, *through, *onwards], image, CAMERA, TRUTH, PRIOR)
    assert names(both, cloud, image) == [(k, k) for k in range(len(cloud))]


DEGENERATE = {"parallel": bad.parallel_segments, "concurrent": bad.concurrent_segments}


@pytest.mark.parametrize("kind", DEGENERATE)
@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(3, 12))
def test_the_shift_that_lines_leave_free_is_the_null_direction(kind, seed, count):
    """FORMULAS D4: along parallel lines, along the ray to the point that all lines share; no other."""
    rng = np.random.default_rng(seed)
    segments, free = DEGENERATE[kind](rng, count)
    T = bad.pose(rng)
    pairs = bad.pairs_of(T, K, segments)
    J = plk.jacobians(pairs, K, T)
    scale = np.repeat((0.01, 0.1), 3)
    values, V = np.linalg.eigh(np.einsum("nki,nkj->ij", J, J) * np.outer(scale, scale))
    assert abs(values[0]) < 1e-9 * values[5]
    assert abs(V[3:, 0] @ free) == pytest.approx(1.0, abs=1e-4)
    if kind == "parallel":
        assert plk.rotation_from_directions(pairs, K, T) is None
    assert plk.method_two(pairs, K, T) is None


@pytest.mark.parametrize("kind", DEGENERATE)
@pytest.mark.parametrize("seed", range(4))
def test_what_lines_leave_free_stays_where_it_was(kind, seed):
    rng = np.random.default_rng(seed)
    segments, free = DEGENERATE[kind](rng, 8)
    T = bad.pose(rng)
    start = se3.retract(T, np.concatenate([rng.normal(0, 3e-3, 3), 0.05 * free]))
    found = plk.method_one(bad.pairs_of(T, K, segments), K, start)
    xi = se3.local(T, found.T_cam_lidar)
    assert np.abs(xi[:3]).max() < 1e-6
    assert xi[3:] - (xi[3:] @ free) * free == pytest.approx(np.zeros(3), abs=1e-5)
    values = np.linalg.eigvalsh(found.information)
    assert values[0] > -1e-9 * values[5]


def test_lines_of_one_plane_with_the_camera_see_three_directions():
    """They tell that plane and no more: the turn about its normal and both shifts within it are free."""
    rng = np.random.default_rng(3)
    segments, normal = bad.flat_segments(rng, 9)
    T = bad.pose(rng)
    found = plk.method_one(bad.pairs_of(T, K, segments), K, T)
    assert observable(found.information, LIMITS).rank == 3
    free = np.concatenate([normal, np.zeros(3)])
    assert free @ found.information @ free < 1e-9 * np.trace(found.information)
    assert plk.method_two(bad.pairs_of(T, K, segments), K, T) is None


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_lines_are_no_start_and_no_full_rank(count):
    rng = np.random.default_rng(count)
    T = bad.pose(rng)
    pairs = bad.pairs_of(T, K, bad.concurrent_segments(rng, 3)[0][:count])
    found = plk.method_one(pairs, K, T)
    assert plk.method_two(pairs, K, T) is None
    assert np.isfinite(found.T_cam_lidar).all()
    assert observable(found.information, LIMITS).rank == 2 * count


def test_concurrent_poles_and_parallel_lanes_are_held_by_the_witness():
    """Through associate and solve_lines, with noise: the free shift keeps the stored value."""
    rng = np.random.default_rng(5)
    point = np.array([15.0, 1.0, 0.3])
    spread = rng.normal(size=(7, 3)) * (1.5, 2.0, 2.0)
    cloud = [scenes.fitted("pole", point - 0.3 * d, point + d, 20, 0.02, rng) for d in spread]
    image = [scenes.imaged("pole", point - 0.3 * d, point + d, 0.5, rng) for d in spread]
    estimate = solve_lines([bad.line_frame(cloud, image)], CAMERA, TRUTH).estimate
    ray = se3.apply(TRUTH, point[None])[0]
    shift = np.concatenate([np.zeros(3), ray / np.linalg.norm(ray)])
    assert estimate.features >= 5
    assert observable(estimate.information, LIMITS).rank <= 5
    assert shift @ estimate.information @ shift < 1e-3 * np.linalg.eigvalsh(estimate.information)[5]
    assert abs(shift @ estimate.xi) < 0.05


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10_000), kind=st.integers(0, 6))
def test_p3l_gives_rotations_or_says_why_not(seed, kind):
    """Normals and directions that coincide, vanish or enclose right angles, beside sound ones."""
    rng = np.random.default_rng(seed)

    def unit(count=8):
        v = rng.normal(size=(count, 3))
        return v / np.linalg.norm(v, axis=1, keepdims=True)

    given_ = [unit() for _ in range(5)]
    n1, n2, n3, d_l, d_p = given_
    if kind < 5:
        given_[kind][:4] = 0.0
    elif kind == 5:
        n2[:4], d_p[4:] = n1[:4], d_l[4:]
    else:
        n3[:4] = np.cross(n1[:4], n2[:4])
        n3[:4] /= np.linalg.norm(n3[:4], axis=1, keepdims=True)
    roots = p3l.p3l_candidates(*given_, *(rng.normal(0, 10, (3, 8, 3))))
    T = roots.T_cam_lidar
    assert np.isfinite(T).all()
    R = T[roots.valid, :, :3, :3]
    assert np.allclose(R @ R.transpose(0, 1, 3, 2), np.eye(3), atol=1e-6)
    assert np.allclose(np.linalg.det(R), 1.0, atol=1e-6)
    one_plane, ahead, along = (
        p3l.Degeneracy.LANES_IN_ONE_PLANE,
        p3l.Degeneracy.POLE_DEAD_AHEAD,
        p3l.Degeneracy.POLE_ALONG_LANES,
    )
    wanted = {0: [one_plane] * 4, 1: [one_plane] * 4, 2: [ahead] * 4, 5: [one_plane] * 4 + [along] * 4}
    told = wanted.get(kind, [])
    assert roots.degeneracy[: len(told)].tolist() == told


@pytest.fixture(scope="module")
def road():
    rng = np.random.default_rng(7)
    truth = roads.truth_of(rng)
    strips, posts = roads.road(rng, lanes=3, poles=3)
    cloud, image = roads.lines_of(rng, truth, strips, posts)
    masks = roads.masks_of(truth, strips, posts)
    return truth, cloud, image, roads.points_of(rng, strips, posts), masks


def test_coarse_is_not_led_astray_by_broken_lines(road):
    _, cloud, image, points, masks = road
    maps = height_maps(masks, roads.CAMERA, "plateau")
    alone = coarse_extrinsic(cloud, image, points, maps, roads.CAMERA)
    more = [*cloud, *bad.broken_cloud_lines("lane"), *bad.broken_cloud_lines("pole")]
    seen = [*image, *bad.broken_image_lines("lane"), *bad.broken_image_lines("pole")]
    among = coarse_extrinsic(more, seen, points, maps, roads.CAMERA)
    assert isinstance(alone, CoarseSolution)
    assert isinstance(among, CoarseSolution)
    assert np.array_equal(among.T_cam_lidar, alone.T_cam_lidar)


@pytest.mark.parametrize("up", [(np.nan,) * 3, (0.0, 0.0, -1.0)])
def test_coarse_with_a_wrong_up_finds_nothing(road, up):
    _, cloud, image, points, masks = road
    maps = height_maps(masks, roads.CAMERA, "plateau")
    found = coarse_extrinsic(cloud, image, points, maps, roads.CAMERA, up=np.array(up))
    assert isinstance(found, NoCoarse)


POINTS = {
    "none": np.zeros((0, 3)),
    "one": np.ones((1, 3)),
    "at the origin": np.zeros((7, 3)),
    "equal": np.full((5000, 3), 9.0),
    "behind": np.full((9, 3), -20.0),
    "far": np.full((9, 3), 1e4),
}


@pytest.mark.parametrize("kind", POINTS)
@pytest.mark.parametrize("filled", [0.0, 1.0])
def test_searches_end_in_an_extrinsic_whatever_the_points_and_masks(kind, filled):
    heights = np.full((375, 1242), filled, dtype=np.float32)
    maps = HeightMaps(heights, heights, 1.0, 1.0)
    points = SemanticPoints(POINTS[kind], POINTS[kind])
    few = RandomSearchParameters(samples=60)
    short = EvolutionParameters(generations=6)
    for found in (
        random_search(TRUTH, points, [maps] * 2, CAMERA, np.random.default_rng(0), few),
        evolution_search(TRUTH, points, [maps] * 2, CAMERA, np.random.default_rng(0), short),
    ):
        T = found.T_cam_lidar
        assert np.isfinite(T).all()
        assert T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
        assert 0.0 <= found.cost <= 2.0
        assert found.cost == pytest.approx(semantic_cost(T[None], points, maps, CAMERA)[0], abs=1e-6)


@pytest.mark.parametrize("population", [0, 1, 3])
def test_a_generation_without_parents_is_refused(population):
    with pytest.raises(InputError, match="population"):
        EvolutionParameters(population=population)


def test_more_candidates_than_an_image_has_rows_are_judged():
    heights = np.linspace(0, 1, 375 * 1242, dtype=np.float32).reshape(375, 1242)
    maps = HeightMaps(heights, heights, 1.0, 1.0)
    point = SemanticPoints(np.array([[9.0, 1.0, -1.0]]), np.zeros((0, 3)))
    one = semantic_cost(TRUTH[None], point, maps, CAMERA)
    many = semantic_cost(np.tile(TRUTH, (40_000, 1, 1)), point, maps, CAMERA)
    assert one > 0
    assert (many == one).all()
