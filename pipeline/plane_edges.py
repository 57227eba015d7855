"""Lines of planes: where two of them meet, and where one ends before something further away (PLK V-C)."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipeline.planes import Cells, Plane
from pipeline.records import Floats
from pipeline.uncertain_lines import UncertainLine, across, ends_covariance

MIN_ANGLE = math.radians(25.0)
"""rad between planes that meet: the line between flatter ones is known worse than their noise by 1/sin."""
SURFACE_M = 0.01
"""m, standard deviation at each end of a line; so flat are plastered walls and even roads."""
MIN_LENGTH_M = 0.5
"""m; shorter edges are details of vehicles and plants."""
MIN_LENGTH_RAD = 0.04
"""Length over range, at least: 20 px (PLK V-C) at a focal length of 720 px are 0.028; a jump between beams
0.2 deg apart tells a direction to the 2 deg of PLK's merging from 0.04 on."""
SUPPORT_CELLS = 2.0
"""Sides of a cell from the line within which a plane has points where the line is real."""
MAX_GAP_CELLS = 3.0
"""Sides of a cell along a line without points that do not end it."""
CROSSING_SHARE = 0.25
"""Points of a plane behind another one over those before it, up to which it ends there: bodies are solid."""
MIN_BORDER_CELLS = 5
"""Cells along a border, at least."""
OPEN_ANGLE = math.radians(120.0)
"""rad; a cell whose neighbours leave so much of the plane empty lies at its border (straight: 180)."""
BORDER_TRIES = 64
"""Pairs drawn for a border; a side of a quarter of all border cells is missed with 0.94^64 = 2 %."""
BORDERS_OF_PLANE = 6
"""Borders looked for on one plane: four sides and two more."""
BEYOND_M, BEYOND_SHARE = 0.5, 0.06
"""m and share of the range by which what is seen beside a border lies further away."""
OPEN_SHARE = 0.6
"""Share of places beside a border that must see something further away; else another thing may hide it, or
the sensor's field of view ends there."""


def creases(planes: list[Plane], cells: Cells, xyz: Floats) -> list[UncertainLine]:
    """Lines where two planes meet and both have points.

    The covariance is that of both planes' fits carried through the intersection.

    Args:
        planes: Planes of the cloud.
        cells: The thinned cloud.
        xyz: float64 (N,3), its points, m, from the sensor.
    """
    lines = []
    for i, j, place, direction in _meetings(planes, xyz):
        first, second = planes[i], planes[j]
        parts = (
            _near(first, second, place, direction, cells, xyz),
            _near(second, first, place, direction, cells, xyz),
        )
        if parts[0] is None or parts[1] is None:
            continue
        along = [parts[0][1], parts[1][1]]
        points = np.concatenate([parts[0][0], parts[1][0]])
        step = float(np.median(cells.size[cells.of_point[points]]))
        for low, high in _common_runs(along, step):
            ends = place + np.array([[low], [high]]) * direction
            if not _long_enough(ends):
                continue
            s = np.concatenate(along)
            covariance = _crease_covariance(first, second, direction, ends)
            members = np.unique(points[(s >= low) & (s <= high)])
            lines.append(UncertainLine("crease", ends[0], ends[1], members, covariance))
    return lines


def _meetings(planes: list[Plane], xyz: Floats) -> list[tuple[int, int, Floats, Floats]]:
    """Pairs of planes whose common line passes through both of their neighbourhoods.

    Returns:
        Their numbers, the point of the line that is nearest to the middle between their centres, and its
        direction.
    """
    if len(planes) < 2:
        return []
    normal = np.stack([plane.normal for plane in planes])
    centre = np.stack([plane.centre for plane in planes])
    radius = np.array([np.linalg.norm(xyz[p.points] - p.centre, axis=1).max(initial=0.0) for p in planes])
    i, j = np.triu_indices(len(planes), 1)
    D = np.cross(normal[i], normal[j])
    sine = np.linalg.norm(D, axis=1)
    steep = sine >= math.sin(MIN_ANGLE)
    i, j, D, sine = i[steep], j[steep], D[steep], sine[steep, None]
    height = np.einsum("pi,pi->p", normal, centre)[:, None]
    place = (height[i] * np.cross(normal[j], D) + height[j] * np.cross(D, normal[i])) / sine**2
    direction = D / sine
    middle = 0.5 * (centre[i] + centre[j]) - place
    place = place + np.einsum("pi,pi->p", middle, direction)[:, None] * direction
    meets = np.ones(len(i), dtype=bool)
    for k in (i, j):
        offset = centre[k] - place
        offset -= np.einsum("pi,pi->p", offset, direction)[:, None] * direction
        meets &= np.linalg.norm(offset, axis=1) <= radius[k] + MIN_LENGTH_M
    return [
        (int(a), int(b), p, d)
        for a, b, p, d in zip(i[meets], j[meets], place[meets], direction[meets], strict=True)
    ]


def _near(
    plane: Plane, other: Plane, place: Floats, direction: Floats, cells: Cells, xyz: Floats
) -> tuple[NDArray[np.int64], Floats] | None:
    """Points of a plane beside the line and their positions along it; None where it passes through."""
    inward = np.cross(plane.normal, direction)
    offset = xyz[plane.points] - place
    reach = offset @ inward
    near = np.abs(reach) <= SUPPORT_CELLS * cells.size[cells.of_point[plane.points]]
    if near.sum() < MIN_BORDER_CELLS:
        return None
    along = offset[near] @ direction
    # Whether it goes on behind the other plane is asked only where it meets it.
    height = other.heights(xyz[plane.points[near]])
    beyond = np.abs(height) > _CLEAR_SIGMAS * other.sigma_m
    sides = [int((beyond & (height > 0)).sum()), int((beyond & (height < 0)).sum())]
    if min(sides) > CROSSING_SHARE * max(sides):
        return None
    return plane.points[near], along


_CLEAR_SIGMAS = 4.0
"""Sigmas of a plane within which a point is on neither side of it."""


def _common_runs(along: list[Floats], step: float) -> list[tuple[float, float]]:
    """Stretches (low, high) of a line on which all sets of positions have points without a long gap."""
    low = max(float(a.min()) for a in along)
    high = min(float(a.max()) for a in along)
    count = math.ceil((high - low) / step)
    if count < 2:
        return []
    full = np.ones(count, dtype=bool)
    for a in along:
        inside = a[(a >= low) & (a <= high)]
        full &= (
            np.bincount(np.minimum(((inside - low) / step).astype(np.int64), count - 1), minlength=count) > 0
        )
    return [(low + a * step, low + b * step) for a, b in _runs(np.flatnonzero(full), MAX_GAP_CELLS)]


def _runs(sorted_bins: NDArray[np.int64], gap: float) -> list[tuple[int, int]]:
    """Half open ranges of bins without a gap of more than ``gap``."""
    if len(sorted_bins) == 0:
        return []
    cut = np.flatnonzero(np.diff(sorted_bins) > gap)
    first = np.concatenate([[0], cut + 1])
    last = np.concatenate([cut, [len(sorted_bins) - 1]])
    return [(int(sorted_bins[a]), int(sorted_bins[b]) + 1) for a, b in zip(first, last, strict=True)]


def _long_enough(ends: Floats) -> bool:
    length = float(np.linalg.norm(ends[1] - ends[0]))
    return length >= max(MIN_LENGTH_M, MIN_LENGTH_RAD * float(np.linalg.norm(ends.mean(axis=0))))


def _crease_covariance(first: Plane, second: Plane, direction: Floats, ends: Floats) -> Floats:
    """Covariance (4,4) of both ends across the line, from those of the planes' fits.

    To each end comes what no count of points averages away: walls and roads are not planes.
    With heights e1, e2 of the true planes over the fitted ones, the line moves by N^-1 (e1, e2), N the
    normals in the axes across.
    """
    axes = across(direction, ends.mean(axis=0))
    N_inverse = np.linalg.inv(np.stack([first.normal, second.normal]) @ axes.T)
    covariance = np.zeros((4, 4))
    for k, plane in enumerate((first, second)):
        rows = plane.rows(ends)
        heights = rows @ plane.covariance @ rows.T + SURFACE_M**2 * np.eye(2)
        covariance += np.kron(heights, np.outer(N_inverse[:, k], N_inverse[:, k]))
    return covariance


def borders(
    planes: list[Plane], cells: Cells, xyz: Floats, spacing: float, rng: np.random.Generator
) -> list[UncertainLine]:
    """Straight borders of planes beside which the sensor sees something further away.

    The true border lies up to a step of the beams beyond the last cell; the line is moved out by half of
    that, and what is left of it enters the covariance in full at both ends.

    Args:
        planes: Planes of the cloud.
        cells: The thinned cloud.
        xyz: float64 (N,3), its points, m, from the sensor.
        spacing: Angle between neighbouring beams, rad.
        rng: Draws pairs of border cells.
    """
    if not planes:
        return []
    distance = np.linalg.norm(cells.position, axis=1)
    view = cKDTree(cells.position / distance[:, None])
    lines = []
    for plane in planes:
        members = np.unique(cells.of_point[plane.points])
        edge, outward = _border_cells(plane, members, cells)
        for _ in range(BORDERS_OF_PLANE):
            side = _border(cells.position[edge], outward, cells.size[edge], rng)
            if side is None:
                break
            line = _border_line(plane, cells, xyz, edge[side], outward[side])
            if line is not None and _open(line[0], line[1], view, distance, spacing):
                lines.append(line[0])
            edge, outward = edge[~side], outward[~side]
    return lines


def _border_cells(plane: Plane, members: NDArray[np.int64], cells: Cells) -> tuple[NDArray[np.int64], Floats]:
    """Cells of a plane that have much of it empty beside them, and the unit direction (E,3) there."""
    inside = np.zeros(len(cells.position), dtype=bool)
    inside[members] = True
    neighbours = cells.neighbours[members]
    offset = (cells.position[neighbours] - cells.position[members][:, None]) @ plane.basis.T
    angle = np.arctan2(offset[..., 1], offset[..., 0])
    real = inside[neighbours] & (neighbours != members[:, None])
    # Absent neighbours repeat a real one, so that they open no gap and close none.
    first = np.take_along_axis(angle, real.argmax(axis=1)[:, None], axis=1)
    angle = np.sort(np.where(real, angle, first), axis=1)
    gap = np.diff(np.concatenate([angle, angle[:, :1] + 2.0 * math.pi], axis=1), axis=1)
    widest = gap.argmax(axis=1)
    rows = np.arange(len(members))
    open_ = (gap[rows, widest] >= OPEN_ANGLE) & (real.sum(axis=1) >= _LEAST_NEIGHBOURS)
    middle = angle[rows, widest] + 0.5 * gap[rows, widest]
    outward = np.column_stack([np.cos(middle), np.sin(middle)]) @ plane.basis
    return members[open_], outward[open_]


_LEAST_NEIGHBOURS = 3
"""Neighbours on the plane that a cell at its border has: fewer are a stray."""


def _border(
    position: Floats, outward: Floats, size: Floats, rng: np.random.Generator
) -> NDArray[np.bool_] | None:
    """Which border cells (E,) make the longest straight side; None where there is none."""
    count = len(position)
    if count < MIN_BORDER_CELLS:
        return None
    a, b = rng.integers(0, count, (2, BORDER_TRIES))
    span = position[b] - position[a]
    length = np.linalg.norm(span, axis=1)
    fair = length > MIN_LENGTH_M
    if not fair.any():
        return None
    a, span = a[fair], span[fair] / length[fair, None]
    offset = position[None] - position[a][:, None]
    along = np.einsum("tei,ti->te", offset, span)
    off = np.linalg.norm(offset - along[..., None] * span[:, None], axis=2)
    faces = np.abs(np.einsum("ei,ti->te", outward, span)) < _FACING
    # Cells on the other side of a strip look the other way.
    faces &= np.einsum("ei,ti->te", outward, outward[a]) > 0
    support = (off <= 0.5 * size) & faces
    best = int(support.sum(axis=1).argmax())
    chosen = np.flatnonzero(support[best])
    order = chosen[np.argsort(along[best, chosen])]
    step = np.diff(along[best, order]) > MAX_GAP_CELLS * size[order[1:]]
    runs = np.split(order, np.flatnonzero(step) + 1)
    side = np.zeros(count, dtype=bool)
    side[max(runs, key=len)] = True
    return side if side.sum() >= MIN_BORDER_CELLS else None


_FACING = math.sin(math.radians(50.0))
"""Largest sine between a cell's open direction and the normal of its border: the direction is rough."""


def _border_line(
    plane: Plane, cells: Cells, xyz: Floats, edge: NDArray[np.int64], outward: Floats
) -> tuple[UncertainLine, Floats] | None:
    """The line along the outermost points of border cells, and its direction outwards (3,)."""
    rough = cells.position[edge]
    span = np.linalg.svd(rough - rough.mean(axis=0), full_matrices=False)[2][0]
    span -= (span @ plane.normal) * plane.normal
    span /= np.linalg.norm(span)
    out = np.cross(span, plane.normal)
    out *= math.copysign(1.0, float(out @ outward.sum(axis=0)))
    step = float(np.median(cells.size[edge]))
    inside = np.zeros(len(cells.position) + 1, dtype=bool)
    inside[edge] = True
    index = plane.points[inside[cells.of_point[plane.points]]]
    along, reach = np.stack([span, out]) @ (xyz[index] - rough.mean(axis=0)).T
    outermost = np.lexsort((-reach, np.floor(along / step)))
    outermost = outermost[np.unique(np.floor(along / step)[outermost], return_index=True)[1]]
    if len(outermost) < MIN_BORDER_CELLS:
        return None
    s, r = along[outermost], reach[outermost]
    slope, level = np.polyfit(s, r, 1)
    sigma = float(np.sqrt(((r - level - slope * s) ** 2).sum() / max(len(s) - 2, 1)))
    if sigma > 0.5 * step:
        return None
    ends_s = (float(s.min()), float(s.max()))
    # Of several points in a step the outermost lies short of the border by a share of their distance.
    short = step / (1.0 + len(index) / len(outermost))
    ends = rough.mean(axis=0) + np.array(
        [at * span + (level + slope * at + 0.5 * short) * out for at in ends_s]
    )
    ends -= plane.heights(ends)[:, None] * plane.normal
    if not _long_enough(ends):
        return None
    direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    axes = across(direction, ends.mean(axis=0))
    outwards = np.cross(direction, plane.normal)
    fit = ends_covariance(s, ends_s, sigma) + short**2 / 12.0
    rows = plane.rows(ends)
    covariance = np.kron(fit, np.outer(axes @ outwards, axes @ outwards)) + np.kron(
        rows @ plane.covariance @ rows.T, np.outer(axes @ plane.normal, axes @ plane.normal)
    )
    out = outwards * math.copysign(1.0, float(outwards @ out))
    return UncertainLine("border", ends[0], ends[1], np.sort(index[outermost]), covariance), out


def _open(line: UncertainLine, out: Floats, view: cKDTree, distance: Floats, spacing: float) -> bool:
    """Whether beside a border the sensor sees something further away."""
    share = (np.arange(_PLACES) + 0.5)[:, None] / _PLACES
    place = line.start + share * (line.end - line.start)
    there = np.linalg.norm(place, axis=1)
    beside = place + _BESIDE_BEAMS * spacing * there[:, None] * out
    answer = view.query(beside / np.linalg.norm(beside, axis=1)[:, None], k=1)
    found, which = np.asarray(answer[0]), np.asarray(answer[1])
    farther = distance[which] > there + np.maximum(BEYOND_M, BEYOND_SHARE * there)
    return float(np.mean(farther & (found <= _BESIDE_BEAMS * spacing))) >= OPEN_SHARE


_PLACES = 10
"""Places along a border that are asked."""
_BESIDE_BEAMS = 1.5
"""Beams from a border to the place beside it."""
