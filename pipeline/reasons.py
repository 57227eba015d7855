"""What a verdict says in one sentence, with the figure that carries it."""

import numpy as np

from pipeline.drift_test import Judgement
from pipeline.records import AXES, Floats


def size(axis: int, value: float, sigma: float) -> str:
    """A drift of one axis, rad or m, as ``yaw +0.50 deg (sigma 0.05)``."""
    if axis < 3:
        return f"{AXES[axis]} {np.degrees(value):+.2f} deg (sigma {np.degrees(sigma):.2f})"
    return f"{AXES[axis]} {value:+.3f} m (sigma {sigma:.3f})"


def worst(drift: Floats, sigma: Floats, limits: Floats) -> str:
    """The axis (of six, rad and m) on which a drift is the largest share of its alert limit."""
    axis = int(np.argmax(np.abs(drift) / limits))
    return size(axis, float(drift[axis]), float(sigma[axis]))


def drift(judgement: Judgement, limits: Floats) -> str:
    """Of a drift that is sure."""
    return f"The mount has moved: {worst(judgement.drift, judgement.sigma, limits)}."


def over(span: str, claim: str, told: tuple[Floats, Floats], limits: Floats) -> str:
    """Of a drift (6,) and its sigma (6,) that was heard over a span: ``12 scenes``, ``the last 0.6 s``."""
    return f"Over {span} the mount {claim}: {worst(*told, limits)}."


def blindness(judgement: Judgement) -> tuple[str, str]:
    """Code and reason of a window in which nothing is seen."""
    if judgement.ambiguous:
        return "ambiguous", "Several extrinsics explain these scenes about as well: nothing tells them apart."
    reason = "Image and cloud show nothing in common here (dark, blocked, or off by more than can be seen)."
    return "nothing_in_common", reason


def unmonitored(judgement: Judgement, axes: list[int]) -> str:
    """Of required axes that are not known well enough."""
    parts = []
    for axis in axes:
        level = float(judgement.protection_level[axis])
        text = f"{np.degrees(level):.2f} deg" if axis < 3 else f"{level:.3f} m"
        parts.append(f"{AXES[axis]} is known to {text} only")
    return f"{' and '.join(parts)}, more than its alert limit." if parts else "No axis is required."
