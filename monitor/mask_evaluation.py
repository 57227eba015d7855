"""Lane and pole masks against labelled pictures: what the watch would make of them, set by set."""

import dataclasses
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from monitor.clock import Clock
from monitor.labelled_sets import LabelledSet, find_sets
from monitor.model_file import open_segmenter
from pipeline import labels, mask_quality
from pipeline.errors import InputError
from pipeline.label_image import label_image, on_image
from pipeline.mask_quality import RATIOS, Truth
from pipeline.masks import MaskParameters, masks_from_probabilities
from pipeline.parameters import Parameters
from pipeline.records import Floats, Masks
from pipeline.segmentation import Segmenter, grid_scale

SCHEMA: Literal["calibwatch.mask-evaluation/1"] = "calibwatch.mask-evaluation/1"

CLASSES = {"lane": labels.LANE, "pole": labels.POLE}

VARIANTS = ("argmax", "thresholds", "crf")
"""How probabilities become masks: the likeliest class; the shipped thresholds; the CRF with its own."""

SWEEP = tuple(round(0.05 * i, 2) for i in range(1, 20))
"""Thresholds that are tried without CRF."""

RESAMPLES = 1000
"""Of the bootstrap: the ends of a 95 % interval are then known to a tenth of its width."""

SEED = 20_260
"""Of the bootstrap; the same for every row, so that rows of a set are resampled alike."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, serialize_by_alias=True)


class Ratio(_Part):
    """A ratio of pixel counts; null where there is nothing to divide by."""

    value: float | None
    low: float | None = Field(description="lower end of the 95 % bootstrap interval over images")
    high: float | None


class Quality(_Part):
    """Figures of one way to make masks."""

    iou: Ratio
    precision: Ratio = Field(description="masked pixels within 2 px (at 1280 px width) of a labelled one")
    recall: Ratio = Field(description="labelled pixels within 2 px (at 1280 px width) of a masked one")
    f: Ratio = Field(description="harmonic mean of precision and recall")
    covered: Ratio = Field(description="masked share of the known pixels")


class Reliability(_Part):
    """Stated probability against observed share, by tenths of the stated one."""

    pixels: tuple[int, ...]
    stated: tuple[float | None, ...] = Field(description="mean stated probability")
    observed: tuple[float | None, ...] = Field(description="share of pixels that are of the class")
    error: float | None = Field(description="expected calibration error: mean distance, weighted by pixels")


class ClassReport(_Part):
    """One class of one set."""

    labelled: float | None = Field(description="labelled share of the known pixels")
    masks: dict[str, Quality] = Field(description="by way: argmax, thresholds, crf")
    reliability: dict[str, Reliability] = Field(description="of the network, and of the marginals with CRF")
    sweep: dict[float, Quality] = Field(description="threshold -> figures without CRF")


class SetReport(_Part):
    """One set."""

    name: str
    folder: str
    images: int
    network_ms: float = Field(description="median")
    masks_ms: float | None = Field(
        description="CRF, thresholds and choice of pieces, median; null without CRF"
    )
    classes: dict[str, ClassReport]


class Evaluation(_Part):
    """All sets."""

    schema_: Literal["calibwatch.mask-evaluation/1"] = Field(default=SCHEMA, alias="schema")
    model_hash: str
    model_version: str
    split: str
    lane_threshold: float = Field(description="without CRF")
    pole_threshold: float
    lane_threshold_crf: float | None = Field(description="of the CRF's marginals; null: no CRF for the class")
    pole_threshold_crf: float | None
    longest_side: int | None = Field(description="px that images were reduced to before; null: as the watch")
    threads: int
    resamples: int
    seed: int
    sets: tuple[SetReport, ...]


@dataclass(frozen=True, slots=True)
class Options:
    """What is measured.

    Attributes:
        split: Split of the sets.
        crf: Whether masks with CRF are measured too.
        sweep: Whether other thresholds are tried.
        longest_side: Images are reduced to this longer side before, px, or None: as the watch does.
        threads: Threads of the network and of OpenCV.
    """

    split: str = "val"
    crf: bool = True
    sweep: bool = False
    longest_side: int | None = None
    threads: int = 2


@dataclass(slots=True, eq=False)
class _Sums:
    """Of one class of one set: a row of counts per image and way, tables of stated probability."""

    counts: defaultdict[str | float, list[Floats]] = field(default_factory=lambda: defaultdict(list))
    stated: dict[str, Floats] = field(default_factory=dict)

    def count(self, way: str | float, mask: NDArray[np.bool_], truth: Truth) -> None:
        slack = mask_quality.slack_px(mask.shape[1])
        self.counts[way].append(mask_quality.count(mask, truth, slack))

    def state(self, of: str, probability: NDArray[np.float32], truth: Truth) -> None:
        table = mask_quality.stated(probability, truth)
        self.stated[of] = self.stated[of] + table if of in self.stated else table


def evaluate(
    folders: Sequence[Path],
    model: Path | None,
    options: Options,
    clock: Clock,
    progress: Callable[[str, int, int], None],
) -> Evaluation:
    """Measures masks on every set that has the split.

    Args:
        folders: Folders of sets, or sets.
        model: The network's file, or None: the one that ships.
        options: What is measured.
        clock: Measures network and masks.
        progress: Told the name of a set, how many of its images are done, and of how many.

    Raises:
        InputError: No set has the split and a class that is evaluated, or a file can not be used.
        ModelError: The network can not be used.
    """
    sets = [one for one in find_sets(folders) if one.description.splits.get(options.split)]
    chosen = [one for one in sets if _classes(one)]
    if not chosen:
        raise InputError(
            f"no set below {', '.join(map(str, folders))} has a split '{options.split}' and labelled "
            f"{' or '.join(CLASSES)}",
            hint="name another --split, or see labelled_classes in set.json",
        )
    for one in chosen:
        for identifier in one.description.splits[options.split]:
            one.files(identifier)  # what is missing is told before an hour has passed
    segmenter = open_segmenter(model, options.threads)
    parameters = Parameters().masks
    with _opencv_threads(options.threads):
        reports = tuple(_measured(one, segmenter, parameters, options, clock, progress) for one in chosen)
    lane, pole = (parameters.crf.lane, parameters.crf.pole) if parameters.crf else (None, None)
    return Evaluation(
        model_hash=segmenter.info.hash,
        model_version=segmenter.info.version,
        split=options.split,
        lane_threshold=parameters.lane_threshold,
        pole_threshold=parameters.pole_threshold,
        lane_threshold_crf=lane.threshold if lane else None,
        pole_threshold_crf=pole.threshold if pole else None,
        longest_side=options.longest_side,
        threads=options.threads,
        resamples=RESAMPLES,
        seed=SEED,
        sets=reports,
    )


@contextmanager
def _opencv_threads(count: int) -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _classes(one: LabelledSet) -> dict[str, int]:
    """The evaluated classes that a set labels."""
    return {name: value for name, value in CLASSES.items() if value in one.description.labelled}


def _measured(
    one: LabelledSet,
    segmenter: Segmenter,
    parameters: MaskParameters,
    options: Options,
    clock: Clock,
    progress: Callable[[str, int, int], None],
) -> SetReport:
    """One set, an image at a time."""
    sums = {name: _Sums() for name in _classes(one)}
    network_ms: list[float] = []
    masks_ms: list[float] = []
    identifiers = one.description.splits[options.split]
    for index, identifier in enumerate(identifiers):
        progress(one.folder.name, index, len(identifiers))
        pixels, label = one.read(identifier)
        shown = _reduced(pixels, options.longest_side)
        begun_ns = clock.monotonic_ns()
        try:
            probabilities = segmenter.probabilities(shown)
        except InputError as error:  # a side that is too long
            raise InputError(f"{one.folder}: {identifier}: {error.what}", hint=error.hint) from error
        network_ms.append((clock.monotonic_ns() - begun_ns) / 1e6)
        seen = _Seen(probabilities, shown, (label.shape[1], label.shape[0]))
        truths = {name: mask_quality.truth_of(label, one.description.groups, CLASSES[name]) for name in sums}
        _without_crf(seen, parameters, sums, truths, sweep=options.sweep)
        if options.crf:
            begun_ns = clock.monotonic_ns()
            masks = seen.masks(parameters)
            masks_ms.append((clock.monotonic_ns() - begun_ns) / 1e6)
            _with_crf(seen, masks, sums, truths)
    return SetReport(
        name=one.folder.name,
        folder=str(one.folder),
        images=len(identifiers),
        network_ms=float(np.median(network_ms)),
        masks_ms=float(np.median(masks_ms)) if masks_ms else None,
        classes={name: _report(summed) for name, summed in sums.items()},
    )


def _reduced(pixels: NDArray[np.uint8], longest_side: int | None) -> NDArray[np.uint8]:
    """The image with at most so long a side, by area means as the network's input rule does it."""
    height, width = pixels.shape[:2]
    if longest_side is None or max(height, width) <= longest_side:
        return pixels
    scale = longest_side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """What the network says of one image.

    Attributes:
        probabilities: float32 (C,h,w).
        pixels: uint8, the image it was given.
        size: Width and height of the label, px.
    """

    probabilities: NDArray[np.float32]
    pixels: NDArray[np.uint8]
    size: tuple[int, int]

    def masks(self, parameters: MaskParameters) -> Masks:
        """As the watch makes them, without a horizon; placed on the label's pixels."""
        height, width = self.pixels.shape[:2]
        scale = grid_scale(width, height)
        masks = masks_from_probabilities(self.probabilities, self.pixels, parameters, scale=scale)
        scale_x, scale_y = self.scale
        return dataclasses.replace(masks, scale_x=scale_x, scale_y=scale_y)

    @property
    def scale(self) -> tuple[float, float]:
        """Grid px per px of the label."""
        height, width = self.pixels.shape[:2]
        scale_x, scale_y = grid_scale(width, height)
        return scale_x * width / self.size[0], scale_y * height / self.size[1]


def _without_crf(
    seen: _Seen, parameters: MaskParameters, sums: dict[str, _Sums], truths: dict[str, Truth], *, sweep: bool
) -> None:
    """Counts the likeliest class, the shipped thresholds and others."""
    plain = dataclasses.replace(parameters, crf=None)
    likeliest = on_image(seen.probabilities.argmax(axis=0), seen.scale, seen.size)
    shipped = label_image(seen.masks(plain), seen.size)
    for name, summed in sums.items():
        value, truth = CLASSES[name], truths[name]
        summed.count("argmax", likeliest == value, truth)
        summed.count("thresholds", shipped == value, truth)
        summed.state("network", on_image(seen.probabilities[value], seen.scale, seen.size), truth)
        for threshold in SWEEP if sweep else ():
            # The other class keeps its threshold: pixels of poles are none of lanes.
            tried = (
                dataclasses.replace(plain, lane_threshold=threshold)
                if value == labels.LANE
                else dataclasses.replace(plain, pole_threshold=threshold)
            )
            summed.count(threshold, label_image(seen.masks(tried), seen.size) == value, truth)


def _with_crf(seen: _Seen, masks: Masks, sums: dict[str, _Sums], truths: dict[str, Truth]) -> None:
    """Counts the masks of the watch."""
    found = label_image(masks, seen.size)
    marginals = {"lane": masks.lane_probability, "pole": masks.pole_probability}
    for name, summed in sums.items():
        summed.count("crf", found == CLASSES[name], truths[name])
        summed.state("crf", on_image(marginals[name], seen.scale, seen.size), truths[name])


def _report(summed: _Sums) -> ClassReport:
    rows = np.stack(summed.counts["argmax"]).sum(axis=0)
    labelled, known = (float(rows[mask_quality.COUNTS.index(name)]) for name in ("labelled", "known"))
    return ClassReport(
        labelled=labelled / known if known else None,
        masks={way: _quality(summed.counts[way]) for way in VARIANTS if way in summed.counts},
        reliability={of: _reliability(table) for of, table in summed.stated.items()},
        sweep={way: _quality(counts) for way, counts in summed.counts.items() if isinstance(way, float)},
    )


def _quality(counts: list[Floats]) -> Quality:
    rows = np.stack(counts)
    values = mask_quality.ratios(rows.sum(axis=0))
    low, high = mask_quality.intervals(rows, np.random.default_rng(SEED), RESAMPLES)
    return Quality(
        **{
            name: Ratio(value=_finite(values[i]), low=_finite(low[i]), high=_finite(high[i]))
            for i, name in enumerate(RATIOS)
        }
    )


def _reliability(table: Floats) -> Reliability:
    (stated, observed), error = mask_quality.reliability(table)
    return Reliability(
        pixels=tuple(int(pixels) for pixels in table[0]),
        stated=tuple(map(_finite, stated)),
        observed=tuple(map(_finite, observed)),
        error=_finite(error),
    )


def _finite(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None
