"""Straight edges of the image: LSD, PLK-Calib's merging, and a sub-pixel line through each (PLK V-C).

LSD says where an edge is; where exactly says the image itself: at stations across each segment the steepest
place of the grey values is a point of the edge. The points are undistorted before the fit (FORMULAS E1), so
pieces of an edge that the lens has bent lie on one line again and are merged there.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.cameras import ideal_pixels
from pipeline.image_lines import BLUR_PX, FLOOR_PX, INDEPENDENT_PX, REFERENCE_FOCAL_PX
from pipeline.records import CameraImage, CameraModel, Floats, ImageLine

MERGE_GAP_PX = 5.0
"""px; ends of two pieces of one line lie nearer than this (PLK V-C)."""
MERGE_ANGLE = math.radians(2.0)
"""rad; directions of two pieces of one line differ by less (PLK V-C)."""
MIN_LENGTH_PX = 20.0
"""px; shorter lines are dropped (PLK V-C): 0.3 px at each end of one are already 1.2 deg."""
MIN_PIECE_PX = 8.0
"""px; shorter pieces of LSD are not asked to take part in a line: their direction is chance."""
MOST_PIECES = 3000
"""Pieces looked at, the longest first: foliage gives thousands of short ones. Bounds the time."""
STATION_PX = 3.0
"""px along a piece from one cross-section to the next; nearer ones share their pixels after the blur."""
MOST_STATIONS = 32
"""Cross-sections per piece; more do not sharpen a line against its floor."""
REACH_PX = 2.5
"""px to each side in which the edge is sought: LSD's rectangles lie within 1 px of it."""
SAMPLE_PX = 0.5
"""px; step across the edge."""
MIN_STATIONS = 3
"""Points of a piece, at least: one more than a line has."""
MIN_SHARE = 0.5
"""Share of a piece's stations that show the edge, at least."""
TRIM_PX = 1.0
"""px; a point further from the median line of its piece belongs to something that crosses it."""
MAX_RMS_PX = 0.8
"""px; straight edges scatter by 0.1 to 0.4 px, leaves by more."""


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """N fitted pieces as arrays, ideal px.

    Attributes:
        ends: (N,2,2), start and end on the fitted line; the brighter side lies on one and the same hand.
        count: (N,), points.
        mean: (N,2), of the points.
        scatter: (N,3), sums xx, yy, xy of squares about the mean, px^2.
    """

    ends: Floats
    count: Floats
    mean: Floats
    scatter: Floats

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> "_Pieces":
        return _Pieces(self.ends[index], self.count[index], self.mean[index], self.scatter[index])


def find_image_segments(image: CameraImage, camera: CameraModel) -> list[ImageLine]:
    """Straight edges of the image as lines of class ``structure``, the longest first.

    Args:
        image: The image, raw.
        camera: Intrinsics of the raw image; lengths in px grow with its focal length.

    Returns:
        Lines in ideal pixels, of at least ``MIN_LENGTH_PX``.
    """
    grey = np.asarray(cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    grey, coarser = shrunk(grey, camera)
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    if found is None:
        return []
    segments = np.asarray(found, dtype=np.float64).reshape(-1, 2, 2)
    return segments_to_lines(segments, grey, coarser, camera)


def shrunk(grey: NDArray[np.uint8], camera: CameraModel) -> tuple[NDArray[np.uint8], int]:
    """The image at the resolution that is looked at, and how many of its px (to a side) one px covers.

    Lenses of long focal length blur over more px; LSD's cost grows with the px and its yield does not.
    """
    coarser = max(1, int(_unit(camera)))
    if coarser == 1 or min(grey.shape) < 2 * coarser:
        return grey, 1
    height, width = (side // coarser for side in grey.shape)
    whole = grey[: height * coarser, : width * coarser]
    small = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8), coarser


def _unit(camera: CameraModel) -> float:
    return max(1.0, float(camera.K[1, 1]) / REFERENCE_FOCAL_PX)


def segments_to_lines(
    segments: Floats, grey: NDArray[np.uint8], coarser: int, camera: CameraModel
) -> list[ImageLine]:
    """What follows LSD: sub-pixel points, undistortion, fit, merging, shortest length.

    Args:
        segments: float64 (N,2,2), rough start and end of each piece, px of ``grey``.
        grey: uint8 (H,W), the raw image as :func:`shrunk` gives it.
        coarser: Raw px to one px of ``grey``, each way.
        camera: Intrinsics of the raw image.

    Returns:
        As :func:`find_image_segments`.
    """
    unit = _unit(camera)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    order = np.argsort(-length, kind="stable")[:MOST_PIECES]
    segments = segments[order[length[order] >= MIN_PIECE_PX * unit / coarser]]
    if len(segments) == 0:
        return []
    points, piece, directed = _edge_points(segments, grey, unit / coarser)
    points = (points + 0.5) * coarser - 0.5
    if camera.model != "pinhole":
        points = ideal_pixels(camera, points)
    sound = np.isfinite(points).all(axis=1)
    pieces = _fitted(points[sound], piece[sound], directed, unit)
    return _image_lines(merge(pieces, unit), unit)


def _edge_points(
    segments: Floats, grey: NDArray[np.uint8], unit: float
) -> tuple[Floats, NDArray[np.int64], Floats]:
    """Edge points (M,2), px of ``grey``, at stations of each segment, whose they are, and its sense (N,2).

    The sense is the direction of a segment, turned so that grey values rise to its right as u, v are drawn.
    """
    span = segments[:, 1] - segments[:, 0]
    length = np.linalg.norm(span, axis=1)
    along = span / length[:, None]
    stations = np.clip((length / (STATION_PX * unit)).astype(np.int64) + 1, MIN_STATIONS, MOST_STATIONS)
    piece = np.repeat(np.arange(len(segments)), stations)
    rank = np.arange(len(piece)) - np.repeat(np.cumsum(stations) - stations, stations)
    place = segments[piece, 0] + ((rank + 0.5) / stations[piece])[:, None] * span[piece]
    across = np.column_stack([-along[:, 1], along[:, 0]])[piece]
    offset = np.arange(-REACH_PX * unit, REACH_PX * unit + SAMPLE_PX / 2, SAMPLE_PX)
    where = (place[:, None] + offset[None, :, None] * across[:, None]).astype(np.float32)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), BLUR_PX * unit)
    profile = cv2.remap(
        smooth, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    slope = (profile[:, 2:] - profile[:, :-2]).astype(np.float64)
    # One sense per piece: the other side of a thin bar is another edge.
    rise = np.bincount(piece, weights=slope[:, slope.shape[1] // 2], minlength=len(segments))
    sign = np.where(rise >= 0, 1.0, -1.0)
    slope *= sign[piece, None]
    best = slope.argmax(axis=1)
    rows = np.arange(len(piece))
    inner = np.clip(best, 1, slope.shape[1] - 2)
    before, at, after = (slope[rows, inner + k] for k in (-1, 0, 1))
    peak = (best == inner) & (at > 0)
    bend = np.minimum(before - 2.0 * at + after, -1e-9)
    shift = offset[inner + 1] + np.clip(0.5 * (before - after) / bend, -0.5, 0.5) * SAMPLE_PX
    shown = np.bincount(piece, weights=peak, minlength=len(segments))
    peak &= (shown >= np.maximum(MIN_STATIONS, MIN_SHARE * stations))[piece]
    points = place + shift[:, None] * across
    return points[peak], piece[peak], along * sign[:, None]


def _fitted(points: Floats, piece: NDArray[np.int64], directed: Floats, unit: float) -> _Pieces:
    """Lines of least squares through the points (M,2) of each piece, trimmed once; directed as (N,2) say."""
    count = len(directed)
    kept = np.ones(len(points), dtype=bool)
    pieces = _moments(points, piece, count)
    for _ in range(2):
        pieces = _moments(points[kept], piece[kept], count)
        axis = _axes(pieces.scatter)
        off = points - pieces.mean[piece]
        across = off[:, 1] * axis[piece, 0] - off[:, 0] * axis[piece, 1]
        kept = np.abs(across) <= TRIM_PX * unit
    pieces = _moments(points[kept], piece[kept], count)
    axis = _axes(pieces.scatter)
    axis *= np.where((axis * directed).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    reach = ((points - pieces.mean[piece]) * axis[piece]).sum(axis=1)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, piece[kept], reach[kept])
    np.maximum.at(high, piece[kept], reach[kept])
    sound = (pieces.count >= MIN_STATIONS) & (_rms(pieces.scatter, pieces.count) <= MAX_RMS_PX * unit)
    low, high = np.where(sound, low, 0.0), np.where(sound, high, 0.0)
    ends = pieces.mean[:, None] + np.stack([low, high], axis=1)[:, :, None] * axis[:, None]
    return _Pieces(ends, pieces.count, pieces.mean, pieces.scatter).take(sound)


def _moments(points: Floats, piece: NDArray[np.int64], count: int) -> _Pieces:
    """Counts, means and scatters of the points of each piece; its ends are not yet known (zero)."""
    n = np.bincount(piece, minlength=count).astype(np.float64)
    safe = np.maximum(n, 1.0)
    mean = np.column_stack([np.bincount(piece, weights=x, minlength=count) / safe for x in points.T])
    x, y = (points - mean[piece]).T
    scatter = [np.bincount(piece, weights=product, minlength=count) for product in (x * x, y * y, x * y)]
    return _Pieces(np.zeros((count, 2, 2)), n, mean, np.column_stack(scatter))


def _axes(scatter: Floats) -> Floats:
    """Unit directions (N,2) of largest scatter (N,3), closed form."""
    angle = 0.5 * np.arctan2(2.0 * scatter[:, 2], scatter[:, 0] - scatter[:, 1])
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _rms(scatter: Floats, count: Floats) -> Floats:
    """Standard deviation (N,) of points across their line, px."""
    half = 0.5 * (scatter[:, 0] + scatter[:, 1])
    least = half - np.hypot(0.5 * (scatter[:, 0] - scatter[:, 1]), scatter[:, 2])
    return np.sqrt(np.maximum(least, 0.0) / np.maximum(count - 2.0, 1.0))


def merge_candidates(ends: Floats, gap: float) -> NDArray[np.int64]:
    """Pairs (M,2), first below second, of lines (N,2,2) that may be one by PLK V-C.

    Any end of the one lies nearer than ``gap`` to any end of the other, and their directions differ by less
    than ``MERGE_ANGLE``. Unlike in the paper, directions have a sense here (the brighter side): the two
    borders of a thin bar are not one line.
    """
    near = cKDTree(ends.reshape(-1, 2)).query_pairs(gap, output_type="ndarray") // 2
    near = np.unique(np.sort(near[near[:, 0] != near[:, 1]], axis=1), axis=0).astype(np.int64)
    span = ends[:, 1] - ends[:, 0]
    along = span / np.maximum(np.linalg.norm(span, axis=1), 1e-9)[:, None]
    a, b = along[near[:, 0]], along[near[:, 1]]
    angle = np.abs(np.arctan2(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0], (a * b).sum(axis=1)))
    return np.asarray(near[angle < MERGE_ANGLE])


def merge(pieces: _Pieces, unit: float) -> _Pieces:
    """Joins pieces of one line until nothing changes; what no one straight line explains stays apart."""
    # Each round has a piece less at least, and about half as many of a chain of pieces.
    while True:
        pairs = merge_candidates(pieces.ends, MERGE_GAP_PX * unit)
        joint, straight = _joined(pieces, pairs, unit)
        pairs, joint = pairs[straight], joint.take(straight)
        # The best pairs first; a piece takes part in one pair a round.
        order = np.argsort(_rms(joint.scatter, joint.count), kind="stable")
        free = np.ones(len(pieces.count), dtype=bool)
        chosen = []
        for k in order.tolist():
            i, j = int(pairs[k, 0]), int(pairs[k, 1])
            if free[i] and free[j]:
                free[i] = free[j] = False
                chosen.append(k)
        if not chosen:
            return pieces
        new, old = joint.take(np.array(chosen, dtype=np.int64)), pieces.take(free)
        pieces = _Pieces(
            np.concatenate([new.ends, old.ends]),
            np.concatenate([new.count, old.count]),
            np.concatenate([new.mean, old.mean]),
            np.concatenate([new.scatter, old.scatter]),
        )


def _joined(pieces: _Pieces, pairs: NDArray[np.int64], unit: float) -> tuple[_Pieces, NDArray[np.bool_]]:
    """Each pair (M,2) as one piece, and whether one straight line explains both."""
    a, b = pieces.take(pairs[:, 0]), pieces.take(pairs[:, 1])
    count = a.count + b.count
    mean = (a.count[:, None] * a.mean + b.count[:, None] * b.mean) / count[:, None]
    x, y = (b.mean - a.mean).T
    lever = a.count * b.count / count
    scatter = a.scatter + b.scatter + lever[:, None] * np.column_stack([x * x, y * y, x * y])
    axis = _axes(scatter)
    sense = a.ends[:, 1] - a.ends[:, 0]
    axis *= np.where((axis * sense).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    reach = np.concatenate(
        [((part.ends - mean[:, None]) * axis[:, None]).sum(axis=2) for part in (a, b)], axis=1
    )
    span = np.column_stack([reach.min(axis=1), reach.max(axis=1)])
    joint = _Pieces(mean[:, None] + span[:, :, None] * axis[:, None], count, mean, scatter)
    alone = np.maximum(_rms(a.scatter, a.count), _rms(b.scatter, b.count))
    # Each part is asked for its own mean: a short piece beside a long one has no say in the common rms.
    off = [
        np.abs((part.mean - mean)[:, 1] * axis[:, 0] - (part.mean - mean)[:, 0] * axis[:, 1])
        for part in (a, b)
    ]
    allowed = np.maximum(alone, FLOOR_PX * unit)
    straight = (_rms(scatter, count) <= 1.2 * allowed) & (np.maximum(*off) <= 2.0 * allowed)
    return joint, straight


def _image_lines(pieces: _Pieces, unit: float) -> list[ImageLine]:
    """Pieces that are long enough as records, the longest first.

    Sigma is that of the line at its ends: twice that of a mean (1/m + s^2/S of evenly spread points), where
    points nearer than ``INDEPENDENT_PX`` count as one, and the floor that no count of points averages away.
    """
    length = np.linalg.norm(pieces.ends[:, 1] - pieces.ends[:, 0], axis=1)
    independent = np.maximum(2.0, np.minimum(pieces.count, length / (INDEPENDENT_PX * unit)))
    sigma = np.hypot(2.0 * _rms(pieces.scatter, pieces.count) / np.sqrt(independent), FLOOR_PX * unit)
    order = np.argsort(-length, kind="stable")
    return [
        ImageLine("structure", pieces.ends[k, 0].copy(), pieces.ends[k, 1].copy(), float(sigma[k]))
        for k in order[: int((length >= MIN_LENGTH_PX * unit).sum())].tolist()
    ]
