"""What is said of the mount beside the window that is judged: all scenes, the newest frames, other causes."""

from dataclasses import dataclass

from pipeline.onset import Onset
from pipeline.records import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Steady:
    """What is said of a drift beside the window as a whole.

    All scenes of a drive speak of a small steady one (``scene_sum``), the newest frames of a sudden one
    (``shock``).

    Attributes:
        alarming: They say 'moved', at the run length that is wanted.
        suspicious: They want more evidence.
        drift: float64 (6,), rad and m, since then.
        sigma: float64 (6,), of it, the floor between scenes included.
        over: What it was heard over: ``12 scenes``, ``the last 0.6 s``.
        onset: When it began.
        timed: A jump of the time between sweeps and images would look the same.
    """

    alarming: bool
    suspicious: bool
    drift: Floats
    sigma: Floats
    over: str
    onset: Onset
    timed: bool = False


@dataclass(frozen=True, slots=True)
class Doubt:
    """Why evidence is not held against the mount: clock or lens explain it as well, or better (``inquiry``).

    Attributes:
        code: Out of ``CODES``.
        reason: One sentence.
    """

    code: str
    reason: str
