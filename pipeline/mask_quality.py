"""How good a mask is against a label: pixels counted per image, ratios of the counts, intervals, reliability.

Counts of images add up, so a set is judged by the sum of its rows, and a resample of its images by another
sum. Drawn labels are no better than a pixel or two: precision and recall forgive ``slack_px``, the
intersection over union (IoU) forgives nothing.
"""

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline import labels
from pipeline.errors import InputError
from pipeline.records import Floats

Bools: TypeAlias = NDArray[np.bool_]

COUNTS = ("hit", "masked", "near", "found", "labelled", "known")
"""Columns of a row of counts, px: masked and labelled; masked; masked within the slack of a labelled pixel;
labelled within the slack of a masked one; labelled; of which the label says whether they are of the class."""

RATIOS = ("iou", "precision", "recall", "f", "covered")
"""hit / (masked or labelled); near / masked; found / labelled; harmonic mean of the two; masked / known."""

_REFERENCE_WIDTH_PX = 1280
_SLACK_PX = 2.0
_LEAST_SLACK_PX = 1.0

TENTHS = 10
"""Bins of the stated probability."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What a label image says of one class.

    Attributes:
        known: bool (H,W), whether the pixel is for sure of the class or for sure not.
        present: bool (H,W), whether it is of the class; False where that is not known.
    """

    known: Bools
    present: Bools


def truth_of(label: NDArray[np.uint8], groups: Bools, value: int) -> Truth:
    """Read a partial label for one class.

    Args:
        label: uint8 (H,W), values of ``pipeline.labels``; ``IGNORE`` and values beyond the classes are not
            known.
        groups: bool (classes,classes), what the pixels of a value may be (``labels.group_table``).
        value: The class.

    Returns:
        A pixel is known where its value may be the class alone, or any but the class; where it may be this
        or that, nothing is said.
    """
    may = groups[:, value]
    sure = np.zeros(256, dtype=np.bool_)
    present = np.zeros(256, dtype=np.bool_)
    present[: len(may)] = may & (groups.sum(axis=1) == 1)
    sure[: len(may)] = present[: len(may)] | ~may
    sure[labels.IGNORE] = present[labels.IGNORE] = False
    return Truth(known=sure[label], present=present[label])


def slack_px(width: int) -> float:
    """Slack of precision and recall in an image of this width, px: 2 px at 1280 px, nowhere below one."""
    return max(_LEAST_SLACK_PX, _SLACK_PX * width / _REFERENCE_WIDTH_PX)


def count(mask: Bools, truth: Truth, slack: float) -> Floats:
    """Count the pixels of one image: float64 (6,), see ``COUNTS``.

    Args:
        mask: bool (H,W). Where the truth is not known it takes no part.
        truth: Of the same image.
        slack: px, Euclidean between pixel centres; a distance of just this counts as near.

    Raises:
        InputError: The mask is not of the label's size.
    """
    if mask.shape != truth.known.shape:
        raise InputError(f"a mask of {mask.shape} is held against a label of {truth.known.shape}")
    seen = mask & truth.known
    figures = (
        np.count_nonzero(seen & truth.present),
        np.count_nonzero(seen),
        np.count_nonzero(seen & _near(truth.present, slack)),
        np.count_nonzero(truth.present & _near(seen, slack)),
        np.count_nonzero(truth.present),
        np.count_nonzero(truth.known),
    )
    return np.array(figures, dtype=np.float64)


def ratios(counts: Floats) -> Floats:
    """Ratios (...,5), see ``RATIOS``, of counts (...,6); NaN where there is nothing to divide by.

    Without a labelled pixel there is no recall and no F; without a masked one no precision, and F is 0.
    """
    hit, masked, near, found, labelled, known = np.moveaxis(np.asarray(counts, dtype=np.float64), -1, 0)
    precision, recall = _share(near, masked), _share(found, labelled)
    kept = np.nan_to_num(precision)
    # Where both are 0 so is F; the denominator only has to be something.
    total = np.where(kept + recall == 0.0, 1.0, kept + recall)
    columns = (
        _share(hit, masked + labelled - hit),
        precision,
        recall,
        2.0 * kept * recall / total,
        _share(masked, known),
    )
    return np.stack(columns, axis=-1)


def intervals(counts: Floats, rng: np.random.Generator, resamples: int, share: float = 0.95) -> Floats:
    """Percentile bootstrap over the images of a set.

    Frames of one drive resemble each other: for them the interval is too narrow, and it says nothing of
    other streets and cameras.

    Args:
        counts: float64 (n,6), a row for each image.
        rng: Draws the resamples.
        resamples: How many.
        share: Of the resamples between both ends.

    Returns:
        float64 (2,5), lower and upper end of each of ``RATIOS``; NaN with fewer than two images, or where
        no resample gives the ratio.
    """
    images = len(counts)
    ends = np.full((2, len(RATIOS)), np.nan)
    if images < 2:
        return ends
    drawn = (np.bincount(rng.integers(images, size=images), minlength=images) for _ in range(resamples))
    found = ratios(np.stack([times @ counts for times in drawn]))
    tails = (0.5 - 0.5 * share, 0.5 + 0.5 * share)
    for column in range(len(RATIOS)):
        given = found[:, column][np.isfinite(found[:, column])]
        if given.size:
            ends[:, column] = np.quantile(given, tails)
    return ends


def stated(probability: NDArray[np.float32], truth: Truth) -> Floats:
    """Sort the known pixels of one image by what was stated of them.

    Args:
        probability: float32 (H,W), 0..1, of the class.
        truth: Of the same image.

    Returns:
        float64 (3,10), for each tenth of stated probability: pixels, sum of what was stated, pixels that
        are of the class. Tables of images add up.
    """
    said = probability[truth.known].astype(np.float64)
    bins = np.clip((TENTHS * said).astype(np.intp), 0, TENTHS - 1)
    weights = (None, said, truth.present[truth.known])
    return np.stack([np.bincount(bins, weights, minlength=TENTHS) for weights in weights]).astype(np.float64)


def reliability(table: Floats) -> tuple[Floats, float]:
    """What was stated against what was so.

    Args:
        table: float64 (3,10) of :func:`stated`, summed over images.

    Returns:
        float64 (2,10): mean stated probability and observed share of each tenth, NaN where nothing was
        stated; and the expected calibration error: their mean distance, weighted by pixels. Nearly all
        pixels of a thin class lie in the first tenth and are right, so it is small by itself.
    """
    pixels, said, right = table
    rows = np.stack([_share(said, pixels), _share(right, pixels)])
    error = float(np.abs(said - right).sum() / pixels.sum()) if pixels.sum() else float("nan")
    return rows, error


def _share(part: Floats, whole: Floats) -> Floats:
    """The part by the whole, NaN where the whole is nothing."""
    out = np.full(np.shape(whole), np.nan)
    return np.asarray(np.divide(part, whole, out=out, where=np.asarray(whole) > 0.0), dtype=np.float64)


def _near(mask: Bools, slack: float) -> Bools:
    """Pixels whose distance to the next pixel of the mask is at most ``slack``, px."""
    reach = int(slack)
    away = np.arange(-reach, reach + 1)
    disc = (away[:, None] ** 2 + away[None] ** 2 <= slack**2).astype(np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disc), dtype=np.bool_)
