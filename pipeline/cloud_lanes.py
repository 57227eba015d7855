"""Painted lines on the ground of one sweep: straight rows of marks that chance does not make (CRLF (3)).

Works on unorganised clouds in any LiDAR frame: the plan view comes from the fitted ground, and brightness is
compared along the track of one beam (``paint_marks``).
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline.cloud_lines import cloud_line, total_least_squares, unrepeated
from pipeline.ground import Ground, plane_basis
from pipeline.paint_marks import PaintMarks, along_tracks
from pipeline.records import CloudLine, Floats, PointCloud
from pipeline.rings import has_rings

Bools: TypeAlias = NDArray[np.bool_]
Indices: TypeAlias = NDArray[np.int64]
Weights: TypeAlias = NDArray[np.float32]

LANE_RANGE_M = (2.0, 50.0)
"""m, horizontal; nearer is the vehicle itself, further a lane line has less than one ring per dash."""
MAX_MARKS = 400
"""Marks kept for the search of lines, the clearest; more only cost time."""
HYPOTHESES = 3000
"""Pairs of marks tried: a line that holds 4 % of the marks is missed with 1 %."""
PAIR_M = (3.0, 30.0)
"""m; a shorter pair has no direction, a longer one bends with the road."""
STROKE_M = 0.15
"""m; half width of a row of marks: their middles scatter by 3 to 5 cm, and roads bend."""
REFIT_M = (0.20, 0.15, 0.10)
"""m; half widths of the refits: the last shed marks beside the paint, which at a far end turn the line."""
CORE_M = 0.07
"""m; half width within which the ground of a line is asked for its rise: half of usual paint."""
FLANK_M = (0.35, 1.5)
"""m beside a line; what rises there rises by chance."""
MIN_FLANK = 20
"""Points of the flanks below which their rises have no spread."""
SURE_SIGMAS = 6.0
"""Standard errors by which the mean rise of a line's tracks exceeds that of its flanks: of some 1e5 rows that
marks may form the highest reaches 4.5 by chance."""
BACKED_M, BACKED_SHARE = 1.5, 0.34
"""m along a row to each side of a mark, and the share of the tracks there that are marked, at least: between
dashes and beyond the last one chance marks a few."""
CLAIM_M = 0.30
"""m; D0 of CRLF (3): marks so near to a found line belong to it, and to no second one."""
MAX_GAP_M = 13.0
"""m; dashes of one line stand at most 12 m apart (9 to 12 m on motorways)."""
MIN_LANE_M = 5.0
"""m; a shorter row is an arrow, a letter or a cover."""
MIN_TRACKS = 5
"""Tracks with a mark in the row: with fewer two strokes of a letter make one."""
FINALISTS = 6
"""Pairs with the highest rise on their line that are looked at closely."""
MIN_REACH_CHANGE_M = 0.3
"""m; a chord of one scan ring changes its range by less: one laser may read bright."""
MAX_LANES = 12
"""Lines per sweep; a road of six lanes has seven."""
MAX_FAILURES = 4
"""Rows that turned out to be none before the search ends: the strongest come first."""


def find_lanes(
    cloud: PointCloud, ground: Ground, seen: Bools, rng: np.random.Generator, *, origin: Floats | None = None
) -> list[CloudLine]:
    """Finds the painted lines of a sweep.

    Args:
        cloud: The sweep; without intensity there is no paint to see and the list is empty.
        ground: Its ground.
        seen: bool (N,), points that may take part (those in view of the camera).
        rng: Draws the pairs.
        origin: float64 (3,), where the sensor stands in the cloud's frame (``sensor_seat``); None: at
            its origin.

    Returns:
        Lines in no particular order; dashes of one line are one line.
    """
    if cloud.intensity is None:
        return []
    sensor = np.zeros(3) if origin is None else origin
    index = unrepeated(cloud.xyz, np.flatnonzero(ground.inliers & seen))
    # Tracks of beams and ranges are those about the sensor, wherever the cloud's frame has its origin.
    plan = (cloud.xyz[index] - sensor) @ plane_basis(ground.normal).T
    reach = np.hypot(plan[:, 0], plan[:, 1])
    near = (reach > LANE_RANGE_M[0]) & (reach < LANE_RANGE_M[1])
    index, plan, reach = index[near], plan[near], reach[near]
    shade = np.asarray(cloud.intensity[index], dtype=np.float64)
    ring = None
    if cloud.ring is not None and has_rings(cloud):
        ring = cloud.ring[index].astype(np.int64)
    paint = _Paint(plan, shade, along_tracks(plan, shade, ring, float(ground.heights(sensor))))
    lines = []
    for row in _rows(paint, rng):
        members = index[row]
        lines.append(cloud_line("lane", total_least_squares(cloud.xyz[members].astype(np.float64)), members))
    return lines


@dataclass(frozen=True, slots=True, eq=False)
class _Paint:
    """Points of the ground in the plan (N,2), their intensity (N,) and the marks along their tracks."""

    plan: Floats
    shade: Floats
    marks: PaintMarks


def _rows(paint: _Paint, rng: np.random.Generator) -> list[Indices]:
    """Points of each straight row of marks that is no chance."""
    marks = paint.marks
    chosen = np.argsort(marks.rise, kind="stable")[::-1][:MAX_MARKS]
    plan, rise = marks.plan[chosen], marks.rise[chosen].astype(np.float32)
    on_line = _through_pairs(plan, rng)
    free = np.ones(len(chosen), dtype=bool)
    rows: list[Indices] = []
    failures = 0
    while len(rows) < MAX_LANES and failures < MAX_FAILURES and free.sum() >= MIN_TRACKS and len(on_line):
        order = np.argsort(on_line @ (rise * free), kind="stable")[::-1][:FINALISTS]
        starts = [free & (on_line[k] > 0) for k in order.tolist()]
        # Many pairs lie on one line and end in one row.
        refined = list({row.tobytes(): row for row in (_refined(plan, start) for start in starts)}.values())
        clear = [_clearness(paint, chosen[row]) for row in refined]
        best = int(np.argmax(clear))
        taken = free & _claims(plan[refined[best]], plan) if clear[best] >= SURE_SIGMAS else None
        # A row may settle on marks of an earlier one: it takes nothing more, and would come again for ever.
        if taken is not None and taken.any():
            free &= ~taken
            row = _backed(paint, chosen[refined[best]])
            if _long_enough(marks, row):
                rows.append(_members(paint, row))
        else:
            failures += 1
            free &= ~starts[0]
    return rows


def _through_pairs(plan: Floats, rng: np.random.Generator) -> Weights:
    """Which of the marks (M,) lie on the lines through two of them, float32 (H,M), 0 or 1."""
    if len(plan) == 0:
        return np.zeros((0, 0), dtype=np.float32)
    first, second = rng.integers(0, len(plan), (2, HYPOTHESES))
    span = plan[second] - plan[first]
    length = np.hypot(span[:, 0], span[:, 1])
    fit = (length > PAIR_M[0]) & (length < PAIR_M[1])
    origin, direction = plan[first[fit]], span[fit] / length[fit, None]
    normal = np.column_stack([-direction[:, 1], direction[:, 0]]).astype(np.float32)
    middle = (origin * normal).sum(axis=1).astype(np.float32)
    across = np.abs(normal @ plan.T.astype(np.float32) - middle[:, None])
    return np.asarray(across < STROKE_M, dtype=np.float32)


def _refined(plan: Floats, start: Bools) -> Indices:
    """Which of the marks (M,2) are the row that begins as the line through some of them."""
    members = np.flatnonzero(start)
    for half_width in REFIT_M:
        if len(members) < MIN_TRACKS:
            break
        along, across = _row_frame(plan, plan[members])
        members = _longest_run(along, np.abs(across) < half_width)
    return members


def _long_enough(marks: PaintMarks, row: Indices) -> bool:
    """Whether a row of marks has tracks and length enough for a line and is no chord of one track."""
    if len(np.unique(marks.track[row])) < MIN_TRACKS:
        return False
    own = marks.plan[row]
    along = _row_frame(own, own)[0]
    reach = np.hypot(own[:, 0], own[:, 1])
    return bool(np.ptp(along) >= MIN_LANE_M and np.ptp(reach) >= MIN_REACH_CHANGE_M)


def _clearness(paint: _Paint, row: Indices) -> float:
    """Standard errors by which the tracks under a row of marks rise above those beside it; -inf: no row.

    Every track that crosses the row counts, whether or not it was marked, so that nothing was chosen for
    being bright but the line itself.
    """
    marks = paint.marks
    if not _long_enough(marks, row):
        return -math.inf
    own = marks.plan[row]
    along, across = _row_frame(paint.plan, own)
    extent = _row_frame(own, own)[0]
    span = (along >= extent.min()) & (along <= extent.max())
    off = np.abs(across)
    core = np.flatnonzero(span & (off < CORE_M))
    flank = marks.rise_of_point[span & (off > FLANK_M[0]) & (off < FLANK_M[1])]
    if len(core) == 0 or len(flank) < MIN_FLANK:
        return -math.inf
    _, track = np.unique(marks.track_of_point[core], return_inverse=True)
    rise = np.bincount(track, weights=marks.rise_of_point[core]) / np.bincount(track)
    return float((rise.mean() - flank.mean()) / max(flank.std(), 1.0) * np.sqrt(len(rise)))


def _backed(paint: _Paint, row: Indices) -> Indices:
    """The marks of a row among tracks of which enough are marked."""
    marks = paint.marks
    own, _ = _row_frame(marks.plan[row], marks.plan[row])
    along, across = _row_frame(paint.plan, marks.plan[row])
    core = np.flatnonzero(np.abs(across) < CORE_M)
    numbers, track = np.unique(marks.track_of_point[core], return_inverse=True)
    place = np.bincount(track, weights=along[core]) / np.bincount(track)
    order = np.argsort(place)
    hits = np.concatenate([[0], np.cumsum(np.isin(numbers, marks.track[row])[order])])
    low, high = (np.searchsorted(place[order], own + side) for side in (-BACKED_M, BACKED_M))
    backed = hits[high] - hits[low] >= BACKED_SHARE * (high - low)
    return np.asarray(row[backed])


def _members(paint: _Paint, row: Indices) -> Indices:
    """Points of the ground on the line of a row that are the brighter ones of their mark: those on paint."""
    marks = paint.marks
    chosen = np.zeros(len(marks.plan) + 1, dtype=bool)
    chosen[row] = True
    inside = np.flatnonzero(chosen[marks.of_point])
    mark, shade = marks.of_point[inside], paint.shade[inside]
    mean = np.bincount(mark, weights=shade) / np.maximum(np.bincount(mark), 1)
    _, across = _row_frame(paint.plan[inside], marks.plan[row])
    return inside[(shade >= mean[mark]) & (np.abs(across) < REFIT_M[-1])]


def _claims(row: Floats, plan: Floats) -> Bools:
    """Places (N,2) of the plan so near to a row of places (M,2) that no other row may use them."""
    own, _ = _row_frame(row, row)
    along, across = _row_frame(plan, row)
    return np.asarray((along >= own.min()) & (along <= own.max()) & (np.abs(across) < CLAIM_M))


def _row_frame(plan: Floats, members: Floats) -> tuple[Floats, Floats]:
    """Coordinates (N,) along and across the line through some places (M,2) of the plan."""
    mean = members.mean(axis=0)
    (xx, xy), (_, yy) = (members - mean).T @ (members - mean)
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    direction = np.array([math.cos(angle), math.sin(angle)])
    centred = plan - mean
    return centred @ direction, centred @ np.array([-direction[1], direction[0]])


def _longest_run(along: Floats, inside: Bools) -> Indices:
    """Of the places inside, those of the longest stretch without a gap wider than two dashes may leave."""
    where = np.flatnonzero(inside)
    order = where[np.argsort(along[where])]
    cuts = np.flatnonzero(np.diff(along[order]) > MAX_GAP_M) + 1
    runs = np.split(order, cuts) if len(cuts) else [order]
    longest = max(runs, key=lambda run: float(along[run[-1]] - along[run[0]]) if len(run) else 0.0)
    return np.sort(longest)
