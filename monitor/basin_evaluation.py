"""``calibwatch evaluate basin``: from how far off each way of calibrating finds back, frame by frame."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict

from monitor.clock import Clock
from monitor.evaluated_frames import EvaluatedFrame, EvaluatedFrames
from monitor.first_guess import PriorSigma, masks_of_network
from monitor.frame_calibration import Stopwatch, calibrated, lines_around
from pipeline import basin, se3
from pipeline.association import associate
from pipeline.basin import OFFSETS, BasinScene, Sweep
from pipeline.height_maps import height_maps
from pipeline.line_witness import find_lines
from pipeline.masks import horizon_line
from pipeline.records import Floats
from pipeline.segmentation import Segmenter
from pipeline.semantic_cost import points_of_lines

Progress = Callable[[str, int, int], None]
"""Is told which frame is run, how many starts are done, and of how many."""

Way: TypeAlias = Literal[basin.Method, "calibrate"]
WAYS: tuple[Way, ...] = (*basin.METHODS, "calibrate")

_MATCHED = np.diag([math.radians(0.3) ** 2] * 3 + [0.1**2] * 3)
"""rad^2 and m^2; lines are matched at the true extrinsic, as well as it is known, and noise of a frame."""


class _Values(BaseModel):
    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Point(_Values):
    """One way of calibrating from one initial error."""

    offset: float
    """Deg or m; for both together deg."""
    answers: int
    success: float
    """Share of all runs, those without an answer too."""
    rotation_deg: float | None
    """Median of CRLF (16) over the answers; null where there is none."""
    translation_m: float | None
    """Median of CRLF (15)."""


class Curve(_Values):
    """One sweep of initial errors."""

    unit: str
    runs: int
    """At each initial error."""
    ways: dict[Way, tuple[Point, ...]]


class Basin(_Values):
    """All sweeps."""

    frames: int
    starts: int
    seed: int
    matched: dict[str, int]
    """Lines with a known match in each frame."""
    sweeps: dict[Sweep, Curve]


@dataclass(frozen=True, slots=True)
class _Key:
    sweep: Sweep
    place: int
    way: Way


def evaluate(
    frames: EvaluatedFrames, starts: int, seed: int, segmenter: Segmenter, clock: Clock, progress: Progress
) -> Basin:
    """Runs every sweep on every frame.

    Args:
        frames: With their true extrinsics.
        starts: Of each frame at each initial error.
        seed: Of the starts and the searches.
        segmenter: The network.
        clock: For the times of a calibration, which are not told.
        progress: Told each start.
    """
    found: dict[_Key, list[tuple[float, float] | None]] = {}
    matched = {}
    of = len(frames) * starts * sum(len(places) for places in OFFSETS.values())
    done = 0
    for number, frame in enumerate(frames):
        scene = scene_of(frame, segmenter, np.random.default_rng([seed, number]))
        matched[frame.name] = len(scene.pairs)
        for sweep, places in OFFSETS.items():
            for place, offset in enumerate(places.tolist()):
                for start in range(starts):
                    # The same draw at every offset of a sweep, so that curves are smooth.
                    rng = np.random.default_rng([seed, number, start])
                    drift = basin.drift_of(sweep, offset, rng)
                    for way, error in _errors(frame, scene, drift, segmenter, clock, rng).items():
                        found.setdefault(_Key(sweep, place, way), []).append(error)
                    done += 1
                    progress(frame.name, done, of)
    runs = len(frames) * starts
    return Basin(
        frames=len(frames),
        starts=starts,
        seed=seed,
        matched=matched,
        sweeps={sweep: _curve(sweep, runs, found) for sweep in OFFSETS},
    )


def scene_of(frame: EvaluatedFrame, segmenter: Segmenter, rng: np.random.Generator) -> BasinScene:
    """Lines, points and masks of a frame, found under its true extrinsic."""
    mount, pair, camera = frame.mount, frame.pair, frame.camera
    up_cam = mount.T_cam_lidar[:3, :3] @ mount.up
    masks = masks_of_network(segmenter, pair, horizon_line(camera, up_cam))
    around, ground = lines_around(frame, rng)
    lines = find_lines(
        pair.cloud,
        pair.image,
        masks,
        camera,
        mount.T_cam_lidar,
        up=mount.up,
        forward=mount.forward,
        rng=rng,
        ground=ground,
    )
    known = associate(lines.cloud_lines, lines.image_lines, camera, mount.T_cam_lidar, _MATCHED)
    return BasinScene(
        camera,
        known.pairs,
        points_of_lines(pair.cloud, around),
        height_maps(masks, camera, "plateau"),
        height_maps(masks, camera, "ridge"),
    )


def _errors(
    frame: EvaluatedFrame,
    scene: BasinScene,
    drift: Floats,
    segmenter: Segmenter,
    clock: Clock,
    rng: np.random.Generator,
) -> dict[Way, tuple[float, float] | None]:
    """CRLF (15), m, and (16), rad, of every way from one start; None without an answer."""
    mount = frame.off_by(drift)
    extrinsics: dict[Way, Floats | None] = dict(basin.answers(scene, mount.T_cam_lidar, rng).items())
    whole = calibrated(frame, mount, segmenter, Stopwatch(clock), _told(drift))
    extrinsics["calibrate"] = whole.T_estimated if whole.observable.any() else None
    truth = frame.mount.T_cam_lidar
    return {way: None if T is None else se3.pose_error(truth, T) for way, T in extrinsics.items()}


_GUESS = np.array([math.radians(2.0)] * 3 + [0.3] * 3)
"""rad and m; what ``calibwatch calibrate`` takes a first guess to be right to unless told otherwise."""


def _told(drift: Floats) -> PriorSigma | None:
    """What somebody would say of a start who knows about how far off it is; nothing of a near one."""
    widest = np.maximum(np.abs(drift), _GUESS)
    if (widest <= _GUESS).all():
        return None
    # Two sigmas are what is searched.
    return PriorSigma(float(widest[:3].max()) / 2.0, float(widest[3:].max()) / 2.0)


def _curve(sweep: Sweep, runs: int, found: dict[_Key, list[tuple[float, float] | None]]) -> Curve:
    scale, unit = (1.0, "m") if sweep == "translation" else (180.0 / math.pi, "deg")
    places = (OFFSETS[sweep] * scale).tolist()
    return Curve(
        unit=unit,
        runs=runs,
        ways={
            way: tuple(
                _point(sweep, offset, found[_Key(sweep, place, way)]) for place, offset in enumerate(places)
            )
            for way in WAYS
        },
    )


def _point(sweep: Sweep, offset: float, errors: list[tuple[float, float] | None]) -> Point:
    given = [error for error in errors if error is not None]
    medians = np.median(given, axis=0) if given else None
    return Point(
        offset=offset,
        answers=len(given),
        success=sum(basin.succeeded(sweep, error) for error in given) / len(errors),
        rotation_deg=None if medians is None else float(np.degrees(medians[1])),
        translation_m=None if medians is None else float(medians[0]),
    )
