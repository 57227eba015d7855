"""Planes of an unorganised cloud: curvature, region growing, merging (PLK V-C, after Lu et al. 2019).

The points are thinned to cells whose size grows with the range, so that a wall has about as many neighbours
near and far, along the rings and across them. Regions grow over neighbouring cells that are flat and agree
in their normals; a region that bends is peeled into planes, and planes that continue each other are merged.
Then every point of the cloud that lies on a plane is asked, so that planes reach to their borders. No axis
of the frame, no rings and no order of points is used.
"""

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from pipeline.ground import plane_basis
from pipeline.medians import median
from pipeline.records import Floats, read_only

Indices: TypeAlias = NDArray[np.int64]

DEFAULT_SPACING_RAD = 0.01
"""rad; angle between neighbouring beams where the cloud does not tell: between 64 and 32 rings."""
NEAREST_M = 1.0
"""m; nearer is the vehicle itself."""
FARTHEST_M = 80.0
"""m; beyond, walls have a handful of points."""
LEAST_CELL_M = 0.1
"""m; cells are not smaller: five times the noise of a range, so that a cell's plane is not made of it."""
MOST_CELLS = 6_000
"""Cells looked at, which bounds the time; a denser cloud gets larger cells until it fits."""
MOST_PLANES = 40
"""Planes kept, those of most cells: a street shows ten to thirty. Bounds the time."""
NEIGHBOURS = 12
"""Cells of a neighbourhood: the ring of eight around a cell and some more (Lu et al. take 20 points, which
without thinning lie on one or two rings)."""
REACH_CELLS = 3.0
"""Sides of a cell to the farthest neighbour, so that nothing is joined over a gap."""
MAX_THICKNESS_M = 0.04
"""m, standard deviation across a neighbourhood: range noise of usual sensors is 0.02 to 0.03 m."""
FLATNESS = 0.35
"""Thickness of a neighbourhood over its shorter extent, at most: leaves have 0.5 to 0.7."""
SLENDERNESS = 0.15
"""Shorter over longer extent of a neighbourhood, at least: the points of one ring have no plane."""
LEAST_INCIDENCE = math.sin(math.radians(2.0))
"""Sine of the angle between beam and surface, at least: the points of one ring always lie on a plane through
the sensor, whatever it sweeps over. A road is steeper as far as 28 times the sensor's height."""
MAX_BEND = math.radians(12.0)
"""rad between normals of neighbouring cells of one region: three times the scatter of a normal."""
BAND_M = 0.10
"""m to each side; points further from a plane are not on it: three to five sigma of the range noise."""
MAX_SIGMA_M = 0.05
"""m; rms of the points of a plane. Hedges and crowns that happen to look flat have 0.1 m and more."""
MIN_CELLS = 8
"""Cells of a plane, at least: with fewer its tilt is that of single points."""
MAX_MERGE_ANGLE = math.radians(4.0)
"""rad between planes that may be one: twice the error of the tilt of the smallest planes."""
MAX_MERGE_STEP_M = 0.08
"""m; the middle of a plane lies no further from the other one: less than a kerb, more than the noise."""
MAX_MERGE_GAP_M = 3.0
"""m between two pieces of one plane, as balls around their middles: what stands before a wall is so wide."""
MAX_TAKEN = 0.5
"""Share of a plane's points that larger planes have, at most."""
_PEELS = 6
"""Planes peeled off one region; a car's body has about as many."""
_BAND_SIGMAS = 3.0
"""Of a plane's own noise to each side."""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """A plane fitted to points.

    Attributes:
        normal: float64 (3,), unit, of either sign.
        centre: float64 (3,), mean of the points it was fitted to, m.
        basis: float64 (2,3), unit directions that span it.
        points: int64 (m,), indices of all points on it, sorted.
        sigma_m: rms of the fitted points across it, m.
        covariance: float64 (3,3), of the offset along the normal at the centre, m, and of the slopes along
            the two directions of the basis.
    """

    normal: Floats
    centre: Floats
    basis: Floats
    points: Indices
    sigma_m: float
    covariance: Floats

    def __post_init__(self) -> None:
        for name in ("normal", "centre", "basis", "points", "covariance"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def heights(self, xyz: Floats) -> Floats:
        """Signed distances (N,) of points (N,3) from the plane, m."""
        return np.asarray((xyz - self.centre) @ self.normal, dtype=np.float64)

    def rows(self, xyz: Floats) -> Floats:
        """Rows (N,3) that map (offset, slopes) to the height error of the plane at points (N,3)."""
        plan = (xyz - self.centre) @ self.basis.T
        return np.column_stack([np.ones(len(plan)), plan])


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """The thinned cloud.

    Attributes:
        of_point: int64 (N,), the cell of each point, -1 for points that take no part.
        position: float64 (M,3), mean of the points of each cell, m.
        size: float64 (M,), side of each cell, m.
        neighbours: int64 (M,k), its nearest cells, itself where there are fewer within reach.
        normal: float64 (M,3), unit, of the neighbourhood.
        thickness: float64 (M,), m, standard deviation of the neighbourhood across (Lu's curvature, in m).
        flat: bool (M,), whether the neighbourhood is a plane.
    """

    of_point: Indices
    position: Floats
    size: Floats
    neighbours: Indices
    normal: Floats
    thickness: Floats
    flat: NDArray[np.bool_]


def find_planes(cells: Cells, xyz: Floats) -> list[Plane]:
    """The planes of a cloud, those of most cells first.

    Args:
        cells: The cloud thinned by :func:`thinned`.
        xyz: float64 (N,3), the points themselves, m.

    Returns:
        At most ``MOST_PLANES``; a point near an edge may lie on two of them.
    """
    pieces = [piece for region in _regions(cells) for piece in _peeled(cells, region)]
    pieces.sort(key=len, reverse=True)
    pieces = _merged(cells.position, pieces[: 2 * MOST_PLANES])
    pieces.sort(key=len, reverse=True)
    rough = [_on_plane(cells, xyz, piece) for piece in pieces[:MOST_PLANES]]
    real, taken = [], np.zeros(len(xyz), dtype=bool)
    for points in rough:
        # Cells on the edge of two planes make a small one across it, all of their points.
        if len(points) and taken[points].mean() <= MAX_TAKEN:
            real.append(points)
            taken[points] = True
    shared = np.zeros(len(xyz), dtype=np.int16)
    for points in real:
        shared[points] += 1
    # Near an edge nobody knows on which of two planes a point lies; it would bend both.
    found = [_plane(xyz, points, points[shared[points] == 1]) for points in real]
    return [plane for plane in found if plane is not None]


def thinned(xyz: Floats, keep: NDArray[np.bool_], spacing: float) -> Cells:
    """Thins a cloud to cells of at least one beam's spacing, with the shape of each neighbourhood.

    Args:
        xyz: float64 (N,3), m, from the sensor; what is not finite takes no part.
        keep: bool (N,), points that may take part.
        spacing: Angle between neighbouring beams in the direction in which they lie further apart, rad.
    """
    distance = np.sqrt(np.einsum("ni,ni->n", xyz, xyz))
    with np.errstate(invalid="ignore"):
        chosen = np.flatnonzero(keep & (distance > NEAREST_M) & (distance < FARTHEST_M))
    points, distance = xyz[chosen], distance[chosen]
    while True:
        octave = np.maximum(np.ceil(np.log2(spacing * distance / LEAST_CELL_M)), 0.0)
        size = LEAST_CELL_M * np.exp2(octave)
        place = np.floor(points / size[:, None]).astype(np.int64) + _HALF_GRID
        key = ((octave.astype(np.int64) * _GRID + place[:, 0]) * _GRID + place[:, 1]) * _GRID + place[:, 2]
        _, first, cell = np.unique(key, return_index=True, return_inverse=True)
        if len(first) <= MOST_CELLS:
            break
        spacing = max(spacing, LEAST_CELL_M / FARTHEST_M) * 1.5
    count = np.maximum(np.bincount(cell, minlength=len(first)), 1)
    position = np.column_stack(
        [np.bincount(cell, weights=x, minlength=len(first)) / count for x in points.T]
    ).reshape(-1, 3)
    of_point = np.full(len(xyz), -1, dtype=np.int64)
    of_point[chosen] = cell
    return _shaped(of_point, position, size[first])


_HALF_GRID = 1024
_GRID = 2 * _HALF_GRID
"""Cells along an axis: 80 m of the smallest ones to each side of the sensor."""


def _shaped(of_point: Indices, position: Floats, size: Floats) -> Cells:
    """Neighbours, normals and flatness of cells (M,3)."""
    count = len(position)
    k = min(NEIGHBOURS, count)
    if k < MIN_CELLS:
        nothing = np.zeros(count)
        own = np.arange(count)[:, None]
        return Cells(of_point, position, size, own, np.zeros((count, 3)), nothing, nothing > 0)
    distance, neighbours = cKDTree(position, balanced_tree=False, compact_nodes=False).query(position, k=k)
    near = distance <= REACH_CELLS * size[:, None]
    neighbours = np.where(near, neighbours, np.arange(count)[:, None]).astype(np.int64)
    n = near.sum(axis=1)
    # A cell beyond reach stands for itself there: at no offset, it adds nothing.
    x, y, z = (np.ascontiguousarray(p)[neighbours] - p[:, None] for p in position.T)
    mean = [a.sum(axis=1) / n for a in (x, y, z)]

    C = np.stack(
        [
            np.einsum("nk,nk->n", (x, y, z)[i], (x, y, z)[j]) / n - mean[i] * mean[j]
            for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        ]
    )
    values, normal = least_axes(C)
    extent = np.sqrt(np.maximum(values, 0.0))
    incidence = np.abs(np.einsum("ni,ni->n", normal, position)) / np.linalg.norm(position, axis=1)
    flat = (
        (n >= MIN_CELLS)
        & (incidence >= LEAST_INCIDENCE)
        & (extent[:, 0] <= MAX_THICKNESS_M)
        & (extent[:, 0] <= FLATNESS * extent[:, 1])
        & (extent[:, 1] >= SLENDERNESS * extent[:, 2])
    )
    return Cells(of_point, position, size, neighbours, normal, extent[:, 0], flat)


def least_axes(C: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues (M,3), ascending, of symmetric matrices, and the axes (M,3) of the least ones.

    In closed form (the roots of a cubic by its angle): thousands of matrices at once, which an iteration
    takes one by one. Where the least two are equal there is no such axis; it may be zero.

    Args:
        C: float64 (6,M), the elements xx, yy, zz, xy, xz, yz.
    """
    mean = (C[0] + C[1] + C[2]) / 3.0
    a, b, c = C[:3] - mean
    d, e, f = C[3:]
    radius = np.sqrt((a * a + b * b + c * c + 2.0 * (d * d + e * e + f * f)) / 6.0)
    half_det = 0.5 * (a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e))
    angle = np.arccos(np.clip(half_det / np.maximum(radius**3, _TINY), -1.0, 1.0)) / 3.0
    largest, least = (mean + 2.0 * radius * np.cos(angle + turn) for turn in (0.0, 2.0 * math.pi / 3.0))
    values = np.stack([least, 3.0 * mean - largest - least, largest], axis=1)
    # The axis is normal to all rows of C - least: of the three products of two the longest is the surest.
    x, y, z = C[:3] - least
    products = np.stack(
        [
            [d * f - e * y, e * d - x * f, x * y - d * d],
            [d * z - e * f, e * e - x * z, x * f - d * e],
            [y * z - f * f, f * e - d * z, d * f - y * e],
        ]
    )
    square = (products * products).sum(axis=1)
    longest = square.argmax(axis=0)
    rows = np.arange(C.shape[1])
    axis = products[longest, :, rows] / np.sqrt(np.maximum(square[longest, rows], _TINY))[:, None]
    return values, axis


_TINY = 1e-60
"""Keeps matrices of nothing but zeros from dividing by it."""


def _regions(cells: Cells) -> list[Indices]:
    """Groups of flat cells, each connected by neighbours whose planes go on into each other."""
    count, k = cells.neighbours.shape
    flat = np.flatnonzero(cells.flat)
    a, b = np.repeat(flat, k), cells.neighbours[flat].ravel()
    both = cells.flat[b] & (a != b)
    a, b = a[both], b[both]
    for end in (0, 1):
        between = cells.position[b] - cells.position[a]
        level = np.abs(np.einsum("ni,ni->n", cells.normal[(a, b)[end]], between)) <= 0.5 * BAND_M
        a, b = a[level], b[level]
    agree = np.abs(np.einsum("ni,ni->n", cells.normal[a], cells.normal[b])) >= math.cos(MAX_BEND)
    a, b = a[agree], b[agree]
    graph = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(count, count))
    label = connected_components(graph, directed=False)[1]
    # Most cells are a group of their own, and go before anything is done per group.
    members = np.flatnonzero(np.bincount(label, minlength=1)[label] >= MIN_CELLS)
    if len(members) == 0:
        return []
    order = members[np.argsort(label[members], kind="stable")]
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _peeled(cells: Cells, region: Indices) -> list[Indices]:
    """Planes of a region, from its flattest place on: one, unless the region bends."""
    pieces: list[Indices] = []
    for _ in range(_PEELS):
        if len(region) < MIN_CELLS:
            break
        seed = region[int(np.argmin(cells.thickness[region]))]
        normal, centre, position = cells.normal[seed], cells.position[seed], cells.position[region]
        inside = np.abs((position - centre) @ normal) <= BAND_M
        # The seed's tilt carries some metres only; the plane grows with what it reaches.
        inside &= np.linalg.norm(position - centre, axis=1) <= _SEED_REACH * cells.size[seed]
        for _ in range(_PEEL_ROUNDS):
            if inside.sum() < MIN_CELLS:
                break
            normal, centre, _ = _fit(position[inside])
            inside = np.abs((position - centre) @ normal) <= 0.5 * BAND_M
        if inside.sum() < MIN_CELLS:
            region = np.setdiff1d(region, seed)
            continue
        if _fit(position[inside])[2] <= MAX_SIGMA_M:
            pieces.append(region[inside])
        region = region[np.abs((position - centre) @ normal) > 0.5 * BAND_M]
    return pieces


_SEED_REACH = 8.0
"""Sides of a cell around a seed; the tilt of a neighbourhood of 3 is good to half the band there."""
_PEEL_ROUNDS = 3
"""Fits from seed to plane; the third moves it by millimetres."""


def _fit(points: Floats) -> tuple[Floats, Floats, float]:
    """Normal, mean and rms of the plane of least squared distances to points (N,3)."""
    centre = points.sum(axis=0) / len(points)
    centred = points - centre
    values, V = np.linalg.eigh(centred.T @ centred)
    return V[:, 0], centre, math.sqrt(max(float(values[0]), 0.0) / max(len(points) - 3, 1))


def _merged(position: Floats, pieces: list[Indices]) -> list[Indices]:
    """Pieces of one plane joined, the best supported first; what no one plane explains stays apart."""
    merged: list[Indices] = []
    normals, centres, radii = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    for piece in pieces:
        normal, centre, _ = _fit(position[piece])
        radius = float(np.linalg.norm(position[piece] - centre, axis=1).max())
        between = centre - centres
        fits = (
            (np.abs(normals @ normal) >= math.cos(MAX_MERGE_ANGLE))
            & (np.abs(np.einsum("ni,ni->n", between, normals)) <= MAX_MERGE_STEP_M)
            & (np.linalg.norm(between, axis=1) <= radii + radius + MAX_MERGE_GAP_M)
        )
        target = next(
            (
                int(k)
                for k in np.flatnonzero(fits)
                if _fit(position[np.concatenate([merged[k], piece])])[2] <= _MERGED_SIGMA_M
            ),
            None,
        )
        if target is None:
            merged.append(piece)
            normals, centres = np.vstack([normals, normal]), np.vstack([centres, centre])
            radii = np.append(radii, radius)
        else:
            whole = np.concatenate([merged[target], piece])
            merged[target] = whole
            normals[target], centres[target], _ = _fit(position[whole])
            radii[target] = float(np.linalg.norm(position[whole] - centres[target], axis=1).max())
    return merged


_MERGED_SIGMA_M = 0.5 * MAX_SIGMA_M
"""m; rms of the cells of a merged plane: cells are means of points, so less noisy than they."""


def _on_plane(cells: Cells, xyz: Floats, piece: Indices) -> Indices:
    """Points (sorted indices) of the cells of a piece and of those beside them that lie on its plane."""
    normal, centre, _ = _fit(cells.position[piece])
    mask = np.zeros(len(cells.position), dtype=bool)
    mask[piece] = True
    mask[cells.neighbours[piece].ravel()] = True
    near = np.flatnonzero(np.concatenate([mask, [False]])[cells.of_point])
    return near[np.abs((xyz[near] - centre) @ normal) <= BAND_M]


def _plane(xyz: Floats, points: Indices, fitted: Indices) -> Plane | None:
    """The plane of least squares through ``fitted``, its noise, and which of ``points`` lie on it."""
    if len(fitted) < MIN_CELLS:
        return None
    own = xyz[fitted]
    normal, centre, _ = _fit(own)
    height = np.abs((own - centre) @ normal)
    band = min(BAND_M, max(_BAND_SIGMAS * 1.48 * median(height), _LEAST_BAND_M))
    own = own[height <= band]
    if len(own) < MIN_CELLS:
        return None
    normal, centre, sigma = _fit(own)
    if sigma > MAX_SIGMA_M or abs(float(normal @ centre)) < LEAST_INCIDENCE * float(np.linalg.norm(centre)):
        return None
    basis = plane_basis(normal)
    plan = (own - centre) @ basis.T
    rows = np.column_stack([np.ones(len(plan)), plan])
    covariance = sigma**2 * np.linalg.pinv(rows.T @ rows)
    on = points[np.abs((xyz[points] - centre) @ normal) <= band]
    return Plane(normal, centre, basis, on, sigma, covariance)


_LEAST_BAND_M = 0.02
"""m; a noiseless plane keeps its points through the rounding of coordinates to millimetres."""
