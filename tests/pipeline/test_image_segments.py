import itertools
import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.cameras import raw_pixels
from pipeline.image_segments import (
    MERGE_ANGLE,
    MERGE_GAP_PX,
    MIN_LENGTH_PX,
    find_image_segments,
    merge_candidates,
    segments_to_lines,
    shrunk,
)
from pipeline.records import CameraImage, CameraModel

WIDTH, HEIGHT = 640, 360
OVER = 4


def camera(focal=600.0, D=(), width=WIDTH, height=HEIGHT):
    K = np.array([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return CameraModel("plumb_bob" if len(D) else "pinhole", K, np.array(D, dtype=float), width, height)


def drawn(polygons, cam, rng=None, sigma=2.0):
    """Polygons (ideal px, brightness) on grey ground, through the lens, each px the mean of 4 x 4, noisy."""
    canvas = np.full((cam.height * OVER, cam.width * OVER), 90, dtype=np.uint8)
    for corners, level in polygons:
        dense = np.concatenate([np.linspace(a, b, 30) for a, b in itertools.pairwise([*corners, corners[0]])])
        fine = (raw_pixels(cam, dense) + 0.5) * OVER - 0.5
        cv2.fillPoly(canvas, [np.rint(fine * 16).astype(np.int32)], level, shift=4)
    grey = cv2.resize(canvas, (cam.width, cam.height), interpolation=cv2.INTER_AREA).astype(float)
    if rng is not None:
        grey = grey + sigma * rng.normal(size=grey.shape)
    grey = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return CameraImage(np.repeat(grey[:, :, None], 3, axis=2))


def quad(centre, size, angle):
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(size) / 2
    c, s = math.cos(angle), math.sin(angle)
    return np.array(centre) + half @ np.array([[c, s], [-s, c]])


def off(line, a, b):
    """Signed distances of the line's ends from the line through a and b, and how much of a..b it covers."""
    d = (b - a) / np.linalg.norm(b - a)
    ends = np.stack([line.start, line.end]) - a
    along = np.sort(ends @ d)
    covered = (min(along[1], np.linalg.norm(b - a)) - max(along[0], 0.0)) / np.linalg.norm(b - a)
    return ends @ np.array([-d[1], d[0]]), covered


@pytest.mark.parametrize("D", [(), (-0.30, 0.10, 0.001, -0.0005, 0.0)])
def test_borders_of_a_body_are_found_within_their_sigma(D):
    cam = camera(D=D)
    whitened = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        corners = quad(rng.uniform([240, 130], [400, 230]), rng.uniform(120, 220, 2), rng.uniform(0, math.pi))
        lines = find_image_segments(drawn([(corners, 170)], cam, rng), cam)
        for a, b in itertools.pairwise([*corners, corners[0]]):
            best = max(lines, key=lambda line: off(line, a, b)[1] - np.abs(off(line, a, b)[0]).max())
            error, covered = off(best, a, b)
            # Drawn polygons hold the px of their borders, half of one beyond them.
            error = error + 0.5 / OVER
            assert covered > 0.85
            assert np.abs(error).max() < 0.6
            whitened.append(error / best.sigma_px)
    # The floor stands for what is not drawn here: most of the error is below it.
    assert 0.005 < np.mean(np.square(whitened)) < 1.0
    assert abs(np.mean(whitened)) < 0.3


def test_the_brighter_side_is_on_one_hand():
    cam = camera()
    corners = quad((320, 180), (200, 120), 0.2)
    for level, sign in ((200, 1.0), (20, -1.0)):
        lines = find_image_segments(drawn([(corners, level)], cam), cam)
        assert len(lines) == 4
        middle = corners.mean(axis=0)
        for line in lines:
            d = line.end - line.start
            inward = middle - line.start
            assert sign * (d[0] * inward[1] - d[1] * inward[0]) > 0


def test_the_borders_of_a_thin_bar_stay_two_lines():
    cam = camera()
    lines = find_image_segments(drawn([(quad((320, 180), (200, 4), 0.3), 200)], cam), cam)
    long = [line for line in lines if np.linalg.norm(line.end - line.start) > 150]
    assert len(long) == 2
    error, _ = off(long[0], long[1].start, long[1].end)
    np.testing.assert_allclose(np.abs(error), 4.0, atol=0.5)


def test_pieces_of_one_edge_are_one_line():
    cam = camera()
    body = quad((320, 180), (300, 160), 0.1)
    # A thin wire before the body cuts its upper edge in two.
    wire = quad((300, 100), (2, 60), 0.1)
    lines = find_image_segments(drawn([(body, 180), (wire, 90)], cam), cam)
    _, covered = off(lines[0], body[0], body[1])
    assert max(covered, off(lines[1], body[0], body[1])[1]) > 0.9


@pytest.mark.parametrize("count", [17, 40])
def test_many_pieces_of_one_edge_are_one_line(count):
    """A fence before a kerb cuts it every 12 px: joined two by two until one is left."""
    cam = camera()
    grey = drawn([([(10.0, 180.2), (630.0, 180.2), (630.0, 350.0), (10.0, 350.0)], 180)], cam).pixels[:, :, 0]
    left = 20.0 + 12.0 * np.arange(count)
    pieces = np.stack([np.column_stack([left + at, np.full(count, 180.0)]) for at in (0.0, 11.0)], axis=1)
    lines = segments_to_lines(pieces, grey, 1, cam)
    assert len(lines) == 1
    error, covered = off(lines[0], np.array([20.0, 180.2]), np.array([left[-1] + 11.0, 180.2]))
    assert np.abs(error).max() < 0.7
    assert covered > 0.97


def test_a_long_lens_gives_the_same_lines():
    cam = camera()
    big = camera(focal=2400.0, width=4 * WIDTH, height=4 * HEIGHT)
    corners = quad((320, 180), (180, 120), 0.4)
    small = find_image_segments(drawn([(corners, 200)], cam), cam)
    pixels = cv2.resize(drawn([(corners, 200)], cam).pixels, (big.width, big.height))
    large = find_image_segments(CameraImage(pixels), big)
    assert shrunk(pixels[:, :, 0], big)[1] == 3
    assert len(small) == len(large) == 4
    for line in small:
        a, b = (np.array(p) * 4 + 1.5 for p in (line.start, line.end))
        assert min(np.abs(off(other, a, b)[0]).max() for other in large) < 2.0


def test_noise_and_emptiness_give_nothing_long():
    cam = camera()
    rng = np.random.default_rng(0)
    flat = np.full((HEIGHT, WIDTH, 3), 90, dtype=np.uint8)
    assert find_image_segments(CameraImage(flat), cam) == []
    noise = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    assert len(find_image_segments(CameraImage(noise), cam)) <= 2
    for size in ((1, 1), (2, 300), (3, 3)):
        tiny = camera(width=size[1], height=size[0])
        assert find_image_segments(CameraImage(np.zeros((*size, 3), np.uint8)), tiny) == []


def test_every_line_is_long_enough_and_the_longest_is_first():
    cam = camera()
    rng = np.random.default_rng(3)
    bodies = [
        (quad(rng.uniform([60, 60], [580, 300]), rng.uniform(8, 120, 2), rng.uniform(0, 3)), level)
        for level in (30, 150, 200, 230, 60, 120)
    ]
    lines = find_image_segments(drawn(bodies, cam, rng), cam)
    length = [np.linalg.norm(line.end - line.start) for line in lines]
    assert len(lines) > 5
    assert min(length) >= MIN_LENGTH_PX
    assert length == sorted(length, reverse=True)
    assert all(line.label == "structure" and 0.3 <= line.sigma_px < 1.5 for line in lines)


def brute_force(ends, gap):
    """Pairs by PLK's words: any end to any end, and the angle between the directions."""
    pairs = set()
    for i, j in itertools.combinations(range(len(ends)), 2):
        nearest = min(np.linalg.norm(p - q) for p in ends[i] for q in ends[j])
        a, b = ends[i][1] - ends[i][0], ends[j][1] - ends[j][0]
        cosine = a @ b / np.linalg.norm(a) / np.linalg.norm(b)
        if nearest <= gap and math.acos(np.clip(cosine, -1, 1)) < MERGE_ANGLE:
            pairs.add((i, j))
    return pairs


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 40))
def test_candidates_to_merge_are_those_of_the_paper(seed, count):
    rng = np.random.default_rng(seed)
    start = rng.uniform(0, 60, (count, 2))
    angle = rng.uniform(-0.1, 0.1, count)
    span = rng.uniform(8, 40, count)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    ends = np.stack([start, start + span], axis=1)
    found = {tuple(pair) for pair in merge_candidates(ends, MERGE_GAP_PX).tolist()}
    assert found == brute_force(ends, MERGE_GAP_PX)
