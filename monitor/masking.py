"""Image files to label images, by the network, CRF and thresholds that the watch uses."""

import dataclasses
import threading
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from monitor.clock import Clock
from monitor.image_files import read_image
from monitor.mask_overlay import mask_overlay
from monitor.model_file import open_segmenter
from monitor.outputs import write_whole
from pipeline import labels
from pipeline.errors import CalibwatchError, InputError
from pipeline.label_image import label_image
from pipeline.masks import MaskParameters, masks_from_probabilities
from pipeline.parameters import Parameters
from pipeline.segmentation import Segmenter, grid_scale

SCHEMA: Literal["calibwatch.masks/1"] = "calibwatch.masks/1"

THREADS = 2
"""Threads of the network: the cores that the watch counts on."""

_JPEG_QUALITY = 92


class Covered(BaseModel):
    """What of an image one class covers."""

    model_config = ConfigDict(frozen=True)

    share: float
    """Share of the image's pixels, 0..1."""
    components: int
    """Connected pieces (8 neighbours)."""


class MaskedImage(BaseModel):
    """One image that got its masks."""

    model_config = ConfigDict(frozen=True)

    file: str
    width: int
    height: int
    lane: Covered
    pole: Covered
    network_ms: float
    masks_ms: float
    """CRF, thresholds and choice of pieces."""
    label: str
    """The label image that was written."""
    overlay: str
    note: str
    """What a person should look at, or empty."""


class Refused(BaseModel):
    """One image that got none, and why."""

    model_config = ConfigDict(frozen=True)

    file: str
    reason: str


class MaskRun(BaseModel):
    """What became of a list of images."""

    model_config = ConfigDict(frozen=True, serialize_by_alias=True)

    schema_: Literal["calibwatch.masks/1"] = Field(default=SCHEMA, alias="schema")
    model_hash: str
    model_version: str
    crf: bool
    threads: int
    complete: bool
    """False where the run was interrupted."""
    images: tuple[MaskedImage, ...]
    refused: tuple[Refused, ...]


def mask_files(
    files: Sequence[Path],
    out: Path,
    *,
    model: Path | None,
    crf: bool,
    replace: bool,
    clock: Clock,
    stop: threading.Event,
    tell: Callable[[MaskedImage | Refused], None],
) -> MaskRun:
    """Writes ``NAME.png`` (labels) and ``NAME.overlay.jpg`` for each image; bad ones do not keep the others.

    No camera is known, so paint may lie anywhere: the watch leaves out what is above the horizon.

    Args:
        files: The images.
        out: Folder, made where it is absent.
        model: The network's file, or None: the one that ships.
        crf: Whether the CRF takes part, as in the watch.
        replace: Whether files of an earlier run may be replaced; an input never is.
        clock: Measures network and masks.
        stop: Ends the run early.
        tell: Told each image as it is done or refused.

    Raises:
        ModelError: The network can not be used; nothing was written.
        CalibwatchError: ``out`` can not be written.
    """
    segmenter = open_segmenter(model, THREADS)
    parameters = Parameters().masks if crf else dataclasses.replace(Parameters().masks, crf=None)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {out} can not be made: {error.strerror}", hint="name a folder") from error
    places = _Places(out, files, replace=replace)
    done: list[MaskedImage] = []
    refused: list[Refused] = []
    for file in files:
        if stop.is_set():
            break
        try:
            label_file, overlay_file = places.of(file)
            done.append(_masked(file, (label_file, overlay_file), segmenter, parameters, clock))
            tell(done[-1])
        except InputError as error:
            refused.append(Refused(file=str(file), reason=str(error)))
            tell(refused[-1])
    return MaskRun(
        model_hash=segmenter.info.hash,
        model_version=segmenter.info.version,
        crf=crf,
        threads=THREADS,
        complete=len(done) + len(refused) == len(files),
        images=tuple(done),
        refused=tuple(refused),
    )


class _Places:
    """Where the files of each image go; nothing is replaced that someone may miss."""

    def __init__(self, out: Path, files: Sequence[Path], *, replace: bool) -> None:
        self._out = out
        self._inputs = {file.resolve() for file in files}
        self._replace = replace
        self._names = _names(self._inputs)
        self._taken: dict[str, Path] = {}

    def of(self, file: Path) -> tuple[Path, Path]:
        """Label image and overlay of an image; InputError where that would replace something."""
        name = self._names[file.resolve()]
        first = self._taken.setdefault(name, file)
        if first is not file:
            raise InputError(f"{file}: {first} has written {name}.png already", hint="name each image once")
        places = self._out / f"{name}.png", self._out / f"{name}.overlay.jpg"
        for place in places:
            if place.resolve() in self._inputs:
                raise InputError(f"{file}: {place} is one of the images", hint="name another --out")
            if _exists(place, file) and not self._replace:
                raise InputError(f"{file}: {place} exists already", hint="--force replaces it")
        return places


def _exists(place: Path, file: Path) -> bool:
    """Whether a file is there; InputError where there can be none of this name."""
    try:
        place.lstat()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise InputError(
            f"{file}: {place} can not be written: {error.strerror}", hint="rename the image"
        ) from error
    return True


def _names(files: Collection[Path]) -> dict[Path, str]:
    """A name for each file: its own, with those of as many folders before it as tell it from its like."""
    alike: dict[str, list[Path]] = {}
    for file in files:
        alike.setdefault(file.stem, []).append(file)
    names: dict[Path, str] = {}
    for stem, group in alike.items():
        depths = range(min(len(file.parts) for file in group) - 1)
        told_apart = (n for n in depths if len({file.parts[-1 - n : -1] for file in group}) == len(group))
        folders = next(told_apart, 0)
        names |= {file: "_".join((*file.parts[-1 - folders : -1], stem)) for file in group}
    return names


def _masked(
    file: Path, places: tuple[Path, Path], segmenter: Segmenter, parameters: MaskParameters, clock: Clock
) -> MaskedImage:
    """One image read, segmented and written."""
    image = read_image(file)
    size = image.pixels.shape[1], image.pixels.shape[0]
    begun_ns = clock.monotonic_ns()
    try:
        probabilities = segmenter.probabilities(image.pixels)
    except InputError as error:  # a side that is too long
        raise InputError(f"{file}: {error.what}", hint=error.hint) from error
    seen_ns = clock.monotonic_ns()
    masks = masks_from_probabilities(probabilities, image.pixels, parameters, scale=grid_scale(*size))
    done_ns = clock.monotonic_ns()
    label = label_image(masks, size)
    # The label image comes last: where it is, the overlay is too.
    _write(places[1], mask_overlay(image.pixels, label), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    _write(places[0], label, [])
    return MaskedImage(
        file=str(file),
        width=size[0],
        height=size[1],
        lane=_covered(label == labels.LANE),
        pole=_covered(label == labels.POLE),
        network_ms=(seen_ns - begun_ns) / 1e6,
        masks_ms=(done_ns - seen_ns) / 1e6,
        label=str(places[0]),
        overlay=str(places[1]),
        note=image.note,
    )


def _covered(mask: NDArray[np.bool_]) -> Covered:
    count, _ = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    return Covered(share=float(mask.mean()), components=count - 1)


def _write(path: Path, pixels: NDArray[np.uint8], options: list[int]) -> None:
    """Encodes and writes; an OSError is none of the image and ends the run."""
    _, data = cv2.imencode(path.suffix, pixels, options)
    try:
        write_whole(path, data.tobytes())
    except OSError as error:
        raise CalibwatchError(
            f"{path} can not be written: {error.strerror}", hint="make room, or name another --out"
        ) from error
