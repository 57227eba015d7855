"""The Dense CRF on one frame: time and memory, beside pydensecrf2 where that is installed."""

import importlib
import importlib.util
import sys
import time
import tracemalloc
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline import labels
from pipeline.crf import AppearanceKernel, CrfParameters, SmoothnessKernel, mean_field

_REPEATS = 5
_SMOOTH_PX, _SMOOTH_COMPAT = 3.0, 1.0
_LIKE_PX, _LIKE_GREY, _LIKE_COMPAT = 20.0, 13.0, 3.0
"""The gentle setting: kernels at which thin things live, so that there are masks to compare."""

_ITERATIONS = 5
_THRESHOLDS = {labels.LANE: 0.5, labels.POLE: 0.3}
_REFERENCE = "pydensecrf"


def least(work: Callable[[], object]) -> float:
    """Least process time of some repetitions, ms."""
    times = []
    for _ in range(_REPEATS):
        begun = time.process_time()
        work()
        times.append(1e3 * (time.process_time() - begun))
    return min(times)


def measure(
    seen: NDArray[np.float32], pixels: NDArray[np.uint8], masks: Callable[[], object]
) -> dict[str, float]:
    """Figures of the CRF in full, every pixel of the image and three classes, and of the product's masks.

    Args:
        seen: float32 (classes,h,w), what the network says, on its grid.
        pixels: uint8 (H,W,3), the image.
        masks: Makes the product's masks of both.
    """
    height, width = pixels.shape[:2]
    lane, pole = (cv2.resize(seen[one], (width, height)) for one in (labels.LANE, labels.POLE))
    unary = -np.log(np.clip(np.stack([lane, pole, 1.0 - lane - pole]), 1e-4, 1.0))
    smooth = SmoothnessKernel(_SMOOTH_PX, _SMOOTH_PX, _SMOOTH_COMPAT)
    like = AppearanceKernel(_LIKE_PX, _LIKE_PX, (_LIKE_GREY,) * 3, _LIKE_COMPAT)
    setting = CrfParameters(smooth, like, _ITERATIONS)
    full = least(lambda: mean_field(unary, pixels, setting))
    product = least(masks)
    found = {
        "CRF on every pixel, three classes, ms": full,
        "masks with CRF, ms": product,
        "CRF on every pixel, largest memory, MB": _peak_mb(lambda: mean_field(unary, pixels, setting)),
        "masks with CRF, largest memory, MB": _peak_mb(masks),
    }
    if importlib.util.find_spec(_REFERENCE) is None:
        sys.stderr.write("no comparison with pydensecrf2: it is not installed\n")
        return found
    theirs = _reference(unary, pixels)
    spent = least(lambda: _reference(unary, pixels))
    ours = mean_field(unary, pixels, setting)
    found |= {"pydensecrf2, ms": spent, "pydensecrf2 / CRF on every pixel": spent / full}
    found["pydensecrf2 / masks with CRF"] = spent / product
    for plane, (label, threshold) in enumerate(_THRESHOLDS.items()):
        one, other = ours[plane] >= threshold, theirs[plane] >= threshold
        union = int((one | other).sum())
        name = f"{labels.NAMES[label]} mask: CRF on every pixel and pydensecrf2, IoU"
        found[name] = float((one & other).sum()) / union if union else float("nan")
    return found


def _reference(unary: NDArray[np.float32], pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Marginals by pydensecrf2."""
    dense = importlib.import_module(f"{_REFERENCE}.densecrf")
    classes, height, width = unary.shape
    crf = dense.DenseCRF2D(width, height, classes)
    crf.setUnaryEnergy(np.ascontiguousarray(unary.reshape(classes, -1)))
    crf.addPairwiseGaussian(sxy=_SMOOTH_PX, compat=_SMOOTH_COMPAT)
    # It refuses arrays that it could not write to.
    crf.addPairwiseBilateral(sxy=_LIKE_PX, srgb=_LIKE_GREY, rgbim=np.array(pixels), compat=_LIKE_COMPAT)
    return np.array(crf.inference(_ITERATIONS), dtype=np.float32).reshape(unary.shape)


def _peak_mb(work: Callable[[], object]) -> float:
    """Largest memory of arrays that the work holds at once, beside what was there."""
    tracemalloc.start()
    work()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 2.0**20
