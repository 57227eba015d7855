"""Which frames stay in the rolling window: the newest densely, of the older ones those that add most.

Frames are kept for what they add to the information, not for their age alone: one that shows what its
neighbours show adds nothing, however often it is repeated.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from pipeline.records import Floats

_NS = 1_000_000_000

Departure: TypeAlias = Literal["past", "aged", "repeats", "adds_least"]
"""Why a frame left the window, closed list.

past: it is too old, or was taken too far back, to speak of now.
aged: it is old, and the window holds as many old ones as the newer can outvote.
repeats: what it shows, a newer frame shows too (standing, slow traffic).
adds_least: the window is full, and of its older frames this one added least.
"""


@dataclass(frozen=True, slots=True)
class WindowParameters:
    """Length of the window and rhythm of the judgements.

    Attributes:
        most_frames: Frames kept: 20 of 1242x375 px take 100 MB.
        dense_frames: The newest frames, kept whatever their spacing: a change shows in them first.
        brief_ns: Frames so young stay whatever way was driven since: a second of dense ones, and room for as
            many older ones 2.5 m apart at 10 m/s.
        near_m: Older ones stay while they were taken so near: two scenes; what lies further back dilutes what
            is new.
        longest_ns: Time after which a change must show: older frames are outvoted. So long without any frame,
            and the window begins anew.
        oldest_ns: Older than this leaves: a stop at a light lasts so long, and before it was another time.
        aged_frames: Frames older than ``longest_ns`` that may stay: a quarter of the window, which can not
            hide what the other three show.
        overlap_m: Way after which a frame shows other things, e-fold: as in ``edge_score.NEW_SCENE_M``.
        creep_m_s: What time alone is worth, as way: others come and go while the vehicle stands, and the way
            may be unknown.
        repeats: A frame whose share of new things is below this repeats a newer one.
        least_frames: Frames before the first judgement: single frames are off by 0.2 deg (PROBE 2).
        judge_every_ns: Time between judgements while nothing stirs.
        judge_soon_ns: The same while there is suspicion.
        judge_first_ns: The same at the beginning: each frame of a 10 Hz sensor.
        beginning_ns: How long the beginning lasts: recordings of incidents may be as short.
        lines_seldom_ns: Time between frames that get lines while the vehicle stands: traffic uncovers others.
        lines_way_m: Way after which lines show something new: a dash of 3 m.
        lines_barren_ns: Time between frames that get lines while the last of them showed none to match: the
            budget is kept for where paint and poles are; the first that comes up waits no longer than this.
    """

    most_frames: int = 20
    dense_frames: int = 10
    brief_ns: int = 3_500_000_000
    near_m: float = 40.0
    longest_ns: int = 6 * _NS
    oldest_ns: int = 30 * _NS
    aged_frames: int = 5
    overlap_m: float = 20.0
    creep_m_s: float = 0.1
    repeats: float = 0.01
    least_frames: int = 5
    judge_every_ns: int = 1 * _NS
    judge_soon_ns: int = 200_000_000
    judge_first_ns: int = 100_000_000
    beginning_ns: int = 1_200_000_000
    lines_seldom_ns: int = 2 * _NS
    lines_way_m: float = 3.0
    lines_barren_ns: int = 1 * _NS


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """What the choice knows of a frame.

    Attributes:
        stamp_ns: Stamp of its image.
        way_m: Way driven so far, m.
        information: float64 (6,6), what it says by itself, alert units (``edge_witness.information_of``).
    """

    stamp_ns: int
    way_m: float
    information: Floats


def retained(frames: Sequence[Candidate], parameters: WindowParameters) -> tuple[list[int], list[Departure]]:
    """Indices of the frames that stay, ascending, and why each of the others leaves.

    Args:
        frames: At least one, their stamps ascending; the last is the newest.
        parameters: See there.
    """
    newest = frames[-1]
    dense = max(0, len(frames) - parameters.dense_frames)
    kept = [k for k, frame in enumerate(frames) if not past(frame, newest, parameters)]
    left: list[Departure] = ["past"] * (len(frames) - len(kept))
    reason: Departure
    while True:
        aged = [k for k in kept if newest.stamp_ns - frames[k].stamp_ns > parameters.longest_ns]
        crowded = len(kept) > parameters.most_frames
        if len(aged) > parameters.aged_frames:
            choice, reason = aged, "aged"
        elif crowded:
            choice, reason = [k for k in kept[:-1] if k < dense] or kept[:-1], "adds_least"
        else:
            return kept, left
        index, novelty = _least_missed([frames[k] for k in kept], [kept.index(k) for k in choice], parameters)
        left.append("repeats" if novelty < parameters.repeats else reason)
        del kept[index]


def past(frame: Candidate, now: Candidate, parameters: WindowParameters) -> bool:
    """Whether a frame no longer speaks of now."""
    age = now.stamp_ns - frame.stamp_ns
    near = now.way_m - frame.way_m <= parameters.near_m and age <= parameters.oldest_ns
    return age > parameters.brief_ns and not near


def _least_missed(
    kept: Sequence[Candidate], choice: Sequence[int], parameters: WindowParameters
) -> tuple[int, float]:
    """The frame of ``choice`` without which log det of the information shrinks least, and its own novelty.

    A frame adds the share of its information that the next newer one does not show as well. Of equals the
    oldest is taken.
    """
    novelty = np.array([_novelty(a, b, parameters) for a, b in itertools.pairwise(kept)] + [1.0])
    each = np.stack([frame.information for frame in kept])
    # One alert unit known beforehand: what a direction never shows must not decide.
    whole = np.eye(6) + np.tensordot(novelty, each, 1)
    without = []
    for k in choice:
        rest = whole - novelty[k] * each[k]
        if k > 0:
            further = _novelty(kept[k - 1], kept[k + 1], parameters) - novelty[k - 1]
            rest = rest + further * each[k - 1]
        without.append(rest)
    heights = np.linalg.slogdet(np.stack(without))[1]
    # To a millionth, for of frames that add nothing rounding would choose.
    best = choice[int(np.argmax(np.round(heights, 6)))]
    return best, float(novelty[best])


def _novelty(frame: Candidate, newer: Candidate, parameters: WindowParameters) -> float:
    """Share of what a frame shows that the newer one does not."""
    way = abs(newer.way_m - frame.way_m)
    way += parameters.creep_m_s * (newer.stamp_ns - frame.stamp_ns) / _NS
    return 1.0 - math.exp(-way / parameters.overlap_m)


def judgement_due(
    now_ns: int,
    judged_ns: int | None,
    frames: int,
    *,
    soon: bool,
    parameters: WindowParameters,
    beginning: bool = False,
) -> bool:
    """Whether the window should be judged now; depends on stamps alone, so that a replay repeats a drive."""
    if frames < parameters.least_frames:
        return False
    if judged_ns is None:
        return True
    wait = parameters.judge_soon_ns if soon else parameters.judge_every_ns
    wait = parameters.judge_first_ns if beginning else wait
    # A tenth of slack: stamps of a 10 Hz sensor jitter by milliseconds.
    return now_ns - judged_ns >= wait - wait // 10


def lines_due(
    waited_ns: int | None, way_m: float | None, every_ns: int, parameters: WindowParameters, *, barren: bool
) -> bool:
    """Whether a frame should get masks and lines: the budget allows it, and they would show something new.

    Args:
        waited_ns: Time since the last frame that got them, or None.
        way_m: Way driven since, m, or None where the motion is not known.
        every_ns: Time between such frames that the budget allows.
        parameters: See there.
        barren: Whether the last frame that got them had none in its cloud, or none in its image.
    """
    if waited_ns is None:
        return True
    new = way_m is None or way_m >= parameters.lines_way_m
    wait = max(every_ns, parameters.lines_barren_ns) if barren else every_ns
    wait = wait if new else max(wait, parameters.lines_seldom_ns)
    return waited_ns >= wait - wait // 10
