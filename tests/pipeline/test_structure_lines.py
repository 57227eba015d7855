import dataclasses
import json
import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline import se3
from pipeline.image_segments import find_image_segments
from pipeline.line_witness import in_view
from pipeline.plane_edges import SURFACE_M
from pipeline.records import CameraImage, CameraModel, PointCloud
from pipeline.structure_lines import MOST_LINES, cloud_lines, find_structure_lines

DATA = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))
HEIGHT_M, SIGMA_M = 1.8, 0.02


def beams(rings, columns=400, half=0.7):
    """Directions (N,3) of a spinning sensor in a sector, and their rings."""
    e, a = np.meshgrid(
        np.radians(np.linspace(-24.8, 10.0, rings)), np.linspace(-half, half, columns), indexing="ij"
    )
    u = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    return u.reshape(-1, 3), np.repeat(np.arange(rings), columns)


def house(x, y, yaw, size):
    """A box on the ground: axes, centre, half sizes."""
    half = np.array(size) / 2
    return Rotation.from_euler("z", yaw).as_matrix(), np.array([x, y, half[2] - HEIGHT_M]), half


def ranges(u, boxes):
    """True range of each beam: ground, boxes, inf for the sky."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(u[:, 2] < 0, -HEIGHT_M / u[:, 2], np.inf)
        for R, c, h in boxes:
            o, d = -(c @ R) / h, (u @ R) / h
            low = np.minimum((-1 - o) / d, (1 - o) / d).max(axis=1)
            high = np.maximum((-1 - o) / d, (1 - o) / d).min(axis=1)
            t = np.where((low < high) & (low > 0) & (low < t), low, t)
    return t


def sweep(boxes, rng, rings=64, jitter=0.0, columns=400):
    """What a sensor at the origin measures; with jitter its beams lie anywhere, and there are no rings."""
    u, ring = beams(rings, columns)
    if jitter:
        u = u + jitter * rng.normal(size=u.shape)
        u /= np.linalg.norm(u, axis=1)[:, None]
    t = ranges(u, boxes)
    seen = t < 70.0
    xyz = u[seen] * (t[seen] + SIGMA_M * rng.normal(size=seen.sum()))[:, None]
    return PointCloud(xyz.astype(np.float32), None, None if jitter else ring[seen].astype(np.uint16))


def edges(box):
    """The twelve edges of a box as pairs of corners."""
    R, c, h = box
    found = []
    for axis in range(3):
        for k in range(4):
            p = np.array([1.0 if k & 1 else -1.0, 1.0 if k & 2 else -1.0])
            a = np.insert(p, axis, -1.0) * h
            found.append((R @ a + c, R @ (a * np.where(np.arange(3) == axis, -1, 1)) + c))
    return found


def error(line, true):
    """Offsets (4,) of the nearest true edge from both ends, along the line's axes; None if none fits."""
    best = None
    for p, q in true:
        d = (q - p) / np.linalg.norm(q - p)
        if abs(d @ line.direction) < math.cos(math.radians(6.0)):
            continue
        at = [
            p + ((end - p) @ line.direction) / (d @ line.direction) * d - end
            for end in (line.start, line.end)
        ]
        e = np.concatenate([line.axes @ offset for offset in at])
        if best is None or np.abs(e[::2]).max() < np.abs(best[::2]).max():
            best = e
    return best if best is not None and np.abs(best[::2]).max() < 0.5 else None


def lines_of(cloud, seen=None, **kwargs):
    every = np.ones(len(cloud), dtype=bool) if seen is None else seen
    return find_structure_lines(cloud, every, np.random.default_rng(0), **kwargs)


def street(rng):
    distance, bearing = rng.uniform(8, 24), rng.uniform(-0.3, 0.3)
    x, y = (distance + 3) * math.cos(bearing), distance * math.sin(bearing)
    return house(x, y, bearing + rng.uniform(-0.7, 0.7), (6.0, 7.0, rng.uniform(2.5, 4.0)))


@pytest.fixture(scope="module")
def found():
    """Lines of sixteen houses and the houses."""
    cases = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        box = street(rng)
        cases.append((box, lines_of(sweep([box], rng))))
    return cases


def whitened(found, kind, upright):
    values = []
    for box, lines in found:
        for line in lines:
            e = error(line, edges(box))
            if line.kind == kind and (abs(line.direction[2]) > 0.7) == upright and e is not None:
                side = e[::2]
                values.append(side @ np.linalg.solve(line.covariance[::2, ::2], side))
    return np.array(values)


def test_edges_lie_where_their_covariance_says(found):
    for kind, upright, least in (("jump", True, 12), ("jump", False, 12), ("crease", True, 5)):
        values = whitened(found, kind, upright)
        assert len(values) >= least, (kind, upright)
        # Two ends, 2 degrees of freedom; the gap between beams is told as wide as it may be, not as it is.
        assert values.mean() < 2.6, (kind, upright)
        assert np.quantile(values, 0.9) < 6.0, (kind, upright)
    assert whitened(found, "jump", upright=True).mean() > 0.3


def test_what_is_found_is_an_edge(found):
    lines = [(box, line) for box, lines in found for line in lines]
    strays = [line for box, line in lines if error(line, edges(box)) is None]
    assert len(lines) > 35
    assert len(strays) <= 0.05 * len(lines)


def test_corners_of_houses_are_found(found):
    """Upright edges with two visible faces or before something farther, of at least 2 m in view."""
    hit, wanted = 0, 0
    for box, lines in found:
        for p, q in edges(box):
            d = (q - p) / np.linalg.norm(q - p)
            bearings = [math.atan2(point[1], point[0]) for point in (p, q)]
            if abs(d[2]) < 0.7 or np.abs(bearings).max() > 0.6 or not visible(box, 0.5 * (p + q)):
                continue
            wanted += 1
            hit += any(
                abs(line.direction @ d) > math.cos(math.radians(4.0))
                and np.linalg.norm(np.cross(0.5 * (line.start + line.end) - p, d)) < 0.6
                for line in lines
            )
    assert wanted >= 30
    assert hit >= 0.7 * wanted


def visible(box, point):
    u = point / np.linalg.norm(point)
    # Just outside a visible corner of a convex body some beam passes it, just inside one meets it there.
    t = ranges(u[None] * 1.0, [(box[0], box[1], box[2] * 1.001)])[0]
    return abs(t - np.linalg.norm(point)) < 0.1


def test_creases_without_the_surfaces_floor_are_as_sure_as_their_points(found):
    values = []
    for box, lines in found:
        for line in lines:
            e = error(line, edges(box))
            if line.kind == "crease" and abs(line.direction[2]) > 0.7 and e is not None:
                rough = np.kron(SURFACE_M**2 * np.eye(2), np.eye(2))
                values.append(np.abs(e[::2]).max() / math.sqrt(line.covariance[0, 0]))
                assert np.linalg.eigvalsh(line.covariance - 0.4 * rough).min() > 0
    assert np.max(values) < 1.5


@pytest.mark.parametrize("rings", [16, 32, 128])
def test_other_sensors(rings):
    lines, strays = 0, 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        box = street(rng)
        for line in lines_of(sweep([box], rng, rings=rings, columns=300)):
            lines += 1
            strays += error(line, edges(box)) is None
    assert lines >= {16: 1, 32: 3, 128: 10}[rings]
    assert strays <= 0.1 * lines


def test_a_cloud_without_rings_shows_corners_and_borders():
    kinds, strays = [], 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        box = house(12 + 2 * seed, rng.uniform(-1, 1), 0.6, (6.0, 7.0, 3.0))
        wall = house(40.0, 0.0, 0.0, (2.0, 60.0, 12.0))
        for line in lines_of(sweep([box, wall], rng, jitter=0.004)):
            e = error(line, edges(box) + edges(wall))
            kinds.append(line.kind)
            strays += e is None
    assert "jump" not in kinds
    assert kinds.count("crease") >= 3
    assert kinds.count("border") >= 2
    assert strays <= 2


@pytest.mark.parametrize("turn", ["up side down", "about z", "spin about x"])
def test_no_axis_is_up(turn):
    rng = np.random.default_rng(2)
    cloud = sweep([street(rng)], rng)
    R = {
        "up side down": Rotation.from_euler("x", 180, degrees=True).as_matrix(),
        "about z": Rotation.from_euler("z", 90, degrees=True).as_matrix(),
        "spin about x": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    }[turn]
    turned = dataclasses.replace(cloud, xyz=(cloud.xyz @ R.T).astype(np.float32))
    a, b = lines_of(cloud), lines_of(turned)
    assert len(a) >= 3
    upright = [line for line in a if line.kind == "jump" and abs(line.direction[2]) > 0.7]
    assert upright
    for line in upright:
        ends = np.stack([line.start, line.end]) @ R.T
        assert any(
            min(
                np.abs(np.stack([c.start, c.end]) - ends).max(),
                np.abs(np.stack([c.end, c.start]) - ends).max(),
            )
            < 0.02
            for c in b
        )


def test_a_sensor_beside_the_origin():
    rng = np.random.default_rng(2)
    cloud = sweep([street(rng)], rng)
    origin = np.array([1.5, 0.3, 1.9])
    moved = dataclasses.replace(cloud, xyz=(cloud.xyz + origin).astype(np.float32))
    a, b = lines_of(cloud), lines_of(moved, origin=origin)
    assert len(a) == len(b)
    for line, other in zip(a, b, strict=True):
        np.testing.assert_allclose(other.start - origin, line.start, atol=5e-3)
        np.testing.assert_allclose(other.covariance, line.covariance, atol=1e-4)
        np.testing.assert_allclose(other.axes, line.axes, atol=0.02)


def test_vegetation_has_hardly_any_lines():
    total = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        u, ring = beams(64)
        t = np.minimum(ranges(u, []), 70.0)
        # Bushes and crowns: beams stop anywhere inside of balls.
        for _ in range(12):
            c = np.array([rng.uniform(6, 30), rng.uniform(-12, 12), rng.uniform(-1.5, 2.0)])
            along = u @ c
            depth = np.sqrt(np.maximum(rng.uniform(0.6, 2.0) ** 2 - (c @ c - along**2), 0.0))
            inside = (depth > 0) & (rng.random(len(u)) < 0.8)
            t = np.where(inside, np.minimum(t, along + rng.uniform(-1, 1, len(u)) * depth), t)
        seen = t < 70.0
        cloud = PointCloud((u * t[:, None])[seen].astype(np.float32), None, ring[seen].astype(np.uint16))
        total += len(lines_of(cloud))
    assert total <= 6


@pytest.mark.parametrize("ring", [True, False])
@pytest.mark.parametrize(
    "xyz",
    [
        np.zeros((0, 3)),
        np.ones((1, 3)),
        np.ones((500, 3)),
        np.zeros((500, 3)),
        np.column_stack([np.full(400, 9.0), np.linspace(-5, 5, 400), np.zeros(400)]),
        np.column_stack(
            [np.full(900, 9.0), np.repeat(np.linspace(-3, 3, 30), 30), np.tile(np.linspace(0, 3, 30), 30)]
        ),
        np.full((300, 3), np.nan),
        np.full((300, 3), 1e30),
    ],
    ids=["empty", "one", "same", "origin", "row", "plane", "nan", "huge"],
)
def test_bad_clouds_are_an_ordinary_answer(xyz, ring):
    cloud = PointCloud(
        xyz.astype(np.float32), None, np.arange(len(xyz), dtype=np.uint16) // 30 if ring else None
    )
    lines = lines_of(cloud)
    assert all(np.isfinite(line.start).all() and np.isfinite(line.covariance).all() for line in lines)
    assert len(lines) <= 4


def test_what_is_not_finite_or_not_seen_takes_no_part():
    rng = np.random.default_rng(2)
    cloud = sweep([street(rng)], rng)
    bad = cloud.xyz.copy()
    bad[::50] = np.nan
    bad[1::50] = np.inf
    seen = np.ones(len(cloud), dtype=bool)
    seen[::50] = seen[1::50] = False
    a = lines_of(cloud, seen)
    b = lines_of(dataclasses.replace(cloud, xyz=bad))
    assert len(a) == len(b) > 0
    for line, other in zip(a, b, strict=True):
        np.testing.assert_array_equal(line.start, other.start)
    assert lines_of(cloud, np.zeros(len(cloud), dtype=bool)) == []


def test_records_keep_the_covariance_and_the_class():
    rng = np.random.default_rng(2)
    cloud = sweep([street(rng)], rng)
    found = lines_of(cloud)
    assert 0 < len(found) <= MOST_LINES
    eye = np.array([0.8, -0.3, -1.5])
    for line, record in zip(found, cloud_lines(found, eye), strict=True):
        assert record.label == "structure"
        assert len(np.unique(record.points)) == len(record.points) > 0
        assert record.points.max() < len(cloud)
        arm = np.array([0.0, line.length]) - record.mean_m
        variance = record.sigma_m**2 * (1.0 / len(record.points) + np.outer(arm, arm) / record.spread)
        np.testing.assert_allclose(variance, line.seen_from(eye), rtol=1e-4, atol=1e-9)


def shown(lines, segments, camera, T):
    """Lines in view, and those of them along half of which an image line lies, within 3 px and 2 deg."""
    unit = max(1.0, camera.K[1, 1] / 720.0)
    ends = np.array([[segment.start, segment.end] for segment in segments])
    span = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(span, axis=1)
    span /= length[:, None]
    hits, count = 0, 0
    for line in lines:
        p = np.stack([line.start, line.end]) @ T[:3, :3].T + T[:3, 3]
        if p[:, 2].min() < 1.0:
            continue
        a, b = (p @ camera.K.T)[:, :2] / p[:, 2:]
        places = a + np.linspace(0.025, 0.975, 20)[:, None] * (b - a)
        inside = ((places >= 0) & (places < [camera.width, camera.height])).all(axis=1)
        if inside.mean() < 0.7:
            continue
        count += 1
        e = (b - a) / np.linalg.norm(b - a)
        alike = np.abs(e[0] * span[:, 1] - e[1] * span[:, 0]) < math.sin(math.radians(2.0))
        offset = places[:, None] - ends[None, alike, 0]
        along = np.einsum("psi,si->ps", offset, span[alike])
        across = np.abs(offset[..., 0] * span[alike, 1] - offset[..., 1] * span[alike, 0])
        on = (across < 3.0 * unit) & (along > -2.0 * unit) & (along < length[alike] + 2.0 * unit)
        hits += on.mean(axis=0).max(initial=0.0) >= 0.5
    return hits, count


@pytest.mark.recordings
def test_the_image_shows_the_lines_of_real_frames_and_not_those_of_a_turned_mount():
    """The published extrinsics are good to 0.1 to 0.2 deg."""
    folders = [DATA / "kitti_singles" / f"{k:06d}" for k in (1, 5, 6, 9, 11, 12)]
    folders = [folder for folder in folders if (folder / "calib.json").is_file()]
    if not folders:
        pytest.skip(f"no recordings in {DATA}")
    hits, count = np.zeros(3), np.zeros(3)
    for folder in folders:
        calib = json.loads((folder / "calib.json").read_text())
        pixels = cv2.imread(str(folder / "image.png"))
        K = np.array(calib["camera"]["K"], dtype=float).reshape(3, 3)
        camera = CameraModel("pinhole", K, np.zeros(0), pixels.shape[1], pixels.shape[0])
        xyz = np.fromfile(folder / "cloud.bin", np.float32).reshape(-1, 4)[:, :3]
        cloud, T = PointCloud(np.ascontiguousarray(xyz)), np.array(calib["T_cam_lidar"])
        lines = lines_of(cloud, in_view(cloud, camera, T))
        segments = find_image_segments(CameraImage(pixels), camera)
        for k, degrees in enumerate((0.0, 1.0, 2.0)):
            for axis in range(3):
                for sign in (1, -1):
                    xi = sign * math.radians(degrees) * np.eye(6)[axis]
                    found = shown(lines, segments, camera, se3.retract(T, xi))
                    hits[k] += found[0]
                    count[k] += found[1]
    share = hits / count
    assert count[0] > 25 * 6
    assert share[0] > 0.2
    assert share[1] < 0.75 * share[0]
    assert share[2] < 0.55 * share[0]
