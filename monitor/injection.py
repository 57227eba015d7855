"""``--inject``: a rig whose stored extrinsic is made wrong by a drift that is known (DESIGN 2)."""

import dataclasses
import math

import numpy as np

from monitor.rig import RigPair
from monitor.rig_document import nearest
from pipeline.errors import RigError
from pipeline.records import AXES, Floats
from pipeline.se3 import stored_before

LARGEST_DEG = 45.0
"""deg; the camera of a mount that turned further looks elsewhere, and nothing is promised beyond it."""
LARGEST_M = 5.0
"""m; further than the length of a car no camera is carried off: such a number was meant in centimetres."""


def parse_inject(text: str) -> Floats:
    """``yaw=0.5,up=0.05`` (degrees, metres) as drift (6,): roll, pitch, yaw rad, forward, left, up m.

    Raises:
        RigError: An axis is unknown or given twice, or a value is no number that a mount can move by.
    """
    drift = np.zeros(6)
    seen = set()
    for item in text.split(","):
        name, _, number = (part.strip() for part in item.partition("="))
        if name not in AXES:
            raise RigError(f"no axis is called '{name}'", hint=nearest(name, AXES))
        if name in seen:
            raise RigError(f"{name} is named twice", hint="give each axis once")
        seen.add(name)
        drift[AXES.index(name)] = _amount(name, number)
    return drift


def _amount(name: str, number: str) -> float:
    """What stands behind ``name=``, rad or m."""
    turns = AXES.index(name) < 3
    largest, unit = (LARGEST_DEG, "degrees") if turns else (LARGEST_M, "metres")
    example = "as in yaw=0.5,up=0.05"
    try:
        value = float(number)
    except ValueError as error:
        raise RigError(f"'{number}' is no number for {name}", hint=example) from error
    if not math.isfinite(value):
        raise RigError(f"{name} is {number}", hint=f"a finite number, {example}")
    if abs(value) > largest:
        raise RigError(
            f"{name}={number} is more than a mount can move", hint=f"{unit}, at most {largest:g}, {example}"
        )
    return math.radians(value) if turns else value


def injected_text(drift: Floats) -> str:
    """What a reader of a verdict must know where ``drift`` (6,), rad, m, was injected."""
    sizes = [math.degrees(value) if index < 3 else float(value) for index, value in enumerate(drift)]
    named = [
        f"{name} {size:+g} {'deg' if index < 3 else 'm'}"
        for index, (name, size) in enumerate(zip(AXES, sizes, strict=True))
        if size
    ]
    return (
        f"a test by --inject: the stored extrinsic was altered so that a drift of {', '.join(named) or '0'} "
        "is true, and the recording was judged against that"
    )


def inject(pair: RigPair, drift: Floats) -> RigPair:
    """The pair, its stored extrinsic altered so that the true drift is ``drift`` (6,), rad, m (DESIGN 2).

    Raises:
        RigError: The pair has no extrinsic yet.
    """
    if pair.T_cam_lidar is None:
        raise RigError(
            f"pair {pair.name} has no extrinsic to alter", hint="give one in the rig file or by tf_static"
        )
    R_vehicle_lidar = None if pair.T_vehicle_lidar is None else pair.T_vehicle_lidar[:3, :3]
    stored = stored_before(pair.T_cam_lidar, drift, R_vehicle_lidar)
    return dataclasses.replace(pair, T_cam_lidar=stored)
