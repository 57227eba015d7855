"""Images by ray casting through the project's own lens models, with the class of every pixel.

Where something ends, a pixel gets four rays on a rotated grid: edges of any direction are resolved to a
quarter of a pixel. Elsewhere one ray is enough.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from pipeline import labels
from pipeline.cameras import undistort
from pipeline.errors import InputError
from pipeline.records import CameraImage, CameraModel, Floats, read_only
from pipeline.simulation.raycast import Hits, Window, cast
from pipeline.simulation.reflections import add_reflections, mirror_below
from pipeline.simulation.scene import Scene
from pipeline.simulation.shading import View, shade
from pipeline.simulation.shadows import ShadowMap
from pipeline.simulation.solids import CORNERS, Solids
from pipeline.simulation.surface import F32, Rays

GRID = ((-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375))
"""px; places of the rays in a pixel (u, v): four different columns and rows."""
_LENS_STEP_PX = 8
"""px; the inverse lens is computed so often and interpolated by cubics: 1e-8 of the focal length at most."""
_NEAR_M = 0.05
"""m; solids are cut there to find their place in the image."""
_TONE_STEP = 0.25
"""Relative step of brightness between neighbours that counts as a border (window, shadow); grain is less."""
_GAMMA = 1.0 / 2.2
_RANK = np.array([0, 8, 7, 2, 3, 1, 4, 0, 6, -1], dtype=np.int32)
"""Which class wins a pixel that is shared evenly: the thinner one."""
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 2]


@dataclass(frozen=True, slots=True, eq=False)
class Optics:
    """Rays of a camera in its own frame.

    Attributes:
        camera: Intrinsics.
        rays: float32 (4,2,H,W), x and y at z = 1 for each ray of a pixel.
        columns: float32 (2,W), least and greatest x of each column.
        rows: float32 (2,H), least and greatest y of each row.
    """

    camera: CameraModel
    rays: F32
    columns: F32
    rows: F32

    def __post_init__(self) -> None:
        for name in ("rays", "columns", "rows"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """How the sensor turns light into grey levels.

    Attributes:
        grey: Mean grey level that the exposure aims at.
        blur: Standard deviation of the point spread, px.
        vignetting: Loss of light in the corners, 0..1.
        noise: Standard deviation at mid grey, grey levels.
        tint: Gain of blue, green, red.
        bloom: Share of the light that the glass scatters widely.
        contrast: 0 the tone curve of a plain power law, 1 one with toe and shoulder, as most cameras have.
        veil: Light that haze on the glass adds everywhere, relative to white.
    """

    grey: float = 105.0
    blur: float = 0.5
    vignetting: float = 0.25
    noise: float = 1.8
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    bloom: float = 0.0
    contrast: float = 0.0
    veil: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A simulated image.

    Attributes:
        image: The image.
        labels: uint8 (H,W), class of ``pipeline.labels`` that covers most of each pixel.
    """

    image: CameraImage
    labels: NDArray[np.uint8]

    def __post_init__(self) -> None:
        object.__setattr__(self, "labels", read_only(self.labels))


def optics_of(camera: CameraModel) -> Optics:
    """The rays of a camera; InputError where its lens model folds inside the image."""
    u = np.linspace(-1.0, camera.width, camera.width // _LENS_STEP_PX + 4)
    v = np.linspace(-1.0, camera.height, camera.height // _LENS_STEP_PX + 4)
    grid = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
    xy = undistort(camera, grid).reshape(len(u), len(v), 2)
    if not np.isfinite(xy).all():
        raise InputError(
            "the lens model folds inside the image", hint="a weaker distortion or a smaller image"
        )
    splines = [RectBivariateSpline(u, v, xy[:, :, k]) for k in range(2)]
    rays = np.empty((len(GRID), 2, camera.height, camera.width), dtype=np.float32)
    for p, (du, dv) in enumerate(GRID):
        for k in range(2):
            rays[p, k] = splines[k](np.arange(camera.width) + du, np.arange(camera.height) + dv).T
    x, y = rays[:, 0], rays[:, 1]
    columns = np.stack([x.min(axis=(0, 1)), x.max(axis=(0, 1))])
    return Optics(camera, rays, columns, np.stack([y.min(axis=(0, 2)), y.max(axis=(0, 2))]))


def render(
    scene: Scene,
    shadows: ShadowMap,
    optics: Optics,
    T_world_cam: Floats,
    *,
    time: float,
    look: Look,
    rng: np.random.Generator,
) -> Picture:
    """One image.

    Args:
        scene: What is seen.
        shadows: ``shadow_map`` of the scene around the camera.
        optics: ``optics_of`` the camera.
        T_world_cam: float64 (4,4), maps camera to world.
        time: Of the exposure (a global shutter), s.
        look: Sensor.
        rng: Noise.
    """
    solids = scene.solids_at(time)
    focal, R = float(optics.camera.K[0, 0]), T_world_cam[:3, :3]
    windows = _windows(solids, optics, T_world_cam)
    rays = _rays(optics.rays[0], T_world_cam)
    hits = cast(scene, solids, rays, windows)
    first = View(scene, solids, rays, hits, shadows, focal, R)
    radiance, classes = shade(first)
    column, row = np.nonzero(_busy(radiance, classes, hits).T)
    xy = optics.rays[1:, :, row, column].transpose(1, 2, 0).reshape(2, 1, -1)
    more = _rays(xy, T_world_cam)
    more_hits = cast(scene, solids, more, _listed(hits.tested, column))
    colour, more_classes = shade(View(scene, solids, more, more_hits, shadows, focal, R))
    per_pixel = len(GRID) - 1
    total = radiance[:, row, column] + colour.reshape(3, -1, per_pixel).sum(axis=2)
    radiance[:, row, column] = total / np.float32(len(GRID))
    votes = np.concatenate([classes[row, column][:, None], more_classes.reshape(-1, per_pixel)], axis=1)
    classes[row, column] = _voted(votes)
    if scene.weather.wet > 0.0:
        mirror = mirror_below(scene, T_world_cam)
        add_reflections(first, mirror, _windows(solids, optics, mirror.T_world_cam), radiance, classes)
    return Picture(CameraImage(_developed(radiance, look, rng)), classes)


def _rays(xy: F32, T_world_cam: Floats) -> Rays:
    """Rays through (2,H,W) at z = 1; their parameter is the depth."""
    R = T_world_cam[:3, :3].astype(np.float32)
    x, y, z = (np.full((1, 1), T_world_cam[k, 3], dtype=np.float32) for k in range(3))
    direction = np.stack([R[k, 0] * xy[0] + R[k, 1] * xy[1] + R[k, 2] for k in range(3)])
    return Rays((x, y, z), direction, np.zeros((1, 1), dtype=np.float32))


def _busy(radiance: F32, classes: NDArray[np.uint8], hits: Hits) -> NDArray[np.bool_]:
    """Pixels at a border between things, classes or tones: those that need all their rays.

    A border between two samples lies in one of their two pixels. Foliage has no borders within itself.
    """
    grey = radiance.sum(axis=0)
    busy = np.zeros(grey.shape, dtype=np.bool_)
    whole = slice(None)
    for a, b in (
        ((slice(1, None), whole), (slice(None, -1), whole)),
        ((whole, slice(1, None)), (whole, slice(None, -1))),
    ):
        border = hits.what[a] != hits.what[b]
        border |= np.abs(grey[a] - grey[b]) > _TONE_STEP * np.minimum(grey[a], grey[b])
        border &= classes[a] != labels.VEGETATION
        border |= classes[a] != classes[b]
        busy[a] |= border
        busy[b] |= border
    return busy


def _listed(windows: tuple[Window, ...], columns: NDArray[np.int64]) -> list[Window]:
    """The windows of an image as parts of a list of rays, some a pixel, whose pixels are sorted by column."""
    stops = [(w[2].start, w[2].stop) for w in windows]
    ends = np.searchsorted(columns, np.array(stops, dtype=np.int64).reshape(-1, 2)) * (len(GRID) - 1)
    every = slice(None)
    return [
        (w[0], every, slice(int(first), int(last)), w[3])
        for w, (first, last) in zip(windows, ends, strict=True)
        if last > first
    ]


def _windows(solids: Solids, optics: Optics, T_world_cam: Floats) -> list[Window]:
    """Rows and columns in which each solid may be seen, from its corners cut at the near plane."""
    corners = (solids.corners() - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]
    depth = corners[:, :, 2]
    a, b = (np.array([e[k] for e in _EDGES]) for k in range(2))
    cut = (_NEAR_M - depth[:, a]) / np.where(depth[:, b] == depth[:, a], 1.0, depth[:, b] - depth[:, a])
    crosses = (depth[:, a] < _NEAR_M) != (depth[:, b] < _NEAR_M)
    on_plane = corners[:, a] + cut[:, :, None] * (corners[:, b] - corners[:, a])
    points = np.concatenate([corners, on_plane], axis=1)
    usable = np.concatenate([depth >= _NEAR_M, crosses], axis=1)
    xy = points[:, :, :2] / np.where(usable, np.maximum(points[:, :, 2], _NEAR_M), 1.0)[:, :, None]
    low = np.where(usable[:, :, None], xy, np.inf).min(axis=1)
    high = np.where(usable[:, :, None], xy, -np.inf).max(axis=1)
    columns = (optics.columns[1] >= low[:, :1]) & (optics.columns[0] <= high[:, :1])
    rows = (optics.rows[1] >= low[:, 1:]) & (optics.rows[0] <= high[:, 1:])
    seen = np.flatnonzero(columns.any(axis=1) & rows.any(axis=1))
    near = np.where(usable, points[:, :, 2], np.inf).min(axis=1)
    return [(int(k), _extent(rows[k]), _extent(columns[k]), float(near[k])) for k in seen]


def _extent(flags: NDArray[np.bool_]) -> slice:
    return slice(int(np.argmax(flags)), len(flags) - int(np.argmax(flags[::-1])))


def _voted(votes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The class with most votes in each row of (N,4), the thinner one of equals; the unsure last."""
    candidates = np.array([*range(len(labels.NAMES)), labels.IGNORE], dtype=np.uint8)
    score = np.stack([16 * (votes == k).sum(axis=1) + r for k, r in zip(candidates, _RANK, strict=True)])
    # A class without a vote must not win by its rank.
    return np.asarray(candidates[np.argmax(np.where(score >= 16, score, -1), axis=0)], dtype=np.uint8)


def _developed(radiance: F32, look: Look, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Lens, exposure, tone curve and noise: radiance (3,H,W) to BGR uint8 (H,W,3)."""
    light = np.ascontiguousarray(np.moveaxis(radiance, 0, -1)) * np.array(look.tint, dtype=np.float32)
    height, width = light.shape[:2]
    light = np.asarray(cv2.GaussianBlur(light, (0, 0), look.blur), dtype=np.float32)
    v, u = np.linspace(-1, 1, height, dtype=np.float32), np.linspace(-1, 1, width, dtype=np.float32)
    light *= (1.0 - np.float32(look.vignetting / 2) * (u[None, :] ** 2 + v[:, None] ** 2))[:, :, None]
    gain = _exposure(light[::4, ::4], look.grey)
    if look.bloom > 0.0 or look.veil > 0.0:
        light = _scattered(light, gain, look)
    grey = np.clip(gain * light, 0.0, 1.0) ** np.float32(_GAMMA)
    if look.contrast > 0.0:
        grey += np.float32(look.contrast) * (grey * grey * (3.0 - 2.0 * grey) - grey)
    grey *= np.float32(255.0)
    grain = rng.standard_normal(grey.shape, dtype=np.float32)
    # Shot noise after the tone curve: about even over the grey levels, a little stronger in the dark.
    grey += np.float32(look.noise) * grain * (1.2 - grey * np.float32(0.4 / 255.0))
    return np.asarray(np.clip(np.rint(grey), 0, 255), dtype=np.uint8)


def _scattered(light: F32, gain: np.float32, look: Look) -> F32:
    """Light (H,W,3) with halos about what is too bright, and a veil."""
    height, width = light.shape[:2]
    small = cv2.resize(
        np.minimum(light, 12.0 / gain), (width // 4, height // 4), interpolation=cv2.INTER_AREA
    )
    halo = cv2.GaussianBlur(small, (0, 0), 0.004 * width) + cv2.GaussianBlur(small, (0, 0), 0.02 * width)
    wide = cv2.resize(halo, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(light + 0.5 * look.bloom * wide + look.veil / gain, dtype=np.float32)


def _exposure(light: F32, target: float) -> np.float32:
    """Gain that brings the mean grey level to the target."""
    gain = 1.0
    for _ in range(12):
        mean = float((np.clip(gain * light, 0.0, 1.0) ** _GAMMA).mean()) * 255.0
        gain *= (target / mean) ** (1.0 / _GAMMA)
    return np.float32(gain)
