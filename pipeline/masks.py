"""Class probabilities of the network -> lane and pole masks: CRF, thresholds, horizon, which pieces stay."""

import dataclasses
from dataclasses import dataclass, field
from typing import TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline import labels
from pipeline.crf import AppearanceKernel, CrfParameters, SmoothnessKernel, mean_field
from pipeline.errors import InputError, RigError
from pipeline.mask_pieces import pieces_of
from pipeline.records import CameraModel, Floats, Masks

Floats32: TypeAlias = NDArray[np.float32]
Bools: TypeAlias = NDArray[np.bool_]
_K = TypeVar("_K", SmoothnessKernel, AppearanceKernel)

REFERENCE_WIDTH_PX = 1242
"""px; lengths below are those of an image of this width and grow with the image."""


@dataclass(frozen=True, slots=True, eq=False)
class ClassCrf:
    """How one class is told from all others by its neighbourhood.

    Attributes:
        crf: The CRF over the class and the rest, in this order; widths in px of the reference width.
        threshold: Least marginal that makes a mask, 0..1. Lower than the network's: a thin thing has more
            neighbours of other classes than of its own, so that its marginals fall; at these thresholds as
            much of it is found as without the CRF.
    """

    crf: CrfParameters
    threshold: float

    def __post_init__(self) -> None:
        if not 0.0 <= self.threshold <= 1.0:
            raise RigError(f"masks: threshold {self.threshold} after the CRF is no share", hint="0..1")


@dataclass(frozen=True, slots=True, eq=False)
class MaskCrf:
    """The CRFs of lane and pole, each for itself: hardly a pixel could be both. None: as the network says."""

    lane: ClassCrf | None
    pole: ClassCrf | None


def _appearance(compat: float) -> AppearanceKernel:
    """40 px: as far as one road or wall has one colour; 13 grey levels: a camera's noise, and shading."""
    return AppearanceKernel(sigma_x_px=40.0, sigma_y_px=40.0, sigma_colour=(13.0, 13.0, 13.0), compat=compat)


def _default_crf() -> MaskCrf:
    """Appearance alone: smoothness, isotropic or upright, lowers the precision of both classes."""
    return MaskCrf(
        lane=ClassCrf(CrfParameters(None, _appearance(3.0)), threshold=0.2),
        pole=ClassCrf(CrfParameters(None, _appearance(3.0), class_weights=(1.0, 0.5)), threshold=0.15),
    )


@dataclass(frozen=True, slots=True, eq=False)
class MaskParameters:
    """How probabilities become masks. All px are px of an image ``REFERENCE_WIDTH_PX`` wide.

    Attributes:
        lane_threshold: Least probability of paint by the network, 0..1: of every pixel of a mask, or where a
            CRF takes part of one pixel of every piece. One half: what is more likely paint than anything else
            together; the largest class alone paints too wide where three classes share a pixel.
        pole_threshold: Likewise for poles, whose cells are mostly covered in part: best between 0.2 and 0.4
            on the pictures that the network was trained on.
        crf: The CRFs, or None: the network's probabilities as they are. The common setting for large objects
            (weight 10, 80 px, with smoothness) takes away poles of up to 8 px.
        evidence: Least probability of a class that lets a pixel change by its CRF; from there to one half are
            2.9 nats, all that full agreement under the default kernels could add.
        margin_px: Pixels this near to evidence change too.
        pole_sure: A pole of which the network gives some cell this probability is no mistake of a few cells:
            the CRF may trim it to its contour, not delete it.
        pole_keep: Least share of a sure pole's pixels, 0..1, that the CRF must leave, or the network's own
            mask stands.
        lane_road: Least share of road in what lies around a patch of paint and is no paint, 0..1: paint lies
            on a road. On training pictures no paint was below 0.4, and an eighth of one dashcam's errors.
        lane_least_px2: Smallest patch of paint, px^2: a dash 3 m long at 30 m under a camera 1.65 m high.
        pole_least_px2: Smallest piece of pole, px^2: 2 px wide, 12 px tall (1 m at 50 m).
        horizon_slack_px: Paint may lie this far above the horizon, px: 2 deg of pitch and slope at 720 px
            focal length.
    """

    lane_threshold: float = 0.5
    pole_threshold: float = 0.3
    crf: MaskCrf | None = field(default_factory=_default_crf)
    evidence: float = 0.05
    margin_px: float = 2.0
    pole_sure: float = 0.5
    pole_keep: float = 0.5
    lane_road: float = 0.3
    lane_least_px2: float = 12.0
    pole_least_px2: float = 24.0
    horizon_slack_px: float = 25.0

    def __post_init__(self) -> None:
        for name in _SHARES:
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise RigError(f"masks: {name} {getattr(self, name)} is no share", hint="0..1")
        for name in _LENGTHS:
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0.0):
                raise RigError(f"masks: {name} {getattr(self, name)} is negative or not finite")


_SHARES = (
    *("lane_threshold", "pole_threshold", "evidence", "pole_sure", "pole_keep"),
    "lane_road",
)
_LENGTHS = ("margin_px", "lane_least_px2", "pole_least_px2", "horizon_slack_px")


def masks_from_probabilities(
    probabilities: Floats32,
    pixels: NDArray[np.uint8],
    parameters: MaskParameters,
    horizon: Floats | None = None,
    scale: tuple[float, float] | None = None,
) -> Masks:
    """Lane and pole masks on the grid of the probabilities: CRLF (7).

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
        heeded, and the network's own elsewhere; each is that of a class against all others.

    Raises:
        InputError: Shapes do not fit, or a probability is not finite or outside 0..1.
    """
    _require_probabilities(probabilities, pixels)
    height, width = probabilities.shape[1:]
    scale_x, scale_y = scale or (width / pixels.shape[1], height / pixels.shape[0])
    # Grid px per px of the reference width, along each axis.
    unit = width / REFERENCE_WIDTH_PX, scale_y * pixels.shape[1] / REFERENCE_WIDTH_PX
    crf = parameters.crf or MaskCrf(None, None)
    small = _reduced(pixels, (width, height)) if crf.lane or crf.pole else pixels
    pole_seen, lane_seen = probabilities[labels.POLE], probabilities[labels.LANE]
    pole_probability, pole = _told(pole_seen, parameters.pole_threshold, small, crf.pole, parameters, unit)
    if crf.pole is not None:
        restored = _deleted_poles(pole_seen, pole, parameters)
        pole_probability, pole = np.where(restored, pole_seen, pole_probability), pole | restored
    lane_probability, lane = _told(lane_seen, parameters.lane_threshold, small, crf.lane, parameters, unit)
    lane &= ~pole
    if horizon is not None:
        slack = parameters.horizon_slack_px * pixels.shape[1] / REFERENCE_WIDTH_PX
        lane &= _ground_side(horizon, slack, (height, width), (scale_x, scale_y))
    return Masks(
        lane=_lane_pieces(lane, probabilities, parameters, unit),
        pole=_pole_pieces(pole, pole_seen, parameters, unit),
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


def _reduced(pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """The image on a grid of (width, height) cells."""
    shrinks = size[0] <= pixels.shape[1] and size[1] <= pixels.shape[0]
    small = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(small, dtype=np.uint8)


def _told(
    seen: Floats32,
    threshold: float,
    small: NDArray[np.uint8],
    crf: ClassCrf | None,
    parameters: MaskParameters,
    unit: tuple[float, float],
) -> tuple[Floats32, Bools]:
    """Probability of one class and its mask (h,w): by its CRF, or as seen."""
    if crf is None:
        return seen, seen >= threshold
    window = np.ones([2 * round(parameters.margin_px * each) + 1 for each in unit[::-1]], dtype=np.uint8)
    evidence = (seen >= parameters.evidence).astype(np.uint8)
    region = np.asarray(cv2.dilate(evidence, window)).astype(np.bool_)
    stack = np.clip(np.stack([seen, 1.0 - seen]), _SUREST, 1.0)
    marginals = mean_field(-np.log(stack), small, _on_grid(crf.crf, unit), region)
    refined = np.where(region, marginals[0], seen)
    return refined, region & (refined >= crf.threshold)


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


def _deleted_poles(seen: Floats32, left: Bools, parameters: MaskParameters) -> Bools:
    """The sure poles of the network of which the mask ``left`` keeps too little."""
    pieces = pieces_of(seen >= parameters.pole_threshold)
    sure = pieces.peaks(seen) >= parameters.pole_sure
    return pieces.where(sure & (pieces.share(left) < parameters.pole_keep))


def _pole_pieces(mask: Bools, seen: Floats32, parameters: MaskParameters, unit: tuple[float, float]) -> Bools:
    """The pieces that are large enough and in which the network itself saw a pole."""
    pieces = pieces_of(mask)
    return pieces.where(
        (pieces.sizes >= parameters.pole_least_px2 * unit[0] * unit[1])
        & (pieces.peaks(seen) >= parameters.pole_threshold)
    )


_BORDER_PX = 4.0
"""px of the reference width: what lies so near to paint is its border; at least two cells, for the first may
be paint in part."""


def _lane_pieces(
    mask: Bools, probabilities: Floats32, parameters: MaskParameters, unit: tuple[float, float]
) -> Bools:
    """The pieces that are large enough, lie on a road, and in which the network itself saw paint."""
    pieces = pieces_of(mask)
    reach = max(2, round(_BORDER_PX * unit[0])), max(2, round(_BORDER_PX * unit[1]))
    seen = probabilities[labels.LANE]
    road, bare = pieces.around(probabilities[labels.ROAD], reach), 1.0 - pieces.around(seen, reach)
    return pieces.where(
        (pieces.sizes >= parameters.lane_least_px2 * unit[0] * unit[1])
        & (pieces.peaks(seen) >= parameters.lane_threshold)
        # Paint that fills the image has no border that could be road: NaN is not less.
        & ~(road < parameters.lane_road * bare)
    )


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
