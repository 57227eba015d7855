"""The extrinsic of a rig of which nothing is known but the intrinsics, or next to nothing, from one frame.

Two lanes of the image and two of the cloud, and up by the ground and by poles, leave some hundred extrinsics
(``pipeline.lane_pairs``); two lanes and a pole leave some dozen (``pipeline.coarse``, CRLF III-C), and where
there are no two lanes, one lane and two poles may do (``pipeline.pole_pairs``). J of CRLF (9) ranks them; the
edges of cloud and image judge the best (``pipeline.candidate_edges``). An answer that is not clearly ahead of
every other one is none.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline import coarse, se3
from pipeline.candidate_edges import (
    CandidateParameters,
    Judged,
    Scene,
    best_starts,
    distinct,
    judge_candidates,
)
from pipeline.cloud_lanes import find_lanes
from pipeline.cloud_poles import find_poles
from pipeline.errors import InputError
from pipeline.gradients import GradientPyramid, gradient_pyramid
from pipeline.ground import Ground
from pipeline.ground_side import find_grounds
from pipeline.height_maps import HeightMaps, height_maps
from pipeline.image_lines import find_image_lines
from pipeline.lane_pairs import LanePairParameters, lane_pair_extrinsics
from pipeline.pole_pairs import PolePairParameters, pole_pair_extrinsics
from pipeline.records import (
    CameraImage,
    CameraModel,
    CloudLine,
    Floats,
    ImageLine,
    Masks,
    PointCloud,
    read_only,
)
from pipeline.semantic_cost import (
    EvolutionParameters,
    SemanticPoints,
    evolution_search,
    points_in_view,
    points_of_lines,
    semantic_cost,
)
from pipeline.sensor_seat import sensor_origin

Reason: TypeAlias = Literal[
    "no ground plane in the cloud",
    "fewer than two lanes in the image",
    "fewer than two lanes in the cloud",
    "no extrinsic puts the lanes of the cloud on those of the image",
    "the cloud shows too few edges to tell the right extrinsic",
    "image and cloud show hardly more in common than by chance",
    "another extrinsic fits as well",
]
"""Why a frame gives no extrinsic."""


@dataclass(frozen=True, slots=True, eq=False)
class NoPriorParameters:
    """What takes part, and how clearly an answer must win.

    Attributes:
        judged: Candidates that the edges judge: one costs some 30 ms.
        points: Points of lanes by which candidates are ranked before.
        apart_rad: rad; with ``apart_m`` how far candidates are apart that are judged both.
        apart_m: m, of the camera's centre.
        lines_weight: Share of J in the score. Between right and wrong extrinsics J moves by 0.4 where the
            response of the edges moves by 0.1, so that each has its say.
        least_peak: Standard deviations over chance that an answer must have: the best of some dozen climbs
            that end at random reaches 3.
        least_lead: Standard errors by which it must be ahead of the second: a rival that is as good wins
            with one in ten.
        lane_pairs: See there.
        pole_pairs: See there.
        triples: See there.
        candidates: See there.
    """

    judged: int = 16
    points: int = 400
    apart_rad: float = math.radians(2.0)
    apart_m: float = 0.5
    lines_weight: float = 0.25
    least_peak: float = 4.0
    least_lead: float = 1.28
    lane_pairs: LanePairParameters = field(default_factory=LanePairParameters)
    pole_pairs: PolePairParameters = field(default_factory=PolePairParameters)
    triples: coarse.CoarseParameters = field(default_factory=coarse.CoarseParameters)
    candidates: CandidateParameters = field(default_factory=CandidateParameters)


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is believed of the extrinsic.

    Attributes:
        T_cam_lidar: float64 (4,4).
        sigma_rad: Of the rotation, rad per axis.
        sigma_m: Of the camera's place, m per axis.
    """

    T_cam_lidar: Floats
    sigma_rad: float
    sigma_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_cam_lidar", read_only(self.T_cam_lidar))
        for name in ("sigma_rad", "sigma_m"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise InputError(f"prior: {name} {getattr(self, name)} is not positive and finite")

    def within(self, T: Floats) -> NDArray[np.bool_]:
        """Whether the turns and shifts (N,6) to extrinsics (N,4,4) are those of three sigma at most."""
        xi = np.array([se3.local(self.T_cam_lidar, one) for one in T]).reshape(-1, 6)
        return np.asarray(np.abs(xi) <= _SIGMAS * np.array([self.sigma_rad] * 3 + [self.sigma_m] * 3))


_SIGMAS = 3.0
"""One start in some fifty lies further out on one of six axes."""


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """One extrinsic and what speaks for it.

    Attributes:
        T_cam_lidar: float64 (4,4).
        score: Response of the edges and J of the lines together.
        peak: Of the edges over chance, standard deviations.
        cells: Shares of the cells of the image and of the lines in the score, each less its mean.
    """

    T_cam_lidar: Floats
    score: float
    peak: float
    cells: Floats


@dataclass(frozen=True, slots=True, eq=False)
class FoundExtrinsic:
    """The extrinsic of a frame.

    Attributes:
        T_cam_lidar: float64 (4,4).
        lead: Standard errors by which it is ahead of the second; inf where there is none.
        answers: All that were compared, the best first.
    """

    T_cam_lidar: Floats
    lead: float
    answers: tuple[Answer, ...]


@dataclass(frozen=True, slots=True, eq=False)
class NoExtrinsic:
    """The frame does not give it.

    Attributes:
        reason: Why.
        answers: What came out nevertheless, the best first.
        lead: Of the first, standard errors; 0 where there is none.
    """

    reason: Reason
    answers: tuple[Answer, ...] = ()
    lead: float = 0.0


def find_extrinsic(
    cloud: PointCloud,
    image: CameraImage,
    masks: Masks,
    camera: CameraModel,
    rng: np.random.Generator,
    *,
    prior: Prior | None = None,
    parameters: NoPriorParameters | None = None,
) -> FoundExtrinsic | NoExtrinsic:
    """Finds the extrinsic of one frame without a first guess, or far from one.

    Args:
        cloud: The sweep, in any frame.
        image: The image.
        masks: Lane and pole masks of it.
        camera: Intrinsics.
        rng: For ground, lines, search and chance.
        prior: What is believed of the extrinsic, or None: LiDAR and camera are within 5 m of each other and
            the image is upright to 45 deg.
        parameters: See there; None: the defaults.

    Returns:
        The extrinsic to the accuracy of the edges, or why the frame does not tell it.
    """
    p = parameters or NoPriorParameters()
    image_lines = find_image_lines(image, masks, camera)
    gradients, origin = gradient_pyramid(image, camera), sensor_origin(cloud)
    maps = height_maps(masks, camera, "plateau")
    grounds = find_grounds(cloud, rng)
    if not grounds:
        return NoExtrinsic("no ground plane in the cloud")
    answers: list[Answer] = []
    reasons: list[Reason] = []
    for ground in grounds:
        road = _Road(cloud, ground, gradients, origin, image_lines, maps, masks, camera)
        found = _of_road(road, rng, prior, p)
        if isinstance(found, str):
            reasons.append(found)
        else:
            answers += found
    if not answers:
        return NoExtrinsic(reasons[0])
    return _verdict(answers, p)


@dataclass(frozen=True, slots=True, eq=False)
class _Road:
    """A frame with one of the planes that may be its ground."""

    cloud: PointCloud
    ground: Ground
    gradients: GradientPyramid
    origin: Floats
    image_lines: Sequence[ImageLine]
    maps: HeightMaps
    masks: Masks
    camera: CameraModel


def _of_road(
    road: _Road, rng: np.random.Generator, prior: Prior | None, p: NoPriorParameters
) -> list[Answer] | Reason:
    """What the frame says if this plane is its ground."""
    lines = _cloud_lines(road, rng)
    whole = [line for part in lines for line in part]
    points = points_of_lines(road.cloud, whole)
    pairs = [
        lane_pair_extrinsics(part, road.image_lines, road.ground, road.camera, p.lane_pairs) for part in lines
    ]
    open_place = np.concatenate(pairs)
    if prior is not None:
        # Their place along the road is yet to be found.
        open_place = open_place[prior.within(open_place)[:, :3].all(axis=1)]
    open_place = _best_by_paint(open_place, points, road, p)
    triples = coarse.coarse_extrinsic(
        whole, road.image_lines, points, road.maps, road.camera, up=road.ground.normal, parameters=p.triples
    )
    fixed = np.zeros((0, 4, 4)) if isinstance(triples, coarse.NoCoarse) else triples.candidates
    fixed = fixed[: p.triples.finalists]
    if len(open_place) == 0:
        found = pole_pair_extrinsics(whole, road.image_lines, road.ground, road.camera, p.pole_pairs)
        fixed = np.concatenate([fixed, _best_by_lines(found, points, road, p)])
    scene = Scene(road.cloud, road.ground, road.gradients, road.camera, road.origin)
    if prior is not None:
        fixed = fixed[prior.within(fixed).all(axis=1)]
        fixed = np.concatenate([fixed, _near_prior(prior, points, road, scene, rng, p)])
    if len(open_place) + len(fixed) == 0:
        return _missing(whole, road.image_lines)
    judged = [
        *judge_candidates(open_place, scene, p.candidates, rng, along_road=True),
        *judge_candidates(fixed, scene, p.candidates, rng, along_road=False),
    ]
    if prior is not None:
        judged = [one for one in judged if prior.within(one.T_cam_lidar[None]).all()]
    if not judged:
        return "the cloud shows too few edges to tell the right extrinsic"
    return [_answer(one, whole, road, p) for one in judged]


def _cloud_lines(road: _Road, rng: np.random.Generator) -> tuple[list[CloudLine], ...]:
    """Lines of the whole turn, and lanes of each half of it along the road: a bend parts them."""
    xyz, everywhere = road.cloud.xyz, np.ones(len(road.cloud), dtype=np.bool_)
    lanes = find_lanes(road.cloud, road.ground, everywhere, rng, origin=road.origin)
    poles = find_poles(road.cloud, road.ground, everywhere, origin=road.origin)
    if not lanes:
        return ([*lanes, *poles],)
    longest = max(lanes, key=lambda line: float(np.linalg.norm(line.end - line.start)))
    along = xyz @ (longest.end - longest.start).astype(np.float32)
    halves = [
        find_lanes(road.cloud, road.ground, half, rng, origin=road.origin) for half in (along > 0, along < 0)
    ]
    return ([*lanes, *poles], *halves)


def _best_by_paint(T: Floats, points: SemanticPoints, road: _Road, p: NoPriorParameters) -> Floats:
    """Of extrinsics (N,4,4) the best different ones by paint alone: poles are not in place yet."""
    lane = points.lane[:: max(1, len(points.lane) // p.points)]
    paint = SemanticPoints(lane, points.pole[:0])
    scores = semantic_cost(T, paint, coarse.above_chance(road.maps, coarse.SEEK), road.camera)
    T = T[np.argsort(-scores, kind="stable")]
    return T[distinct(T, p.apart_rad, p.apart_m, p.judged)]


def _best_by_lines(T: Floats, points: SemanticPoints, road: _Road, p: NoPriorParameters) -> Floats:
    """Of extrinsics (N,4,4) the best different ones by paint and poles."""
    lane, pole = (xyz[:: max(1, len(xyz) // p.points)] for xyz in (points.lane, points.pole))
    some, heights = SemanticPoints(lane, pole), coarse.above_chance(road.maps, coarse.SEEK)
    T = T[np.argsort(-semantic_cost(T, some, heights, road.camera), kind="stable")]
    return T[distinct(T, p.apart_rad, p.apart_m, p.judged)]


def _near_prior(
    prior: Prior,
    points: SemanticPoints,
    road: _Road,
    scene: Scene,
    rng: np.random.Generator,
    p: NoPriorParameters,
) -> Floats:
    """Extrinsics (N,4,4) to begin with: the prior itself, the highest J, and where edges begin to fit."""
    sigma = np.array([prior.sigma_rad] * 3 + [prior.sigma_m] * 3)
    starts = [prior.T_cam_lidar[None], best_starts(prior.T_cam_lidar, sigma, scene, p.candidates, rng)]
    some = points_in_view(points, road.camera, prior.T_cam_lidar)
    if len(some.lane) and len(some.pole):
        search = EvolutionParameters(angle=prior.sigma_rad, shift=prior.sigma_m)
        ridge = height_maps(road.masks, road.camera, "ridge")
        found = evolution_search(prior.T_cam_lidar, some, (road.maps, ridge), road.camera, rng, search)
        starts.append(found.T_cam_lidar[None])
    return np.concatenate(starts)


def _missing(cloud_lines: Sequence[CloudLine], image_lines: Sequence[ImageLine]) -> Reason:
    """Why there is nothing to judge."""
    if sum(line.label == "lane" for line in image_lines) < _TWO:
        return "fewer than two lanes in the image"
    if sum(line.label == "lane" for line in cloud_lines) < _TWO:
        return "fewer than two lanes in the cloud"
    return "no extrinsic puts the lanes of the cloud on those of the image"


_TWO = 2
"""Lanes that an extrinsic needs."""


def _answer(one: Judged, lines: Sequence[CloudLine], road: _Road, p: NoPriorParameters) -> Answer:
    """A judged candidate with what its lines say."""
    heights = coarse.above_chance(road.maps, coarse.SETTLE)
    total, shares = one.score, []
    for label in ("lane", "pole"):
        own = [line.points for line in lines if line.label == label]
        if not own:
            continue
        each = [
            _height(road.cloud.xyz[points], label, heights, one.T_cam_lidar, road.camera) for points in own
        ]
        count = np.array([len(points) for points in own], dtype=np.float64)
        mean = float(count @ each / count.sum())
        total += p.lines_weight * mean
        shares.append(p.lines_weight * count * (np.array(each) - mean) / count.sum())
    return Answer(one.T_cam_lidar, total, one.peak, np.concatenate([one.cells, *shares]))


def _height(xyz: np.ndarray, label: str, maps: HeightMaps, T: Floats, camera: CameraModel) -> float:
    """Mean height of the points (N,3) of one line."""
    lane, pole = (xyz, xyz[:0]) if label == "lane" else (xyz[:0], xyz)
    return float(semantic_cost(T[None], SemanticPoints(lane, pole), maps, camera)[0])


def lead(first: Answer, second: Answer) -> float:
    """By how many of its own standard errors the first scores more than the second.

    What falls into one cell of the image is one observation, and so is a line: the same car is one witness.
    """
    size = max(len(first.cells), len(second.cells))
    a, b = (np.pad(one.cells, (0, size - len(one.cells))) for one in (first, second))
    return (first.score - second.score) / max(float(np.linalg.norm(a - b)), 1e-9)


def _verdict(answers: Sequence[Answer], p: NoPriorParameters) -> FoundExtrinsic | NoExtrinsic:
    order = sorted(answers, key=lambda answer: -answer.score)
    T = np.stack([answer.T_cam_lidar for answer in order])
    kept = distinct(T, p.candidates.distinct_rad, p.candidates.distinct_m).tolist()
    best = tuple(order[k] for k in kept)
    margin = min((lead(best[0], other) for other in best[1:]), default=math.inf)
    if best[0].peak < p.least_peak:
        return NoExtrinsic("image and cloud show hardly more in common than by chance", best, margin)
    if margin < p.least_lead:
        return NoExtrinsic("another extrinsic fits as well", best, margin)
    return FoundExtrinsic(best[0].T_cam_lidar, margin, best)
