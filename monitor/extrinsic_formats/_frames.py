"""The extrinsic between two frames of a tree of transforms, as tf and URDF state it (parent -> child)."""

from collections.abc import Sequence

import numpy as np

from monitor.discovery import VEHICLE_FRAMES, compose, path
from monitor.extrinsic_formats import Choice, Direction, Reading, defined, names_camera, one_of
from monitor.messages import Transform
from pipeline.errors import InputError, RigError
from pipeline.records import Floats
from pipeline.se3 import AXES_CAM_IN_VEHICLE, transform

_LIDAR_WORDS = (
    "lidar",
    "laser",
    "velo",
    "ouster",
    "os0",
    "os1",
    "os2",
    "hesai",
    "pandar",
    "livox",
    "robosense",
)
"""Parts of names that LiDARs bear."""


def between(transforms: Sequence[Transform], choice: Choice, *, optical: bool) -> Reading:
    """The extrinsic of the camera and the LiDAR of a tree.

    Args:
        transforms: Its links.
        choice: Which camera and LiDAR, where names do not tell.
        optical: Whether camera frames look along z (x right, y down); else those whose name does not say
            "optical" look along x (y left, z up).

    Raises:
        InputError: Several frames or none may be the camera or the LiDAR, or nothing connects them.
        RigError: ``--direction`` contradicts the file, or makes no sense for a chain.
    """
    names = list(dict.fromkeys(name for t in transforms for name in (t.parent, t.child)))
    camera = one_of(_cameras(names, choice), choice.camera, "camera frame", "--camera")
    lidar = one_of(_lidars([n for n in names if n != camera], choice), choice.lidar, "LiDAR frame", "--lidar")
    chain = path(transforms, camera, lidar)
    if chain is None:
        raise InputError(
            f"no chain of transforms from {lidar} to {camera}", hint=f"frames: {', '.join(names)}"
        )
    T = compose(chain)
    links = ", ".join(f"{step.parent} -> {step.child}" for step, _ in chain)
    why = f"tf, parent -> child: {links}"
    if len(chain) == 1:
        stated: Direction = "T_cam_lidar" if chain[0][1] else "T_lidar_cam"
        kept = "kept as it is" if defined(choice, stated, why) == "T_cam_lidar" else "inverted"
        read_as = f"{stated} ({why}), {kept}"
    elif choice.direction is not None:
        raise RigError(f"--direction has no meaning for a chain ({links})", hint="leave it out")
    else:
        read_as = f"a chain ({why}), composed to T_cam_lidar"
    if optical or "optical" in camera.lower():
        note = f"{camera} is taken as an optical frame (x right, y down, z ahead)"
    else:
        T = transform(AXES_CAM_IN_VEHICLE.T, np.zeros(3)) @ T
        note = f"{camera} looks along its x: turned into the optical axes (x right, y down, z ahead)"
    return Reading(
        T,
        read_as,
        camera={"frame": camera},
        lidar={"frame": lidar},
        name=camera,
        T_vehicle_lidar=_vehicle(transforms, lidar),
        notes=(note, f"clouds must be in frame {lidar}"),
    )


def _vehicle(transforms: Sequence[Transform], lidar: str) -> Floats | None:
    chains = (path(transforms, vehicle, lidar) for vehicle in VEHICLE_FRAMES)
    return next((compose(chain) for chain in chains if chain), None)


def _cameras(names: Sequence[str], choice: Choice) -> list[str]:
    """Frames that may be the camera; of a camera's frames the optical one."""
    if choice.camera is not None:
        return list(names)
    cameras = [name for name in names if names_camera(name)]
    optical = [name for name in cameras if "optical" in name.lower()]
    if not cameras and choice.lidar is not None and len(names) == 2:
        return [name for name in names if name != choice.lidar]
    return optical or cameras


def _lidars(names: Sequence[str], choice: Choice) -> list[str]:
    """Frames that may be the LiDAR: by its name, or the only one that is left."""
    if choice.lidar is not None or len(names) == 1:
        return list(names)
    return [name for name in names if any(word in name.lower() for word in _LIDAR_WORDS)]
