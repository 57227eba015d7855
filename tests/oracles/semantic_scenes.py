"""Straight roads with perfect masks, and the points and lines of their paint and poles."""

import cv2
import numpy as np

from pipeline import se3
from pipeline.cameras import project
from pipeline.cloud_lines import cloud_line, total_least_squares
from pipeline.records import CameraModel, CloudLine, ImageLine, Masks
from pipeline.semantic_cost import SemanticPoints

HEIGHT = 1.73
CAMERA = CameraModel(
    "pinhole",
    np.array([[721.5, 0.0, 609.6], [0.0, 721.5, 172.9], [0.0, 0.0, 1.0]]),
    np.zeros(0),
    1242,
    375,
)
MOST_ANGLE = np.radians(6.0)
LANE_HALF_M, POLE_RADIUS_M = 0.075, 0.1


def truth_of(rng):
    """A camera that looks ahead within 2 deg, half a metre around the LiDAR."""
    R = se3.exp_so3(rng.normal(0, np.radians(1.0), 3)) @ se3.AXES_CAM_IN_VEHICLE.T
    return se3.transform(R, -R @ (np.array([0.3, 0.0, -0.1]) + rng.uniform(-0.3, 0.3, 3)))


def road(rng, *, lanes=3, poles=4):
    """Lanes (y, first x, last x) and poles (x, y, top z)."""
    width = rng.uniform(3.0, 3.8)
    first = rng.uniform(0.3, 0.7) * width - width * (lanes // 2)
    sides = [first + k * width for k in range(lanes)]
    strips = [(y, rng.uniform(6.5, 10.0), rng.uniform(25.0, 35.0)) for y in sides]
    outside = max(abs(sides[0]), abs(sides[-1])) + 1.0
    posts = []
    while len(posts) < poles:
        x, y = rng.uniform(9, 38), rng.choice([-1, 1]) * (outside + rng.uniform(0, 4))
        if all(np.hypot(x - a, y - b) > 4 for a, b, _ in posts) and abs(y) < 0.75 * x:
            posts.append((x, y, min(4.0 - HEIGHT, 0.035 * np.hypot(x, y))))
    return strips, posts


def points_of(rng, strips, posts, *, per_lane=100, per_pole=40, noise=0.02):
    """Points spread over the width of the paint and over the visible front of the poles."""
    lane = [
        np.column_stack(
            [
                rng.uniform(a, b, per_lane),
                y + rng.uniform(-LANE_HALF_M, LANE_HALF_M, per_lane),
                np.full(per_lane, -HEIGHT),
            ]
        )
        for y, a, b in strips
    ]
    pole = []
    for x, y, top in posts:
        angle = np.arctan2(y, x) + np.pi + rng.uniform(-1.3, 1.3, per_pole)
        pole.append(
            np.column_stack(
                [
                    x + POLE_RADIUS_M * np.cos(angle),
                    y + POLE_RADIUS_M * np.sin(angle),
                    rng.uniform(0.73 - HEIGHT, top, per_pole),
                ]
            )
        )
    both = [np.concatenate([np.zeros((0, 3)), *part]) for part in (lane, pole)]
    lane, pole = ((xyz + rng.normal(0, noise, xyz.shape)).astype(np.float32) for xyz in both)
    return SemanticPoints(lane, pole)


def masks_of(T, strips, posts, *, camera=CAMERA, scale=1.0):
    """Perfect masks by filled polygons, to an eighth of a px."""
    shape = (round(camera.height * scale), round(camera.width * scale))
    lane, pole = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)

    def fill(canvas, corners):
        cam = se3.apply(T, np.array(corners))
        uv = cam @ camera.K.T
        grid = (uv[:, :2] / uv[:, 2:] + 0.5) * scale - 0.5
        cv2.fillConvexPoly(canvas, np.rint(grid * 8).astype(np.int32), 1, cv2.LINE_8, 3)

    for y, a, b in strips:
        fill(
            lane,
            [
                (x, y + s * LANE_HALF_M, -HEIGHT)
                for x, s in ((max(a - 1, 5), -1), (max(a - 1, 5), 1), (b + 8, 1), (b + 8, -1))
            ],
        )
    for x, y, _ in posts:
        side = POLE_RADIUS_M * np.array([-y, x]) / np.hypot(x, y)
        fill(
            pole,
            [
                (x + s * side[0], y + s * side[1], z)
                for z, s in ((-HEIGHT, -1), (-HEIGHT, 1), (5.0 - HEIGHT, 1), (5.0 - HEIGHT, -1))
            ],
        )
    lane, pole = (lane > 0) & (pole == 0), pole > 0
    return Masks(lane, pole, lane.astype(np.float32), pole.astype(np.float32), scale, scale)


def disturbed(T, rng, *, angle=MOST_ANGLE, shift=1.0):
    """A start that is off by up to 6 deg and 1 m on each axis (FORMULAS B (14))."""
    R = se3.exp_so3(rng.uniform(-angle, angle, 3)) @ T[:3, :3]
    return se3.transform(R, T[:3, 3] + rng.uniform(-shift, shift, 3))


def lines_of(rng, T, strips, posts, *, camera=CAMERA, sigma_px=1.0, sigma_m=0.03):
    """Cloud lines and image lines of a road as fits of noisy points and pixels give them; poles unsorted.

    The image shows a lane until 40 m, or as far as the paint goes, and a pole from its foot up to the border.
    """
    cloud, image = [], []
    for y, a, b in strips:
        ends = np.array([[a, y, -HEIGHT], [b, y, -HEIGHT]])
        cloud.append(fitted("lane", ends, rng, 40, sigma_m))
        image += _imaged("lane", np.array([[a, y, -HEIGHT], [b + 6, y, -HEIGHT]]), T, camera, sigma_px, rng)
    for x, y, top in posts:
        lean = rng.normal(0, np.radians(0.7), 2)
        up = np.array([*lean, 1.0])
        foot = np.array([x, y, -HEIGHT])
        cloud.append(
            fitted("pole", np.stack([foot + 0.73 * up, foot + (top + HEIGHT) * up]), rng, 15, sigma_m)
        )
        image += _imaged("pole", np.stack([foot, foot + 5.0 * up]), T, camera, sigma_px, rng)
    return cloud, image


def fitted(label, ends, rng, count=15, sigma_m=0.03):
    """A cloud line as a fit of noisy points between two ends gives it; either end may come first."""
    along = ends[1] - ends[0]
    xyz = ends[0] + np.sort(rng.uniform(0, 1, count))[:, None] * along + rng.normal(0, sigma_m, (count, 3))
    line = cloud_line(label, total_least_squares(xyz), np.arange(count))
    if rng.random() < 0.5:
        return line
    length = float(np.linalg.norm(line.end - line.start))
    return CloudLine(
        label, line.end, line.start, line.points, line.sigma_m, line.spread, length - line.mean_m
    )


def _imaged(label, ends, T, camera, sigma_px, rng):
    """The part of a projected segment inside the image, as a list of one line or none."""
    share = np.linspace(0, 1, 400)[:, None]
    uv, seen = project(camera, se3.apply(T, ends[0] + share * (ends[1] - ends[0])))
    if seen.sum() < 20:
        return []
    shown = uv[seen]
    start, end = (shown[k] + rng.normal(0, sigma_px, 2) for k in (0, -1))
    return [ImageLine(label, start, end, sigma_px)] if np.linalg.norm(end - start) > 25 else []
