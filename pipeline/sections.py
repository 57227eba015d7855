"""A section of road seen by the edge witness, linearised in mount, clock and lens (FORMULAS G; PROBE 4).

The score's slope and curvature by the mount and by a magnification of the image come from the edges; those by
the time offset follow from each frame's own motion (G1).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pipeline import edge_score, se3, trust_region
from pipeline.causes import CLOCK, LENS, UNKNOWNS, Section
from pipeline.edge_score import NEW_SCENE_M, UNITS, EdgeBatch, EdgeFrame
from pipeline.edge_witness import EdgeWitnessParameters
from pipeline.records import CameraModel, Floats

_ZOOM_UNIT = 0.005
"""Half a percent moves the border of a wide image by as much as a quarter of a degree."""

_CLIMB_UNITS = np.array([*UNITS, _ZOOM_UNIT])

_ALL_UNITS = np.array([*UNITS, 0.005, _ZOOM_UNIT])
"""The units of all unknowns; 5 ms are 5 cm at 10 m/s."""

_OTHER_SPEED_M_S = 2.0
"""m/s; frames driven so differently from the last section tell clock from mount on the same road."""

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
    batch = edge_score.batch_of([p.frame for p in passages], place.camera, parameters.most_edges)
    zoomed = _Zoomed(batch, place.T_expected)
    x = np.array([*xi, 0.0]) / _CLIMB_UNITS
    H = _curvature(zoomed, x, parameters)
    top = _climbed(zoomed, x, H, parameters)
    if float(np.linalg.norm(top - x)) > parameters.difference:
        H = _curvature(zoomed, top, parameters)
    return _joined(passages, batch, (top, H, zoomed.shares(top)), place, parameters)


class _Zoomed:
    """The score of a batch by (phi, rho, log f), in units.

    A longer focal length magnifies what lies about the optical axis; lenses bend little enough there for the
    points of the camera frame to be spread instead.
    """

    def __init__(self, batch: EdgeBatch, T_expected: Floats) -> None:
        self._batch = batch
        self._T = T_expected

    def shares(self, x: Floats) -> Floats:
        """Each edge's share (N,7) of the gradient at ``x``."""
        return self._shares(x)[1]

    def loss(self, x: Floats) -> tuple[float, Floats]:
        """Minus the score, and its gradient."""
        value, shares = self._shares(x)
        return -value, -shares.sum(axis=0)

    def _shares(self, x: Floats) -> tuple[float, Floats]:
        theta = x * _CLIMB_UNITS
        T = se3.retract(self._T, theta[:6])
        spread = np.array([np.exp(theta[6]), np.exp(theta[6]), 1.0])
        value, _, share = edge_score.score(self._batch, np.diag([*spread, 1.0]) @ T, 0)
        points = self._batch.position @ T[:3, :3].T + T[:3, 3]
        by_point = share[:, 3:] * spread
        by_zoom = (by_point[:, :2] * points[:, :2]).sum(axis=1)
        shares = np.column_stack([np.cross(points, by_point), by_point, by_zoom])
        return value, shares * _CLIMB_UNITS


def _curvature(zoomed: _Zoomed, x: Floats, parameters: EdgeWitnessParameters) -> Floats:
    """Minus the second derivative (7,7) by differences, made positive as for the estimate (PROBE 4)."""
    H = np.empty((len(x), len(x)))
    for row, step in zip(H, parameters.difference * np.eye(len(x)), strict=True):
        row[:] = (zoomed.loss(x + step)[1] - zoomed.loss(x - step)[1]) / (2.0 * parameters.difference)
    values, vectors = np.linalg.eigh(0.5 * (H + H.T))
    values = np.maximum(values, parameters.eigenvalue_floor * max(float(values.max()), 1e-9))
    return np.asarray((vectors * values) @ vectors.T, dtype=np.float64)


def _climbed(zoomed: _Zoomed, x: Floats, H: Floats, parameters: EdgeWitnessParameters) -> Floats:
    """The top of the score near ``x``."""
    start = zoomed.loss(x)
    top, _ = trust_region.descend(zoomed.loss, x, start, H, parameters.step_limits[0], parameters.search)
    return top


def _joined(
    passages: Sequence[Passage],
    batch: EdgeBatch,
    solved: tuple[Floats, Floats, Floats],
    place: Place,
    parameters: EdgeWitnessParameters,
) -> Section:
    """Every frame's slope by the eight unknowns, from (top, curvature, shares) by the seven, in units.

    All frames of a section see the same road: they share its curvature by the weight of their edges, so that
    what their motions do not tell apart stays exactly so.
    """
    top, H, shares = solved
    motions = np.stack([p.move.motion for p in passages])
    # drift = B xi with B orthogonal, in units too: it turns angles into angles and shifts into shifts.
    turn = np.eye(7)
    turn[:6, :6] = se3.vehicle_block(place.R_vehicle_cam)
    H, shares = turn @ H @ turn.T, shares @ turn.T
    designs = np.zeros((len(passages), 7, UNKNOWNS))
    designs[:, :6, :6] = np.eye(6)
    designs[:, :6, CLOCK] = motions / UNITS * _ALL_UNITS[CLOCK]
    designs[:, 6, LENS] = 1.0
    weight = np.bincount(batch.slot, batch.weight, minlength=len(passages))
    curvature = np.einsum("f,fai,ab,fbj->ij", weight / weight.sum(), designs, H, designs)
    slopes = np.empty((len(batch), UNKNOWNS))
    for slot, design in enumerate(designs):
        mine = batch.slot == slot
        slopes[mine] = shares[mine] @ design
    cells = np.stack([np.bincount(batch.cell, column) for column in slopes.T])
    common = np.zeros((UNKNOWNS, UNKNOWNS))
    common[:6, :6] = place.floor
    common[LENS, LENS] = place.zoom**2
    common /= np.outer(_ALL_UNITS, _ALL_UNITS)
    noise = parameters.sigma_factor**2 * cells @ cells.T + curvature @ common @ curvature
    noise += _NULL * float(np.trace(noise)) * np.eye(UNKNOWNS)
    theta = np.zeros(UNKNOWNS)
    theta[:6], theta[LENS] = (turn @ top)[:6], top[6]
    pull = slopes.sum(axis=0) + curvature @ theta
    return Section(
        from_ns=passages[0].move.stamp_ns,
        to_ns=passages[-1].move.stamp_ns,
        curvature=curvature / np.outer(_ALL_UNITS, _ALL_UNITS),
        pull=pull / _ALL_UNITS,
        certainty=np.linalg.inv(noise) * np.outer(_ALL_UNITS, _ALL_UNITS),
        motion=np.abs(motions).max(axis=0),
        speed=_speed(passages),
        sync_s=float(np.mean([p.move.sync_s for p in passages])),
        tracked=all(p.move.tracked for p in passages),
    )
