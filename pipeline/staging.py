"""A drive as a trial has the watch told it, before it is watched.

Every drive is told in other words (LiDAR axes turned and moved, the image cropped), so that nothing may rest
on a file; and then one thing is wrong, as the trial says.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline import se3
from pipeline.cameras import project_unbounded, undistort
from pipeline.drift_trials import Trial, direction
from pipeline.mount import Mount
from pipeline.records import CameraImage, CameraModel, Floats, FramePair, PointCloud

TURNED_DEG, MOVED_M = 1.5, 0.3
"""How far LiDAR axes are turned about a random axis and moved in a random direction, at most."""

CROPPED_PX = 12
"""px that are cut off at each side of the image, at most."""

_GRID_PX = 16
"""px between the places where a turned camera's rays are followed; between them the shift is linear to a
hundredth of a px."""


@dataclass(frozen=True, slots=True, eq=False)
class Staged:
    """A drive as the watch is told it.

    Attributes:
        mount: With the stored extrinsic and intrinsics.
        frames: Its frames, made while they are asked for.
    """

    mount: Mount
    frames: Iterator[FramePair]


def stage(trial: Trial, true: Mount, frames: Sequence[FramePair], rng: np.random.Generator) -> Staged:
    """The drive of a trial: in other words, and with one thing wrong.

    Args:
        trial: What is wrong.
        true: The mount with its true extrinsic, constant over ``frames``.
        frames: The drive.
        rng: Of this trial's axes, crop and shaking.
    """
    G = _axes_elsewhere(rng)
    left, top, right, bottom = (int(n) for n in rng.integers(0, CROPPED_PX + 1, 4))
    turns = shaking(trial.shake_rad, len(frames), rng)
    stored = true.T_cam_lidar
    if not trial.moves:
        T = true.T_vehicle_lidar
        stored = se3.stored_before(stored, trial.drift, None if T is None else T[:3, :3])
    mount = dataclasses.replace(
        true,
        T_cam_lidar=stored @ se3.inverse(G),
        T_vehicle_lidar=None if true.T_vehicle_lidar is None else true.T_vehicle_lidar @ se3.inverse(G),
        camera=_stored_camera(true.camera, (left, top, right, bottom), trial.focal),
    )

    def told() -> Iterator[FramePair]:
        for k, pair in enumerate(late_images(frames, trial.late_ns)):
            pixels = pair.image.pixels
            if turns is not None:
                pixels = turned_image(pixels, true.camera, turns[k])
            height, width = pixels.shape[:2]
            moved = G
            if trial.moves:
                xi = trial.share(k, len(frames)) * trial.drift
                T_now = se3.displaced(true.T_cam_lidar, xi, true.R_vehicle_cam)
                moved = G @ se3.inverse(T_now) @ true.T_cam_lidar
            yield dataclasses.replace(
                pair,
                cloud=_mapped(pair.cloud, moved),
                image=CameraImage(np.ascontiguousarray(pixels[top : height - bottom, left : width - right])),
            )

    return Staged(mount, told())


def _axes_elsewhere(rng: np.random.Generator) -> Floats:
    """T_new_old (4,4) of the axes in which LiDAR points are told."""
    turn = direction(rng) * math.radians(TURNED_DEG) * rng.uniform()
    return se3.transform(se3.exp_so3(turn), direction(rng) * MOVED_M * rng.uniform())


def _stored_camera(true: CameraModel, crop: tuple[int, int, int, int], focal: float) -> CameraModel:
    left, top, right, bottom = crop
    K = true.K.copy()
    K[:2, :2] *= focal
    K[:2, 2] -= (left, top)
    width, height = true.width - left - right, true.height - top - bottom
    return dataclasses.replace(true, K=K, width=width, height=height)


def _mapped(cloud: PointCloud, T: Floats) -> PointCloud:
    return dataclasses.replace(cloud, xyz=se3.apply(T, cloud.xyz).astype(np.float32))


def shaking(rms: float, frames: int, rng: np.random.Generator) -> Floats | None:
    """Turn of the camera at each exposure (frames,3), rad, mean zero; None where it does not shake.

    Slower frames see a fast shake as turns that have nothing to do with each other.
    """
    if rms == 0.0:
        return None
    turns = rng.normal(0.0, rms / math.sqrt(3.0), (frames, 3))
    return np.asarray(turns - turns.mean(axis=0), dtype=np.float64)


def turned_image(pixels: np.ndarray, camera: CameraModel, turn: Floats) -> np.ndarray:
    """What the camera sees when it is turned about its centre by ``turn`` (3,), rad, camera axes."""
    columns = np.append(np.arange(0, camera.width - 1, _GRID_PX), camera.width - 1)
    rows = np.append(np.arange(0, camera.height - 1, _GRID_PX), camera.height - 1)
    u, v = np.meshgrid(columns.astype(np.float64), rows.astype(np.float64))
    uv = np.column_stack([u.ravel(), v.ravel()])
    rays = np.column_stack([undistort(camera, uv), np.ones(len(uv))])
    before, seen = project_unbounded(camera, rays @ se3.exp_so3(turn))
    # Corners that the lens model does not reach stay where they are.
    shift = np.where(seen[:, None] & np.isfinite(before), before - uv, 0.0).reshape(*u.shape, 2)
    across, down = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    # Where in the grid each pixel lies; its last row and column are nearer to their neighbours.
    gx = np.interp(across[0], columns, np.arange(len(columns)))
    gy = np.interp(down[:, 0], rows, np.arange(len(rows)))
    x, y = (a.astype(np.float32) for a in np.meshgrid(gx, gy))
    full = cv2.remap(shift.astype(np.float32), x, y, cv2.INTER_LINEAR)
    return cv2.remap(
        np.asarray(pixels),
        (across + full[..., 0]).astype(np.float32),
        (down + full[..., 1]).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )


def late_images(frames: Sequence[FramePair], late_ns: int) -> list[FramePair]:
    """The pairs that are made when images bear stamps that are ``late_ns`` too late.

    A sweep goes with the image whose stamp now lies where that of its own image lay, each with its nearest;
    the sweeps at the end for which there is none are left out.
    """
    if late_ns == 0:
        return list(frames)
    stamps = np.array([frame.image_stamp_ns for frame in frames], dtype=np.int64)
    apart = np.abs(stamps[None, :] + late_ns - stamps[:, None])
    images, sweeps = apart.argmin(axis=1), apart.argmin(axis=0)
    return [
        dataclasses.replace(
            frames[i], image=frames[j].image, image_stamp_ns=frames[j].image_stamp_ns + late_ns
        )
        for i, j in enumerate(images.tolist())
        if sweeps[j] == i
    ]
