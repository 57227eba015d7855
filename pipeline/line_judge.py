"""A second judge between rival fits: how well they put lanes and poles of the cloud on their masks.

Edges of one look at a street may fit as well two degrees off. Lanes and poles are few, but known by name:
where a fit leaves one beside its mask, J of CRLF (9) tells, line by line. One line is one witness, however
many points it has.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from scipy.stats import qmc

from pipeline import se3
from pipeline.cameras import project
from pipeline.height_maps import HeightMaps, height_maps
from pipeline.records import CameraModel, CloudLine, Floats, LineLabel, Masks, PointCloud
from pipeline.semantic_cost import EvolutionParameters, SemanticPoints, evolution_search, semantic_cost

_Line: TypeAlias = tuple[LineLabel, Floats]
"""Class and points (N,3) of a line."""


@dataclass(frozen=True, slots=True)
class LineJudgeParameters:
    """How far lanes and poles are believed.

    Attributes:
        sigma_height: Error of a line's mean height: 3 px that the contour of a mask is off, at 0.98 per px.
        wrong: Share of lines that are none, or whose mask shows another one; all of a frame may be such.
        least_points: Of a line that all fits see; fewer are no line.
        draws: Of the lines' weights and errors that tell which fit is right.
        places: Extrinsics around the first guess at which J is looked up; a power of two.
        picked: The best of them.
        searches: Searches for the maximum of J.
    """

    sigma_height: float = 0.06
    wrong: float = 0.2
    least_points: int = 5
    draws: int = 512
    places: int = 4096
    picked: int = 64
    searches: int = 3


@dataclass(frozen=True, slots=True, eq=False)
class JudgedFrame:
    """Lanes and poles of one frame.

    Attributes:
        lines: Class and points (N,3), m, LiDAR frame, of each.
        maps: Plateau maps of the image's masks.
    """

    lines: tuple[_Line, ...]
    maps: HeightMaps


def judged_frame(
    cloud: PointCloud, lines: Sequence[CloudLine], masks: Masks, camera: CameraModel
) -> JudgedFrame:
    """The lanes and poles of a cloud and the maps of an image's masks."""
    points = tuple((line.label, cloud.xyz[line.points].astype(np.float64)) for line in lines)
    return JudgedFrame(points, height_maps(masks, camera, "plateau"))


@dataclass(frozen=True, slots=True, eq=False)
class LineJudge:
    """Judges extrinsics by the lanes and poles of some frames.

    Attributes:
        frames: Of one pair of sensors.
        camera: Intrinsics of the raw images.
        parameters: See there.
    """

    frames: tuple[JudgedFrame, ...]
    camera: CameraModel
    parameters: LineJudgeParameters = field(default_factory=LineJudgeParameters)

    def heights(self, T_cam_lidar: Floats) -> Floats:
        """Mean height (L,M), 0..1, of each line under each extrinsic (M,4,4).

        Of the points that all extrinsics see: one that leaves the image says nothing about either.
        """
        rows = []
        for frame in self.frames:
            for label, xyz in frame.lines:
                seen = np.all([project(self.camera, se3.apply(T, xyz))[1] for T in T_cam_lidar], axis=0)
                if seen.sum() >= self.parameters.least_points:
                    some = _points([(label, xyz[seen])])
                    rows.append(semantic_cost(T_cam_lidar, some, frame.maps, self.camera))
        return np.stack(rows) if rows else np.zeros((0, len(T_cam_lidar)))

    def odds(self, T_cam_lidar: Floats, rng: np.random.Generator) -> Floats:
        """How likely each extrinsic (M,4,4) is by its lines, (M,), adds up to 1; even where none tells.

        The share of draws (Bayesian bootstrap over the lines, and the error of each height) that an extrinsic
        wins, mixed with evenness by the chance that every line is a wrong one. Several frames of a drive show
        the same lines: all of them are worth one.
        """
        count = len(T_cam_lidar)
        heights = self.heights(T_cam_lidar)
        if len(heights) == 0:
            return np.full(count, 1.0 / count)
        p = self.parameters
        weights = rng.exponential(size=(p.draws, len(heights)))
        # Errors of the heights, weighed and added up, are one normal error of the sum.
        same = len(self.frames)
        sigma = p.sigma_height * same**0.5 * np.linalg.norm(weights, axis=1, keepdims=True)
        error = sigma * rng.normal(size=(p.draws, count))
        won = np.bincount(np.argmax(weights @ heights + error, axis=1), minlength=count) / p.draws
        all_wrong = p.wrong ** (len(heights) / same)
        return np.asarray(all_wrong / count + (1.0 - all_wrong) * won, dtype=np.float64)

    def starts(
        self, T_guess: Floats, T_seen: Floats, sigma: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """Where around a first guess lines lie on their masks, by the frame with the most lines.

        Few lines leave J flat on top: searches for its maximum end in different places of it, and single
        places all over it may be nearer to the truth.

        Args:
            T_guess: float64 (4,4), the first guess.
            T_seen: float64 (4,4); the points that it sees take part.
            sigma: float64 (6,), how far off the first guess may be, rad and m.
            rng: Draws places.

        Returns:
            Where searches end, float64 (S,4,4), and the best of evenly drawn places, float64 (P,4,4); none
            where no line is seen.
        """
        p = self.parameters
        frames = [(self._seen(frame, T_seen), frame.maps) for frame in self.frames]
        best, maps = max(frames, key=lambda frame: len(frame[0]), default=((), None))
        if maps is None or not best:
            return np.zeros((0, 4, 4)), np.zeros((0, 4, 4))
        points = _points(best)
        search = EvolutionParameters(angle=sigma[0], shift=sigma[3], reach=_REACH, least=_LEAST)
        summits = [
            evolution_search(T_guess, points, (maps,), self.camera, rng, search).T_cam_lidar
            for _ in range(p.searches)
        ]
        drawn = (2.0 * qmc.Sobol(6, rng=rng).random(p.places) - 1.0) * _REACH * sigma
        places = np.stack([se3.retract(T_guess, xi) for xi in drawn])
        order = np.argsort(-semantic_cost(places, points, maps, self.camera), kind="stable")
        return np.stack(summits), places[order[: p.picked]]

    def _seen(self, frame: JudgedFrame, T: Floats) -> tuple[_Line, ...]:
        """What an extrinsic sees of a frame's lines, few points of each: one line is one witness."""
        seen = [(label, xyz[project(self.camera, se3.apply(T, xyz))[1]]) for label, xyz in frame.lines]
        return tuple(
            (label, xyz[:: -(-len(xyz) // _FEW)])
            for label, xyz in seen
            if len(xyz) >= self.parameters.least_points
        )


_REACH = 2.0
"""Sigmas of the prior: 95 % of each axis."""
_LEAST = 0.05
"""Sigmas of the prior at which a search ends: edges climb on from there."""
_FEW = 30
"""Points of a line that take part in a search."""


def _points(lines: Sequence[_Line]) -> SemanticPoints:
    """The points of lines by class."""
    none = [np.zeros((0, 3))]
    return SemanticPoints(
        *(
            np.concatenate(none + [xyz for label, xyz in lines if label == wanted]).astype(np.float32)
            for wanted in ("lane", "pole")
        )
    )
