"""Lines that no scene has, and scenes that leave a freedom: what a broken mask or a bare street may give."""

import numpy as np

from pipeline import plk, se3
from pipeline.line_witness import LineFrame
from pipeline.records import CloudLine, ImageLine

ASIDE = np.array([0.0, 1.0, 0.0])
BROKEN = (np.nan, np.inf, -np.inf, 1e30, 1e300)


def cloud_line(label, start, end, *, sigma_m=0.03, spread=100.0, mean_m=None):
    ends = (np.asarray(end, dtype=np.float64) for end in (start, end))
    return CloudLine(label, *ends, np.arange(12), sigma_m, spread, mean_m)


def image_line(label, start, end, sigma_px=1.0):
    return ImageLine(label, *(np.asarray(end, dtype=np.float64) for end in (start, end)), sigma_px)


def broken_cloud_lines(label):
    """Lines with a figure that is none, each otherwise where a good one may be."""
    start, end = (8.0, 1.8, -1.73), (25.0, 1.8, -1.73)
    for bad in BROKEN:
        yield cloud_line(label, (bad, *start[1:]), end)
        yield cloud_line(label, start, (25.0, bad, bad))
        yield cloud_line(label, (bad, bad, bad), (bad, bad, bad))
        yield cloud_line(label, start, end, sigma_m=bad)
    yield cloud_line(label, start, start)


def broken_image_lines(label):
    """Likewise of the image."""
    start, end = (500.0, 330.0), (590.0, 200.0)
    for bad in BROKEN:
        yield image_line(label, (bad, 330.0), end)
        yield image_line(label, start, (bad, bad))
        yield image_line(label, (bad, bad), (bad, bad))
        yield image_line(label, start, end, bad)
    yield image_line(label, start, start)


def line_frame(cloud, image):
    return LineFrame(tuple(cloud), tuple(image), (), ASIDE)


def thousand_lines(rng, count=1000):
    """So many lanes and poles in cloud and image, anywhere."""
    feet = rng.uniform((4.0, -30.0, -1.8), (60.0, 30.0, -1.6), (count, 3))
    cloud = [cloud_line("lane", foot, np.add(foot, (20.0, 0.0, 0.0))) for foot in feet]
    cloud += [cloud_line("pole", foot, np.add(foot, (0.0, 0.0, 3.0))) for foot in feet]
    places = rng.uniform((0.0, 0.0), (1242.0, 375.0), (count, 2))
    image = [image_line("lane", place, place + rng.normal(0, 100, 2)) for place in places]
    image += [image_line("pole", place, np.add(place, (2.0, 90.0))) for place in places]
    return cloud, image


def pose(rng):
    """Any extrinsic."""
    return se3.transform(se3.exp_so3(rng.normal(0, 1.5, 3)), rng.normal(0, 1.0, 3))


def pairs_of(T_cam_lidar, K, cam_ends, sigma_px=0.5):
    """Pairs for the solvers from segments (N,2,3) in camera axes, seen without noise."""
    back = se3.inverse(T_cam_lidar)
    start, end = (se3.apply(back, cam_ends[:, k]) for k in (0, 1))
    uv = cam_ends @ K.T
    uv = uv[..., :2] / uv[..., 2:]
    return plk.LinePairs(start, end, uv[:, 0], uv[:, 1], np.tile(sigma_px**2 * np.eye(2), (len(start), 1, 1)))


def parallel_segments(rng, count):
    """Segments (N,2,3) in camera axes, before the camera, along one direction, and the direction."""
    along = rng.normal(size=3)
    along /= np.linalg.norm(along)
    middle = rng.uniform((-3, -2, 7), (3, 2, 12), (count, 3))
    return np.stack([middle - 1.5 * along, middle + 1.5 * along], axis=1), along


def concurrent_segments(rng, count):
    """Segments through one point, and the direction of its ray."""
    point = rng.uniform((-2, -1, 8), (2, 1, 12))
    along = rng.normal(size=(count, 3))
    along *= 1.5 / np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([point - 0.3 * along, point + along], axis=1), point / np.linalg.norm(point)


def flat_segments(rng, count):
    """Segments in one plane through the camera centre, and the plane's normal."""
    first, second = rng.normal(size=(2, 3)) * (0.3, 0.3, 0.0) + (0.0, 0.0, 1.0)
    weight = rng.uniform(3.0, 6.0, (count, 2, 2))
    normal = np.cross(first, second)
    return weight @ np.stack([first, second]), normal / np.linalg.norm(normal)
