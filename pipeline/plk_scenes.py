"""Simulated lines for PLK-Calib's published experiments (FORMULAS H).

The lines and the camera are exact, the ends of the image lines are noisy, and which image line shows which
cloud line is known: what is measured with them is the solvers, nothing before them.
"""

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from pipeline import se3
from pipeline.plk import LinePairs
from pipeline.records import Floats, read_only

Method: TypeAlias = Literal["I", "II", "ours"]
METHODS: tuple[Method, ...] = ("I", "II", "ours")
"""Method I from the start; method II; method I from the start or from II, whichever is cheaper."""

K: Floats = read_only(np.array([[600.0, 0.0, 640.0], [0.0, 600.0, 360.0], [0.0, 0.0, 1.0]]))
IMAGE_SIZE = (1280, 720)
"""px; the principal point of FORMULAS H lies in its middle."""

START_ANGLE = math.radians(5.0)
START_SHIFT = 0.5
"""rad about and m along each axis: the published initial error."""

SCENES = ("a", "b", "c", "d", "e", "corner")
"""Scenes of Table I as rebuilt in FORMULAS H, and three edges that meet in one corner (FORMULAS C8)."""

_SIDE = 1.5 * np.array([0.2, 1.0, 0.1])
_CORNER = np.array([0.4, -0.3, 7.0])
_CORNER_EDGES = np.array([[1.4, 0.3, 0.5], [-0.5, 1.3, 0.4], [-0.3, -0.5, 1.4]])
_RANDOM_TEN = """1.26,1.53,12.55 .24,1.01,11.41 1.01,.28,9.01 2.85,1.62,9.41 .22,.96,14.49 -.16,-.62,13.42
-2.13,.47,6.92 -1.94,.25,3.87 1.11,.74,10.04 -.44,-.65,8.9 .38,-1.36,12.25 -1.95,-1.81,12.69 3.39,-.28,11.58
.78,1.17,11.78 -1.01,-1.06,5.98 -.66,1.68,5.08 .01,1.31,10.82 -1.46,1.75,9.8 -.97,-1.61,9.52 .25,-.05,7.72"""

_SHORTEST_PX = 20.0
"""px; shorter image lines are discarded, as published."""

_LENGTHS = (1.5, 4.0)
"""m; lines of drawn scenes: kerbs, posts, door frames as far as one image line reaches."""


def _euler(yaw: float, pitch: float, roll: float) -> Floats:
    """Rz(yaw) Ry(pitch) Rx(roll), rad."""
    turns = np.diag([roll, pitch, yaw])
    return se3.exp_so3(turns[2]) @ se3.exp_so3(turns[1]) @ se3.exp_so3(turns[0])


TRUTH: Floats = read_only(
    se3.transform(
        (_euler(*np.radians([2.0, -1.0, 1.5])) @ se3.AXES_CAM_IN_VEHICLE).T, np.array([0.10, -0.25, -0.15])
    )
)
"""T_cam_lidar (4,4) of every experiment."""


def start_off(signs: Floats) -> Floats:
    """The published initial guess (4,4): wrong by 5 deg about and 0.5 m along each axis.

    Args:
        signs: float64 (6,), +1 or -1 for roll, pitch, yaw and the three translations.
    """
    turn = _euler(*(START_ANGLE * signs[2::-1]))
    return se3.transform(turn @ TRUTH[:3, :3], TRUTH[:3, 3] + START_SHIFT * signs[3:])


START: Floats = read_only(start_off(np.ones(6)))
"""The initial guess of Table I: 0.149 rad and 0.866 m from the truth."""


@dataclass(frozen=True, slots=True, eq=False)
class LineScene:
    """Lines in the axes of the true camera.

    Attributes:
        start: float64 (N,3), m: one end of each line.
        end: float64 (N,3), the other.
        meet: float64 (4,), homogeneous point through which all lines go (at infinity where they are
            parallel), or None: no line tells how far the camera is from it (FORMULAS D4).
    """

    start: Floats
    end: Floats
    meet: Floats | None = None

    def held(self, T_cam_lidar: Floats) -> Floats | None:
        """Unit translation (3,), camera axes, that the lines can not see from ``T_cam_lidar``, or None."""
        if self.meet is None:
            return None
        towards = (T_cam_lidar @ se3.inverse(TRUTH) @ self.meet)[:3]
        return np.asarray(towards / np.linalg.norm(towards))


def scene(name: str) -> LineScene:
    """One of ``SCENES``."""
    if name in ("a", "b"):
        ends = np.array(
            [[[-2, -1.5, 6], [-1.5, 2, 7]], [[1, -1.8, 5], [3, 0.5, 9]], [[-1.5, 1.5, 5], [2.5, 1, 8]]],
            dtype=np.float64,
        )
        if name == "b":
            ends[:, :, 2] = 7 + 0.3 * ends[:, :, 0] + 0.2 * ends[:, :, 1]
        return LineScene(ends[:, 0], ends[:, 1])
    if name in ("c", "d"):
        middles = {"c": [[-2, 0, 6], [0.5, 0, 9], [2, 0, 7]], "d": [[-2, 0, 6], [0, 0, 6.6], [2, 0, 7.2]]}
        middle = np.array(middles[name], dtype=np.float64)
        return LineScene(middle - _SIDE, middle + _SIDE, np.append(_SIDE, 0.0))
    if name == "e":
        ends = np.array([[float(x) for x in point.split(",")] for point in _RANDOM_TEN.split()])
        return LineScene(ends[0::2], ends[1::2])
    return LineScene(np.tile(_CORNER, (3, 1)), _CORNER + _CORNER_EDGES, np.append(_CORNER, 1.0))


def pixels(points: Floats) -> Floats:
    """Image points (N,2) of points (N,3) in camera axes that lie in front of the camera."""
    uv = points @ K.T
    return np.asarray(uv[:, :2] / uv[:, 2:])


def observed(lines: LineScene, sigma_px: float, rng: np.random.Generator) -> LinePairs:
    """The lines in the LiDAR frame with what the true camera sees of them.

    Args:
        lines: The scene.
        sigma_px: Noise of each of the four coordinates of the image ends, px.
        rng: Where the noise comes from.
    """
    to_lidar = se3.inverse(TRUTH)
    first, last = (
        pixels(points) + rng.normal(0.0, sigma_px, (len(points), 2)) for points in (lines.start, lines.end)
    )
    covariance = np.broadcast_to(sigma_px**2 * np.eye(2), (len(lines.start), 2, 2))
    return LinePairs(
        se3.apply(to_lidar, lines.start), se3.apply(to_lidar, lines.end), first, last, covariance
    )


def drawn_scene(near: float, far: float, count: int, rng: np.random.Generator) -> LineScene:
    """``count`` lines of any direction: both ends in the image, the middle near..far m ahead."""
    chosen: list[tuple[Floats, Floats]] = []
    while len(chosen) < count:
        uv = rng.uniform(0.0, 1.0, 2) * IMAGE_SIZE
        middle = np.linalg.solve(K, np.append(uv, 1.0)) * rng.uniform(near, far)
        along = rng.normal(size=3)
        side = along / np.linalg.norm(along) * 0.5 * rng.uniform(*_LENGTHS)
        ends = np.stack([middle - side, middle + side])
        # Closer than half the nearest distance the end of a line would rule the whole scene.
        if ends[:, 2].min() < 0.5 * near:
            continue
        shown = pixels(ends)
        inside = ((shown >= 0.0) & (shown <= IMAGE_SIZE)).all()
        if inside and np.linalg.norm(shown[1] - shown[0]) >= _SHORTEST_PX:
            chosen.append((ends[0], ends[1]))
    return LineScene(np.array([one for one, _ in chosen]), np.array([other for _, other in chosen]))


def errors(T_cam_lidar: Floats | None) -> tuple[float, float]:
    """Rotation, rad, and translation |t - t_true|, m (CRLF (15), (16)); NaN where there is no answer."""
    if T_cam_lidar is None:
        return math.nan, math.nan
    return (
        se3.rotation_angle(T_cam_lidar[:3, :3], TRUTH[:3, :3]),
        float(np.linalg.norm(T_cam_lidar[:3, 3] - TRUTH[:3, 3])),
    )
