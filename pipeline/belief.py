"""What a window of frames says about the mount: both witnesses solved, fused, and tested."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import drift_test, edge_witness, fusion, se3
from pipeline.drift_test import Evidence, Judgement
from pipeline.edge_witness import EdgeFrame, EdgeSolution, Trail
from pipeline.fusion import Testimony
from pipeline.line_hearing import heard, match_lines
from pipeline.line_witness import LineFrame, LineSolution
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import Floats, LineMatch, read_only


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """What is believed after the last judgement.

    Attributes:
        judgement: The test's result.
        evidence: What was tested, against the expected extrinsic.
        T_estimated: float64 (4,4), the estimated extrinsic.
        edges: The edge witness, or None where it said nothing.
        lines: The line witness, or None likewise.
        edges_drift: Its testimony in vehicle axes, against the expected extrinsic, or None.
        lines_drift: Likewise.
        matched: Lines matched in each frame of the window that has lines, heard or not.
    """

    judgement: Judgement
    evidence: Evidence
    T_estimated: Floats
    edges: EdgeSolution | None
    lines: LineSolution | None
    edges_drift: Testimony | None
    lines_drift: Testimony | None
    matched: tuple[tuple[LineMatch, ...], ...]


def believe(
    mount: Mount,
    parameters: Parameters,
    edge_frames: Sequence[EdgeFrame],
    line_frames: Sequence[LineFrame],
    scenes: int = 0,
    trail: Trail | None = None,
) -> Belief | None:
    """Solves the window, fuses the witnesses, tests the extrinsic that is expected to hold.

    Args:
        mount: What is stored of the pair.
        parameters: Settings.
        edge_frames: The window's frames with edges, ascending in time.
        line_frames: The window's frames with lines, likewise.
        scenes: Scenes of the drive that lie behind: the more, the rarer each window may alarm by chance.
        trail: What the edge witness left of the window before, or None.

    Returns:
        What is believed of the mount, or None where neither witness says anything.
    """
    test = mount.thresholds(drift_test.at_chance(parameters.test, parameters.scenes.budget, scenes + 1))
    R_vc = mount.R_vehicle_cam
    B = se3.vehicle_block(R_vc)
    expectation = mount.expectation(test)
    T_expected = se3.retract(mount.T_cam_lidar, B.T @ expectation.mean)
    feigned = np.mean([f.feigned for f in edge_frames] or [np.zeros(6)], axis=0)
    doubt = expectation.floor + np.outer(feigned, feigned) + expectation.covariance
    edges = _solve_edges(mount, parameters, edge_frames, (T_expected, B.T @ doubt @ B), trail)
    matched = match_lines(line_frames, mount.camera, T_expected)
    told = None if edges is None else edges.xi
    lines = heard(matched, line_frames, mount.camera, T_expected, told)
    edges_drift = None if edges is None else _testimony(edges.xi, np.linalg.inv(edges.covariance), B)
    lines_drift = None
    if lines is not None:
        own = _testimony(lines.estimate.xi, lines.estimate.information, B)
        lines_drift = fusion.with_floor(own, test.lines_floor())
    fused = edges_drift or lines_drift
    if fused is None:
        return None
    contradicted = False
    if edges_drift is not None and lines_drift is not None:
        contradicted = fusion.contradiction(fusion.with_floor(edges_drift, expectation.floor), lines_drift)
        fused = edges_drift if contradicted else fusion.intersected(edges_drift, lines_drift)
    T_estimated = se3.retract(T_expected, B.T @ fused.drift)
    evidence = Evidence(
        drift=se3.mount_drift(T_expected, T_estimated, R_vc),
        covariance=mount.noise**2 * fused.covariance(),
        loss=np.inf if edges is None else edges.loss,
        contrast=np.inf if edges is None else edges.contrast,
        peak=np.inf if edges is None else edges.peak,
        preference=np.inf if edges is None else edges.preference,
        persistent=edges is None or min(edges.block_gains, default=0.0) > 0.0,
        frames=len(edge_frames),
        contradicted=contradicted,
        feigned=feigned,
    )
    judgement = drift_test.judge(evidence, expectation, mount.limits, test)
    if edges is not None:
        doubted = judgement.suspicious or judgement.alarming or judgement.blind
        edges = dataclasses.replace(edges, trail=dataclasses.replace(edges.trail, doubted=doubted))
    return Belief(
        judgement=judgement,
        evidence=evidence,
        T_estimated=read_only(T_estimated),
        edges=edges,
        lines=lines,
        edges_drift=edges_drift,
        lines_drift=lines_drift,
        matched=() if matched is None else matched.matches,
    )


def _solve_edges(
    mount: Mount,
    parameters: Parameters,
    frames: Sequence[EdgeFrame],
    expected: tuple[Floats, Floats],
    trail: Trail | None,
) -> EdgeSolution | None:
    if not frames:
        return None
    settings, (T_expected, doubt) = parameters.edge_witness, expected
    batch = edge_witness.batch_of(frames, mount.camera, settings.most_edges)
    rng = np.random.default_rng(parameters.seed)
    return edge_witness.solve(batch, T_expected, doubt, settings, rng, trail)


def _testimony(xi: Floats, information: np.ndarray, B: Floats) -> Testimony:
    """Drift in vehicle axes from xi and its information in camera axes (FORMULAS A4; B is orthogonal)."""
    return Testimony(B @ xi, B @ information @ B.T)
