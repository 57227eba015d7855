"""The label contract between training and run time: class order, names, colours.

And what a labelled set says of itself. The one module of ours that training may import: it needs numpy alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

VERSION = "1"
"""Changes with the order or meaning of a class; the .onnx carries it and a mismatch is refused."""

IGNORE = 255
"""Label value of pixels that take no part in training or evaluation."""

NAMES = ("other", "lane", "pole", "road", "vehicle", "construction", "vegetation", "sky", "sign")
"""Class names in the order of the network's output channels."""

OTHER, LANE, POLE, ROAD, VEHICLE, CONSTRUCTION, VEGETATION, SKY, SIGN = range(len(NAMES))

COLOURS_RGB = (
    (90, 90, 90),
    (255, 220, 0),
    (230, 40, 230),
    (70, 60, 110),
    (30, 90, 230),
    (140, 90, 60),
    (60, 140, 60),
    (140, 190, 230),
    (240, 120, 30),
)
"""One drawing colour per class, RGB 0..255."""


@dataclass(frozen=True, slots=True, eq=False)
class SetDescription:
    """What the ``set.json`` of a labelled set says.

    Attributes:
        groups: What the pixels of a label value may be, bool (classes,classes), see :func:`group_table`.
        labelled: The classes that were drawn.
        splits: Split name -> picture ids, each one name of a file without folder and suffix.
    """

    groups: NDArray[np.bool_]
    labelled: frozenset[int]
    splits: Mapping[str, tuple[str, ...]]

    def strange_values(self, label: NDArray[np.uint8]) -> list[int]:
        """Values of a label image (any shape) that are neither labelled, nor folded, nor ``IGNORE``."""
        folded = np.flatnonzero((self.groups != group_table()).any(axis=1)).tolist()
        return sorted(set(np.unique(label).tolist()) - {*self.labelled, *folded, IGNORE})


def group_table(folded_into: Mapping[int, list[int]] | None = None) -> NDArray[np.bool_]:
    """Return what each label value may be: bool (classes, classes), row = value, column = class.

    Args:
        folded_into: Label value -> all classes that its pixels may be; values not named mean themselves.

    Raises:
        ValueError: If a value or class is not in the label contract, or a group leaves out its own value.
    """
    table = np.eye(len(NAMES), dtype=np.bool_)
    for value, group in (folded_into or {}).items():
        if not all(0 <= c < len(NAMES) for c in (value, *group)) or value not in group:
            raise ValueError(f"group {value} -> {group} does not fit the {len(NAMES)} classes")
        table[value] = False
        table[value, group] = True
    return table


def read_description(said: object) -> SetDescription:
    """Check what a ``set.json`` says; keys that are not known are notes.

    Args:
        said: The decoded JSON, of whatever type and content.

    Raises:
        ValueError: If a key is missing or of the wrong type, a class is not in the label contract, or an id
            is no plain name of a file. The text names the key.
    """
    keys = _object(said, "the whole")
    folded = _object(keys.get("folded_into", {}), "folded_into")
    if not all(value.isdecimal() for value in folded):
        raise ValueError(f"folded_into has keys {str(list(folded))[:80]}, wanted are label values")
    splits = _object(keys.get("splits"), "splits")
    return SetDescription(
        groups=group_table({int(value): _classes(group, "folded_into") for value, group in folded.items()}),
        labelled=frozenset(_classes(keys.get("labelled_classes"), "labelled_classes")),
        splits={name: _identifiers(ids, f"split {name[:80]!r}") for name, ids in splits.items()},
    )


def check_class_names(said: object) -> None:
    """Check what a ``classes.json`` says against the contract.

    Raises:
        ValueError: If it names other classes, or the same in another order.
    """
    if _object(said, "the whole").get("classes") != list(NAMES):
        raise ValueError(f"classes are not {', '.join(NAMES)}")


def _object(given: object, key: str) -> dict[str, object]:
    """An object out of JSON."""
    if not isinstance(given, dict):
        raise ValueError(f"{key} is no object")  # noqa: TRY004 - a wrong file, not a wrong call
    return given


def _classes(given: object, key: str) -> list[int]:
    """A list of classes out of JSON."""
    if not isinstance(given, list) or not all(
        isinstance(c, int) and not isinstance(c, bool) and 0 <= c < len(NAMES) for c in given
    ):
        raise ValueError(f"{key} {repr(given)[:80]} is no list of classes 0 to {len(NAMES) - 1}")
    return given


def _identifiers(given: object, key: str) -> tuple[str, ...]:
    """Ids of a split out of JSON."""
    if not isinstance(given, list):
        raise ValueError(f"{key} is no list of ids")  # noqa: TRY004 - likewise
    for identifier in given:
        if not _is_plain(identifier):
            raise ValueError(f"{key}: id {str(identifier)[:80]!r} is no plain name of a file")
    if len(set(given)) != len(given):
        raise ValueError(f"{key} names an id twice")
    return tuple(given)


_LONGEST_ID = 200
"""Characters; file systems allow 255 bytes with the suffix."""


def _is_plain(identifier: object) -> bool:
    """Whether it names a file inside its folder, on any system, and can be printed in one line."""
    return (
        isinstance(identifier, str)
        and 0 < len(identifier) <= _LONGEST_ID
        and identifier.isprintable()
        and not identifier.startswith(".")
        and not set(identifier) & set("/\\:")
    )
