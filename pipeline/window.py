"""Which frames stay in the rolling window: the newest densely, older ones thinned, a bounded number."""

from dataclasses import dataclass

_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class WindowParameters:
    """Length of the window and rhythm of the judgements.

    Attributes:
        most_frames: Frames kept: 20 of 1242x375 px take 100 MB.
        dense_frames: The newest frames, kept whatever their spacing: a change shows in them first.
        spacing_ns: Older frames are kept at this spacing: at 10 m/s two of them share half of what they see.
        longest_ns: Older than this leaves: a verdict speaks of now.
        least_frames: Frames before the first judgement: single frames are off by 0.2 deg (PROBE 2).
        judge_every_ns: Time between judgements while nothing stirs.
        judge_soon_ns: The same while there is suspicion.
        judge_first_ns: The same at the beginning: each frame of a 10 Hz sensor.
        beginning_ns: How long the beginning lasts: recordings of incidents may be as short.
    """

    most_frames: int = 20
    dense_frames: int = 10
    spacing_ns: int = 250_000_000
    longest_ns: int = 6 * _NS
    least_frames: int = 5
    judge_every_ns: int = 1 * _NS
    judge_soon_ns: int = 200_000_000
    judge_first_ns: int = 100_000_000
    beginning_ns: int = 1_200_000_000


def retained(stamps_ns: list[int], parameters: WindowParameters) -> list[int]:
    """Indices of the frames that stay, ascending. ``stamps_ns`` ascend; the last is the newest."""
    count = len(stamps_ns)
    newest = stamps_ns[-1]
    kept: list[int] = []
    taken: set[int] = set()
    for index in range(count - 1, -1, -1):
        if newest - stamps_ns[index] > parameters.longest_ns or len(kept) == parameters.most_frames:
            break
        # Older frames share fixed slots of time, one each, so that the one kept now is kept next time too.
        slot = stamps_ns[index] // parameters.spacing_ns
        if count - 1 - index < parameters.dense_frames or slot not in taken:
            kept.append(index)
        if count - 1 - index >= parameters.dense_frames:
            taken.add(slot)
    return kept[::-1]


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
