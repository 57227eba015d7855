"""A drive of one minute as an engine would tell it: a camera mount that turns by 0.8 deg after 20 s."""

import math
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import pytest

from monitor.events import EndEvent, Event, FrameEvent, StatusEvent
from monitor.status import (
    AXIS_NAMES,
    AxisDrift,
    AxisValues,
    Drift,
    Frames,
    Onset,
    Provenance,
    Rates,
    State,
    Status,
    TimeOffset,
    Timing,
    Window,
    Witness,
    Witnesses,
    finite,
)
from pipeline import se3
from pipeline.cameras import project, undistort
from pipeline.records import CameraImage, CameraModel, CloudLine, ImageLine, LineMatch, Masks

START_NS = 1_317_042_145_000_000_000
SECOND_NS = 1_000_000_000
DRIFT_S, SUSPECT_S, DRIFTED_S, END_S = 20, 26, 30, 60
TRUE_DRIFT = np.array([0.0, 0.0, math.radians(0.8), 0.0, 0.0, 0.0])
LIMITS = dict(zip(AXIS_NAMES, (0.75, 0.5, 0.5, 0.20, 0.15, 0.15), strict=True))

CAMERA = CameraModel(
    "plumb_bob",
    np.array([[720.0, 0.0, 479.5], [0.0, 720.0, 149.5], [0.0, 0.0, 1.0]]),
    np.array([-0.15, 0.05, 0.001, -0.001, 0.0]),
    960,
    300,
)
T_STORED = se3.transform(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.05, -0.1, -0.2])
)
T_DRIFTED = se3.displaced(T_STORED, TRUE_DRIFT, se3.AXES_CAM_IN_VEHICLE)

POLES = tuple((x, y, 0.15) for x in (9.0, 15.0, 22.0, 31.0) for y in (-5.5, 6.0))
LANES = (-1.8, 1.8)
GROUND_Z = -1.7


def pole_points(x: float, y: float, radius: float) -> np.ndarray:
    z = np.linspace(GROUND_Z, 2.5, 40)
    sides = [np.column_stack([np.full(40, x), np.full(40, y + s * radius), z]) for s in (-1, 1)]
    return np.concatenate(sides).astype(np.float32)


def ground_points() -> np.ndarray:
    x, y = np.meshgrid(np.geomspace(4.0, 50.0, 60), np.linspace(-12.0, 12.0, 60))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_Z)]).astype(np.float32)


EDGES = np.concatenate([pole_points(*pole) for pole in POLES])
GROUND = ground_points()
POINTS = np.concatenate([EDGES, GROUND])


def polygon(T: np.ndarray, corners: np.ndarray) -> np.ndarray:
    uv, _ = project(CAMERA, se3.apply(T, corners))
    return np.round(uv * 16).astype(np.int32)


def pole_corners(x: float, y: float, radius: float) -> np.ndarray:
    ends = ((-1, GROUND_Z), (-1, 2.5), (1, 2.5), (1, GROUND_Z))
    return np.array([[x, y + s * radius, z] for s, z in ends])


def lane_corners(y: float) -> np.ndarray:
    return np.array(
        [[x, y + s * 0.08, GROUND_Z] for x, s in ((5, -1), (40, -1), (40, 1), (5, 1))], dtype=float
    )


@cache
def scene(*, moved: bool) -> tuple[CameraImage, Masks, tuple[LineMatch, ...]]:
    """What the camera shows before and after its mount moved, masks at half the size, and matched poles."""
    T = T_DRIFTED if moved else T_STORED
    pixels = np.full((CAMERA.height, CAMERA.width, 3), (200, 170, 140), dtype=np.uint8)
    pixels[150:] = (95, 95, 95)
    lane = np.zeros(pixels.shape[:2], dtype=np.uint8)
    pole = lane.copy()
    for y in LANES:
        cv2.fillPoly(pixels, [polygon(T, lane_corners(y))], (235, 235, 235), cv2.LINE_AA, 4)
        cv2.fillPoly(lane, [polygon(T, lane_corners(y))], (1,), cv2.LINE_8, 4)
    for found in reversed(POLES):
        cv2.fillPoly(pixels, [polygon(T, pole_corners(*found))], (50, 55, 60), cv2.LINE_AA, 4)
        cv2.fillPoly(pole, [polygon(T, pole_corners(*found))], (1,), cv2.LINE_8, 4)
    lane, pole = lane[::2, ::2], pole[::2, ::2]
    masks = Masks(lane > 0, pole > 0, lane.astype(np.float32), pole.astype(np.float32), 0.5, 0.5)
    return CameraImage(pixels), masks, tuple(match(T, found) for found in POLES)


def match(T: np.ndarray, pole: tuple[float, float, float]) -> LineMatch:
    x, y, _ = pole
    ends = np.array([[x, y, GROUND_Z + 0.2], [x, y, 2.0]])
    uv, _ = project(CAMERA, se3.apply(T, ends))
    ideal = undistort(CAMERA, uv) @ CAMERA.K[:2, :2].T + CAMERA.K[:2, 2]
    cloud = CloudLine("pole", ends[0], ends[1], np.arange(40), 0.02, 10.0)
    return LineMatch(cloud, ImageLine("pole", ideal[0], ideal[1], 0.5))


@dataclass(frozen=True)
class Drive:
    """Makes the events of a drive."""

    vehicle: str = "van-17"
    pair: str = "front"
    start_ns: int = START_NS

    def stamp(self, second: float) -> int:
        return self.start_ns + round(second * SECOND_NS)

    def state(self, second: float) -> tuple[State, str, str, float]:
        if second < 3:
            return "starting", "gathering", "The evidence of 3 s is not enough.", 0.0
        if second < SUSPECT_S:
            return "healthy", "excluded", "Drift beyond the limits is excluded for yaw and pitch.", 3.0
        if second < DRIFTED_S:
            return "suspect", "first_threshold", "The test for yaw has passed its first threshold.", SUSPECT_S
        return "drifted", "second_threshold", "The drift of yaw is sure and was held for 4 s.", DRIFTED_S

    @cache  # noqa: B019 # a handful of drives in a session
    def drift(self, second: float) -> Drift:
        rng = np.random.default_rng(int(second * 10))
        yaw = 0.8 * min(1.0, max(0.0, (second - DRIFT_S) / 8.0))
        sigmas = dict(zip(AXIS_NAMES, (0.06, 0.04, 0.04, math.inf, 0.05, 0.03), strict=True))
        axes = {}
        for name, sigma in sigmas.items():
            seen_axis = math.isfinite(sigma) and second >= 1
            value = (yaw if name == "yaw" else 0.0) + 0.4 * min(sigma, 1.0) * rng.standard_normal()
            level = 3.09 * sigma + (0.13 if name in ("roll", "pitch", "yaw") else 0.04)
            axes[name] = AxisDrift(
                value=value if seen_axis else 0.0,
                sigma=sigma if seen_axis else None,
                protection_level=finite(level) if seen_axis else None,
                alert_limit=LIMITS[name],
                detectable=finite(7.5 * sigma) if seen_axis else None,
                observable=seen_axis and sigma <= 2 * LIMITS[name],
                monitored=seen_axis and level <= LIMITS[name],
                last_seen_ns=self.stamp(second) if seen_axis else None,
            )
        return Drift(axes="camera", relative_to="stored", **axes)

    def status(self, second: float, seq: int = 0, **changes: object) -> Status:
        state, code, reason, since = self.state(second)
        drift = self.drift(second)
        values = AxisValues(**{name: axis.value for name, axis in drift.items()})
        sigmas = AxisValues(**{name: axis.sigma for name, axis in drift.items()})
        witness = Witness(drift=values, sigma=sigmas, chi2=1.1, frames=int(second))
        used = int(second * 2)
        fields = {
            "vehicle": self.vehicle,
            "pair": self.pair,
            "seq": seq,
            "stamp_ns": self.stamp(second),
            "state": state,
            "code": code,
            "reason": reason,
            "since_ns": self.stamp(since),
            "onset": Onset(stamp_ns=self.stamp(21), from_ns=self.stamp(19), to_ns=self.stamp(24))
            if state in ("suspect", "drifted")
            else None,
            "severity": "major" if state == "drifted" else None,
            "drift": drift,
            "witnesses": Witnesses(lines=witness, edges=None),
            "window": Window(frames=used, span_s=second, lines_lane=4, lines_pole=16, lines_structure=0),
            "frames": Frames(received=used + 3, used=used, dropped={"no_partner": 2, "too_dark": 1}),
            "rates": Rates(lidar_hz=10.0, camera_hz=10.0, gap_ms=3.0, lines_hz=2.0, edges_hz=10.0),
            "time_offset": TimeOffset(ms=None, sigma_ms=None, separable=False),
            "timing_ms": {"masks": Timing(p50=90.0, p95=120.0)},
            "extrinsic": Provenance(hash="9f2c" * 16, version="3"),
            "model": Provenance(hash="77aa" * 16, version="1"),
            "software": "calibwatch 0.1.0",
        }
        return Status.model_validate(fields | changes)

    def frame(self, second: float) -> FrameEvent:
        image, masks, matches = scene(moved=second >= DRIFT_S)
        drift = np.array([0.0, 0.0, math.radians(self.drift(second).yaw.value or 0.0), 0.0, 0.0, 0.0])
        return FrameEvent(
            pair=self.pair,
            stamp_ns=self.stamp(second),
            image=image,
            camera=CAMERA,
            masks=masks,
            points=POINTS,
            intensity=np.linspace(0.0, 1.0, len(POINTS), dtype=np.float32),
            edge_points=EDGES,
            T_stored=T_STORED,
            T_estimated=se3.displaced(T_STORED, drift, se3.AXES_CAM_IN_VEHICLE) if second >= 1 else None,
            matches=matches,
        )

    def events(self, end: EndEvent | None = None, frames_hz: int = 2) -> Iterator[Event]:
        for second in range(END_S + 1):
            for part in range(frames_hz):
                yield self.frame(second + part / frames_hz)
            yield StatusEvent(self.status(second, seq=second))
        yield end or EndEvent(complete=True)


@pytest.fixture(scope="session")
def drive() -> Callable[..., Drive]:
    return Drive


@pytest.fixture
def small_files() -> Callable[[int], object]:
    """Within ``small_files(n)`` no file of this process grows beyond n bytes: a disk that is full then."""

    @contextmanager
    def limited(size: int) -> Iterator[None]:
        handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            signal.signal(signal.SIGXFSZ, handler)

    return limited
