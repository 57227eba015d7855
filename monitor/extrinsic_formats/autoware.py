"""Autoware's ``sensor_kit_calibration.yaml``: parent -> child -> x, y, z (m), roll, pitch, yaw (rad).

The angles are those of URDF: about the parent's fixed x, then y, then z. ``camera_link`` looks along x; its
optical frame follows in the vehicle's URDF and is added here.
"""

import math
from collections.abc import Iterator, Mapping

import numpy as np

from monitor.extrinsic_formats import Choice, Document, Format, Reading, frame, numbers_of, table
from monitor.extrinsic_formats._frames import between
from monitor.messages import Transform
from pipeline.errors import InputError
from pipeline.records import Floats
from pipeline.se3 import transform

_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")


class Autoware:
    """Sensor kit calibration."""

    name = "autoware"
    title = "Autoware sensor_kit_calibration YAML"

    def matches(self, document: Document) -> bool:
        """A child frame with x, y, z, roll, pitch and yaw."""
        return any(True for _ in _links(document.data))

    def read(self, document: Document, choice: Choice) -> Reading:
        """The extrinsic between a camera and a LiDAR of the kit."""
        links = list(_links(document.data))
        if not links:
            raise InputError(f"{document.path} has no frame with {', '.join(_KEYS)}")
        transforms = [
            Transform(frame(parent), frame(child), _motion(values, child), static=True)
            for parent, child, values in links
        ]
        return between(transforms, choice, optical=False)


def _links(data: object) -> Iterator[tuple[str, str, Mapping[str, object]]]:
    for parent, children in table(data).items():
        for child, values in table(children).items():
            if set(_KEYS) <= table(values).keys():
                yield str(parent), str(child), table(values)


def _motion(values: Mapping[str, object], child: str) -> Floats:
    numbers = numbers_of([values[key] for key in _KEYS], child)
    roll, pitch, yaw = (float(angle) for angle in numbers[3:])
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (math.cos, math.sin))
    R = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return transform(R, numbers[:3])


FORMAT: Format = Autoware()
