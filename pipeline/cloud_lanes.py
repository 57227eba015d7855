"""Painted lines on the ground of one sweep: bright against their surroundings, straight, narrow (CRLF (3)).

Works on unorganised clouds in any LiDAR frame: the plan view comes from the fitted ground, and brightness is
compared with the ground around each point, for neither the angle nor the range leaves intensities alike.
"""

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import pdtrc

from pipeline.cloud_lines import cloud_line, total_least_squares
from pipeline.ground import Ground, plane_basis
from pipeline.records import CloudLine, Floats, PointCloud

Bools: TypeAlias = NDArray[np.bool_]

LANE_RANGE_M = (2.0, 50.0)
"""m, horizontal; nearer is the vehicle itself, further a lane line has less than one ring per dash."""
CELL_M = 0.5
"""m; cell of the plan in which brightness is compared."""
BOX_CELLS = 7
"""Cells; the 3.5 m around a point are its background: one lane, of which paint fills 4 %."""
BRIGHT_SIGMAS = 2.0
"""CRLF takes mean + sigma of all ground; above the local background paint that fills 4 % stands 5."""
CELL_SHARE = 0.08
"""Share of a cell's echoes that are bright, at least: chance makes 0.02, a stroke through the cell 0.3."""
MIN_BACKGROUND = 10
"""Points in the box below which its mean and sigma mean nothing."""
MAX_BRIGHT = 1000
"""Bright points kept for the search of lines; more only cost time."""
HYPOTHESES = 400
"""Point pairs tried per line: a line that holds 10 % of the bright points is missed with 2 %."""
PAIR_M = (3.0, 30.0)
"""m; a shorter pair has no direction, a longer one bends with the road."""
STROKE_M = 0.12
"""m; half width of a stroke with the range noise: paint is 0.10 to 0.20 m wide."""
REFIT_M = (0.12, 0.10, 0.08, 0.08)
"""m; half widths of the refits: the last shed echoes beside the paint, which at a far end turn the line."""
FLANK_M = (0.25, 0.60)
"""m; beside a stroke nothing is bright; a patch of bright ground has no such flanks."""
PAINTED_SHARE = 0.2
"""Share of a metre's echoes in the stroke that are bright, at least: chance gives 0.02, paint a half."""
CHANCE = 1e-7
"""Probability that ground as bright as the flanks fills the stroke so much: some 1e4 strokes compete."""
CLAIM_M = 0.30
"""m; D0 of CRLF (3): bright points so near to a found line belong to it, and to no second one."""
MAX_GAP_M = 13.0
"""m; dashes of one line stand at most 12 m apart (9 to 12 m on motorways)."""
MIN_LANE_M = 5.0
"""m; a shorter stroke is an arrow, a letter or a cover."""
MIN_LANE_POINTS = 12
MIN_LANE_METRES = 4
"""Metres along the line with a bright point in them: a few echoes of one cover are no line."""
FINALISTS = 20
"""Pairs with most echoes that are looked at metre by metre."""
METRE_ECHOES = 3
"""Echoes of a metre that count: paint gives some on every metre of a dash, chance one here and there."""
MIN_REACH_CHANGE_M = 0.3
"""m; a chord of one scan ring changes its range by less: one laser may read bright."""
MAX_LANES = 12
"""Lines per sweep; a road of six lanes has seven."""
MAX_FAILURES = 6
"""Strokes that turned out to be none before the search ends: the strongest come first."""


def find_lanes(cloud: PointCloud, ground: Ground, seen: Bools, rng: np.random.Generator) -> list[CloudLine]:
    """Finds the painted lines of a sweep.

    Args:
        cloud: The sweep; without intensity there is no paint to see and the list is empty.
        ground: Its ground plane.
        seen: bool (N,), points that may take part (those in view of the camera).
        rng: Draws the pairs.

    Returns:
        Lines in no particular order; dashes of one line are one line.
    """
    if cloud.intensity is None:
        return []
    index = np.flatnonzero(ground.inliers & seen)
    plan = np.asarray(cloud.xyz[index], dtype=np.float64) @ plane_basis(ground.normal).T
    reach = np.hypot(plan[:, 0], plan[:, 1])
    near = (reach > LANE_RANGE_M[0]) & (reach < LANE_RANGE_M[1])
    index, plan = index[near], plan[near]
    shade = np.asarray(cloud.intensity[index], dtype=np.float64)
    surface = _Surface(plan, shade, _bright(plan, shade))
    points = plan[surface.bright]
    if len(points) > MAX_BRIGHT:
        points = points[rng.choice(len(points), MAX_BRIGHT, replace=False)]
    lines: list[CloudLine] = []
    failures = 0
    while len(lines) < MAX_LANES and failures < MAX_FAILURES and len(points) >= MIN_LANE_POINTS:
        first = _best_stroke(points, rng)
        if first is None:
            break
        stroke = _refined_stroke(surface, points[first])
        claimed = first
        if stroke.sum() >= MIN_LANE_POINTS:
            claimed = claimed | _claimed(points, plan[stroke])
        if stroke.sum() >= MIN_LANE_POINTS and _is_painted(surface, stroke):
            members = index[stroke]
            axis = total_least_squares(cloud.xyz[members].astype(np.float64))
            lines.append(cloud_line("lane", axis, members))
        else:
            failures += 1
        points = points[~claimed]
    return lines


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """Ground points in the plan, float64 (N,2), their intensity (N,) and whether they are bright (N,)."""

    plan: Floats
    shade: Floats
    bright: Bools


def _bright(plan: Floats, shade: Floats) -> Bools:
    """Points (N,) brighter than the ground around them, by box filters over cells of the plan (N,2)."""
    if len(plan) == 0:
        return np.zeros(0, dtype=bool)
    low = plan.min(axis=0)
    column, row = np.floor((plan - low) / CELL_M).astype(np.int64).T
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    cell = row * shape[1] + column

    def box(weights: Floats | None) -> Floats:
        sums = np.bincount(cell, weights=weights, minlength=shape[0] * shape[1]).reshape(shape)
        filtered = cv2.boxFilter(
            sums.astype(np.float64),
            -1,
            (BOX_CELLS, BOX_CELLS),
            normalize=False,
            borderType=cv2.BORDER_CONSTANT,
        )
        return np.asarray(filtered.ravel()[cell], dtype=np.float64)

    count = box(None)
    # Sums about the overall mean: squares of small differences keep their digits.
    centred = shade - shade.mean()
    mean = box(centred) / count
    sigma = np.sqrt(np.maximum(box(centred**2) / count - mean**2, 0.0))
    bright = (count >= MIN_BACKGROUND) & (centred > mean + BRIGHT_SIGMAS * sigma) & (sigma > 0)
    lit = np.bincount(cell[bright], minlength=shape[0] * shape[1])
    return np.asarray(bright & (lit >= CELL_SHARE * np.bincount(cell, minlength=lit.size))[cell])


def _best_stroke(points: Floats, rng: np.random.Generator) -> Bools | None:
    """Which of the bright points (N,2) lie on the line through two of them that covers its metres best."""
    first, second = rng.integers(0, len(points), (2, HYPOTHESES))
    span = points[second] - points[first]
    length = np.hypot(span[:, 0], span[:, 1])
    fit = (length > PAIR_M[0]) & (length < PAIR_M[1])
    if not fit.any():
        return None
    origin, direction = points[first[fit]], span[fit] / length[fit, None]
    normal = np.column_stack([-direction[:, 1], direction[:, 0]])
    # Far points are sparse in proportion to range and as good as near ones.
    weight = np.hypot(points[:, 0], points[:, 1])
    inside = np.abs(points @ normal.T - (origin * normal).sum(axis=1)) < STROKE_M
    best, most = 0, -1
    for candidate in np.argsort(weight @ inside)[::-1][:FINALISTS].tolist():
        along = points[inside[:, candidate]] @ direction[candidate]
        _, echoes = np.unique(np.floor(along), return_counts=True)
        cover = int(np.minimum(echoes, METRE_ECHOES).sum())
        if cover > most:
            best, most = candidate, cover
    return np.asarray(inside[:, best])


def _refined_stroke(surface: _Surface, start: Floats) -> Bools:
    """Bright points (N,) of the surface on the stroke that begins as the line through some points (M,2)."""
    members, stroke = start, np.zeros(len(surface.plan), dtype=bool)
    for half_width in REFIT_M:
        along, across = _stroke_frame(surface.plan, members)
        inside = np.abs(across) < half_width
        kept = _longest_run(along, inside & surface.bright & _painted_metres(along, inside, surface.bright))
        if kept.sum() < MIN_LANE_POINTS:
            return kept
        stroke, members = kept, surface.plan[kept]
    return stroke


def _painted_metres(along: Floats, inside: Bools, bright: Bools) -> Bools:
    """Points (N,) in metres of the stroke of which enough is bright: between dashes chance alone is."""
    metre = np.floor(along - along.min()).astype(np.int64)
    size = int(metre.max()) + 1
    lit = np.bincount(metre[inside & bright], minlength=size)
    return np.asarray((lit >= PAINTED_SHARE * np.bincount(metre[inside], minlength=size))[metre])


def _claimed(points: Floats, members: Floats) -> Bools:
    """Points (N,2) of the plan so near to the stroke of the members (M,2) that no other line may use them."""
    own, _ = _stroke_frame(members, members)
    along, across = _stroke_frame(points, members)
    return np.asarray((along >= own.min()) & (along <= own.max()) & (np.abs(across) < CLAIM_M))


def _stroke_frame(plan: Floats, members: Floats) -> tuple[Floats, Floats]:
    """Coordinates (N,) along and across the line through some points (M,2) of the plan."""
    mean = members.mean(axis=0)
    direction = np.linalg.svd(members - mean, full_matrices=False)[2][0]
    centred = plan - mean
    return centred @ direction, centred @ np.array([-direction[1], direction[0]])


def _is_painted(surface: _Surface, stroke: Bools) -> bool:
    """Whether a stroke of bright points (N,) is paint: long, no scan ring, brighter than chance makes it."""
    members = surface.plan[stroke]
    along, across = _stroke_frame(surface.plan, members)
    own = along[stroke]
    metres, echoes = np.unique(np.floor(own), return_counts=True)
    reach = np.hypot(members[:, 0], members[:, 1])
    if np.ptp(own) < MIN_LANE_M or len(metres) < MIN_LANE_METRES or np.ptp(reach) < MIN_REACH_CHANGE_M:
        return False
    # Judged over the whole length: the metres of the stroke were chosen for being bright.
    span = (along >= own.min()) & (along <= own.max())
    inside = span & (np.abs(across) < REFIT_M[-1])
    beside = span & (np.abs(across) > FLANK_M[0]) & (np.abs(across) < FLANK_M[1])
    if beside.sum() < MIN_BACKGROUND:
        return False
    # One more than counted: a few dark flank points do not prove that bright ones are rare.
    rate = (int((beside & surface.bright).sum()) + 1) / (int(beside.sum()) + 1)
    # Capped per metre, or one bright cover outvotes the metres.
    echo_count = float(np.minimum(echoes, METRE_ECHOES).sum())
    return bool(pdtrc(echo_count - 1, rate * float(inside.sum())) < CHANCE)


def _longest_run(along: Floats, inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of the points inside, those of the longest stretch without a gap wider than two dashes may leave."""
    where = np.flatnonzero(inside)
    if len(where) == 0:
        return inside
    order = where[np.argsort(along[where])]
    runs = np.split(order, np.flatnonzero(np.diff(along[order]) > MAX_GAP_M) + 1)
    longest = max(runs, key=lambda run: float(along[run[-1]] - along[run[0]]))
    kept = np.zeros_like(inside)
    kept[longest] = True
    return kept
