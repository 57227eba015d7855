"""Centre lines of lane strokes and poles in the image, to a fraction of a pixel (FORMULAS E1).

The masks say where a stroke is, the image itself where exactly: across the stroke two edges are sought near
the borders of the mask, and their middle is a point of the line. Points are undistorted before the fit.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.cameras import ideal_pixels
from pipeline.medians import median
from pipeline.records import CameraImage, CameraModel, Floats, ImageLine, LineLabel, Masks

REFERENCE_FOCAL_PX = 720.0
"""px; lengths below are those of an image with this focal length and grow with it: they are angles."""
BLUR_PX = 0.8
"""px; takes the staircase from edges without moving them."""
GRID_PER_UNIT = 0.5
"""Grid px per px of the reference focal length: the widest poles are some 20 grid px wide."""
_HALF = 0.5
"""Share of a coarse px that must be covered."""
MIN_LENGTH_PX = 25.0
"""px; shorter strokes have no direction: 0.5 px at each end are 1.6 deg."""
HOUGH_GAP_PX = 6.0
"""px; holes in a mask that do not end a stroke."""
CORE = 0.5
"""Of the depth of a stroke; what lies deeper is its core, in which straight pieces are sought."""
MIN_FRESH = 0.5
"""Share of a Hough segment that no earlier line has claimed, at least."""
MOST_PIECES = 100
"""Pieces of one mask, before the lens is straightened and after, the longest: a street has some dozens, a
broken mask makes thousands. Bounds the time."""
STATION_PX = 1.5
"""px along the line from one cross-section to the next; nearer ones share their pixels."""
MAX_STATIONS = 200
"""Cross-sections per stroke; more do not sharpen a line against its floor."""
MAX_HALF_PROFILE_PX = 60.0
"""px; a stroke twice as wide is nothing that lies or stands at a distance."""
SAMPLE_PX = 0.5
"""px; step across the stroke."""
MIN_EDGE = 1.5
"""Grey levels per px; weaker edges are noise of an 8-bit image after the blur."""
EDGE_OVER_MEDIAN = 2.0
"""An edge stands out of its own cross-section by this factor."""
MIN_STATIONS = 8
MIN_EDGES_SHARE = 0.4
"""Share of cross-sections that show both edges, at least; below it the mask is not what it says."""
TRIM_SIGMAS = 3.0
MAX_RMS_PX = 1.5
"""px; straight strokes scatter by 0.2 to 0.5 px."""
MAX_SAG_PX = 0.75
"""px; a stroke that bends further is split in two: its middle would pull the line by half of that."""
INDEPENDENT_PX = 4.0
"""px along the line between independent edge points: the mask's and the blur's correlation length."""
FLOOR_PX = 0.3
"""px; what no count of points averages away: paint borders, a pole's taper, the lens model (FORMULAS D4)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Stroke:
    """Sub-pixel centre points (N,2), ideal px, of one straight stroke and the line through them."""

    points: Floats
    mean: Floats
    direction: Floats
    rms: float

    @property
    def along(self) -> Floats:
        return np.asarray((self.points - self.mean) @ self.direction)

    @property
    def length(self) -> float:
        return float(np.ptp(self.along))


def find_image_lines(image: CameraImage, masks: Masks, camera: CameraModel) -> list[ImageLine]:
    """Straight centre lines of all lane strokes and poles.

    Args:
        image: The image, raw.
        masks: Where lanes and poles are.
        camera: Intrinsics of the raw image.

    Returns:
        Lines in ideal pixels; dashes of one lane line are one line.
    """
    unit = max(1.0, float(camera.K[1, 1]) / REFERENCE_FOCAL_PX)
    grey = cv2.cvtColor(image.pixels, cv2.COLOR_BGR2GRAY).astype(np.float32)
    grey = np.asarray(cv2.GaussianBlur(grey, (0, 0), BLUR_PX * unit), dtype=np.float32)
    masks = _coarse(masks, unit)
    lines = []
    for label, mask in _labelled(masks):
        centres = [
            _centres(grey, label, (start, end), widths, unit)
            for start, end, widths in _segments(mask, masks, unit)
        ]
        # One call for all: the inverse of the lens costs more by call than by point.
        ideal = ideal_pixels(camera, np.concatenate([np.zeros((0, 2)), *centres]))
        strokes = []
        for points in np.split(ideal, np.cumsum([len(part) for part in centres])):
            strokes += _straight(points[np.isfinite(points).all(axis=1)], unit)
        lines += [_image_line(label, stroke, unit) for stroke in _merged(strokes, unit)]
    return lines


def _coarse(masks: Masks, unit: float) -> Masks:
    """Masks on a grid no finer than needed: a stroke that is many px wide has no core one px wide."""
    factor = int(min(masks.scale_x, masks.scale_y) * unit / GRID_PER_UNIT)
    if factor <= 1:
        return masks
    size = (max(1, masks.lane.shape[1] // factor), max(1, masks.lane.shape[0] // factor))
    lane, pole = (
        np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        for mask in (masks.lane, masks.pole)
    )
    shrink = size[0] / masks.lane.shape[1], size[1] / masks.lane.shape[0]
    return Masks(
        lane >= _HALF, pole >= _HALF, lane, pole, masks.scale_x * shrink[0], masks.scale_y * shrink[1]
    )


def _labelled(masks: Masks) -> tuple[tuple[LineLabel, NDArray[np.bool_]], ...]:
    return ("lane", masks.lane), ("pole", masks.pole)


def _segments(
    mask: NDArray[np.bool_], masks: Masks, unit: float
) -> list[tuple[Floats, Floats, tuple[float, float]]]:
    """Straight pieces of a mask's core: two ends (2,) in image px and the stroke's widths there, px."""
    # Strokes that the image's border cuts keep their width there.
    padded = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    depth = cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1]
    grid = min(masks.scale_x, masks.scale_y)
    stroke = (depth > 0) & (depth < MAX_HALF_PROFILE_PX * unit * grid)
    # Not only the maxima: along a slanted stroke they come and go with the grid.
    core = (stroke & (depth >= CORE * cv2.dilate(depth, np.ones((7, 7))))).astype(np.uint8)
    shortest, gap = MIN_LENGTH_PX * unit * grid, HOUGH_GAP_PX * unit * grid
    # One px wider: Hough's walk along a slanted line of one px width stumbles over its steps.
    wider = cv2.dilate(core, cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3)))
    votes = max(_LEAST_VOTES, int(0.5 * shortest))
    found = cv2.HoughLinesP(wider, 1.0, math.radians(0.5), votes, None, shortest, gap)
    if found is None:
        return []
    ends = found.reshape(-1, 2, 2).astype(np.float64)
    ends = ends[np.argsort(-np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))]
    row, column = np.nonzero(core)
    pixels = np.stack([column, row]).astype(np.float64)
    half_width = cv2.dilate(depth, np.ones((3, 3)))
    claimed = np.zeros(core.shape, dtype=np.uint8)
    segments = []
    scale = np.array([masks.scale_x, masks.scale_y])
    for rough in ends:
        column, row = _between(rough[0], rough[1])
        if claimed[row, column].mean() > 1.0 - MIN_FRESH:
            continue
        start, end = _settled(pixels, rough, gap)
        column, row = _between(start, end)
        # A slanted line that leaves the image between two px of its grid ends just outside.
        column, row = np.clip(column, 0, core.shape[1] - 1), np.clip(row, 0, core.shape[0] - 1)
        # The depth in the middle is half the width plus the half px to the border's centre.
        width = np.maximum(2.0 * half_width[row, column] - 1.0, 1.0) / grid
        third = max(1, len(column) // 3)
        widths = float(np.median(width[:third])), float(np.median(width[-third:]))
        cv2.line(claimed, _pixel(start), _pixel(end), 1, max(3, math.ceil(1.5 * max(widths) * grid)))
        segments.append(((start + 0.5) / scale - 0.5, (end + 0.5) / scale - 0.5, widths))
        if len(segments) == MOST_PIECES:
            break
    return segments


_LEAST_VOTES = 6
"""Core px on a Hough line, at least: fewer are on a line by chance."""
_CORRIDOR_PX = 2.0
"""Grid px to each side of a Hough line: its own tolerance and half the width of the core."""


def _between(start: Floats, end: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns and rows of the grid px from start to end."""
    count = max(2, round(float(np.abs(end - start).max())) + 1)
    share = np.arange(count) / (count - 1)
    column, row = (np.rint(a + share * (b - a)).astype(np.int64) for a, b in zip(start, end, strict=True))
    return column, row


def _settled(pixels: Floats, rough: Floats, gap: float) -> tuple[Floats, Floats]:
    """A Hough segment (2,2) turned onto the core's px (2,N) around it and prolonged as far as they go on."""
    start, end = rough
    for _ in range(3):
        length = max(math.dist(start, end), 1.0)
        direction = (end - start) / length
        x, y = pixels[0] - start[0], pixels[1] - start[1]
        near = np.flatnonzero(np.abs(y * direction[0] - x * direction[1]) <= _CORRIDOR_PX)
        along = x[near] * direction[0] + y[near] * direction[1]
        order = np.argsort(along)
        along = along[order]
        runs = np.concatenate([[0], np.flatnonzero(np.diff(along) > gap) + 1, [len(along)]])
        middle = int(np.searchsorted(runs, np.searchsorted(along, length / 2), side="right"))
        run = pixels[:, near[order[runs[max(middle, 1) - 1] : runs[max(middle, 1)]]]]
        if run.shape[1] < _LEAST_VOTES:
            break
        mean = run.sum(axis=1) / run.shape[1]
        centred = run.T - mean
        axis = _principal(centred)
        axis = axis if axis @ direction > 0 else -axis
        along = centred @ axis
        start, end = mean + along.min() * axis, mean + along.max() * axis
    return start, end


def _principal(centred: Floats) -> Floats:
    """Unit direction (2,) of largest spread of points (N,2) about their mean, in closed form."""
    (xx, xy), (_, yy) = centred.T @ centred
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    return np.array([math.cos(angle), math.sin(angle)])


def _pixel(point: Floats) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))


def _centres(
    grey: NDArray[np.float32],
    label: LineLabel,
    segment: tuple[Floats, Floats],
    widths: tuple[float, float],
    unit: float,
) -> Floats:
    """Middles (M,2), raw px, between the two edges of a stroke at stations along it; empty for no edges."""
    start, end = segment
    length = float(np.linalg.norm(end - start))
    count = int(min(MAX_STATIONS, max(2, length / STATION_PX)))
    share = np.linspace(0.0, 1.0, count)
    station = start + share[:, None] * (end - start)
    width = widths[0] + share * (widths[1] - widths[0])
    normal = np.array([start[1] - end[1], end[0] - start[0]]) / length
    # The Hough line may lie askew in a wide stroke and the mask's border a grid px off the true one.
    margin = 2.0 * unit + 0.4 * width
    reach = min(MAX_HALF_PROFILE_PX * unit, float((0.5 * width + margin).max()) + 1.0)
    offset = np.arange(-reach, reach + SAMPLE_PX / 2, SAMPLE_PX)
    where = (station[:, None, :] + offset[None, :, None] * normal).astype(np.float32)
    profile = cv2.remap(grey, where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    slope = _slope(profile.astype(np.float64))
    steepness = np.abs(slope)
    floor = np.maximum(MIN_EDGE, EDGE_OVER_MEDIAN * _row_medians(steepness))
    edges = []
    for side in (-1.0, 1.0):
        window = np.abs(offset[None, :] - side * 0.5 * width[:, None]) <= margin[:, None]
        # Each side stays on its own half, or both find the same edge of a thin stroke.
        window &= side * offset[None, :] > -0.5 * margin[:, None]
        # Paint is brighter than the road; what stands behind a pole changes along it.
        signed = steepness if label == "pole" else -side * slope
        edges.append(_peak(signed, window, offset, floor))
    left, right = edges
    both = np.isfinite(left) & np.isfinite(right)
    both[both] &= right[both] - left[both] > SAMPLE_PX
    if both.sum() < max(MIN_STATIONS, MIN_EDGES_SHARE * count):
        return np.zeros((0, 2))
    middle = 0.5 * (left[both] + right[both])
    return np.asarray(station[both] + middle[:, None] * normal)


def _slope(profile: Floats) -> Floats:
    """Change (M,K) of grey per px along each cross-section (M,K) of samples ``SAMPLE_PX`` apart."""
    slope = np.empty_like(profile)
    slope[:, 1:-1] = (profile[:, 2:] - profile[:, :-2]) / (2.0 * SAMPLE_PX)
    slope[:, 0] = (profile[:, 1] - profile[:, 0]) / SAMPLE_PX
    slope[:, -1] = (profile[:, -1] - profile[:, -2]) / SAMPLE_PX
    return slope


def _row_medians(values: Floats) -> Floats:
    """Median (M,) of each row (M,K), finite."""
    half = values.shape[1] // 2
    low = half - 1 + values.shape[1] % 2
    parted = np.partition(values, (low, half), axis=1)
    return np.asarray(0.5 * (parted[:, low] + parted[:, half]))


def _peak(signed: Floats, window: NDArray[np.bool_], offset: Floats, floor: Floats) -> Floats:
    """Offset (M,) of each cross-section's strongest slope in its window, by a parabola; NaN for none."""
    inside = np.where(window, signed, -np.inf)
    best = inside.argmax(axis=1)
    rows = np.arange(len(signed))
    safe = np.clip(best, 1, signed.shape[1] - 2)
    before, at, after = (signed[rows, safe + k] for k in (-1, 0, 1))
    is_peak = (best == safe) & (at > floor) & (at >= before) & (at >= after)
    bend = np.minimum(before - 2 * at + after, -1e-9)
    shift = np.clip(0.5 * (before - after) / bend, -0.5, 0.5)
    return np.where(is_peak, offset[safe] + shift * SAMPLE_PX, np.nan)


def _straight(points: Floats, unit: float) -> list[_Stroke]:
    """Straight strokes through centre points (N,2), ideal px; a bent one is split until straight."""
    stroke = _fit(points, unit)
    if stroke is None or stroke.length < MIN_LENGTH_PX * unit:
        return []
    along = stroke.along
    across = (stroke.points - stroke.mean) @ np.array([-stroke.direction[1], stroke.direction[0]])
    half = 0.5 * float(np.ptp(along))
    middle = 0.5 * float(along.min() + along.max())
    if abs(_sag((along - middle) / half, across)) > MAX_SAG_PX * unit:
        position = (points - stroke.mean) @ stroke.direction
        return _straight(points[position < middle], unit) + _straight(points[position >= middle], unit)
    return [stroke] if stroke.rms <= MAX_RMS_PX * unit else []


def _sag(place: Floats, across: Floats) -> float:
    """Coefficient of the square in the parabola of least squares through ``across`` (N,) at -1..1 (N,)."""
    rows = np.stack([np.ones(len(place)), place, place * place])
    return float(np.linalg.lstsq(rows @ rows.T, rows @ across, rcond=None)[0][2])


def _fit(points: Floats, unit: float) -> _Stroke | None:
    """Total least squares with trimming; None for too few points."""
    kept = np.arange(len(points))
    stroke = None
    for _ in range(4):
        if len(kept) < MIN_STATIONS:
            return None
        own = points[kept]
        mean = own.sum(axis=0) / len(own)
        direction = _principal(own - mean)
        across = np.abs((points - mean) @ np.array([-direction[1], direction[0]]))
        near = across[kept]
        stroke = _Stroke(own, mean, direction, math.sqrt(float(near @ near) / len(near)))
        before, kept = kept, np.flatnonzero(across <= TRIM_SIGMAS * max(1.48 * median(near), 0.1 * unit))
        if np.array_equal(before, kept):
            break
    return stroke


def _merged(strokes: list[_Stroke], unit: float) -> list[_Stroke]:
    """Pieces of one line joined: dashes, and what a mask's hole or Hough's tolerance had split."""
    waiting = sorted(strokes, key=lambda stroke: -stroke.length)[:MOST_PIECES]
    merged: list[_Stroke] = []
    while waiting:
        line = waiting.pop(0)
        grown = True
        while grown:
            grown = False
            for index, other in enumerate(waiting):
                joint = _joint(line, other, unit)
                if joint is not None:
                    line, grown = joint, True
                    del waiting[index]
                    break
        merged.append(line)
    return merged


def _joint(first: _Stroke, second: _Stroke, unit: float) -> _Stroke | None:
    """Both strokes as one, where one straight line explains them as well as each is explained alone."""
    along, across = (second.mean - first.mean) @ np.column_stack(
        [first.direction, [-first.direction[1], first.direction[0]]]
    )
    # Spares the fit where the other lies well off this line's continuation.
    if abs(across) > 4.0 * FLOOR_PX * unit + 0.1 * abs(along):
        return None
    points = np.concatenate([first.points, second.points])
    mean = points.sum(axis=0) / len(points)
    direction = _principal(points - mean)
    across = (points - mean) @ np.array([-direction[1], direction[0]])
    own = len(first.points)
    offset = max(abs(float(part.sum())) / len(part) for part in (across[:own], across[own:]))
    rms = math.sqrt(float(across @ across) / len(across))
    apart = max(first.rms, second.rms, FLOOR_PX * unit)
    joint = _Stroke(points, mean, direction, rms)
    fits = rms <= 1.2 * apart and offset <= apart and len(_straight(points, unit)) == 1
    return joint if fits else None


def _image_line(label: LineLabel, stroke: _Stroke, unit: float) -> ImageLine:
    """The stroke's ends and the sigma of its line there: twice the noise of a mean, and the floor."""
    along = stroke.along
    independent = max(2.0, min(len(along), stroke.length / (INDEPENDENT_PX * unit)))
    # A line's end scatters twice as much as its middle (1/m + s^2/S with evenly spread points).
    sigma = math.hypot(2.0 * stroke.rms / math.sqrt(independent), FLOOR_PX * unit)
    return ImageLine(
        label,
        stroke.mean + float(along.min()) * stroke.direction,
        stroke.mean + float(along.max()) * stroke.direction,
        sigma,
    )
