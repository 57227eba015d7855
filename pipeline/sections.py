"""A section of road seen by the edge witness, linearised in mount, clock and lens (FORMULAS G; PROBE 4).

The score's slope and curvature by the mount and by a magnification of the image come from the edges; those by
the time offset follow from each frame's own motion (G1).
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import edge_score, se3, trust_region
from pipeline.causes import CLOCK, LENS, UNKNOWNS, Section
from pipeline.edge_score import NEW_SCENE_M, UNITS, EdgeBatch, EdgeFrame
from pipeline.edge_witness import EdgeWitnessParameters
from pipeline.records import CameraModel, Floats

_UNITS = np.array([*UNITS, 0.005, 0.005])
"""Of the eight unknowns, each about as much to the image: 5 ms are 5 cm at 10 m/s, half a percent moves the
border of a wide image by a quarter of a degree."""

_SEEN = [0, 1, 2, 3, 4, 5, LENS]
"""Unknowns whose curvature the score itself tells; that of the delay follows from the motion."""

_OTHER_SPEED_M_S = 2.0
"""m/s; frames driven so differently from the last section tell clock from mount on the same road."""

_MOST_EDGES = 5_000
"""Edges of a section that are looked at: twice as many narrow the delay by a tenth, at twice the cost."""

_NULL = 1e-9
"""Share of the largest variance that keeps a slope without any noise invertible."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where and against what a section is linearised.

    Attributes:
        camera: Intrinsics as stored.
        T_expected: float64 (4,4), the extrinsic that is expected to hold.
        R_vehicle_cam: float64 (3,3), turns camera axes into vehicle axes.
        floor: float64 (6,6), covariance of what differs from street to street without drift, vehicle axes.
        zoom: The same of the focal length, as a share, one sigma.
    """

    camera: CameraModel
    T_expected: Floats
    R_vehicle_cam: Floats
    floor: Floats
    zoom: float


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """How the vehicle moved while a frame was taken.

    Attributes:
        stamp_ns: Of the frame.
        motion: float64 (6,), drift that a second of delay would feign, vehicle axes (FORMULAS G1).
        tracked: Whether the motion was measured; else it is assumed.
        sync_s: How well the time between points and exposure is known, one sigma, s.
    """

    stamp_ns: int
    motion: Floats
    tracked: bool
    sync_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Passage:
    """What the edge witness keeps of a frame, and the vehicle's move."""

    frame: EdgeFrame
    move: Move


def fresh(passages: Sequence[Passage], last: Section | None, few: int, many: int) -> tuple[Passage, ...]:
    """The frames after ``last`` once they make a section of their own.

    Args:
        passages: The window's frames, ascending in time.
        last: The newest section, or None.
        few: Frames that make one on new road.
        many: Frames that make one on the same road, at another speed.

    Returns:
        The frames, or none while they are no section yet.
    """
    new = tuple(p for p in passages if p.move.tracked and (last is None or p.move.stamp_ns > last.to_ns))
    if len(new) < few:
        return ()
    if new[-1].frame.distance_m - new[0].frame.distance_m >= NEW_SCENE_M:
        return new
    other = last is None or abs(_speed(new) - last.speed) > _OTHER_SPEED_M_S
    return new if len(new) >= many and other else ()


def _speed(passages: Sequence[Passage]) -> float:
    """Mean speed, m/s."""
    return float(np.mean([np.linalg.norm(p.move.motion[3:]) for p in passages]))


def linearised(
    passages: Sequence[Passage], xi: Floats, place: Place, parameters: EdgeWitnessParameters
) -> Section:
    """The section that some frames make, at the top of their own score.

    Args:
        passages: At least one, ascending in time.
        xi: float64 (6,), where the top is sought, against ``place.T_expected``, camera axes.
        place: See there.
        parameters: Of the edge witness.
    """
    batch = edge_score.batch_of([p.frame for p in passages], place.camera, _MOST_EDGES)
    B = se3.vehicle_block(place.R_vehicle_cam)
    score = _Score(batch, place.T_expected, np.stack([p.move.motion for p in passages]) @ B)
    x = np.array([*xi, 0.0, 0.0]) / _UNITS
    H = _curvature(score, x, parameters)
    top = _climbed(score, x, H, parameters)
    if float(np.linalg.norm(top - x)) > parameters.difference:
        H = _curvature(score, top, parameters)
    turn = np.eye(UNKNOWNS)
    # drift = B xi with B orthogonal, in units too: it turns angles into angles and shifts into shifts.
    turn[:6, :6] = B
    curvature, slopes = turn @ H @ turn.T, score.shares(top) @ turn.T
    scale = np.outer(_UNITS, _UNITS)
    noise = _noise(batch, slopes, curvature, place, parameters)
    motions = np.stack([p.move.motion for p in passages])
    return Section(
        from_ns=passages[0].move.stamp_ns,
        to_ns=passages[-1].move.stamp_ns,
        curvature=curvature / scale,
        pull=(slopes.sum(axis=0) + curvature @ turn @ top) / _UNITS,
        certainty=np.asarray(np.linalg.inv(noise) * scale, dtype=np.float64),
        motion=np.abs(motions).max(axis=0),
        speed=_speed(passages),
        sync_s=float(np.mean([p.move.sync_s for p in passages])),
        tracked=all(p.move.tracked for p in passages),
    )


class _Score:
    """The score of a batch by (phi, rho, delay, log f), in units, camera axes.

    A longer focal length magnifies what lies about the optical axis; lenses bend little enough there for the
    points of the camera frame to be spread instead.

    Args:
        batch: Edges and gradients.
        T_expected: float64 (4,4), where the unknowns are zero.
        rates: float64 (frames,6), xi that a second of delay feigns in each frame (FORMULAS G1).
    """

    def __init__(self, batch: EdgeBatch, T_expected: Floats, rates: Floats) -> None:
        self._batch = batch
        self._T = T_expected
        points = batch.position @ T_expected[:3, :3].T + T_expected[:3, 3]
        turning, moving = rates[batch.slot, :3], rates[batch.slot, 3:]
        self._flow = (np.cross(turning, points) + moving) @ T_expected[:3, :3]
        weight = np.bincount(batch.slot, batch.weight, minlength=len(rates))
        self.weight = weight / weight.sum()
        self.rates = rates / _UNITS[:6] * _UNITS[CLOCK]

    def loss(self, x: Floats) -> tuple[float, Floats]:
        """Minus the score, and its gradient (8,)."""
        value, shares = self._seen(x)
        return -value, -shares.sum(axis=0)

    def shares(self, x: Floats) -> Floats:
        """Each edge's share (N,8) of the gradient at ``x``."""
        return self._seen(x)[1]

    def _seen(self, x: Floats) -> tuple[float, Floats]:
        theta = x * _UNITS
        T = se3.retract(self._T, theta[:6])
        spread = np.array([np.exp(theta[LENS]), np.exp(theta[LENS]), 1.0])
        position = np.asfortranarray(self._batch.position + theta[CLOCK] * self._flow)
        batch = dataclasses.replace(self._batch, position=position)
        value, _, share = edge_score.score(batch, np.diag([*spread, 1.0]) @ T, 0)
        points = position @ T[:3, :3].T + T[:3, 3]
        by_point = share[:, 3:] * spread
        by_xi = np.hstack([np.cross(points, by_point), by_point]) * _UNITS[:6]
        by_delay = np.einsum("ni,ni->n", by_xi, self.rates[batch.slot])
        by_zoom = (by_point[:, :2] * points[:, :2]).sum(axis=1) * _UNITS[LENS]
        return value, np.column_stack([by_xi, by_delay, by_zoom])


def _curvature(score: _Score, x: Floats, parameters: EdgeWitnessParameters) -> Floats:
    """Minus the second derivative (8,8), made positive as for the estimate (PROBE 4).

    By differences for mount and lens. All frames of a section see the same road: they share this curvature by
    the weight of their edges, so that a delay which their motions do not tell from a mount stays untold.
    """
    H = np.empty((len(_SEEN), len(_SEEN)))
    for row, place in zip(H, _SEEN, strict=True):
        step = parameters.difference * np.eye(UNKNOWNS)[place]
        row[:] = (score.loss(x + step)[1] - score.loss(x - step)[1])[_SEEN] / (2.0 * parameters.difference)
    values, vectors = np.linalg.eigh(0.5 * (H + H.T))
    values = np.maximum(values, parameters.eigenvalue_floor * max(float(values.max()), 1e-9))
    designs = np.zeros((len(score.rates), len(_SEEN), UNKNOWNS))
    designs[:, range(len(_SEEN)), _SEEN] = 1.0
    designs[:, :6, CLOCK] = score.rates
    seen = (vectors * values) @ vectors.T
    return np.asarray(np.einsum("f,fai,ab,fbj->ij", score.weight, designs, seen, designs), dtype=np.float64)


def _climbed(score: _Score, x: Floats, H: Floats, parameters: EdgeWitnessParameters) -> Floats:
    """The top of the score near ``x``."""
    # What nothing tells must not be walked along.
    H = H + parameters.eigenvalue_floor * float(np.trace(H)) / UNKNOWNS * np.eye(UNKNOWNS)
    top, _ = trust_region.descend(
        score.loss, x, score.loss(x), H, parameters.step_limits[0], parameters.search
    )
    return top


def _noise(
    batch: EdgeBatch, slopes: Floats, curvature: Floats, place: Place, parameters: EdgeWitnessParameters
) -> Floats:
    """Covariance (8,8) of the slope: cells are the witnesses (PROBE 4), and streets differ by the floor."""
    cells = np.stack([np.bincount(batch.cell, column) for column in slopes.T])
    common = np.zeros((UNKNOWNS, UNKNOWNS))
    common[:6, :6] = place.floor
    common[LENS, LENS] = place.zoom**2
    common /= np.outer(_UNITS, _UNITS)
    noise = parameters.sigma_factor**2 * cells @ cells.T + curvature @ common @ curvature
    return np.asarray(noise + _NULL * (float(np.trace(noise)) or 1.0) * np.eye(UNKNOWNS), dtype=np.float64)
