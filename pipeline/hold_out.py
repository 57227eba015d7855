"""Is a proposed extrinsic better than the stored one on frames from which it was not made?

Everything of one image cell on one stretch of road is one observation (PROBE 4): the two extrinsics are
compared cell by cell, so that a street's own difficulty cancels.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, stdtr

from pipeline import edge_witness, se3
from pipeline.belief import believe
from pipeline.edge_witness import EdgeFrame
from pipeline.fusion import Testimony, with_floor
from pipeline.line_witness import LineFrame
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import Floats


@dataclass(frozen=True, slots=True)
class HoldOutParameters:
    """What a hold-out check asks for.

    Attributes:
        better: Chance, at most, of scoring so much better than the stored extrinsic where neither is better:
            that the mount has moved was decided before, at a far smaller risk.
        agreed: Chance, at least, of differing so much from what the frames themselves say (edges, lines),
            where both mean the same mount.
        least_cells: Cells in which the two extrinsics are compared, at least: Student's t wants some.
    """

    better: float = 0.01
    agreed: float = 1e-3
    least_cells: int = 10


@dataclass(frozen=True, slots=True)
class HoldOut:
    """What the check found.

    Attributes:
        from_ns: Stamp of the oldest frame that was held out, ns.
        to_ns: Of the newest.
        frames: How many.
        apart_m: Way driven between the last frame that the candidate was made from and the first one held
            out, m: below some 20 m they show the same things.
        cells: Parts of the image on stretches of road in which the scores were compared.
        score_stored: Score of the edges under the stored extrinsic.
        score_candidate: Under the candidate.
        score_own: Under the best extrinsic for these very frames.
        p_better: Chance of scoring so much better than the stored one where neither is better.
        p_agreed: Chance of differing so much from what these frames say, where both mean the same mount.
        p_lines: The same against lines alone; None where no line testified.
        lines_stored: Misfit of the lines under the stored extrinsic, chi-square of six directions, or None.
        lines_candidate: Under the candidate.
        reason: Why the candidate fails, one sentence; None: it passes.
    """

    from_ns: int
    to_ns: int
    frames: int
    apart_m: float
    cells: int
    score_stored: float
    score_candidate: float
    score_own: float
    p_better: float
    p_agreed: float
    p_lines: float | None
    lines_stored: float | None
    lines_candidate: float | None
    reason: str | None


def held_out(
    mount: Mount,
    parameters: Parameters,
    criteria: HoldOutParameters,
    candidate: tuple[Floats, Floats],
    frames: Sequence[EdgeFrame],
    lines: Sequence[LineFrame],
    way_m: float,
) -> HoldOut | str:
    """Holds a candidate against frames that it was not made from.

    Args:
        mount: What is stored of the pair.
        parameters: Settings.
        criteria: What is asked for.
        candidate: float64 (4,4) and (6,6): ``T_cam_lidar``, and its covariance (camera axes, floor included).
        frames: The frames held out, at least one, ascending in time.
        lines: Those with lines, likewise.
        way_m: Way driven at the last frame that the candidate was made from, m.

    Returns:
        The result; a sentence where the frames do not allow a comparison.
    """
    T_candidate, covariance = candidate
    asked = dataclasses.replace(mount, T_cam_lidar=T_candidate, baseline=None)
    own = believe(asked, parameters, frames, lines)
    if own is None or own.edges is None or own.judgement.blind:
        return "The frames held out for the check show nothing that image and cloud have in common."
    settings = parameters.edge_witness
    batch = edge_witness.batch_of(frames, mount.camera, settings.most_edges)
    at_stored = edge_witness.score_only(batch, mount.T_cam_lidar, 0)
    at_candidate = edge_witness.score_only(batch, T_candidate, 0)
    gains = np.bincount(batch.cell, at_candidate - at_stored).astype(np.float64)
    weights = np.bincount(batch.cell, batch.weight).astype(np.float64)
    seen = weights > 0.0
    B = se3.vehicle_block(asked.R_vehicle_cam)
    doubt = B @ covariance @ B.T
    # The candidate's covariance holds the floor once; these frames may show another scene.
    spread = own.evidence.covariance + mount.expectation(parameters.test).floor + doubt
    x_stored = se3.mount_drift(T_candidate, mount.T_cam_lidar, asked.R_vehicle_cam)
    p_lines, lines_stored, lines_candidate = _of_lines(own.lines_drift, x_stored, doubt)
    total = float(batch.weight.sum())
    found = HoldOut(
        from_ns=frames[0].stamp_ns,
        to_ns=frames[-1].stamp_ns,
        frames=len(frames),
        apart_m=frames[0].distance_m - way_m,
        cells=int(seen.sum()),
        score_stored=float(at_stored.sum()) / total,
        score_candidate=float(at_candidate.sum()) / total,
        score_own=own.edges.score,
        p_better=chance_of_gain(gains[seen], weights[seen], settings.sigma_factor),
        p_agreed=_chance_of(own.evidence.drift, np.asarray(np.linalg.inv(spread), dtype=np.float64)),
        p_lines=p_lines,
        lines_stored=lines_stored,
        lines_candidate=lines_candidate,
        reason=None,
    )
    return dataclasses.replace(found, reason=_why_not(found, criteria))


def chance_of_gain(gains: Floats, weights: Floats, factor: float) -> float:
    """Chance of a mean gain as large as this where the true one is nothing, one-sided, Student's t.

    Args:
        gains: float64 (n,), summed weighted gain of each cell.
        weights: float64 (n,), summed weight of each cell, positive.
        factor: By which scores of windows scatter more than their cells say (``sigma_factor``).
    """
    mean = float(gains.sum() / weights.sum())
    squares = (gains - mean * weights) ** 2
    total = float(squares.sum())
    if len(gains) < 2 or total == 0.0:
        return 0.5
    # Few cells carry most of the weight: they are worth fewer equal ones.
    worth = total**2 / float((squares**2).sum())
    sigma = factor * np.sqrt(total * len(gains) / (len(gains) - 1.0))
    return float(stdtr(max(1.0, worth - 1.0), -float(gains.sum()) / sigma))


def _chance_of(difference: Floats, information: Floats) -> float:
    """Chance of a difference as large as this, chi-square of the rank of the information."""
    return float(chdtrc(_rank(information), difference @ information @ difference))


_ROUNDING = 1e-9
"""Share of the largest information below which a direction is null (FORMULAS D3)."""


def _rank(information: Floats) -> int:
    values = np.linalg.eigvalsh(information * np.outer(edge_witness.UNITS, edge_witness.UNITS))
    return int((values > _ROUNDING * max(1.0, float(values[-1]))).sum())


def _of_lines(
    lines: Testimony | None, x_stored: Floats, doubt: Floats
) -> tuple[float | None, float | None, float | None]:
    """Chance that lines and candidate mean the same; misfit of the lines under the stored one, and under it.

    Args:
        lines: What lines say against the candidate, their floor included; None where none testified.
        x_stored: float64 (6,), the stored extrinsic as a drift from the candidate.
        doubt: float64 (6,6), covariance of the candidate.
    """
    if lines is None:
        return None, None, None
    apart = lines.drift - x_stored
    candidate = float(lines.drift @ lines.information @ lines.drift)
    chance = _chance_of(lines.drift, with_floor(lines, doubt).information)
    return chance, float(apart @ lines.information @ apart), candidate


def _why_not(found: HoldOut, criteria: HoldOutParameters) -> str | None:
    """The first thing that speaks against the candidate."""
    if found.cells < criteria.least_cells:
        return f"The frames held out show edges in {found.cells} parts of the image only."
    if found.p_better > criteria.better:
        return (
            "On frames that it was not made from it does not score significantly better than the stored one "
            f"(p = {found.p_better:.2g})."
        )
    if found.p_agreed < criteria.agreed:
        return f"Frames that it was not made from show another extrinsic (p = {found.p_agreed:.2g})."
    if found.p_lines is not None and found.p_lines < criteria.agreed:
        return f"Lines of frames that it was not made from contradict it (p = {found.p_lines:.2g})."
    return None
