"""Transforms of ROS as YAML or JSON: translation and quaternion, as tf2 messages or under ``parent-child``.

``T_parent_child`` maps points of the child into the parent. A message names both frames; a key ``a-b`` is
read so, and ``--direction`` overrules it; a transform without names needs ``--direction``.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from monitor.extrinsic_formats import (
    Choice,
    Document,
    Format,
    Reading,
    directed,
    frame,
    numbers_of,
    table,
    told,
)
from monitor.extrinsic_formats._frames import between
from monitor.messages import Transform
from monitor.messages.tf import motion
from pipeline.errors import InputError
from pipeline.records import Floats

_TURNS, _SHIFTS = ("q", "rotation", "quaternion", "orientation"), ("t", "translation", "position")
_UNIT = 0.01
"""A quaternion whose length differs from one by more is something else: three digits are written at least."""


@dataclass(frozen=True, slots=True, eq=False)
class _Entry:
    """One transform; ``stated`` where a message names its frames."""

    parent: str | None
    child: str | None
    values: Mapping[str, object]
    stated: bool


class RosTransform:
    """Quaternion and translation."""

    name = "ros"
    title = "ROS transform: quaternion and translation, YAML or JSON"

    def matches(self, document: Document) -> bool:
        """At least one entry with a translation and a quaternion."""
        return any(True for _ in _entries(document.data))

    def read(self, document: Document, choice: Choice) -> Reading:
        """The transform between camera and LiDAR, over as many links as it takes."""
        entries = list(_entries(document.data))
        if not entries:
            raise InputError(f"{document.path} has no translation with a quaternion")
        only = entries[0] if len(entries) == 1 else None
        unnamed = [entry for entry in entries if entry.parent is None or entry.child is None]
        if only is not None and (unnamed or (choice.direction is not None and not only.stated)):
            direction = told(choice, f"{document.path} names no frames and")
            T, read_as = directed(_motion(only.values), direction, "by --direction")
            return Reading(T, read_as)
        if unnamed:
            raise InputError(f"{document.path} has transforms without names of parent and child")
        transforms = [
            Transform(frame(entry.parent), frame(entry.child), _motion(entry.values), static=True)
            for entry in entries
        ]
        reading = between(transforms, choice, optical=True)
        if all(entry.stated for entry in entries):
            return reading
        note = "the file's key is read as parent-child, as tf writes it: --direction says otherwise"
        return dataclasses.replace(reading, notes=(*reading.notes, note))


def _entries(data: object) -> Iterator[_Entry]:
    """Every transform in a document: messages, lists of messages, values under their names."""
    for document in data if isinstance(data, list) else [data]:
        listed = table(document).get("transforms")
        for message in listed if isinstance(listed, list) else [document]:
            yield from _of_message(table(message))


def _of_message(message: Mapping[str, object]) -> Iterator[_Entry]:
    """The transform of a message, or those of a table ``parent-child: values``."""
    values = table(message.get("transform")) or message
    if _is_motion(values):
        parent = table(message.get("header")).get("frame_id", message.get("frame_id"))
        child = message.get("child_frame_id")
        if isinstance(parent, str) and isinstance(child, str):
            yield _Entry(parent, child, values, stated=True)
        else:
            yield _Entry(None, None, values, stated=False)
        return
    for name, value in message.items():
        if _is_motion(table(value)):
            parent, dash, child = str(name).partition("-")
            named = bool(dash and parent and child and "-" not in child)
            yield _Entry(parent if named else None, child if named else None, table(value), stated=False)


def _is_motion(values: Mapping[str, object]) -> bool:
    return _key(values, _TURNS) is not None and _key(values, _SHIFTS) is not None


def _key(values: Mapping[str, object], names: tuple[str, ...]) -> str | None:
    return next((name for name in names if name in values), None)


def _motion(values: Mapping[str, object]) -> Floats:
    turn = _numbers(values[_key(values, _TURNS) or ""], "xyzw", "the quaternion")
    shift = _numbers(values[_key(values, _SHIFTS) or ""], "xyz", "the translation")
    x, y, z, w = turn
    if abs(math.hypot(x, y, z, w) - 1.0) > _UNIT:
        raise InputError(
            f"the quaternion has length {math.hypot(*turn):.3g}, not 1",
            hint="wanted x, y, z, w of a rotation",
        )
    return motion((shift[0], shift[1], shift[2]), (x, y, z, w))


def _numbers(value: object, names: str, what: str) -> list[float]:
    """Values by name, or a list in the order of ROS."""
    listed = [value.get(name) for name in names] if isinstance(value, Mapping) else value
    numbers = numbers_of(listed, what).reshape(-1)
    if numbers.size != len(names):
        raise InputError(f"{what} has {numbers.size} numbers, wanted {', '.join(names)}")
    return [float(number) for number in numbers]


FORMAT: Format = RosTransform()
