"""Every value that passes between stages. Arrays are read-only views; a value never changes once made.

Conventions, fixed here for the whole project:
- Pixel centres lie at integer coordinates; u to the right, v down.
- Camera optical frame: x right, y down, z forward. LiDAR points stay in the frame of their message, whatever
  its axes.
- ``T_cam_lidar`` maps LiDAR points into the camera frame: ``p_C = R p_L + t``.
- A perturbation ``xi = (phi, rho)`` acts from the left in camera axes: ``R <- Exp(phi) R``,
  ``t <- Exp(phi) t + rho`` (FORMULAS A2).
- Vehicle axes: x forward, y left, z up; six-vectors for people are ordered roll, pitch, yaw, forward, left,
  up.
- Metres, radians, seconds; stamps are integer nanoseconds of the data's own clock.
"""

from dataclasses import dataclass
from typing import Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipeline.errors import InputError

Floats: TypeAlias = NDArray[np.float64]
_T = TypeVar("_T", bound=np.generic)
LineLabel: TypeAlias = Literal["lane", "pole", "structure"]

AXES = ("roll", "pitch", "yaw", "forward", "left", "up")
"""Names and order of the six axes in which drift is told (the first three in radians, the rest in metres)."""


def read_only(array: NDArray[_T]) -> NDArray[_T]:
    """A view of ``array`` that refuses writes; the array itself is not copied."""
    view = array.view()
    view.flags.writeable = False
    return view


def _hold(record: object, name: str, dtype: type[np.generic], shape: tuple[int | None, ...]) -> None:
    """Checks one array field of a frozen record and replaces it by a read-only view."""
    array = np.asarray(getattr(record, name))
    fits = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=False)
    )
    if array.dtype != dtype or not fits:
        owner = type(record).__name__
        message = f"{owner}.{name}: {array.dtype}{array.shape}, wanted {np.dtype(dtype).name}{shape}"
        raise InputError(message)
    object.__setattr__(record, name, read_only(array))


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """One LiDAR sweep without invalid points.

    Attributes:
        xyz: float32 (N,3), metres, LiDAR frame, finite.
        intensity: float32 (N,) in 0..1, or None where the sensor gives none.
        ring: uint16 (N,), index of the laser, or None.
        time: float32 (N,), seconds after the stamp of the sweep (may be negative), or None.
    """

    xyz: NDArray[np.float32]
    intensity: NDArray[np.float32] | None = None
    ring: NDArray[np.uint16] | None = None
    time: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        _hold(self, "xyz", np.float32, (None, 3))
        for name, dtype in (("intensity", np.float32), ("ring", np.uint16), ("time", np.float32)):
            if getattr(self, name) is not None:
                _hold(self, name, dtype, (len(self.xyz),))

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, slots=True, eq=False)
class CameraImage:
    """One decoded image.

    Attributes:
        pixels: uint8 (H,W,3), BGR.
    """

    pixels: NDArray[np.uint8]

    def __post_init__(self) -> None:
        _hold(self, "pixels", np.uint8, (None, None, 3))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px."""
        return self.pixels.shape[1], self.pixels.shape[0]


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """Intrinsics of one camera; ``pipeline.cameras`` projects with it.

    Attributes:
        model: "pinhole", "plumb_bob", "rational_polynomial" or "equidistant" (names of the ROS messages).
        K: float64 (3,3), px, acts on points.
        D: float64 (M,), distortion coefficients in OpenCV's order; empty for "pinhole".
        width: px.
        height: px.
    """

    model: str
    K: Floats
    D: Floats
    width: int
    height: int

    def __post_init__(self) -> None:
        _hold(self, "K", np.float64, (3, 3))
        _hold(self, "D", np.float64, (None,))
        if not (np.isfinite(self.K).all() and self.K[0, 0] > 0 and self.K[1, 1] > 0 and self.K[2, 2] == 1):
            raise InputError(
                f"camera matrix K {self.K.tolist()} has no positive focal length",
                hint="K is [[fu, s, cu], [0, fv, cv], [0, 0, 1]] in px",
            )
        if not np.isfinite(self.D).all():
            raise InputError(f"distortion D {self.D.tolist()} is not finite")
        if self.width <= 0 or self.height <= 0:
            raise InputError(f"camera size {self.width}x{self.height} is not positive")


@dataclass(frozen=True, slots=True, eq=False)
class FramePair:
    """A sweep and the image that goes with it.

    Attributes:
        pair: Name of the pair in the rig.
        cloud: The sweep.
        image: The image.
        cloud_stamp_ns: Stamp of the sweep, ns.
        image_stamp_ns: Stamp of the image, ns.
        sweep_s: Duration of the sweep in s where the source knows it, or None.
    """

    pair: str
    cloud: PointCloud
    image: CameraImage
    cloud_stamp_ns: int
    image_stamp_ns: int
    sweep_s: float | None = None

    @property
    def gap_ns(self) -> int:
        """Image stamp minus cloud stamp, ns."""
        return self.image_stamp_ns - self.cloud_stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class Masks:
    """Lane and pole masks of one image, on a grid that may be coarser than the image.

    A grid pixel (i, j) lies at image px ``(i + 0.5) / scale_x - 0.5, (j + 0.5) / scale_y - 0.5``.

    Attributes:
        lane: bool (h,w).
        pole: bool (h,w).
        lane_probability: float32 (h,w), 0..1.
        pole_probability: float32 (h,w), 0..1.
        scale_x: grid px per image px, horizontally.
        scale_y: grid px per image px, vertically.
    """

    lane: NDArray[np.bool_]
    pole: NDArray[np.bool_]
    lane_probability: NDArray[np.float32]
    pole_probability: NDArray[np.float32]
    scale_x: float
    scale_y: float

    def __post_init__(self) -> None:
        shape = self.lane.shape
        _hold(self, "lane", np.bool_, (None, None))
        _hold(self, "pole", np.bool_, shape)
        _hold(self, "lane_probability", np.float32, shape)
        _hold(self, "pole_probability", np.float32, shape)


@dataclass(frozen=True, slots=True, eq=False)
class ImageLine:
    """A straight line seen in the image, AFTER its points were undistorted (FORMULAS E1).

    Attributes:
        label: Class of the line.
        start: float64 (2,), px of the ideal pinhole image with the camera's own K.
        end: float64 (2,), likewise.
        sigma_px: Standard deviation of the fitted line at its ends, across the line, px.
    """

    label: LineLabel
    start: Floats
    end: Floats
    sigma_px: float

    def __post_init__(self) -> None:
        _hold(self, "start", np.float64, (2,))
        _hold(self, "end", np.float64, (2,))


@dataclass(frozen=True, slots=True, eq=False)
class LineArc:
    """How a line bends: its course against the straight one, at distance s from the points' mean.

    Attributes:
        offset: float64 (3,3), rows c0 (m), c1, c2 (1/m): the course lies ``c0 + c1 s + c2 s^2`` off the
            straight line.
        covariance: float64 (3,3), of (c0, c1, c2), the same for each axis across the line.
    """

    offset: Floats
    covariance: Floats

    def __post_init__(self) -> None:
        _hold(self, "offset", np.float64, (3, 3))
        _hold(self, "covariance", np.float64, (3, 3))


@dataclass(frozen=True, slots=True, eq=False)
class CloudLine:
    """A straight line fitted to points of the cloud.

    Attributes:
        label: Class of the line.
        start: float64 (3,), metres, LiDAR frame.
        end: float64 (3,), likewise.
        points: int64 (m,), indices of its points in the cloud.
        sigma_m: Noise of one point across the line, metres per axis (sigma_p of FORMULAS D1).
        spread: Sum of squared distances of the points along the line from their mean, m^2 (S of FORMULAS D1).
        mean_m: Distance of the points' mean from ``start`` along the line, metres; None for the middle.
        arc: How the line bends, s counted from the points' mean towards ``end``; None: it is straight.
    """

    label: LineLabel
    start: Floats
    end: Floats
    points: NDArray[np.int64]
    sigma_m: float
    spread: float
    mean_m: float | None = None
    arc: LineArc | None = None

    def __post_init__(self) -> None:
        _hold(self, "start", np.float64, (3,))
        _hold(self, "end", np.float64, (3,))
        _hold(self, "points", np.int64, (None,))


@dataclass(frozen=True, slots=True, eq=False)
class LineMatch:
    """A cloud line and the image line that shows the same thing.

    Attributes:
        cloud: The line in the LiDAR frame.
        image: The line in the undistorted image.
    """

    cloud: CloudLine
    image: ImageLine


@dataclass(frozen=True, slots=True, eq=False)
class WitnessEstimate:
    """What one witness says about the extrinsic over the window.

    ``T_estimated = se3.retract(T_stored, xi)``; a direction without information keeps the stored value.

    Attributes:
        witness: "lines" or "edges".
        xi: float64 (6,), (phi, rho) against the stored extrinsic, camera axes, rad and m.
        information: float64 (6,6), inverse covariance of xi, symmetric and semidefinite (singular where
            held).
        frames: Number of frames that took part.
        features: Number of lines or edges that took part.
        chi2: Residual statistic per degree of freedom (1 where the noise model fits).
    """

    witness: Literal["lines", "edges"]
    xi: Floats
    information: Floats
    frames: int
    features: int
    chi2: float

    def __post_init__(self) -> None:
        _hold(self, "xi", np.float64, (6,))
        _hold(self, "information", np.float64, (6, 6))
