"""The line witness: lane lines and poles of a window of frames, matched and solved for the extrinsic."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from pipeline import line_doubt, plk, se3
from pipeline.association import NO_PAIRS, Association, associate_all
from pipeline.cameras import limit_of, undistort
from pipeline.cloud_lanes import find_lanes
from pipeline.cloud_poles import find_poles
from pipeline.ground import Ground, fit_ground
from pipeline.image_lines import find_image_lines
from pipeline.image_segments import find_image_segments
from pipeline.line_arcs import with_arc
from pipeline.records import (
    CameraImage,
    CameraModel,
    CloudLine,
    Floats,
    ImageLine,
    LineLabel,
    LineMatch,
    Masks,
    PointCloud,
    WitnessEstimate,
)
from pipeline.sensor_seat import sensor_origin
from pipeline.structure_lines import cloud_lines, find_structure_lines

PRIOR_SIGMA = np.array([np.radians(1.0)] * 3 + [0.15] * 3)
"""rad and m; how far a mount may have moved and its lines still be told apart: twice the alert limits."""
HELD_SIGMAS = 3.0
"""Prior sigmas; a direction that the lines know worse than this is left to the stored extrinsic."""
FLOOR_SIGMA = np.array([np.radians(0.1)] * 3 + [0.03] * 3)
"""rad and m; lines are matched again at least this wide: what the noise model does not know of."""
ROUNDS = 3
"""Matching and solving in turn; the pairs no longer change after the second on simulated streets."""
_FAINT = 1e-6
"""Share of the prior's precision that keeps unseen directions in place and pulls no seen one."""
MIN_FREEDOM = 0.5
"""Distances measured beyond those that the answer needs; without any a wrong pair looks like drift."""
FRAME_CORRELATION = 0.5
"""Correlation of the errors of neighbouring frames (FORMULAS F1): 10 frames of a street are worth some 4."""
MOST_ODDS: Mapping[LineLabel, float] = {"lane": 0.0, "pole": 0.0, "structure": -2.2}
"""Log odds of being wrong beyond which a group is left out: lanes and poles where it is likelier wrong than
right, structure where the others do not vouch for it nine to one."""
TRACK_M = 0.5
"""m; aside, from frame to frame: a lane's distance changes by so much in a second of weaving or bending."""
VIEW_MARGIN = 0.1
"""Share of the field of view around the image searched for cloud lines: more than the prior moves them."""
MIN_DEPTH_M = 1.0
"""m; nearer points are the vehicle's own."""


@dataclass(frozen=True, slots=True, eq=False)
class LineFrame:
    """Lines of one frame.

    Attributes:
        cloud_lines: In the LiDAR frame; lane lines run along ``forward``, poles from foot to top.
        image_lines: In ideal px.
        reasons: Why a kind of line could not be looked for; empty where all could.
        aside: float64 (3,), unit, LiDAR frame: to the left or right of the way.
    """

    cloud_lines: tuple[CloudLine, ...]
    image_lines: tuple[ImageLine, ...]
    reasons: tuple[str, ...]
    aside: Floats


@dataclass(frozen=True, slots=True, eq=False)
class LineSolution:
    """What the lines of a window say.

    Attributes:
        estimate: Against the stored extrinsic; information zero where nothing was matched.
        matches: Per frame, the pairs that took part.
        fit: Probability that right pairs fit each other worse than these, 0..1; 1 where nothing was said.
    """

    estimate: WitnessEstimate
    matches: tuple[tuple[LineMatch, ...], ...]
    fit: float


def find_lines(
    cloud: PointCloud,
    image: CameraImage,
    masks: Masks,
    camera: CameraModel,
    T_cam_lidar: Floats,
    *,
    up: Floats,
    forward: Floats,
    rng: np.random.Generator,
    ground: Ground | None = None,
    structure: bool = False,
    origin: Floats | None = None,
) -> LineFrame:
    """Finds lane lines and poles in the cloud, around the camera's view, and in the image.

    Structure is for a caller who has time and other witnesses. From 2 deg off, it shows the position ahead in
    half as many frames again (30 for 20 of 140 on simulated streets), but 3 % of its answers are then wrong
    beyond their sigmas, for on a front every window has its neighbour; without it none is.

    Args:
        cloud: The sweep.
        image: The image.
        masks: Lane and pole masks of the image.
        camera: Intrinsics.
        T_cam_lidar: float64 (4,4), the stored extrinsic: it only decides which points are looked at.
        up: float64 (3,), unit, LiDAR frame.
        forward: float64 (3,), unit, LiDAR frame.
        rng: For the plane and the lines.
        ground: The ground plane of this very sweep where it was fitted before; else it is fitted here.
        structure: Edges of buildings, vehicles and furniture too.
        origin: float64 (3,), where the sensor stands in the cloud's frame; None: it is found from the rings.

    Returns:
        The lines, and the reasons where there can be none.
    """
    reasons = []
    lines: list[CloudLine] = []
    seen = in_view(cloud, camera, T_cam_lidar)
    if ground is None:
        ground = fit_ground(cloud, up, rng)
    if origin is None:
        origin = sensor_origin(cloud)
    if ground is None:
        reasons.append("no ground plane in the cloud")
    else:
        if cloud.intensity is None:
            reasons.append("no lane lines in a cloud without intensity")
        lanes = find_lanes(cloud, ground, seen, rng, origin=origin)
        lines += [with_arc(_along(line, forward), cloud) for line in lanes]
        lines += find_poles(cloud, ground, seen, origin=origin)
    image_lines = find_image_lines(image, masks, camera)
    if structure:
        eye = -T_cam_lidar[:3, :3].T @ T_cam_lidar[:3, 3]
        lines += cloud_lines(find_structure_lines(cloud, seen, rng, origin), eye)
        image_lines += find_image_segments(image, camera)
    aside = np.cross(up, forward)
    return LineFrame(tuple(lines), tuple(image_lines), tuple(reasons), aside / np.linalg.norm(aside))


def _along(line: CloudLine, direction: Floats) -> CloudLine:
    """The same line, its ends ordered along a direction (3,)."""
    if (line.end - line.start) @ direction >= 0:
        return line
    length = float(np.linalg.norm(line.end - line.start))
    mean_m = None if line.mean_m is None else length - line.mean_m
    return CloudLine(line.label, line.end, line.start, line.points, line.sigma_m, line.spread, mean_m)


def in_view(cloud: PointCloud, camera: CameraModel, T_cam_lidar: Floats) -> NDArray[np.bool_]:
    """Points (N,) in front of the camera and inside its field of view with a margin."""
    u, v = np.linspace(0, camera.width - 1, 9), np.linspace(0, camera.height - 1, 9)
    border = np.concatenate(
        [np.column_stack([u, np.full(9, e)]) for e in (0, camera.height - 1)]
        + [np.column_stack([np.full(9, e), v]) for e in (0, camera.width - 1)]
    ).astype(np.float64)
    rays = undistort(camera, border)
    if np.isfinite(rays).all():
        low, high = rays.min(axis=0), rays.max(axis=0)
    else:
        # The lens ends inside the image: as far as it goes, it sees.
        high = np.full(2, min(limit_of(camera), _WIDEST_SLOPE))
        low = -high
    margin = VIEW_MARGIN * (high - low)
    low, high = (low - margin).astype(np.float32), (high + margin).astype(np.float32)
    T = T_cam_lidar.astype(np.float32)
    x, y, z = (T[:3, :3] @ cloud.xyz.T) + T[:3, 3:]
    inside = (z > MIN_DEPTH_M) & (x > low[0] * z) & (x < high[0] * z) & (y > low[1] * z) & (y < high[1] * z)
    return np.asarray(inside)


_WIDEST_SLOPE = 1e4
"""Of a lens that sees 180 deg and more."""


def solve_lines(
    frames: Sequence[LineFrame], camera: CameraModel, T_stored: Floats, prior_sigma: Floats = PRIOR_SIGMA
) -> LineSolution:
    """One extrinsic from the lines of all frames of a window, or of one frame.

    Matching and solving take turns, from the prior around the stored extrinsic to the posterior of the
    solution. The prior keeps unobserved directions in place while solving; its pull is taken out of the
    answer again, linearised at the solution. Groups of pairs that the others contradict are left out, and
    what remains of doubt about the rest widens the answer (``line_doubt``). The same pole in 20 frames is not
    20 poles: the information is that of ``effective_frames`` frames, divided by chi2 where residuals exceed
    their model, and by a little more where chi2 itself rests on few lines.

    Args:
        frames: Lines of each frame.
        camera: Intrinsics.
        T_stored: float64 (4,4), the stored extrinsic.
        prior_sigma: float64 (6,), rad and m, how far off it may be per axis. A wider prior makes more pairs
            ambiguous; what then rests on too few of them is held.

    Returns:
        The estimate and the pairs; nothing matched, or no pair more than needed to check the others, gives no
        information and no features.
    """
    prior = plk.Prior(T_stored, np.diag(prior_sigma**-2.0))
    T = T_stored
    covariance = np.diag(prior_sigma**2)
    result = _silence(len(frames))
    lines = [(frame.cloud_lines, frame.image_lines) for frame in frames]
    for _ in range(ROUNDS):
        found = associate_all(lines, camera, T, covariance)
        pairs = plk.stack([part.pairs for part in found] or [NO_PAIRS])
        if len(pairs) == 0:
            return _silence(len(frames))
        round_ = _consistent(_Round(found, pairs, _groups(frames, found)), camera, T, prior)
        if round_ is None:
            return _silence(len(frames))
        solution = round_.solution
        assert solution is not None  # noqa: S101 - _consistent solves
        result, belief = _answer(round_, camera, prior)
        T = solution.T_cam_lidar
        spread = np.linalg.inv(belief.precision) + np.diag(FLOOR_SIGMA**2)
        covariance = np.asarray(spread, dtype=np.float64)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Round:
    """Pairs of one round of matching, in the order of the frames and their matches.

    Attributes:
        found: Per frame.
        pairs: N of all frames.
        group: int64 (N,), pairs that would be wrong together.
        solution: Of method I, where it was asked for.
    """

    found: Sequence[Association]
    pairs: plk.LinePairs
    group: NDArray[np.int64]
    solution: plk.Solution | None = None

    @property
    def frames(self) -> int:
        return sum(1 for part in self.found if part.matches)

    @property
    def labels(self) -> list[LineLabel]:
        """Class of each group."""
        own = [match.cloud.label for part in self.found for match in part.matches]
        return [own[first] for first in np.unique(self.group, return_index=True)[1].tolist()]

    def without(self, group: int) -> "_Round":
        """The round without one group."""
        kept = self.group != group
        first, found = 0, []
        for part in self.found:
            own = kept[first : first + len(part.matches)]
            first += len(part.matches)
            matches = tuple(match for match, keep in zip(part.matches, own, strict=True) if keep)
            found.append(Association(matches, plk.select(part.pairs, own)))
        _, left = np.unique(self.group[kept], return_inverse=True)
        return _Round(found, plk.select(self.pairs, kept), left.astype(np.int64))


def _groups(frames: Sequence[LineFrame], found: Sequence[Association]) -> NDArray[np.int64]:
    """Group (N,) of each pair: those of one cloud line, and of cloud lines that pass at one distance aside.

    While the vehicle moves on, a line or pole stays at its distance to the left or right: a wrong pair
    comes back frame by frame.
    """
    places: list[tuple[str, float]] = []
    keys: list[int] = []
    for index, (frame, part) in enumerate(zip(frames, found, strict=True)):
        for match in part.matches:
            line = match.cloud
            middle = float(0.5 * (line.start + line.end) @ frame.aside)
            same = [
                k
                for k, (label, other) in enumerate(places)
                if label == line.label and abs(other - middle) < TRACK_M
            ]
            if index == 0 or not same:
                known = (line.label, middle)
                if known not in places:
                    places.append(known)
                keys.append(places.index(known))
            else:
                nearest = min(same, key=lambda k: abs(places[k][1] - middle))
                places[nearest] = (line.label, middle)
                keys.append(nearest)
    return np.unique(np.array(keys, dtype=np.int64), return_inverse=True)[1].astype(np.int64)


def _consistent(round_: _Round, camera: CameraModel, T: Floats, prior: plk.Prior) -> _Round | None:
    """The round without groups that the others contradict, solved from ``T``; None if none is left."""
    while True:
        # The prior says where to start; method II asks for none and costs as much again.
        solution = plk.method_one(round_.pairs, camera.K, T, prior=prior, start_two=False)
        T = solution.T_cam_lidar
        solved = _Round(round_.found, round_.pairs, round_.group, solution)
        groups, belief = _linearised(solved, camera, prior)
        odds = line_doubt.odds_wrong(groups, solved.labels, belief)
        excess = odds - np.array([MOST_ODDS[label] for label in solved.labels])
        worst = int(excess.argmax())
        if excess[worst] <= 0.0:
            return solved
        if len(odds) == 1:
            return None
        round_ = round_.without(worst)


def _linearised(
    round_: _Round, camera: CameraModel, prior: plk.Prior
) -> tuple[line_doubt.Quadratic, line_doubt.Belief]:
    """The groups around the solution, worth the effective frames, and the prior there."""
    assert round_.solution is not None  # noqa: S101 - solved before
    T = round_.solution.T_cam_lidar
    groups = line_doubt.quadratic(round_.pairs, round_.group, camera.K, T)
    belief = line_doubt.Belief(-se3.local(prior.T_cam_lidar, T), prior.precision)
    return groups.scaled(effective_frames(round_.frames) / round_.frames), belief


def effective_frames(count: int) -> float:
    """Independent frames that ``count`` correlated ones are worth (FORMULAS F1, exact at any length)."""
    lag = np.arange(1, count)
    return count / (1.0 + 2.0 * float(((1.0 - lag / count) * FRAME_CORRELATION**lag).sum()))


def _misfit(solution: plk.Solution) -> float:
    """Factor on the covariance: chi2 where residuals exceed their model, and the doubt about it.

    A misfit judged by n degrees of freedom is itself known to sqrt(2 / n) only: the answer's tails are those
    of Student's t, whose variance is larger by 1 + 2 / n to first order.
    """
    return max(1.0, solution.chi2) * (1.0 + 2.0 / max(solution.freedom, MIN_FREEDOM))


def _silence(frames: int) -> LineSolution:
    nothing = WitnessEstimate("lines", np.zeros(6), np.zeros((6, 6)), 0, 0, 1.0)
    return LineSolution(nothing, tuple(() for _ in range(frames)), 1.0)


def _answer(round_: _Round, camera: CameraModel, prior: plk.Prior) -> tuple[LineSolution, line_doubt.Belief]:
    """The lines' own answer: prior taken out, directions held that they do not know (FORMULAS D3)."""
    solution = round_.solution
    assert solution is not None  # noqa: S101 - solved before
    groups, stored = _linearised(round_, camera, prior)
    odds = line_doubt.odds_wrong(groups, round_.labels, stored)
    groups = groups.scaled(1.0 / _misfit(solution))
    belief = line_doubt.doubted(groups, stored, odds)
    sigma = 1.0 / np.sqrt(np.diag(prior.precision))
    values, V = np.linalg.eigh((belief.precision - prior.precision) * np.outer(sigma, sigma))
    known = values >= HELD_SIGMAS**-2.0
    matches = tuple(part.matches for part in round_.found)
    if solution.freedom < MIN_FREEDOM or not known.any():
        return LineSolution(_silence(0).estimate, matches, 1.0), belief
    values, V = values[known], V[:, known]
    # Without the prior, or its pull would be in the answer.
    own = line_doubt.posterior(groups, line_doubt.Belief(stored.mean, _FAINT * prior.precision))
    information = (V * values) @ V.T / np.outer(sigma, sigma)
    estimate = WitnessEstimate(
        "lines",
        sigma * (V @ (V.T @ ((own.mean - stored.mean) / sigma))),
        0.5 * (information + information.T),
        round_.frames,
        len(round_.pairs),
        solution.chi2,
    )
    freedom = solution.freedom * effective_frames(round_.frames) / round_.frames
    return LineSolution(estimate, matches, float(chdtrc(freedom, freedom * solution.chi2))), belief
