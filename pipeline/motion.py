"""How the LiDAR moved between two sweeps, from the sweeps alone: registration of small planes (surfels).

The surfels of the later sweep are moved onto those of the earlier one, point to plane, under a loss that
moving vehicles can not pull. Nothing is set per sensor or frame: no axis, no rings, no ground. Where the
scene leaves a direction free (a tunnel, an open field) no motion is claimed.
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from pipeline.deskew import Twist
from pipeline.records import Floats, PointCloud, read_only
from pipeline.surfel_matches import ALIKE_COSINE, LOSS_SCALE, Matches, matched, normal_equations
from pipeline.surfels import Surfels, surfels

UnknownReason: TypeAlias = Literal[
    "too far apart", "few planes", "free direction", "no agreement", "uncertain", "implausible speed"
]
"""Why no motion is claimed: too long (or no) time between the sweeps; too few surfels; the planes of the
scene leave a direction free; those that would fix a direction do not fit any one motion (traffic all
around, wrong match); the covariance is too large; faster than a vehicle."""

MIN_SURFELS = 150
"""Surfels below which nothing is registered: 25 for each of six unknowns."""

ITERATIONS = 25
"""Gauss-Newton steps at most; from the last twist it takes six to ten, for each re-pairs the surfels."""

SETTLED_M = 2e-4
"""m; the iteration ends with a step that moves what lies at ``LEVER_M`` by less in the time between the
sweeps."""

LEVER_M = 10.0
"""m; from here on turning by a little is seen rather than told apart from moving: the width of a street."""

LONGEST_S = 0.5
"""s between two sweeps: a vehicle that brakes or steers hard changes its speed by 4 m/s in it, and the
twist is no longer constant."""

FASTEST_M_S = 70.0
"""m/s; 250 km/h. Faster is a wrong match, or no road vehicle."""

SEARCHED_M_S = 40.0
"""m/s; without a start, speeds up to 144 km/h are sought; a faster vehicle is found once it was slower."""

SEARCHED_M = 6.0
"""m; and no displacement beyond this, whatever the time between the sweeps: the cost grows with its
square."""

SEARCH_STEP_M = 0.6
"""m between tried displacements: half of it is within the gate of a surfel at 8 m and beyond."""

SEARCH_SURFELS = 500
"""Surfels that judge a displacement: those with the rarest normals, for the road fits anywhere."""

MIN_SHARE = 0.02
"""Least share of the surfels' normals along the weakest direction (1/3 if all were alike): noise of normals
(3 deg) alone gives 0.003, and such noise draws the motion to zero."""

MIN_AGREEMENT = 0.25
"""Share of what the scene holds along each direction that must fit the motion: at a wrong optimum the road
fits and what would fix the direction does not (below 0.1); the rest is new, hidden or itself in motion."""

MAX_SIGMA_M_S = 0.5
"""m/s; half a sweep of it displaces points by 2.5 cm."""

MAX_SIGMA_RAD_S = math.radians(2.0)
"""rad/s; half a sweep of it turns points by 0.1 deg."""

UNTIMED_SHARE = 0.015
"""Error of the velocity as a share of the speed where points have no times: things passed at some metres are
seen later in the turn, by a hundredth of the time between the sweeps (simulated: 0.7 to 1.5 %)."""

VARIANCE_INFLATION = 4.0
"""Neighbouring surfels err together (one wall, one bend of the road): seen as scatter of twice the plain
sigma."""


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A twist that can be trusted.

    Attributes:
        twist: Of the LiDAR in its own axes.
        covariance: float64 (6,6) of ``twist.vector``, (rad/s, m/s).
        overlap: Share of the later sweep's surfels that fit the earlier one.
        residual_m: Robust standard deviation of the fitting surfels from their planes, m.
        weakest: Share of the surfels' normals along the direction that they fix least, 0..1/3.
    """

    twist: Twist
    covariance: Floats
    overlap: float
    residual_m: float
    weakest: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", read_only(self.covariance))


@dataclass(frozen=True, slots=True, eq=False)
class MotionUnknown:
    """Two sweeps that do not tell the motion.

    Attributes:
        reason: Why, from a closed list.
        free: float64 (3,), unit, LiDAR frame: the direction in which the motion is not known, or None.
    """

    reason: UnknownReason
    free: Floats | None = None


def estimate_twist(
    previous: PointCloud | Surfels, current: PointCloud | Surfels, seconds: float, start: Twist | None
) -> Motion | MotionUnknown:
    """The constant twist between two sweeps of one LiDAR.

    ``Exp((seconds + t_i - t_j) w)`` maps a point of the current sweep, measured t_i after its stamp, onto
    the surface that the previous sweep saw t_j after its own (FORMULAS G3 between two sweeps); no sweep
    needs to be straightened before. Without times a direction is taken to be measured at the same time of
    each sweep, which errs by the little that it turned in between.

    Args:
        previous: The earlier sweep; its surfels where the caller kept them from the last call.
        current: The later sweep, likewise.
        seconds: Stamp of the later sweep minus that of the earlier.
        start: The last twist, or None: all speeds up to 40 m/s are tried, which takes ten times as long.

    Returns:
        The motion, or why it is not known.
    """
    if not 0.0 < seconds <= LONGEST_S:
        return MotionUnknown("too far apart")
    earlier = previous if isinstance(previous, Surfels) else surfels(previous)
    later = current if isinstance(current, Surfels) else surfels(current)
    if min(len(earlier), len(later)) < MIN_SURFELS:
        return MotionUnknown("few planes")
    tree = cKDTree(earlier.centre)
    if start is None:
        start = _searched(earlier, later, tree, seconds)
    twist = start
    for _ in range(ITERATIONS):
        matches = matched(earlier, later, tree, seconds, twist)
        if len(matches.tau) < MIN_SURFELS:
            return MotionUnknown("no agreement")
        information, gradient = normal_equations(matches)
        # A billionth of the largest entry keeps a free direction where it is; it is told below.
        ridge = 1e-9 * float(np.trace(information)) * np.eye(6)
        step = np.asarray(-np.linalg.solve(information + ridge, gradient), dtype=np.float64)
        twist = Twist(twist.omega + step[:3], twist.velocity + step[3:])
        if settled(step, seconds):
            break
        if float(np.linalg.norm(twist.velocity)) > FASTEST_M_S:
            return MotionUnknown("implausible speed")
    timed = earlier.time is not None and later.time is not None
    return _judged(matches, later, twist, seconds, timed=timed)


def settled(step: Floats, seconds: float) -> bool:
    """Whether a step (6,) of the twist moves nothing any more."""
    return float(max(LEVER_M * np.abs(step[:3]).max(), np.abs(step[3:]).max())) * seconds < SETTLED_M


def _judged(
    matches: Matches, later: Surfels, twist: Twist, seconds: float, *, timed: bool
) -> Motion | MotionUnknown:
    """The motion, or what speaks against it."""
    R = twist.pose(seconds)[:3, :3]
    every = later.normal @ R.T
    held = every.T @ every / len(every)
    shares, directions = np.linalg.eigh(held)
    # Directions are told in the LiDAR frame of the earlier sweep: a sweep later it has turned by a degree
    # or two.
    if float(shares[0]) < MIN_SHARE:
        return MotionUnknown("free direction", read_only(directions[:, 0]))
    fitting = matches.normal[np.abs(matches.error) < LOSS_SCALE * matches.scale]
    fit = fitting.T @ fitting / len(every)
    whiten = directions / np.sqrt(shares)
    agreement, axes = np.linalg.eigh(whiten.T @ fit @ whiten)
    if float(agreement[0]) < MIN_AGREEMENT:
        against = whiten @ axes[:, 0]
        return MotionUnknown("no agreement", read_only(against / np.linalg.norm(against)))
    information, _ = normal_equations(matches)
    spread = VARIANCE_INFLATION * matches.scale**2 * np.linalg.inv(information)
    covariance = np.asarray(0.5 * (spread + spread.T), dtype=np.float64)
    sigma = np.sqrt(np.diag(covariance))
    if float(sigma[:3].max()) > MAX_SIGMA_RAD_S or float(sigma[3:].max()) > MAX_SIGMA_M_S:
        return MotionUnknown("uncertain")
    if not timed:
        covariance[3:, 3:] += (UNTIMED_SHARE * float(np.linalg.norm(twist.velocity))) ** 2 * np.eye(3)
    residual = matches.error * matches.sigma
    return Motion(
        twist,
        covariance,
        overlap=len(matches.tau) / len(later),
        residual_m=1.4826 * float(np.median(np.abs(residual))),
        weakest=float(np.linalg.eigvalsh(fit)[0]),
    )


def _searched(earlier: Surfels, later: Surfels, tree: cKDTree, seconds: float) -> Twist:
    """The velocity without turning under which most of what is rare in the scene fits.

    Displacements are tried on a disc that leaves out the most common normal, which is the road's or a
    wall's: along it a vehicle does not travel, or not far. A surfel counts by how little its normal is
    shared (its leverage), so that the road, which fits anywhere, does not vote.
    """
    held = later.normal.T @ later.normal / len(later)
    shares, directions = np.linalg.eigh(held)
    leverage = (((later.normal @ directions) ** 2) / np.maximum(shares, 1e-6)).sum(axis=1)
    judges = np.argsort(-leverage, kind="stable")[:SEARCH_SURFELS]
    centre, normal = later.centre[judges], later.normal[judges]
    steps = math.ceil(min(SEARCHED_M_S * seconds, SEARCHED_M) / SEARCH_STEP_M)
    grid = np.stack(np.meshgrid(*[np.arange(-steps, steps + 1)] * 2), axis=-1).reshape(-1, 2)
    grid = grid[np.hypot(grid[:, 0], grid[:, 1]) <= steps]
    tried = np.asarray(SEARCH_STEP_M * grid @ directions[:, :2].T, dtype=np.float64)
    cost = np.empty(len(tried))
    for k, displacement in enumerate(tried):
        distance, nearest = tree.query(centre + displacement)
        across = np.einsum(
            "ij,ij->i", centre + displacement - earlier.centre[nearest], earlier.normal[nearest]
        )
        alike = np.abs(np.einsum("ij,ij->i", normal, earlier.normal[nearest])) > ALIKE_COSINE
        misfit = np.minimum(1.0, (across / (0.5 * SEARCH_STEP_M)) ** 2)
        misfit[~alike | (distance > np.maximum(earlier.size[nearest], SEARCH_STEP_M))] = 1.0
        cost[k] = misfit.mean()
    return Twist(np.zeros(3), tried[int(np.argmin(cost))] / seconds)
