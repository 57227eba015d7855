"""Training data in the fleet layout: a folder of sets, each with ``images/``, ``labels/`` and ``set.json``.

``set.json`` names the classes that were drawn (``labelled_classes``), what the pixels of a value may be
(``folded_into``) and the ``splits``; labels are 8 bit PNG, one value per pixel, ``labels.IGNORE`` where
nothing is said.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import cv2
import numpy as np

from models import augment, composite
from pipeline import labels

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

_T = TypeVar("_T")

THIN = (labels.LANE, labels.POLE)
"""Classes that crops are centred on."""

CACHE_BYTES = 2 << 30
"""Decoded pictures kept in memory; more are decoded again at each use."""


class DataError(Exception):
    """A training folder that does not keep the layout; the text names the file."""


@dataclass(frozen=True, slots=True, eq=False)
class LabelledSet(labels.SetDescription):
    """One set of one camera or source, and what its ``set.json`` says.

    Args:
        folder: Where it lies.
    """

    folder: Path

    def files(self, identifier: str) -> tuple[Path, Path]:
        """Return picture and label of one id.

        Raises:
            DataError: If one of them is missing.
        """
        label = self.folder / "labels" / f"{identifier}.png"
        for suffix in (".jpg", ".png"):
            picture = self.folder / "images" / f"{identifier}{suffix}"
            if picture.is_file() and label.is_file():
                return picture, label
        raise DataError(
            f"{self.folder}: {identifier} of a split lacks its images/*.jpg (or .png) or labels/*.png"
        )

    def read(self, identifier: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Decode one pair: BGR uint8 (H, W, 3) and label values uint8 (H, W).

        Raises:
            DataError: If a file can not be decoded, sizes differ or a value is not one of the set's.
        """
        picture_file, label_file = self.files(identifier)
        picture = cv2.imread(str(picture_file), cv2.IMREAD_COLOR)
        label = cv2.imread(str(label_file), cv2.IMREAD_UNCHANGED)
        if picture is None or label is None or label.ndim != 2 or label.dtype != np.uint8:
            raise DataError(f"{label_file}: picture or 8 bit label of one channel can not be decoded")
        if picture.shape[:2] != label.shape:
            raise DataError(f"{label_file}: {label.shape} does not fit the picture's {picture.shape[:2]}")
        strange = self.strange_values(label.astype(np.uint8, copy=False))
        if strange:
            raise DataError(f"{label_file}: values {strange} are neither labelled nor folded in set.json")
        return picture.astype(np.uint8, copy=False), label.astype(np.uint8, copy=False)


def read_set(folder: Path) -> LabelledSet:
    """Read ``set.json`` of one set.

    Raises:
        DataError: If it is missing or says something that does not fit the label contract.
    """
    said = _read(folder / "set.json", labels.read_description)
    return LabelledSet(groups=said.groups, labelled=said.labelled, splits=said.splits, folder=folder)


def _read(path: Path, check: Callable[[object], _T]) -> _T:
    """Decode a JSON file and check what it says."""
    try:
        return check(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: {error}") from error


def read_sets(roots: list[Path], only: frozenset[str] = frozenset()) -> list[LabelledSet]:
    """Read the sets below the given folders, in the order of their names.

    Args:
        roots: Folders of sets.
        only: Names of the sets that are wanted; empty: all.

    Raises:
        DataError: If there is none, a wanted one is missing, or a ``classes.json`` names other classes than
            the label contract.
    """
    found: list[LabelledSet] = []
    for root in roots:
        contract = root / "classes.json"
        if contract.is_file():
            _read(contract, labels.check_class_names)
        found += [
            read_set(path.parent)
            for path in sorted(root.glob("*/set.json"))
            if not only or path.parent.name in only
        ]
    missing = only - {one.folder.name for one in found}
    if missing:
        raise DataError(f"no set {', '.join(sorted(missing))} below {', '.join(map(str, roots))}")
    if not found:
        raise DataError(f"no */set.json below {', '.join(map(str, roots))}")
    return found


def fingerprint(sets: list[LabelledSet], split: str = "train") -> str:
    """Return the SHA-256 of the pictures and labels of a split: which data made a model."""
    digest = hashlib.sha256()
    for one in sorted(sets, key=lambda s: s.folder.name):
        for identifier in sorted(one.splits.get(split, ())):
            for path in one.files(identifier):
                digest.update(f"{one.folder.name}/{path.name}\0".encode())
                digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """One training sample: BGR uint8 (h, w, 3), label values uint8 (h, w), groups bool (classes, classes)."""

    picture: NDArray[np.uint8]
    label: NDArray[np.uint8]
    groups: NDArray[np.bool_]


class Sampler:
    """Draws crops of the training splits: a set by its weight, a picture, a place near paint or a pole.

    Args:
        sets: Sets with a ``train`` split; others are left out.
        size: Crop (height, width), px.
        weights: Set name -> share of the draws, relative; a set not named counts by the root of its size,
            so that a large set of one camera does not drown small ones.
        thin_share: Share of the crops that are centred on a thin class where the set has one.
        paint_share: Share of the crops of a set with labelled road that get synthetic paint.
        pole_share: Share of the crops that get a synthetic pole.
        widths: A picture is scaled so that its full width falls in this range, px, log-uniform: what the
            run time sees. Poles must keep their 2 to 5 px.
        largest_scale: Upper bound of the magnification: beyond it there is nothing but blur to learn.
    """

    def __init__(
        self,
        sets: list[LabelledSet],
        size: tuple[int, int],
        weights: dict[str, float],
        *,
        thin_share: float = 0.75,
        paint_share: float = 0.35,
        pole_share: float = 0.3,
        widths: tuple[float, float] = (760.0, 1600.0),
        largest_scale: float = 2.0,
    ) -> None:
        self._sets = [one for one in sets if one.splits.get("train")]
        unknown = set(weights) - {one.folder.name for one in self._sets}
        if unknown or not self._sets:
            raise DataError(f"no set with a train split is called {', '.join(sorted(unknown)) or 'anything'}")
        shares = np.array([weights.get(s.folder.name, len(s.splits["train"]) ** 0.5) for s in self._sets])
        self._shares = shares / shares.sum()
        self._size = size
        self._thin_share = thin_share
        self._paint_share, self._pole_share = paint_share, pole_share
        self._widths = widths
        self._largest_scale = largest_scale
        self._cache: dict[Path, tuple[NDArray[np.uint8], NDArray[np.uint8]]] = {}
        self._cached = 0

    def draw(self, rng: np.random.Generator) -> Crop:
        """Draw one augmented crop, at times with synthetic paint or a synthetic pole in it."""
        one = self._sets[int(rng.choice(len(self._sets), p=self._shares))]
        identifiers = one.splits["train"]
        picture, label = self._load(one, identifiers[int(rng.integers(len(identifiers)))])
        target = np.exp(rng.uniform(*np.log(self._widths)))
        scale = min(target / label.shape[1], self._largest_scale)
        stretch = np.exp(rng.uniform(-0.1, 0.1))
        scales = (float(scale * stretch), float(scale / stretch))
        centre = self._place(one, label, scales, rng)
        flip = bool(rng.integers(2))
        crop, moved = augment.cut(picture, label, centre, scales, self._size, flip=flip)
        ground = self._ground(label, centre, scales, rng, flip=flip)
        if ground is not None and rng.random() < self._paint_share:
            crop, moved = composite.paint(crop, moved, ground, rng)
        if rng.random() < self._pole_share:
            crop, moved = composite.pole(crop, moved, ground, rng)
        return Crop(augment.photometric(crop, rng), moved, one.groups)

    def _ground(
        self,
        label: NDArray[np.uint8],
        centre: tuple[float, float],
        scales: tuple[float, float],
        rng: np.random.Generator,
        *,
        flip: bool,
    ) -> composite.Ground | None:
        """Guess where the road vanishes in a crop: a little above its uppermost row, near the middle."""
        highest = composite.highest_road(label)
        if highest is None:
            return None
        height, width = label.shape
        u, v = width * rng.normal(0.5, 0.12), highest - height * rng.uniform(0.0, 0.03)
        along = (-1.0 if flip else 1.0) * scales[0] * (u - centre[0])
        return composite.Ground(
            u=(self._size[1] - 1) / 2 + along,
            v=(self._size[0] - 1) / 2 + scales[1] * (v - centre[1]),
            focal=width * scales[0] * rng.uniform(0.5, 1.4),
        )

    def batch(
        self, count: int, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.bool_]]:
        """Draw crops: RGB uint8 (B, 3, h, w), labels uint8 (B, h, w), groups bool (B, classes, classes)."""
        crops = [self.draw(rng) for _ in range(count)]
        rgb = np.stack([crop.picture[..., ::-1].transpose(2, 0, 1) for crop in crops])
        return rgb, np.stack([crop.label for crop in crops]), np.stack([crop.groups for crop in crops])

    def _place(
        self,
        one: LabelledSet,
        label: NDArray[np.uint8],
        scales: tuple[float, float],
        rng: np.random.Generator,
    ) -> tuple[float, float]:
        """Choose the centre of the crop, px: near a thin class, else anywhere."""
        reach = np.array([self._size[1] / scales[0], self._size[0] / scales[1]])
        thin = [c for c in THIN if c in one.labelled]
        if thin and rng.random() < self._thin_share:
            seen = label == thin[int(rng.integers(len(thin)))]
            # A row or column first, then a pixel in it: by pixels alone near, fat strokes would take all.
            axis = int(rng.integers(2))
            lines = np.flatnonzero(seen.any(axis=1 - axis))
            if lines.size:
                line = int(rng.choice(lines))
                other = int(rng.choice(np.flatnonzero(seen.take(line, axis=axis))))
                centre = (
                    np.array([other, line] if axis == 0 else [line, other])
                    + rng.uniform(-0.4, 0.4, 2) * reach
                )
                return _within(centre, reach, label.shape)
        return _within(rng.uniform(0.0, 1.0, 2) * label.shape[::-1], reach, label.shape)

    def _load(self, one: LabelledSet, identifier: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        key = one.folder / identifier
        if key not in self._cache:
            pair = one.read(identifier)
            if self._cached + pair[0].nbytes + pair[1].nbytes > CACHE_BYTES:
                return pair
            self._cache[key] = pair
            self._cached += pair[0].nbytes + pair[1].nbytes
        return self._cache[key]


def _within(
    centre: NDArray[np.float64], reach: NDArray[np.float64], shape: tuple[int, ...]
) -> tuple[float, float]:
    """Move a crop's centre (u, v) so that the crop lies in the picture, or round its middle if larger."""
    size = np.array(shape[1::-1], np.float64)
    half = np.minimum(reach, size) / 2
    u, v = np.clip(centre, half, size - half)
    return float(u), float(v)
