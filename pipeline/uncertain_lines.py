"""A 3-D line segment that knows how sure it is, at both ends and in both directions across."""

import math
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pipeline.records import CloudLine, Floats, read_only

LineKind: TypeAlias = Literal["crease", "border", "jump"]
"""crease: two planes meet; border: a plane ends before something further away; jump: of range, on rings."""

LEVER = 0.1
"""Camera's distance from the LiDAR over the range (1 m at 10 m): so much of an error in depth a camera sees
sideways of which nothing is known yet."""

_LEAST_TILT = 1e-6
"""Share of the variance that the tilt has at least: an error common to both ends has none, and no finite
spread of points would say so."""

_NO_LENGTH_M = 1e-9
"""m; a line that points at the eye has no depth across."""


@dataclass(frozen=True, slots=True, eq=False)
class UncertainLine:
    """A segment with the covariance of its two ends across it.

    Attributes:
        kind: How it was found.
        start: float64 (3,), m, LiDAR frame.
        end: float64 (3,), likewise.
        points: int64 (m,), indices of its points in the cloud, at least one.
        covariance: float64 (4,4), m^2: start sideways, start in depth, end sideways, end in depth, along
            ``axes``.
        origin: float64 (3,), m, LiDAR frame: where the sensor stands.
    """

    kind: LineKind
    start: Floats
    end: Floats
    points: NDArray[np.int64]
    covariance: Floats
    origin: Floats = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        for name in ("start", "end", "points", "covariance", "origin"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def length(self) -> float:
        """Length, m."""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def direction(self) -> Floats:
        """Unit vector (3,) from start to end."""
        return (self.end - self.start) / max(self.length, _NO_LENGTH_M)

    @property
    def axes(self) -> Floats:
        """Rows (2,3): unit vectors across the line, sideways and in depth for an eye at the sensor."""
        return across(self.direction, 0.5 * (self.start + self.end) - self.origin)

    @property
    def sideways(self) -> Floats:
        """Covariance (2,2), m^2, of start and end as a camera somewhere beside the sensor sees them."""
        return np.asarray(self.covariance[::2, ::2] + LEVER**2 * self.covariance[1::2, 1::2])

    def seen_from(self, eye: Floats) -> Floats:
        """Covariance (2,2), m^2, of start and end sideways for a camera at ``eye`` (3,), LiDAR frame.

        Eye and line span one plane; only what leads out of it is seen. A camera far from the sensor sees much
        of an error in depth.
        """
        out = across(self.direction, 0.5 * (self.start + self.end) - eye)[0] @ self.axes.T
        H = np.kron(np.eye(2), out)
        return np.asarray(H @ self.covariance @ H.T)

    def moved(self, R: Floats, t: Floats) -> "UncertainLine":
        """The same line in a frame to which ``R p + t`` brings points; the sensor and the axes move along."""
        start, end, origin = (R @ point + t for point in (self.start, self.end, self.origin))
        return UncertainLine(self.kind, start, end, self.points, self.covariance, origin)


def across(direction: Floats, place: Floats) -> Floats:
    """Rows (2,3) across a unit ``direction``: sideways, and in depth, for an eye at the origin."""
    depth = place - (place @ direction) * direction
    norm = float(np.linalg.norm(depth))
    if norm < _NO_LENGTH_M:
        helper = np.zeros(3)
        helper[int(np.argmin(np.abs(direction)))] = 1.0
        depth, norm = np.cross(direction, helper), float(np.linalg.norm(np.cross(direction, helper)))
    depth = depth / norm
    (a, b, c), (x, y, z) = direction.tolist(), depth.tolist()
    # Written out: np.cross takes 20 times as long for one pair, and lines come in hundreds.
    return np.array([[b * z - c * y, c * x - a * z, a * y - b * x], [x, y, z]])


def ends_covariance(along: Floats, ends: tuple[float, float], sigma: float) -> Floats:
    """Covariance (2,2) of a fitted line's offset at two positions (1/m + s s'/S of FORMULAS D1).

    Args:
        along: float64 (m,), positions of the fitted points along the line, m.
        ends: The two positions.
        sigma: Independent noise of a point across, m.
    """
    mean = float(along.mean())
    spread = max(float(((along - mean) ** 2).sum()), 1e-9)
    arm = np.array(ends) - mean
    return np.asarray(sigma**2 * (1.0 / len(along) + np.outer(arm, arm) / spread))


def structure_line(line: UncertainLine, eye: Floats) -> CloudLine:
    """The line as a record whose noise, D1's way, is that of the line sideways at each place along it.

    Sideways is meant for a camera at ``eye`` (3,), m, LiDAR frame.

    The variance along a line is a parabola; the record's three numbers are its place, height and opening,
    told as those of ``m`` points with independent noise.
    """
    C, length, m = line.seen_from(eye), line.length, max(len(line.points), 1)
    tilt = max(float(C[0, 0] - 2.0 * C[0, 1] + C[1, 1]), _LEAST_TILT * float(C[0, 0] + C[1, 1]), 1e-18)
    middle = float(C[0, 0] - C[0, 1]) / tilt
    least = max(float(C[0, 0]) - middle**2 * tilt, 1e-12)
    return CloudLine(
        "structure",
        line.start,
        line.end,
        line.points,
        math.sqrt(m * least),
        m * least * length**2 / tilt,
        middle * length,
    )
