"""Clouds, images and masks that show nothing, too much or nonsense: lines without fault, or none."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pipeline.cameras import project
from pipeline.cloud_lines import unrepeated
from pipeline.edge_parameters import EdgeParameters
from pipeline.edges import find_edges
from pipeline.ground import fit_ground
from pipeline.image_lines import MOST_PIECES, find_image_lines
from pipeline.image_segments import find_image_segments
from pipeline.line_witness import find_lines, in_view, solve_lines
from pipeline.records import CameraImage, CameraModel, Masks, PointCloud
from pipeline.sensor_seat import sensor_origin
from pipeline.structure_lines import find_structure_lines


def _oracle(name):
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[1] / "oracles" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


scenes = _oracle("line_scenes")
UP, FORWARD = scenes.UP, scenes.FORWARD


@pytest.fixture(scope="module")
def street_points():
    """A straight road with four lanes and four poles."""
    return scenes.sampled_cloud(np.random.default_rng(1))


@pytest.fixture(scope="module")
def picture():
    return scenes.draw([("lane", (100, 300), (300, 100), 5)], rng=np.random.default_rng(2))


def lines_of(cloud, picture, T_cam_lidar=scenes.TRUTH, camera=scenes.CAMERA):
    return find_lines(
        cloud, *picture, camera, T_cam_lidar, up=UP, forward=FORWARD, rng=np.random.default_rng(0)
    )


def sound(line):
    ends = np.concatenate([line.start, line.end])
    return bool(np.isfinite(ends).all() and np.linalg.norm(line.end - line.start) > 0)


def _circle(count, rng):
    a = rng.uniform(-np.pi, np.pi, count)
    return np.column_stack([10 * np.cos(a), 10 * np.sin(a), np.full(count, -1.7)])


def _along(step, count=5000):
    return np.array([4.0, 1.0, -1.7]) + np.linspace(0, 50, count)[:, None] * np.array(step)


CLOUDS = {
    "empty": lambda _: np.zeros((0, 3)),
    "one point": lambda _: np.array([[5.0, 1.0, -1.0]]),
    "points all equal": lambda _: np.tile([5.0, 1.0, -1.0], (5000, 1)),
    "points at the origin": lambda _: np.zeros((5000, 3)),
    "one ring": lambda rng: _circle(5000, rng),
    "one level line": lambda _: _along((1, 0, 0)),
    "one upright line": lambda _: _along((0, 0, 0.1)),
    "one wall": lambda rng: np.column_stack(
        [np.full(5000, 10.0), rng.uniform((-9, -1.7), (9, 5), (5000, 2))]
    ),
    "noise": lambda rng: rng.uniform(-50, 50, (30000, 3)),
    "as far as decoders let": lambda rng: rng.choice([-1e4, 1e4], (5000, 3)),
    "behind the camera": lambda rng: rng.uniform((-50, -20, -2), (-1, 20, 5), (5000, 3)),
    "no numbers": lambda _: np.full((5000, 3), np.nan),
}
FIELDS = {
    "bare": lambda _: {},
    "dark": lambda n: {"intensity": np.zeros(n, np.float32)},
    "even": lambda n: {"intensity": np.full(n, 0.5, np.float32), "ring": np.zeros(n, np.uint16)},
    "rings": lambda n: {
        "intensity": np.linspace(0, 1, n, dtype=np.float32),
        "ring": (np.arange(n) % 64).astype(np.uint16),
    },
    "filler": lambda n: {"ring": np.full(n, 65535, np.uint16)},
}


@pytest.mark.parametrize("fields", FIELDS)
@pytest.mark.parametrize("kind", CLOUDS)
def test_clouds_without_a_street_are_an_ordinary_answer(kind, fields, picture):
    xyz = CLOUDS[kind](np.random.default_rng(4)).astype(np.float32)
    cloud = PointCloud(xyz, **FIELDS[fields](len(xyz)))
    frame = lines_of(cloud, picture)
    assert not frame.cloud_lines
    estimate = solve_lines([frame], scenes.CAMERA, scenes.TRUTH).estimate
    assert not estimate.information.any()
    found = find_structure_lines(cloud, np.ones(len(cloud), dtype=bool), np.random.default_rng(0))
    assert all(sound(line) and np.linalg.eigvalsh(line.covariance)[0] > -1e-12 for line in found)
    if kind not in ("one wall", "noise"):
        assert not found


@pytest.mark.parametrize("value", [0.0, 0.3, 1.0])
def test_even_intensity_shows_poles_and_no_lanes(street_points, picture, value):
    cloud = PointCloud(street_points.xyz, np.full(len(street_points), value, np.float32))
    labels = [line.label for line in lines_of(cloud, picture).cloud_lines]
    assert labels == ["pole"] * 4


def test_a_ring_field_of_one_number_is_none(street_points, picture):
    """Neither lanes nor the sensor's place may be read off it."""
    filler = dataclasses.replace(street_points, ring=np.full(len(street_points), 7, np.uint16))
    found, alone = (lines_of(cloud, picture).cloud_lines for cloud in (filler, street_points))
    assert [line.start.tolist() for line in found] == [line.start.tolist() for line in alone]
    assert len(alone) == 8
    assert not sensor_origin(filler).any()


def test_points_that_are_no_numbers_hide_no_line(street_points, picture):
    rng = np.random.default_rng(5)
    xyz = street_points.xyz.copy()
    xyz[rng.random(len(xyz)) < 0.05] = np.nan
    found = lines_of(PointCloud(xyz, street_points.intensity), picture).cloud_lines
    assert sorted(line.label for line in found) == ["lane"] * 4 + ["pole"] * 4
    assert all(sound(line) for line in found)


@pytest.mark.parametrize("times", [2, 4])
def test_a_cloud_that_holds_each_point_more_than_once_says_no_more(street, drive, picture, times):
    """As sensors give it that tell the strongest and the last echo: mostly one and the same."""
    once = dataclasses.replace(street.cloud, time=None)
    again = PointCloud(*(np.repeat(a, times, axis=0) for a in (once.xyz, once.intensity, once.ring)))
    camera, T = drive.parameters.camera, street.T_cam_lidar
    a, b = (lines_of(cloud, picture, T, camera).cloud_lines for cloud in (once, again))
    assert [(x.label, len(x.points), x.sigma_m, x.spread) for x in a] == [
        (x.label, len(x.points), x.sigma_m, x.spread) for x in b
    ]
    assert len(a) >= 6
    a, b = (
        find_structure_lines(cloud, in_view(cloud, camera, T), np.random.default_rng(0))
        for cloud in (once, again)
    )
    assert [(x.kind, x.start.tolist(), x.covariance.tolist()) for x in a] == [
        (x.kind, x.start.tolist(), x.covariance.tolist()) for x in b
    ]
    assert len(a) >= 6
    a, b = (
        find_edges(cloud, fit_ground(cloud, UP, np.random.default_rng(0)), camera, T, EdgeParameters())
        for cloud in (once, again)
    )
    assert abs(len(b) - len(a)) <= 0.01 * len(a)


def test_unrepeated_keeps_the_first_of_each_point():
    rng = np.random.default_rng(6)
    xyz = rng.integers(-3, 3, (4000, 3)).astype(np.float32)
    index = np.flatnonzero(rng.random(len(xyz)) < 0.5)
    kept = unrepeated(xyz, index)
    seen, wanted = set(), []
    for k in index.tolist():
        if (key := tuple(xyz[k].tolist())) not in seen:
            seen.add(key)
            wanted.append(k)
    assert kept.tolist() == wanted
    assert unrepeated(xyz, kept) is kept


def test_the_order_of_points_hardly_matters(street, drive, picture):
    """Only the draws of the search change, not what stands there."""
    camera, T = drive.parameters.camera, street.T_cam_lidar
    order = np.random.default_rng(7).permutation(len(street.cloud))
    shuffled = PointCloud(*(a[order] for a in (street.cloud.xyz, street.cloud.intensity, street.cloud.ring)))
    a, b = (lines_of(cloud, picture, T, camera).cloud_lines for cloud in (street.cloud, shuffled))
    agreeing = [
        any(x.label == y.label and _apart(x, y) < 0.1 + 0.004 * np.linalg.norm(x.start) for y in b) for x in a
    ]
    assert abs(len(a) - len(b)) <= 1
    assert sum(agreeing) >= len(a) - 1


def _apart(a, b):
    """Distance of the middle of a line from another line."""
    along = (b.end - b.start) / np.linalg.norm(b.end - b.start)
    return float(np.linalg.norm(np.cross(0.5 * (a.start + a.end) - b.start, along)))


def test_of_too_many_poles_those_of_most_returns_are_looked_at(street_points, picture, monkeypatch):
    """A forest has thousands of candidates."""
    poles = [line for line in lines_of(street_points, picture).cloud_lines if line.label == "pole"]
    monkeypatch.setattr("pipeline.cloud_poles.MOST_CANDIDATES", 2)
    few = [line for line in lines_of(street_points, picture).cloud_lines if line.label == "pole"]
    most = sorted(poles, key=lambda line: -len(line.points))[:2]
    assert [line.start.tolist() for line in few] == [line.start.tolist() for line in most]


LENSES = {
    "pinhole": ("pinhole", []),
    "barrel": ("plumb_bob", [-0.4, 0.2, 0.001, -0.001, -0.05]),
    "folding": ("plumb_bob", [-0.6, 0.0, 0.0, 0.0, 0.0]),
    "pincushion": ("plumb_bob", [0.3, 0.2, 0.0, 0.0, 0.0]),
    "rational": ("rational_polynomial", [0.5, 0.1, 0.0, 0.0, 0.01, 0.9, 0.3, 0.05]),
    "fisheye": ("equidistant", [0.02, -0.01, 0.003, -0.001]),
    "folding fisheye": ("equidistant", [-0.3, 0.0, 0.0, 0.0]),
}
SIZES = [(1, 1), (1, 7), (3, 2), (31, 17), (40, 150), (150, 40)]
MASKS = {
    "empty": lambda shape, _: np.zeros(shape, dtype=bool),
    "full": lambda shape, _: np.ones(shape, dtype=bool),
    "noise": lambda shape, rng: rng.random(shape) < 0.3,
    "bars": lambda shape, _: np.indices(shape)[1] % 8 < 3,
    "one pixel": lambda shape, _: np.indices(shape).sum(axis=0) == 0,
}


def camera_of(lens, size, focal):
    model, D = LENSES[lens]
    width, height = size
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    return CameraModel(model, K, np.array(D, dtype=np.float64), width, height)


def image_of(kind, size, rng):
    width, height = size
    if kind == "noise":
        return CameraImage(rng.integers(0, 256, (height, width, 3), dtype=np.uint8))
    squares = (
        (np.indices((height, width)) // 8).sum(axis=0) % 2 if kind == "squares" else np.zeros((height, width))
    )
    return CameraImage(np.repeat((squares * 255).astype(np.uint8)[..., None], 3, axis=2))


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("size", SIZES)
def test_images_of_any_size_and_lens_give_sound_lines(lens, size):
    rng = np.random.default_rng(9)
    width, height = size
    for focal in (1e-3, 0.2 * width, 1e5):
        camera = camera_of(lens, size, focal)
        for kind in ("black", "noise", "squares"):
            image = image_of(kind, size, rng)
            found = find_image_segments(image, camera)
            for scale, mask in (
                (1.0, "noise"),
                (0.5, "bars"),
                (0.1, "full"),
                (1.0, "empty"),
                (1.0, "one pixel"),
            ):
                shape = max(1, round(height * scale)), max(1, round(width * scale))
                where = MASKS[mask](shape, rng)
                shade = where.astype(np.float32)
                masks = Masks(where, where, shade, shade, shape[1] / width, shape[0] / height)
                lines = find_image_lines(image, masks, camera)
                assert mask != "empty" or not lines
                found = [*found, *lines]
            assert all(sound(line) and 0.0 < line.sigma_px < np.inf for line in found)


def test_a_mask_of_a_thousand_strokes_is_bounded():
    size = (1242, 375)
    camera = camera_of("pincushion", size, 248.0)
    image = image_of("squares", size, None)
    where = MASKS["bars"]((188, 621), None)
    shade = where.astype(np.float32)
    lines = find_image_lines(image, Masks(where, where, shade, shade, 0.5, 188 / 375), camera)
    assert len(lines) <= 2 * MOST_PIECES


def test_pixels_beyond_the_fold_are_on_no_line():
    """Edges and strokes out there are no rays: where the lens folds, lines end (FORMULAS E3)."""
    size = (640, 640)
    # r (1 - 0.35 r^2) is largest, 0.651, at r = 0.976: 260 px from the middle.
    camera = CameraModel(
        "plumb_bob",
        np.array([[400.0, 0, 319.5], [0, 400.0, 319.5], [0, 0, 1]]),
        np.array([-0.35, 0, 0, 0]),
        *size,
    )
    strokes = [
        ("lane", (60, 60), (590, 580), 6),
        ("pole", (10, 300), (12, 20), 6),
        ("lane", (20, 600), (300, 628), 6),
    ]
    image, masks = scenes.draw(strokes, size=size, rng=np.random.default_rng(10))
    for found in (find_image_lines(image, masks, camera), find_image_segments(image, camera)):
        assert found
        ends = np.stack([(line.start, line.end) for line in found]).reshape(-1, 2)
        slope = np.linalg.norm(ends - 319.5, axis=1) / 400.0
        assert slope.max() < 1.0 / np.sqrt(3 * 0.35) + 0.02


@pytest.mark.parametrize(
    ("model", "size", "focal"),
    [
        ("equidistant", (1600, 1000), 320.0),
        ("equidistant", (1000, 1600), 320.0),
        ("plumb_bob", (1200, 500), 300.0),
    ],
)
def test_a_lens_that_ends_inside_the_image_sees_as_far_as_it_goes(model, size, focal):
    D = np.array([-0.35, 0, 0, 0]) if model == "plumb_bob" else np.zeros(4)
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    camera = CameraModel(model, K, D, *size)
    rng = np.random.default_rng(11)
    xyz = (rng.uniform(-1, 1, (3000, 3)) * (8, 8, 0) + (0, 0, 5)).astype(np.float32)
    shown = project(camera, xyz.astype(np.float64))[1]
    seen = in_view(PointCloud(xyz), camera, np.eye(4))
    assert shown.sum() > 300
    assert seen[shown].all()
    assert not in_view(PointCloud(xyz * np.float32([1, 1, -1])), camera, np.eye(4)).any()
