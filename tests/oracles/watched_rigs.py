"""Short drives of rigs that differ in what nothing may assume: rings, lenses, axes, one sensor or several."""

import dataclasses
import math

import numpy as np

from pipeline import se3
from pipeline.records import CameraModel, FramePair, PointCloud
from pipeline.simulation.drive import START_NS, Drive, DriveParameters
from pipeline.simulation.lidar import spinning, sweep
from pipeline.simulation.scene import SceneParameters

SIZE = (540, 200)


def camera(model="pinhole", D=(), focal=360.0, size=SIZE):
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    return CameraModel(model, K, np.array(D, dtype=np.float64), *size)


@dataclasses.dataclass(frozen=True)
class Rig:
    """What differs.

    Attributes:
        rings: Of the LiDAR, or of each of two.
        camera: Intrinsics.
        turn: Rotation vector of the LiDAR's axes in the vehicle, rad.
        numbered: Whether the cloud names its rings.
        merged: Two LiDARs in one cloud in the vehicle's frame, at one instant, without times.
        mixed: Both with the same ring numbers; else without any.
    """

    rings: int = 64
    camera: CameraModel = dataclasses.field(default_factory=camera)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    numbered: bool = True
    merged: bool = False
    mixed: bool = False


RIGS = {
    "16 rings": Rig(rings=16),
    "128 rings": Rig(rings=128),
    "rings unnumbered": Rig(numbered=False),
    "merged": Rig(rings=32, merged=True),
    "merged, rings mixed": Rig(rings=32, merged=True, mixed=True),
    "barrel": Rig(camera=camera("plumb_bob", (-0.28, 0.1, 0.001, -0.001, -0.015), 280.0)),
    "fisheye": Rig(camera=camera("equidistant", (0.02, -0.005, 0.001, 0.0), 240.0, (540, 300))),
    "turned": Rig(turn=(math.pi / 2, 0.0, 0.0)),
    "left is forward": Rig(turn=(0.0, 0.0, math.pi / 2)),
}


def drive_of(rig, seed, frames, columns=900):
    """Pairs of a drive, the true extrinsic, and where the cloud's frame is on the vehicle."""
    parameters = DriveParameters(
        seed=seed,
        duration=0.1 * frames,
        camera=rig.camera,
        lidar=spinning(rig.rings, columns),
        scene=SceneParameters(length=200.0),
    )
    drive = Drive(parameters)
    if rig.merged:
        T_cam_vehicle = parameters.T_stored @ se3.inverse(parameters.T_vehicle_lidar)
        return [_merged(drive, index, mixed=rig.mixed) for index in range(frames)], T_cam_vehicle, np.eye(4)
    turn = se3.transform(se3.exp_so3(np.array(rig.turn)), np.zeros(3))
    pairs = []
    for frame in drive:
        xyz = se3.apply(turn, frame.cloud.xyz.astype(np.float64)).astype(np.float32)
        ring = frame.cloud.ring if rig.numbered else None
        cloud = dataclasses.replace(frame.cloud, xyz=xyz, ring=ring)
        pairs.append(_pair(frame, cloud, frame.cloud_stamp_ns))
    back = se3.inverse(turn)
    return pairs, parameters.T_stored @ back, parameters.T_vehicle_lidar @ back


def _pair(frame, cloud, stamp_ns):
    return FramePair("front", cloud, frame.image, stamp_ns, frame.image_stamp_ns, 0.1)


def _merged(drive, index, *, mixed):
    """One of two LiDARs at the sides of the roof, as it all stood at the exposure."""
    frame, p = drive.frame(index), drive.parameters
    start = (frame.cloud_stamp_ns - START_NS) / 1e9
    back = se3.inverse(frame.T_world_vehicle)
    parts = []
    for number, place in enumerate(((0.9, 0.6, 1.7), (0.9, -0.6, 1.7))):
        seat = se3.transform(se3.exp_so3(np.radians([0.5, -0.7 + number, 3.0 * number])), np.array(place))
        rng = np.random.default_rng([p.seed, index, 2 + number])
        cloud = sweep(drive.scene, p.lidar, lambda t, seat=seat: drive.T_world_vehicle(t) @ seat, start, rng)
        moments, which = np.unique(cloud.time, return_inverse=True)
        T = back @ drive.T_world_vehicle(start + moments.astype(np.float64)) @ seat
        xyz = np.einsum("nij,nj->ni", T[which, :3, :3], cloud.xyz) + T[which, :3, 3]
        parts.append((xyz.astype(np.float32), cloud.intensity, cloud.ring))
    xyz, intensity, ring = (np.concatenate(values) for values in zip(*parts, strict=True))
    return _pair(frame, PointCloud(xyz, intensity, ring if mixed else None), frame.image_stamp_ns)
