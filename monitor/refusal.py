"""A recording of which nothing could be used: why, and what to do, in one sentence."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from monitor.intake import Intake
from monitor.sources import Losses
from pipeline.errors import InputError
from pipeline.records import CameraModel

_SCENE_REASONS = frozenset({"no_scan_pattern", "no_edges", "empty_cloud"})
"""Drop reasons that speak of scene or sensor, a verdict by themselves; the others speak of a wrong input."""


_APART_NS = 1_000_000_000
"""ns between image and sweep beyond which their clocks are not one: ten frames."""


@dataclass(frozen=True, slots=True, eq=False)
class Account:
    """What became of the frames of one pair.

    Attributes:
        pair: Its name.
        used: Sweeps and images that took part.
        dropped: Of those that were paired, by reason; the intake counts the others.
        camera: Intrinsics that the images should fit.
        wrong_size: Width and height of the last image that did not, px, or None.
    """

    pair: str
    used: int
    dropped: Counter[str]
    camera: CameraModel
    wrong_size: tuple[int, int] | None


def refuse_unusable(accounts: Sequence[Account], intake: Intake, losses: Losses) -> None:
    """Returns if a frame of any pair was used, or if it was the scene that gave nothing.

    Raises:
        InputError: Not one frame could be used, for a reason that lies in the input.
    """
    if any(account.used for account in accounts):
        return
    for account in accounts:
        received, early = intake.account(account.pair)
        dropped = early + account.dropped
        if set(dropped) & _SCENE_REASONS:
            return
        if received == 0:
            detail = "; ".join(losses.notes) or "no sweep and no image came"
            raise InputError(
                f"pair {account.pair}: {detail}", hint="calibwatch inspect lists topics and pairs"
            )
        raise InputError(_why(account, intake, dropped), hint=_hint(dropped))


def _why(account: Account, intake: Intake, dropped: Counter[str]) -> str:
    name, offset = account.pair, intake.offset_ns(account.pair)
    if set(dropped) & {"undecodable", "wrong_type"} and intake.notes:
        return intake.notes[0]
    if account.wrong_size is not None:
        have, want = account.wrong_size, account.camera
        return f"pair {name}: images are {have[0]}x{have[1]} px, the rig says {want.width}x{want.height}"
    if set(dropped) & {"no_partner", "gap_too_large"} and offset is not None:
        return (
            f"pair {name}: no sweep and image belong together; camera stamps are {offset / 1e9:+.3f} s "
            "from LiDAR stamps"
        )
    counts = ", ".join(f"{reason} {number}" for reason, number in sorted(dropped.items()))
    return f"pair {name}: no frame could be used ({counts or 'nothing was paired'})"


def _hint(dropped: Counter[str]) -> str:
    if set(dropped) & {"undecodable", "wrong_type"}:
        return "calibwatch inspect tells what the recording holds"
    if "image_size" in dropped:
        return "give the intrinsics for this size"
    if set(dropped) & {"no_partner", "gap_too_large"}:
        return "synchronise the clocks, or set max_gap_ms in the rig file"
    return "calibwatch inspect tells what the recording holds"


def drop_notes(accounts: Sequence[Account], intake: Intake) -> list[str]:
    """One line for each pair that lost frames, and for stamps that can not be right."""
    notes = []
    for account in accounts:
        offset, jumps = intake.offset_ns(account.pair), intake.clock_jumps(account.pair)
        if account.used and offset is not None and abs(offset) > _APART_NS:
            notes.append(
                f"pair {account.pair}: images are stamped {offset / 1e9:+.3f} s from their sweeps, "
                "and were taken as they are listed"
            )
        if jumps:
            notes.append(f"pair {account.pair}: stamps of its inputs jump {jumps} times")
        received, early = intake.account(account.pair)
        dropped = early + account.dropped
        if dropped:
            counts = ", ".join(f"{number} {reason}" for reason, number in sorted(dropped.items()))
            notes.append(f"pair {account.pair}: {dropped.total()} of {received} frames dropped ({counts})")
    return notes
