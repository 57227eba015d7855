import dataclasses
import importlib.util
import itertools
from pathlib import Path

import numpy as np
import pytest

from pipeline import se3
from pipeline.line_triples import (
    NoTriples,
    TripleParameters,
    enumerate_triples,
    largest_lines,
    largest_poles,
)
from pipeline.p3l import NEAREST_M
from pipeline.records import CloudLine, ImageLine

_spec = importlib.util.spec_from_file_location(
    "semantic_scenes", Path(__file__).parents[1] / "oracles" / "semantic_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)

CAMERA = scenes.CAMERA
P = TripleParameters()


def lines_of(seed, *, lanes=3, poles=3):
    rng = np.random.default_rng(seed)
    truth = scenes.truth_of(rng)
    strips, posts = scenes.road(rng, lanes=lanes, poles=poles)
    return truth, *scenes.lines_of(rng, truth, strips, posts)


def longer(cloud, behind):
    """The same lines; lanes begin so many metres further back."""
    back = np.array([behind, 0.0, 0.0])
    return [
        dataclasses.replace(line, **{end: getattr(line, end) - back}, mean_m=None)
        if line.label == "lane"
        else line
        for line in cloud
        for end in ["start" if line.start[0] < line.end[0] else "end"]
    ]


def in_front_part(T, line):
    """Projections of the part of a line beyond the nearest depth, sampled densely, px."""
    share = np.linspace(0.0, 1.0, 4001)[:, None]
    cam = se3.apply(T, line.start + share * (line.end - line.start))
    cam = cam[cam[:, 2] >= NEAREST_M]
    return (cam @ CAMERA.K.T)[:, :2] / cam[:, 2:]


def covers(T, cloud, image):
    """Whether a sample of a cloud line projects between the ends of an image line."""
    uv = in_front_part(T, cloud)
    along = image.end - image.start
    share = (uv - image.start) @ along / (along @ along)
    return bool(len(share) and share.max() > 0.0 and share.min() < 1.0)


@pytest.mark.parametrize("behind", [0.0, 60.0])
def test_all_three_lines_lie_on_what_was_seen_of_them(behind):
    """Cheirality (iii): brute force over dense samples; lanes may run on behind the camera."""
    count = 0
    for seed in range(4):
        _, cloud, image = lines_of(100 + seed)
        lines = largest_lines(longer(cloud, behind), image, P)
        found = enumerate_triples(lines, CAMERA, None, P)
        for T, c, i in zip(found.T_cam_lidar, found.cloud, found.image, strict=True):
            pairs = [
                (lines.cloud_lanes[c[0]], lines.image_lanes[i[0]]),
                (lines.cloud_lanes[c[1]], lines.image_lanes[i[1]]),
                (lines.cloud_poles[c[2]], lines.image_poles[i[2]]),
            ]
            assert all(covers(T, *pair) for pair in pairs)
            count += 1
    assert count > 20


def has_truth(truth, cloud, image):
    """Whether a root is near the truth."""
    found = enumerate_triples(largest_lines(cloud, image, P), CAMERA, None, P)
    if isinstance(found, NoTriples):
        return False
    return any(
        se3.rotation_angle(T[:3, :3], truth[:3, :3]) < 0.05 and np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 0.5
        for T in found.T_cam_lidar
    )


def test_of_a_lane_that_runs_on_behind_the_part_in_front_counts():
    """The image shows the near part alone; a point behind the camera projects beyond the vanishing point."""
    for seed in range(4):
        truth, cloud, image = lines_of(100 + seed, lanes=2)
        near = []
        for line in image:
            foot, other = sorted((line.start, line.end), key=lambda end: -end[1])
            cut = ImageLine("lane", foot, foot + 0.4 * (other - foot), line.sigma_px)
            near.append(cut if line.label == "lane" else line)
        assert has_truth(truth, longer(cloud, 60.0), near)


@pytest.mark.parametrize("lane", [0, 1])
def test_a_lane_seen_where_the_cloud_has_none_is_no_match(lane):
    """The true extrinsic goes as soon as one image lane is cut to a part beyond the cloud's lane."""
    truth, cloud, image = lines_of(5, lanes=2, poles=1)
    lanes = [line for line in image if line.label == "lane"]
    true = [line for line in cloud if line.label == "lane"][lane]
    far = max((true.start, true.end), key=lambda end: end[0])
    uv = in_front_part(
        truth, CloudLine("lane", far, far + np.array([30.0, 0.0, 0.0]), np.arange(3), 0.03, 9.0)
    )
    beyond = [
        ImageLine("lane", uv[len(uv) // 4], uv[-1], line.sigma_px) if k == lane else line
        for k, line in enumerate(lanes)
    ]
    poles = [line for line in image if line.label == "pole"]

    assert has_truth(truth, cloud, [*lanes, *poles])
    assert not has_truth(truth, cloud, [*beyond, *poles])


def post(x, y, height):
    foot = np.array([x, y, -1.0])
    return CloudLine("pole", foot, foot + np.array([0.0, 0.0, height]), np.arange(9), 0.03, 9.0)


def test_near_things_that_are_no_poles_leave_places_for_poles():
    """Twenty people around the vehicle; each pole further away is longer, and has a smaller angle."""
    people = [post(*(3.0 * np.array([np.cos(a), np.sin(a)])), 1.6) for a in np.linspace(0, 6, 20)]
    poles = [post(x, 6.0, 3.0) for x in (12.0, 18.0, 24.0, 30.0)]
    chosen = largest_poles([*people, *poles], P.cloud_poles)
    assert len(chosen) == P.cloud_poles
    assert all(any(line is pole for line in chosen) for pole in poles)
    assert len({id(line) for line in chosen}) == len(chosen)


def test_far_masts_leave_places_for_near_poles():
    masts = [post(60.0, y, 9.0) for y in np.linspace(-40, 40, 20)]
    near = [post(x, 5.0, 3.0) for x in (8.0, 12.0)]
    chosen = largest_poles([*masts, *near], P.cloud_poles)
    assert all(any(line is pole for line in chosen) for pole in near)


def test_the_order_of_the_lines_does_not_matter():
    rng = np.random.default_rng(1)
    poles = [post(rng.uniform(5, 40), rng.uniform(-9, 9), rng.uniform(1, 5)) for _ in range(6)]
    first = largest_poles(poles, 4)
    for order in itertools.islice(itertools.permutations(poles), 1, 720, 97):
        assert [id(line) for line in largest_poles(order, 4)] == [id(line) for line in first]


@pytest.mark.parametrize("up", [np.zeros(3), np.full(3, np.nan), np.array([0.0, 0.0, np.inf])])
def test_an_up_that_is_no_direction_is_named(up):
    _, cloud, image = lines_of(5)
    found = enumerate_triples(largest_lines(cloud, image, P), CAMERA, up, P)
    assert isinstance(found, NoTriples)
    assert found.reason == "up is no direction"
