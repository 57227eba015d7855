"""A straight road of lanes and poles (FORMULAS D5) as lines, as points and as a drawn image."""

import cv2
import numpy as np

from pipeline import se3
from pipeline.records import CameraImage, CameraModel, CloudLine, ImageLine, Masks, PointCloud

UP = np.array([0.0, 0.0, 1.0])
FORWARD = np.array([1.0, 0.0, 0.0])
HEIGHT = 1.73
CAMERA = CameraModel(
    "pinhole",
    np.array([[721.5, 0.0, 609.6], [0.0, 721.5, 172.9], [0.0, 0.0, 1.0]]),
    np.zeros(0),
    1242,
    375,
)
_R = se3.AXES_CAM_IN_VEHICLE.T
TRUTH = se3.transform(_R, -_R @ np.array([0.27, 0.0, -0.08]))
LANES = [(1.8, 6.5), (-1.8, 6.5), (5.4, 10.0), (-5.4, 10.0)]
"""(y, first x) in metres; all end at 30 m."""
POLES = [(12.0, 5.0), (18.0, -6.0), (25.0, 6.0), (32.0, -6.0)]
"""(x, y)."""


def lane_ends(lanes=LANES, far=30.0):
    return [(np.array([x, y, -HEIGHT]), np.array([far, y, -HEIGHT])) for y, x in lanes]


def pole_ends(poles=POLES):
    return [
        (np.array([x, y, -HEIGHT + 0.5]), np.array([x, y, min(4.0 - HEIGHT, np.hypot(x, y) * 0.035)]))
        for x, y in poles
    ]


def fitted(label, start, end, count, sigma_m, rng):
    """A cloud line as a fit of noisy points evenly spread between two ends gives it."""
    share = np.sort(rng.uniform(0, 1, count))
    points = start + share[:, None] * (end - start) + rng.normal(0, sigma_m, (count, 3))
    mean = points.mean(axis=0)
    direction = np.linalg.svd(points - mean)[2][0]
    direction *= np.sign(direction @ (end - start))
    along = (points - mean) @ direction
    low, high = along.min(), along.max()
    return CloudLine(
        label,
        mean + low * direction,
        mean + high * direction,
        np.arange(count),
        sigma_m,
        float((along**2).sum()),
        -float(low),
    )


def imaged(label, start, end, sigma_px, rng, T_cam_lidar=TRUTH, K=CAMERA.K):
    """The image line of a 3-D segment, with noise at its ends."""
    uv = se3.apply(T_cam_lidar, np.stack([start, end])) @ K.T
    uv = uv[:, :2] / uv[:, 2:] + rng.normal(0, sigma_px, (2, 2))
    return ImageLine(label, uv[0], uv[1], sigma_px)


def line_sets(rng, *, lanes=LANES, poles=POLES, sigma_px=1.0, sigma_m=0.03, T_cam_lidar=TRUTH):
    """Cloud lines and image lines of one frame, in the same order."""
    cloud, image = [], []
    for label, ends, count in (("lane", lane_ends(lanes), 40), ("pole", pole_ends(poles), 12)):
        for start, end in ends:
            cloud.append(fitted(label, start, end, count, sigma_m, rng))
            image.append(imaged(label, start, end, sigma_px, rng, T_cam_lidar))
    return cloud, image


def sampled_cloud(
    rng, *, lanes=LANES, poles=POLES, radius=0.08, noise=0.02, dash=None, turn=None, rings_deg=0.33
):
    """Points of road, paint and pole fronts as a spinning sensor might give them.

    Returns the cloud; ``turn`` (3,3) turns its frame.
    """
    # 0.18 deg from return to return.
    elevation, angle = np.meshgrid(np.radians(np.arange(2.4, 24.0, rings_deg)), np.arange(-0.9, 0.9, 0.0031))
    angle = angle.ravel() + rng.uniform(0, 0.0031, angle.size)
    reach = HEIGHT / np.tan(elevation.ravel())
    road = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), np.full(len(reach), -HEIGHT)])
    painted = np.zeros(len(road), dtype=bool)
    for y, first in lanes:
        on = (np.abs(road[:, 1] - y) < 0.075) & (road[:, 0] > first) & (road[:, 0] < 30.0)
        if dash is not None:
            on &= road[:, 0] % sum(dash) < dash[0]
        painted |= on
    intensity = np.where(painted, 0.45, 0.2) + rng.normal(0, 0.03, len(road))
    parts, shades = [road], [intensity]
    for x, y in poles:
        heights = np.arange(-HEIGHT, min(4.0 - HEIGHT, np.hypot(x, y) * 0.035), np.hypot(x, y) * 0.0058)
        across = np.arange(-radius, radius, 0.0031 * np.hypot(x, y)) + rng.uniform(0, 0.002)
        sight = np.array([x, y]) / np.hypot(x, y)
        h, a = (grid.ravel() for grid in np.meshgrid(heights, across))
        depth = -np.sqrt(np.maximum(radius**2 - a**2, 0.0))
        plan = np.array([x, y]) + a[:, None] * [-sight[1], sight[0]] + depth[:, None] * sight
        parts.append(np.column_stack([plan, h]))
        shades.append(np.full(len(h), 0.3))
    xyz = np.concatenate(parts)
    xyz *= 1.0 + rng.normal(0, noise, (len(xyz), 1)) / np.linalg.norm(xyz, axis=1, keepdims=True)
    if turn is not None:
        xyz = xyz @ turn.T
    return PointCloud(xyz.astype(np.float32), np.clip(np.concatenate(shades), 0, 1).astype(np.float32))


def masks_of(lane, pole, scale=0.5):
    """Masks on a coarser grid from boolean masks of the full image."""
    grids = []
    for full in (lane, pole):
        height, width = full.shape
        size = (round(width * scale), round(height * scale))
        grids.append(cv2.resize(full.astype(np.float32), size, interpolation=cv2.INTER_AREA))
    return Masks(grids[0] >= 0.5, grids[1] >= 0.5, *grids, scale, scale)


def draw(strokes, *, size=(480, 320), grey=(90, 200), noise=2.0, rng=None, scale=0.5):
    """Strokes (label, start, end, width px) on an even background, with their masks."""
    width, height = size
    fine = 4
    picture = np.zeros((height, width), dtype=np.float64)
    masks = {"lane": np.zeros((height, width), dtype=bool), "pole": np.zeros((height, width), dtype=bool)}
    for label, first, last, thickness in strokes:
        canvas = np.zeros((height * fine, width * fine), dtype=np.uint8)
        start, end = np.asarray(first, float), np.asarray(last, float)
        along = (end - start) / np.linalg.norm(end - start)
        normal = 0.5 * thickness * np.array([-along[1], along[0]])
        corners = (np.array([start + normal, end + normal, end - normal, start - normal]) + 0.5) * fine - 0.5
        cv2.fillConvexPoly(canvas, np.rint(corners * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
        cover = canvas.reshape(height, fine, width, fine).mean(axis=(1, 3)) / 255
        picture = np.maximum(picture, cover)
        masks[label] |= cover > 0.5
    pixels = grey[0] + (grey[1] - grey[0]) * picture
    if rng is not None:
        pixels = pixels + rng.normal(0, noise, pixels.shape)
    pixels = np.clip(np.rint(pixels), 0, 255).astype(np.uint8)
    return CameraImage(np.repeat(pixels[..., None], 3, axis=2)), masks_of(masks["lane"], masks["pole"], scale)
