"""Measure a model on labelled sets: ``python -m models.evaluate --model F --data DIR``.

Needs onnxruntime and no PyTorch: what is measured is the file that ships, fed as the run time feeds it. Per
set and thin class: intersection over union, and precision and recall with a slack of 2 px at 1280 px width,
of the mask ``p > threshold``. The reliability says how often a stated probability was right.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import onnxruntime

from models.data import LabelledSet, read_sets
from pipeline import labels

if TYPE_CHECKING:
    from numpy.typing import NDArray

LONGEST_SIDE = 1280
STRIDE = 32
GRID = 2
"""The input size rule of the contract, see ``export.INPUT_RULE``."""

SLACK_PX = 2.0
"""Slack of precision and recall at a width of 1280 px: hand-drawn labels are no better than that."""

THRESHOLDS = tuple(round(0.05 * i, 2) for i in range(1, 20))
"""Thresholds at which the sums are kept."""

CLASSES = {"lane": labels.LANE, "pole": labels.POLE}


def network_input(bgr: NDArray[np.uint8]) -> tuple[NDArray[np.float32], tuple[int, int]]:
    """Apply the input size rule: RGB float32 (1, 3, h, w) and the reduced (height, width)."""
    height, width = bgr.shape[:2]
    scale = min(1.0, LONGEST_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    reduced = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA) if scale < 1.0 else bgr
    padded = cv2.copyMakeBorder(reduced, 0, -size[1] % STRIDE, 0, -size[0] % STRIDE, cv2.BORDER_REPLICATE)
    return np.ascontiguousarray(padded[..., ::-1].transpose(2, 0, 1)[None], dtype=np.float32), size[::-1]


def probabilities(session: onnxruntime.InferenceSession, bgr: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return class probabilities float32 (classes, H, W), brought back to the picture's own pixels."""
    pixels, (height, width) = network_input(bgr)
    (answer,) = session.run(None, {session.get_inputs()[0].name: pixels})
    full = answer[0].repeat(GRID, axis=1).repeat(GRID, axis=2)[:, :height, :width].transpose(1, 2, 0)
    if full.shape[:2] != bgr.shape[:2]:
        full = cv2.resize(np.ascontiguousarray(full), bgr.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    moved: NDArray[np.float32] = full.transpose(2, 0, 1)
    return moved


@dataclass(slots=True, eq=False)
class Tally:
    """Sums of one class over pictures; each array has one entry per threshold.

    Args:
        hit: Pixels of the mask that carry the label.
        masked: Pixels of the mask.
        near: Pixels of the mask within the slack of a labelled one.
        found: Labelled pixels within the slack of the mask.
        labelled: Labelled pixels.
        said: Pixels by stated probability, ten bins.
        right: Those of them that carry the label.
    """

    hit: NDArray[np.float64] = field(default_factory=lambda: np.zeros(len(THRESHOLDS)))
    masked: NDArray[np.float64] = field(default_factory=lambda: np.zeros(len(THRESHOLDS)))
    near: NDArray[np.float64] = field(default_factory=lambda: np.zeros(len(THRESHOLDS)))
    found: NDArray[np.float64] = field(default_factory=lambda: np.zeros(len(THRESHOLDS)))
    labelled: float = 0.0
    said: NDArray[np.float64] = field(default_factory=lambda: np.zeros(10))
    right: NDArray[np.float64] = field(default_factory=lambda: np.zeros(10))

    def add(self, p: NDArray[np.float32], label: NDArray[np.uint8], value: int) -> None:
        """Add one picture: probability and label values, both (H, W)."""
        known = label != labels.IGNORE
        truth = label == value
        slack = max(1.0, SLACK_PX * label.shape[1] / LONGEST_SIDE)
        to_truth = _distance(truth)
        self.labelled += float(truth.sum())
        for i, threshold in enumerate(THRESHOLDS):
            mask = (p > threshold) & known
            self.hit[i] += float((mask & truth).sum())
            self.masked[i] += float(mask.sum())
            self.near[i] += float((to_truth[mask] <= slack).sum())
            self.found[i] += float((_distance(mask)[truth] <= slack).sum())
        bins = np.minimum((10 * p[known]).astype(np.int64), 9)
        self.said += np.bincount(bins, minlength=10)
        self.right += np.bincount(bins, weights=truth[known], minlength=10)

    def at(self, threshold: float) -> dict[str, float | None]:
        """Return the figures at one of ``THRESHOLDS``; None where nothing was masked or labelled."""
        i = THRESHOLDS.index(threshold)
        return {
            "iou": _ratio(self.hit[i], self.masked[i] + self.labelled - self.hit[i]),
            "precision": _ratio(self.near[i], self.masked[i]),
            "recall": _ratio(self.found[i], self.labelled),
        }

    def reliability(self) -> list[float | None]:
        """Return, per tenth of stated probability, the share of pixels that carry the label."""
        return [_ratio(right, said) for right, said in zip(self.right, self.said, strict=True)]


def _ratio(part: float, whole: float) -> float | None:
    return round(float(part / whole), 3) if whole else None


def _distance(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Distance of every pixel to the next pixel of the mask, px; far where the mask is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf, np.float32)
    outside = np.where(mask, 0, 1).astype(np.uint8)
    return cv2.distanceTransform(outside, cv2.DIST_L2, 5).astype(np.float32, copy=False)


def measure(session: onnxruntime.InferenceSession, one: LabelledSet, split: str) -> dict[str, Tally]:
    """Run the model over one split of one set; a class that the set does not label is left out."""
    tallies = {name: Tally() for name, value in CLASSES.items() if value in one.labelled}
    for identifier in one.splits.get(split, ()):
        picture, label = one.read(identifier)
        p = probabilities(session, picture)
        for name, tally in tallies.items():
            tally.add(p[CLASSES[name]], label, CLASSES[name])
    return tallies


def main() -> None:
    """Read the options, measure and print one line per set and class."""
    parser = argparse.ArgumentParser(prog="python -m models.evaluate", description=__doc__)
    parser.add_argument("--model", type=Path, required=True, help="the .onnx file")
    parser.add_argument(
        "--data", type=Path, action="append", required=True, help="folder of sets; may be repeated"
    )
    parser.add_argument("--split", default="val")
    parser.add_argument(
        "--lane", type=float, default=0.5, choices=THRESHOLDS, metavar="P", help="lane threshold"
    )
    parser.add_argument(
        "--pole", type=float, default=0.5, choices=THRESHOLDS, metavar="P", help="pole threshold"
    )
    parser.add_argument("--json", action="store_true", help="all thresholds and the reliability, as JSON")
    options = parser.parse_args()
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(options.model), settings, providers=["CPUExecutionProvider"])
    chosen = {"lane": options.lane, "pole": options.pole}
    report: dict[str, dict[str, object]] = {}
    for one in read_sets(options.data):
        for name, tally in measure(session, one, options.split).items():
            if not tally.labelled:
                continue
            report.setdefault(one.folder.name, {})[name] = {
                "thresholds": {str(t): tally.at(t) for t in THRESHOLDS},
                "reliability": tally.reliability(),
            }
            if not options.json:
                figures = ", ".join(f"{k} {v}" for k, v in tally.at(chosen[name]).items())
                sys.stdout.write(f"{one.folder.name} {name}: {figures}\n")
    if options.json:
        sys.stdout.write(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
