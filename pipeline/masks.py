"""Class probabilities of the network -> lane and pole masks: CRF, thresholds, the horizon, least sizes."""

import dataclasses
from dataclasses import dataclass, field
from typing import TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline import labels
from pipeline.crf import AppearanceKernel, CrfParameters, SmoothnessKernel, mean_field
from pipeline.errors import InputError, RigError
from pipeline.records import CameraModel, Floats, Masks

Floats32: TypeAlias = NDArray[np.float32]
Bools: TypeAlias = NDArray[np.bool_]
_K = TypeVar("_K", SmoothnessKernel, AppearanceKernel)

REFERENCE_WIDTH_PX = 1242
"""px; lengths below are those of an image of this width and grow with the image."""


def _gentle_crf() -> CrfParameters:
    return CrfParameters(
        smoothness=SmoothnessKernel(sigma_x_px=3.0, sigma_y_px=3.0, compat=1.0),
        appearance=AppearanceKernel(
            sigma_x_px=20.0, sigma_y_px=20.0, sigma_colour=(13.0, 13.0, 13.0), compat=3.0
        ),
        iterations=5,
    )


@dataclass(frozen=True, slots=True, eq=False)
class MaskParameters:
    """How probabilities become masks. All px are px of an image ``REFERENCE_WIDTH_PX`` wide.

    Attributes:
        lane_threshold: Least probability of paint, 0..1. One half: what is more likely paint than anything
            else together; the largest class alone paints too wide where three classes share a pixel.
        pole_threshold: Likewise for poles, whose cells are mostly covered in part: best between 0.2 and 0.4
            on the pictures that the network was trained on.
        crf: Kernel widths in px of the reference width, or None: the network's probabilities as they are. The
            default is gentle: weight 10 and widths of 80 px, common for large objects, take away poles of up
            to 8 px whose contrast is below 20 grey levels although the network saw every pixel of them.
        evidence: Least probability of paint or pole that lets a pixel take part in the CRF; to one half it is
            2.9 nats from there, three quarters of what full agreement under the default kernels could add.
        reach_sigmas: Pixels within this many appearance widths of evidence take part in the CRF; beyond two a
            pixel weighs less than an eighth of a near one.
        pole_keep: Least share of a pole's pixels, 0..1, that the CRF must leave, or the network's own mask
            stands: the CRF may trim a pole to its contour, not delete it.
        lane_least_px2: Smallest patch of paint, px^2: a dash 3 m long at 30 m under a camera 1.65 m high.
        pole_least_px2: Smallest piece of pole, px^2: 2 px wide, 12 px tall (1 m at 50 m).
        horizon_slack_px: Paint may lie this far above the horizon, px: 2 deg of pitch and slope at 720 px
            focal length.
    """

    lane_threshold: float = 0.5
    pole_threshold: float = 0.3
    crf: CrfParameters | None = field(default_factory=_gentle_crf)
    evidence: float = 0.05
    reach_sigmas: float = 2.0
    pole_keep: float = 0.5
    lane_least_px2: float = 12.0
    pole_least_px2: float = 24.0
    horizon_slack_px: float = 25.0

    def __post_init__(self) -> None:
        for name in ("lane_threshold", "pole_threshold", "evidence", "pole_keep"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise RigError(f"masks: {name} {getattr(self, name)} is no share", hint="0..1")
        for name in ("reach_sigmas", "lane_least_px2", "pole_least_px2", "horizon_slack_px"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise RigError(f"masks: {name} {getattr(self, name)} is negative or not finite")


def masks_from_probabilities(
    probabilities: Floats32,
    pixels: NDArray[np.uint8],
    parameters: MaskParameters,
    horizon: Floats | None = None,
    scale: tuple[float, float] | None = None,
) -> Masks:
    """Lane and pole masks on the grid of the probabilities.

    Args:
        probabilities: float32 (C,h,w), 0..1, classes in the order of ``pipeline.labels``; the grid covers the
            whole image and may be coarser than it.
        pixels: uint8 (H,W,3), the image the network saw, BGR.
        parameters: Thresholds, CRF and least sizes.
        horizon: float64 (3,), line ``l`` in image px with ``l . (u, v, 1) > 0`` on the ground's side
            (:func:`horizon_line`), or None: paint may lie anywhere.
        scale: Grid px per image px (``segmentation.grid_scale``), or None: it ends where the image does.
            A network's grid ends beyond it where the image's size is odd.

    Returns:
        Masks that share no pixel. Their probabilities are the CRF's marginals where it took part and was
        heeded, and the network's own elsewhere.

    Raises:
        InputError: Shapes do not fit, or a probability is not finite or outside 0..1.
    """
    _require_probabilities(probabilities, pixels)
    height, width = probabilities.shape[1:]
    scale_x, scale_y = scale or (width / pixels.shape[1], height / pixels.shape[0])
    # Grid px per px of the reference width, along each axis.
    unit_x, unit_y = width / REFERENCE_WIDTH_PX, scale_y * pixels.shape[1] / REFERENCE_WIDTH_PX
    lane_seen, pole_seen = probabilities[labels.LANE], probabilities[labels.POLE]
    lane_probability, pole_probability = lane_seen, pole_seen
    restored = np.zeros((height, width), dtype=np.bool_)
    if parameters.crf is not None:
        lane_probability, pole_probability = _refined(
            lane_seen, pole_seen, pixels, parameters, (unit_x, unit_y)
        )
        restored = _deleted_components(
            pole_seen >= parameters.pole_threshold,
            pole_probability >= parameters.pole_threshold,
            parameters.pole_keep,
        )
        lane_probability = np.where(restored, lane_seen, lane_probability)
        pole_probability = np.where(restored, pole_seen, pole_probability)
    pole = pole_probability >= parameters.pole_threshold
    lane = (lane_probability >= parameters.lane_threshold) & ~pole
    if horizon is not None:
        slack = parameters.horizon_slack_px * pixels.shape[1] / REFERENCE_WIDTH_PX
        lane &= _ground_side(horizon, slack, (height, width), (scale_x, scale_y))
    least = unit_x * unit_y
    return Masks(
        lane=_without_specks(lane, parameters.lane_least_px2 * least),
        pole=_without_specks(pole, parameters.pole_least_px2 * least),
        lane_probability=np.ascontiguousarray(lane_probability),
        pole_probability=np.ascontiguousarray(pole_probability),
        scale_x=scale_x,
        scale_y=scale_y,
    )


def horizon_line(camera: CameraModel, up_cam: Floats) -> Floats:
    """Line (3,) in px on which rays at right angles to ``up_cam`` (3,) lie, positive on the ground side.

    The lens' distortion is left out: it bends the horizon by less than ``horizon_slack_px`` allows.
    """
    return np.asarray(-np.linalg.inv(camera.K).T @ up_cam, dtype=np.float64)


_SUREST = 1e-4
"""Least probability the CRF is told: a class the network gives nothing can still be won by 9 nats."""


def _refined(
    lane: Floats32,
    pole: Floats32,
    pixels: NDArray[np.uint8],
    parameters: MaskParameters,
    unit: tuple[float, float],
) -> tuple[Floats32, Floats32]:
    """Marginals of lane and pole (h,w) by the CRF over lane, pole and the rest."""
    if parameters.crf is None:
        return lane, pole
    height, width = lane.shape
    crf = _on_grid(parameters.crf, unit)
    shrinks = width <= pixels.shape[1] and height <= pixels.shape[0]
    small = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    stack = np.stack([lane, pole, 1.0 - lane - pole])
    region = _surroundings(np.maximum(lane, pole) >= parameters.evidence, crf, parameters.reach_sigmas)
    unary = -np.log(np.clip(stack, _SUREST, 1.0))
    marginals = mean_field(unary, np.asarray(small, dtype=np.uint8), crf, region)
    return np.where(region, marginals[0], lane), np.where(region, marginals[1], pole)


def _on_grid(crf: CrfParameters, unit: tuple[float, float]) -> CrfParameters:
    """The same CRF with its widths in grid px."""
    smooth, like = crf.smoothness, crf.appearance
    return dataclasses.replace(
        crf,
        smoothness=None if smooth is None else _scaled(smooth, unit),
        appearance=None if like is None else _scaled(like, unit),
    )


def _scaled(kernel: _K, unit: tuple[float, float]) -> _K:
    return dataclasses.replace(
        kernel, sigma_x_px=kernel.sigma_x_px * unit[0], sigma_y_px=kernel.sigma_y_px * unit[1]
    )


def _surroundings(evidence: Bools, crf: CrfParameters, sigmas: float) -> Bools:
    """All pixels within ``sigmas`` widths of the wider kernel around the evidence."""
    kernels = [kernel for kernel in (crf.smoothness, crf.appearance) if kernel is not None]
    reach_x = int(np.ceil(sigmas * max((kernel.sigma_x_px for kernel in kernels), default=0.0)))
    reach_y = int(np.ceil(sigmas * max((kernel.sigma_y_px for kernel in kernels), default=0.0)))
    window = np.ones((2 * reach_y + 1, 2 * reach_x + 1), dtype=np.uint8)
    return np.asarray(cv2.dilate(evidence.astype(np.uint8), window)).astype(np.bool_)


def _deleted_components(seen: Bools, left: Bools, keep: float) -> Bools:
    """The connected pieces of ``seen`` of which less than the share ``keep`` is in ``left``."""
    count, pieces = _pieces(seen)
    size = np.bincount(pieces.ravel(), minlength=count)
    kept = np.bincount(pieces[left], minlength=count)
    deleted = kept < keep * size
    deleted[0] = False
    return np.asarray(deleted[pieces], dtype=np.bool_)


def _without_specks(mask: Bools, least: float) -> Bools:
    """The connected pieces (8 neighbours) of at least ``least`` px."""
    count, pieces = _pieces(mask)
    large = np.bincount(pieces.ravel(), minlength=count) >= least
    large[0] = False
    return np.asarray(large[pieces], dtype=np.bool_)


def _pieces(mask: Bools) -> tuple[int, NDArray[np.int32]]:
    """Number of labels and their image, int32 (h,w); label 0 is outside the mask."""
    count, pieces = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    return count, np.asarray(pieces, dtype=np.int32)


def _ground_side(
    horizon: Floats, slack_px: float, shape: tuple[int, int], scale: tuple[float, float]
) -> Bools:
    """Grid pixels (h,w) at most ``slack_px`` image px on the sky's side of the horizon."""
    if np.shape(horizon) != (3,) or not np.isfinite(horizon).all() or not np.any(horizon):
        raise InputError(f"horizon {np.asarray(horizon).tolist()} is no line", hint="three finite numbers")
    u = (np.arange(shape[1]) + 0.5) / scale[0] - 0.5
    v = (np.arange(shape[0]) + 0.5) / scale[1] - 0.5
    # A camera that looks straight down has its horizon at infinity: everything lies on one side.
    height = horizon[0] * u[None] + horizon[1] * v[:, None] + horizon[2]
    return np.asarray(height >= -slack_px * np.hypot(horizon[0], horizon[1]), dtype=np.bool_)


_ROUNDING = 1e-3
"""A float16 network may give probabilities this far outside 0..1."""


def _require_probabilities(probabilities: Floats32, pixels: NDArray[np.uint8]) -> None:
    shape = probabilities.shape
    if len(shape) != 3 or shape[0] != len(labels.NAMES) or 0 in shape or probabilities.dtype != np.float32:
        raise InputError(
            f"probabilities {probabilities.dtype}{shape} are no float32 ({len(labels.NAMES)},h,w)",
            hint="the network's classes are those of pipeline.labels",
        )
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8 or 0 in pixels.shape:
        raise InputError(f"image {pixels.dtype}{pixels.shape} is no uint8 (H,W,3)")
    low, high = float(probabilities.min()), float(probabilities.max())
    if not (low >= -_ROUNDING and high <= 1.0 + _ROUNDING):
        raise InputError(
            f"probabilities reach from {low} to {high}", hint="a softmax gives finite values in 0..1"
        )
