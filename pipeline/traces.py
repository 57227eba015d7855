"""What is kept of the past to tell when a drift began: a few edges of each frame, and what windows said.

Memory is bounded: what is older is kept more thinly, so that the moment of a drift is told to a share of its
age. Frames tell it sharply but reach back some ten seconds; the estimates of windows reach back for hours.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipeline import edge_witness, se3
from pipeline.edge_witness import UNITS, EdgeFrame
from pipeline.edges import Edges
from pipeline.gradients import GradientPyramid
from pipeline.onset import OnsetParameters
from pipeline.records import CameraModel, Floats


@dataclass(frozen=True, slots=True)
class TraceParameters:
    """How much of the past is kept.

    Attributes:
        most_frames: Frames: at 10 Hz they reach back some 15 s, a third of them into the last two.
        most_edges: Edges of each: the way towards a known drift is one number, a third of the edges tells it.
        most_bytes: Gradients of a frame are kept at the finest level that takes no more.
        most_windows: Judgements: at one a second they reach back some days.
        settled_ns: So long after a drift was told the window holds frames from after it alone; then its
            beginning is told for good.
        after_ns: Frames from after that are kept at this spacing: what is sought lies before them.
        change: How the change is found.
    """

    most_frames: int = 64
    most_edges: int = 400
    most_bytes: int = 1 << 20
    most_windows: int = 160
    settled_ns: int = 6_000_000_000
    after_ns: int = 250_000_000
    change: OnsetParameters = field(default_factory=OnsetParameters)


@dataclass(frozen=True, slots=True, eq=False)
class WindowTrace:
    """What one window said.

    Attributes:
        shown_since_ns: Since when a drift would have shown in it.
        stamp_ns: Of its newest frame.
        drift: float64 (6,), estimate against the expected extrinsic, vehicle axes.
    """

    shown_since_ns: int
    stamp_ns: int
    drift: Floats


def spread(stamps_ns: Sequence[int], most: int) -> list[int]:
    """Indices of ascending stamps that stay: the newest densely, one per sixteenth of the age further back.

    Time is cut at fixed places into slots, each made of two of half its length; the first stamp of a slot
    stays. Slots join when all of the longer one is old enough for its length, so that they only ever grow,
    and thinning again and again keeps what thinning at once would.
    """
    newest = stamps_ns[-1]
    kept: list[int] = []
    last: tuple[int, int] | None = None
    for index, stamp in enumerate(stamps_ns):
        width = max((newest - stamp) >> _SHARE_BITS, 1).bit_length() - 1
        end = ((stamp >> width) + 1) << width
        if width > 0 and newest - end < 1 << (width + _SHARE_BITS):
            width -= 1
        slot = (width, stamp >> width)
        if slot != last:
            last = slot
            kept.append(index)
    return kept[-most:]


_SHARE_BITS = 4
"""A sixteenth of the age."""


def thinned(frame: EdgeFrame, parameters: TraceParameters) -> EdgeFrame:
    """A share of the edges, and one level of the gradients."""
    edges, levels = frame.edges, frame.gradients.levels
    kept = slice(None, None, max(1, -(-len(edges) // parameters.most_edges)))
    level = next((k for k, g in enumerate(levels) if g.nbytes <= parameters.most_bytes), len(levels) - 1)
    return dataclasses.replace(
        frame,
        edges=Edges(
            position=edges.position[kept].copy(),
            direction=edges.direction[kept].copy(),
            kind=edges.kind[kept].copy(),
            weight=edges.weight[kept].copy(),
            cell=edges.cell[kept].copy(),
        ),
        gradients=GradientPyramid((levels[level],), (frame.gradients.scales[level],)),
    )


def fractions(
    frames: Sequence[EdgeFrame], camera: CameraModel, T_expected: Floats, T_estimated: Floats
) -> NDArray[np.float64]:
    """How far each frame by itself lies on the way from one extrinsic (0) to the other (1), (F,).

    The place of its highest score on the straight way between them and a quarter beyond each end: a parabola
    through the highest of the places tried and its neighbours.
    """
    batch = edge_witness.batch_of(frames, camera, sum(len(f.edges) for f in frames))
    way = se3.local(T_expected, T_estimated)
    length = float(np.linalg.norm(way / UNITS))
    steps = int(np.clip(np.ceil(length / _STEP), 2, _MOST_STEPS))
    margin = max(1, round(_BEYOND * steps))
    places = np.arange(-margin, steps + margin + 1) / steps
    sums = np.empty((len(places), len(frames)))
    for row, place in enumerate(places):
        response = edge_witness.score_only(batch, se3.retract(T_expected, place * way), 0)
        sums[row] = np.bincount(batch.slot, response, minlength=len(frames))
    top = np.clip(sums.argmax(axis=0), 1, len(places) - 2)
    frame = np.arange(len(frames))
    left, here, right = sums[top - 1, frame], sums[top, frame], sums[top + 1, frame]
    bend = left - 2.0 * here + right
    shift = np.where(bend < 0.0, 0.5 * (left - right) / np.where(bend < 0.0, bend, 1.0), 0.0)
    return np.asarray(places[top] + np.clip(shift, -1.0, 1.0) / steps, dtype=np.float64)


_STEP = 0.5
"""Alert units between places: about the blur of the gradients, so that no top is stepped over."""

_MOST_STEPS = 32
"""Steps of a large drift, whose ends are far from everything between."""

_BEYOND = 0.25
"""Share of the way that is looked at beyond either end: an end is known to its sigma only."""
