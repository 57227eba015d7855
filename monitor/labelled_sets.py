"""Labelled pictures in the fleet layout of models/MODEL_CARD.md: ``images/``, ``labels/``, ``set.json``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from monitor.image_files import read_image, read_label
from monitor.sources.kitti_raw import read_json
from pipeline.errors import InputError
from pipeline.labels import SetDescription, check_class_names, read_description

_PICTURES = (".jpg", ".png")
"""Suffixes of pictures, the first that is there."""

_LAYOUT_HINT = "models/MODEL_CARD.md shows the layout of a set"


@dataclass(frozen=True, slots=True, eq=False)
class LabelledSet:
    """One set of one camera or source.

    Attributes:
        folder: Where it lies.
        description: What its ``set.json`` says.
    """

    folder: Path
    description: SetDescription

    def files(self, identifier: str) -> tuple[Path, Path]:
        """Picture and label of one id; InputError where one is missing."""
        label = self.folder / "labels" / f"{identifier}.png"
        for suffix in _PICTURES:
            picture = self.folder / "images" / f"{identifier}{suffix}"
            if picture.is_file() and label.is_file():
                return picture, label
        raise InputError(
            f"{self.folder}: {identifier} of a split lacks images/{identifier}.jpg (or .png) "
            f"or labels/{identifier}.png",
            hint="add the file, or take the id out of set.json",
        )

    def read(self, identifier: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Decode one pair: BGR uint8 (H,W,3) and label values uint8 (H,W).

        Raises:
            InputError: A file is missing or can not be decoded, sizes differ, or a value is not one of the
                set's.
        """
        picture_file, label_file = self.files(identifier)
        pixels = read_image(picture_file).pixels
        label = read_label(label_file, (pixels.shape[1], pixels.shape[0]))
        strange = self.description.strange_values(label)
        if strange:
            raise InputError(
                f"{label_file}: values {strange} are neither labelled nor folded in set.json",
                hint=_LAYOUT_HINT,
            )
        return pixels, label


def find_sets(folders: Sequence[Path]) -> tuple[LabelledSet, ...]:
    """Every set in the folders, in the order of folders and names; a folder may be a set itself.

    Raises:
        InputError: There is none, a description can not be used, or a ``classes.json`` names other classes.
    """
    found: dict[Path, LabelledSet] = {}
    for folder in folders:
        _check_classes(folder / "classes.json")
        own = folder / "set.json"
        files = [own] if own.is_file() else sorted(folder.glob("*/set.json"))
        if not files:
            raise InputError(f"{folder} holds no set.json and no */set.json", hint=_LAYOUT_HINT)
        for file in files:
            found.setdefault(file.resolve(), LabelledSet(file.parent, _described(file)))
    return tuple(found.values())


def _described(file: Path) -> SetDescription:
    said = read_json(file)
    try:
        return read_description(said)
    except ValueError as error:
        raise InputError(f"{file}: {error}", hint=_LAYOUT_HINT) from error


def _check_classes(file: Path) -> None:
    if not file.is_file():
        return
    said = read_json(file)
    try:
        check_class_names(said)
    except ValueError as error:
        raise InputError(f"{file}: {error}", hint=_LAYOUT_HINT) from error
