"""What a person reads of a proposed extrinsic, or of why none is proposed."""

from typing import Any

import numpy as np

from monitor.candidate_file import SUFFIX, CandidateDocument
from monitor.events import ProposalEvent
from monitor.status import AXIS_NAMES
from monitor.wording import size_text, stamp_text

_CHANCE_DIGITS = 2
"""Digits of a chance: more would promise what it does not know."""


def proposal_section(event: ProposalEvent) -> dict[str, Any]:
    """``sentence``, ``rows`` of a table, and ``matrix``; the last two are empty where nothing is proposed."""
    document = event.document
    if document is None:
        return {"sentence": f"None is proposed: {event.reason}", "rows": [], "matrix": ""}
    return {
        "sentence": _sentence(document, f"{event.pair}{SUFFIX}"),
        "rows": [*_axes(document), *_check(document)],
        "matrix": np.array2string(
            np.array(document.T_cam_lidar), formatter={"float_kind": lambda number: f"{number:+.6f}"}
        ),
    }


def _sentence(document: CandidateDocument, name: str) -> str:
    count = len(document.windows)
    basis = f"{count} windows of different places that agree"
    if not document.agreed:
        few = "one window" if count == 1 else f"{count} windows"
        basis = f"{few} only; drive on, so that others can confirm it"
    check = document.hold_out
    return (
        f"{name} holds the extrinsic that fits now, made from {basis}. On frames that it was not made "
        f"from it scores {check.score_candidate:.3f}, the stored one {check.score_stored:.3f} "
        f"(p = {check.p_better:.{_CHANCE_DIGITS}g}). Nothing is changed by itself: whoever accepts it puts "
        "it into the rig file."
    )


def _axes(document: CandidateDocument) -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for name in AXIS_NAMES:
        value, sigma = getattr(document.drift, name), getattr(document.sigma, name)
        rows.append((name, f"{size_text(name, value, sign=True)} ± {size_text(name, sigma)}"))
    return rows


def _check(document: CandidateDocument) -> list[tuple[str, str]]:
    check = document.hold_out
    lines = "no line testified"
    if check.p_lines is not None:
        lines = (
            f"misfit {check.lines_candidate:.1f}, under the stored one {check.lines_stored:.1f} "
            f"(p = {check.p_lines:.{_CHANCE_DIGITS}g})"
        )
    return [
        ("made from frames up to", stamp_text(document.windows[-1].to_ns)),
        ("checked on", f"{check.frames} frames, {check.apart_m:.0f} m further on, in {check.cells} places"),
        ("best score of those frames", f"{check.score_own:.3f}"),
        ("agrees with those frames", f"p = {check.p_agreed:.{_CHANCE_DIGITS}g}"),
        ("lines of those frames", lines),
        ("content hash", document.hash[:16]),
    ]
