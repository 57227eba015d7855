"""The stage of ``calibwatch evaluate dataset`` that knows no prior, as CRLF's coarse calibration."""

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict

from monitor.clock import Clock
from monitor.evaluated_frames import EvaluatedFrame
from monitor.first_guess import masks_of_network
from monitor.frame_calibration import Stopwatch, errors_of, lines_around
from monitor.statements import TO_PEOPLE
from pipeline import se3
from pipeline.error_statistics import mean_absolute
from pipeline.image_lines import find_image_lines
from pipeline.no_prior import FoundExtrinsic, find_extrinsic
from pipeline.segmentation import Segmenter

NEAR_DEG, NEAR_M = 3.0, 0.5
"""deg and m; CRLF's largest errors of the coarse stage: what a refinement is asked to start from."""


class _Values(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Coarse(_Values):
    """What one frame gave with nothing but its intrinsics."""

    frame: str
    group: str
    found: bool
    reason: str
    errors: tuple[float, ...]
    """Of the axes in the order of ``AXIS_NAMES``, deg and m; empty where nothing was found."""
    rotation_deg: float | None
    """CRLF (16)."""
    translation_m: float | None
    """CRLF (15)."""
    ms: dict[str, float]

    @property
    def near(self) -> bool:
        """Whether it is within ``NEAR_DEG`` and ``NEAR_M``."""
        return (
            self.rotation_deg is not None
            and self.translation_m is not None
            and self.rotation_deg <= NEAR_DEG
            and self.translation_m <= NEAR_M
        )


class CoarseSummary(_Values):
    """One set."""

    group: str
    frames: int
    found: int
    near: int
    """Of those that were found, how many are near."""
    mean_absolute: tuple[float | None, ...]
    """In the order of ``AXIS_NAMES``, deg and m, over those that were found."""
    rotation_deg: float | None
    """Median."""
    translation_m: float | None
    """Median."""
    ms: dict[str, float]
    """Median times of masks, lines, and the whole search after the masks."""


def coarse_of(frame: EvaluatedFrame, segmenter: Segmenter, seed: int, clock: Clock) -> Coarse:
    """Looks for the extrinsic of a frame without a first guess."""
    times, pair = Stopwatch(clock), frame.pair
    with times.stage("masks"):
        # Without an extrinsic nobody knows where the horizon is.
        masks = masks_of_network(segmenter, pair, None)
    # The search finds these lines itself; here they are found once more for their own times.
    with times.stage("image lines"):
        find_image_lines(pair.image, masks, frame.camera)
    with times.stage("cloud lines"):
        lines_around(frame, np.random.default_rng(seed))
    with times.stage("coarse"):
        found = find_extrinsic(pair.cloud, pair.image, masks, frame.camera, np.random.default_rng(seed))
    known = Coarse(
        frame=frame.name,
        group=frame.group,
        found=False,
        reason="",
        errors=(),
        rotation_deg=None,
        translation_m=None,
        ms=dict(times.ms),
    )
    if not isinstance(found, FoundExtrinsic):
        return known.model_copy(update={"reason": found.reason})
    shift, angle = se3.pose_error(frame.mount.T_cam_lidar, found.T_cam_lidar)
    errors = tuple((errors_of(frame, found.T_cam_lidar) * TO_PEOPLE).tolist())
    return known.model_copy(
        update={
            "found": True,
            "errors": errors,
            "rotation_deg": float(np.degrees(angle)),
            "translation_m": shift,
        }
    )


def coarse_summary(group: str, coarse: Sequence[Coarse]) -> CoarseSummary:
    """Of the frames of one set, at least one."""
    found = [one for one in coarse if one.found]
    return CoarseSummary(
        group=group,
        frames=len(coarse),
        found=len(found),
        near=sum(one.near for one in found),
        mean_absolute=tuple(mean_absolute([np.array(one.errors) for one in found])),
        rotation_deg=_median([one.rotation_deg for one in found]),
        translation_m=_median([one.translation_m for one in found]),
        ms={stage: float(np.median([one.ms[stage] for one in coarse])) for stage in coarse[0].ms},
    )


def _median(values: Sequence[float | None]) -> float | None:
    given = [value for value in values if value is not None]
    return float(np.median(given)) if given else None
