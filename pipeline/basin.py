"""How far off a start may be: lines, semantic cost and starts of one frame (PLK-Calib Fig. 6, CRLF Fig. 7).

``pipeline.plk_starts`` asks the same of PLK-Calib's simulated lines, half of the pose held. Here lines, masks
and points are those that were found in a frame, and the whole pose is sought.
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from pipeline import plk
from pipeline.height_maps import HeightMaps
from pipeline.plk import LinePairs
from pipeline.records import CameraModel, Floats, read_only
from pipeline.semantic_cost import SemanticPoints, evolution_search, points_in_view, random_search

Sweep: TypeAlias = Literal["rotation", "translation", "both"]
"""What is wrong at the start.

rotation: turned about the vehicle's up axis, as in PLK-Calib's Fig. 6.
translation: shifted along its left axis, likewise.
both: all six, drawn uniformly up to so much about each axis and a sixth of that in metres per degree along
    it, as in CRLF's Fig. 7: 6 deg and 1 m at most.
"""

OFFSETS: dict[Sweep, Floats] = {
    "rotation": read_only(np.radians([0.0, 2.0, 4.0, 6.0, 10.0, 16.0, 30.0, 46.0])),
    "translation": read_only(np.array([0.0, 0.2, 0.5, 1.0, 2.0, 3.5, 5.0])),
    "both": read_only(np.radians([1.0, 2.0, 4.0, 6.0])),
}
"""rad, m, rad."""

_WIDEST_RAD, _WIDEST_M = math.radians(6.0), 1.0
"""rad and m; CRLF's Fig. 7."""

SUCCESS_RAD, SUCCESS_M = math.radians(1.0), 0.3
"""rad and m; what ends farther off than this has gone to another maximum: noise of one frame leaves less."""

Method: TypeAlias = Literal["method I", "method II", "I from II", "Algorithm 1", "evolution"]
METHODS: tuple[Method, ...] = ("method I", "method II", "I from II", "Algorithm 1", "evolution")
"""The first three with known pairs; ``I from II`` is method I from the start or the answer of II, as the
watch has it."""

_LEAST_PAIRS = 3
"""Lines that six unknowns need."""


@dataclass(frozen=True, slots=True, eq=False)
class BasinScene:
    """What was found in one frame.

    Attributes:
        camera: Intrinsics.
        pairs: Lines that show the same thing, matched at the true extrinsic.
        points: Points of lanes and poles all around the LiDAR.
        plateau: Maps of the masks that are flat inside.
        ridge: Maps that are highest in the middle.
    """

    camera: CameraModel
    pairs: LinePairs
    points: SemanticPoints
    plateau: HeightMaps
    ridge: HeightMaps


def drift_of(sweep: Sweep, offset: float, rng: np.random.Generator) -> Floats:
    """Error of a start, motion of the mount (6,) in vehicle axes, rad and m; signs are drawn."""
    drift = np.zeros(6)
    if sweep == "both":
        drift[:3] = rng.uniform(-offset, offset, 3)
        most_m = offset * _WIDEST_M / _WIDEST_RAD
        drift[3:] = rng.uniform(-most_m, most_m, 3)
    else:
        drift[2 if sweep == "rotation" else 4] = offset * rng.choice([-1.0, 1.0])
    return drift


def answers(scene: BasinScene, T_start: Floats, rng: np.random.Generator) -> dict[Method, Floats | None]:
    """Extrinsic (4,4) that each method finds from a start; None where it gives no answer."""
    found: dict[Method, Floats | None] = dict.fromkeys(METHODS)
    K = scene.camera.K
    if len(scene.pairs) >= _LEAST_PAIRS:
        found["method I"] = plk.method_one(scene.pairs, K, T_start, start_two=False).T_cam_lidar
        found["method II"] = plk.method_two(scene.pairs, K, T_start)
        found["I from II"] = plk.method_one(scene.pairs, K, T_start).T_cam_lidar
    points = points_in_view(scene.points, scene.camera, T_start)
    if len(points.lane) + len(points.pole) > 0:
        low, high, camera = scene.plateau, scene.ridge, scene.camera
        found["Algorithm 1"] = random_search(T_start, points, (low, low, high, high), camera, rng).T_cam_lidar
        found["evolution"] = evolution_search(T_start, points, (low, high), camera, rng).T_cam_lidar
    return found


def succeeded(sweep: Sweep, error: tuple[float, float]) -> bool:
    """Whether an error (m, rad) is that of the right maximum, in the half of the pose that was wrong."""
    shift, angle = error
    return (sweep == "translation" or angle <= SUCCESS_RAD) and (sweep == "rotation" or shift <= SUCCESS_M)
