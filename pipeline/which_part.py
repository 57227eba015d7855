"""Which part of a rig has moved: the LiDAR that several cameras share, one camera, or more than one part.

Each pair's drift is expressed as the motion of the LiDAR that would explain it, in the LiDAR's own frame
(FORMULAS A3). If the LiDAR has moved, one motion explains all of them; if one camera has, the others show
none. Every hypothesis gets its marginal likelihood: the drifts are Gaussian around the motions of the parts
it says have moved, and those are Gaussian in turn, at several widths.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from scipy.special import logsumexp

from pipeline import se3
from pipeline.errors import InputError
from pipeline.records import Floats, read_only

Kind: TypeAlias = Literal["nothing", "lidar", "camera", "several"]

MOVED_RATE = 0.05
"""Prior odds that any one part has moved against that it has not: two at once are a coincidence, so that a
rig on which all drifts agree is not said to have had them all bent alike. A factor of four either way changes
odds by a factor of four."""

MOVED_SIGMA = np.array([np.radians(0.5)] * 3 + [0.05] * 3)
"""rad and m per axis; how far a part that has moved has moved, at its narrowest: an alert limit."""

MOVED_SCALES = (1.0, 3.0, 10.0)
"""Multiples of ``MOVED_SIGMA``, taken as equally likely: a loose bolt, a bent bracket, a kerb."""


@dataclass(frozen=True, slots=True, eq=False)
class PairDrift:
    """What is known of one pair.

    Attributes:
        pair: Its name.
        T_expected: float64 (4,4), ``T_cam_lidar`` of an unmoved mount.
        T_estimated: float64 (4,4), the estimated one.
        covariance: float64 (6,6), camera axes: of the estimate against the expected extrinsic where nothing
            has moved (random error, floor between scenes, uncertainty of the stored one together).
        feigned: float64 (6,), camera axes: what one sigma of error in the LiDAR's time would feign. It is
            common to all pairs.
    """

    pair: str
    T_expected: Floats
    T_estimated: Floats
    covariance: Floats
    feigned: Floats

    def __post_init__(self) -> None:
        for name in ("T_expected", "T_estimated", "covariance", "feigned"):
            object.__setattr__(self, name, read_only(getattr(self, name)))


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """One account of the drifts.

    Attributes:
        kind: "nothing" has moved, the "lidar", one "camera", or "several" parts.
        pair: The pair whose camera it is, or None.
        probability: After the evidence, 0..1; all hypotheses together make 1.
    """

    kind: Kind
    pair: str | None
    probability: float


@dataclass(frozen=True, slots=True)
class WhichPart:
    """What the drifts of several pairs say of the parts.

    Attributes:
        hypotheses: The most probable first.
        odds: Of the first against the second.
    """

    hypotheses: tuple[Hypothesis, ...]
    odds: float


def which_part(pairs: Sequence[PairDrift]) -> WhichPart | None:
    """Weighs which part has moved.

    Args:
        pairs: At least two pairs that share a LiDAR, in any order, names unlike.

    Returns:
        The hypotheses and their odds; None for fewer than two pairs, where a moved LiDAR and a moved camera
        are one and the same.
    """
    if len({pair.pair for pair in pairs}) != len(pairs):
        raise InputError("two pairs bear one name")
    if len(pairs) < 2:
        return None
    drifts, noise = _as_lidar_motion(pairs)
    parts = _parts(pairs)
    weight: dict[tuple[Kind, str | None], list[float]] = {}
    for moved in _movers(len(parts)):
        kind, name = _named(moved, pairs)
        prior = len(moved) * np.log(MOVED_RATE)
        likelihood = _log_likelihood(drifts, noise, [parts[part] for part in moved])
        weight.setdefault((kind, name), []).append(prior + likelihood)
    logs = {key: float(logsumexp(values)) for key, values in weight.items()}
    total = float(logsumexp(list(logs.values())))
    ranked = sorted(logs.items(), key=lambda item: item[1], reverse=True)
    return WhichPart(
        tuple(Hypothesis(kind, name, float(np.exp(value - total))) for (kind, name), value in ranked),
        # Beyond e^40 the number says nothing more than sure.
        float(np.exp(min(40.0, ranked[0][1] - ranked[1][1]))),
    )


def _as_lidar_motion(pairs: Sequence[PairDrift]) -> tuple[Floats, Floats]:
    """Drifts as motions of the LiDAR (6N,), and their covariance (6N,6N) where nothing has moved."""
    size = 6 * len(pairs)
    drifts, noise, feigned = np.zeros(size), np.zeros((size, size)), np.zeros(size)
    for index, pair in enumerate(pairs):
        block = slice(6 * index, 6 * index + 6)
        to_camera = se3.inverse(pair.T_expected)
        Ad = _adjoint(to_camera)
        drifts[block] = se3.local(np.eye(4), to_camera @ pair.T_estimated)
        noise[block, block] = Ad @ pair.covariance @ Ad.T + np.diag((_EXACT * MOVED_SIGMA) ** 2)
        feigned[block] = Ad @ pair.feigned
    return drifts, noise + np.outer(feigned, feigned)


def _adjoint(T: Floats) -> Floats:
    """``Ad(T)`` for (phi, rho) (FORMULAS A3)."""
    R = T[:3, :3]
    Ad = np.zeros((6, 6))
    Ad[:3, :3] = Ad[3:, 3:] = R
    Ad[3:, :3] = se3.skew(T[:3, 3]) @ R
    return Ad


def _parts(pairs: Sequence[PairDrift]) -> list[Floats]:
    """For each part, first the LiDAR, what a unit of its motion does to the drifts: (6N,6).

    A motion is measured about the part itself, in its axes, in ``MOVED_SIGMA``.
    """
    lidar = np.tile(np.eye(6), (len(pairs), 1)) * MOVED_SIGMA
    cameras = []
    for index, pair in enumerate(pairs):
        camera = np.zeros_like(lidar)
        camera[6 * index : 6 * index + 6] = _adjoint(se3.inverse(pair.T_expected)) * MOVED_SIGMA
        cameras.append(camera)
    return [lidar, *cameras]


def _movers(parts: int) -> list[tuple[int, ...]]:
    """Sets of parts that may have moved: none, one, two, or every camera by itself."""
    sets = [moved for size in range(3) for moved in itertools.combinations(range(parts), size)]
    cameras = tuple(range(1, parts))
    return sets if cameras in sets else [*sets, cameras]


def _named(moved: tuple[int, ...], pairs: Sequence[PairDrift]) -> tuple[Kind, str | None]:
    if not moved:
        return "nothing", None
    if len(moved) > 1:
        return "several", None
    return ("lidar", None) if moved[0] == 0 else ("camera", pairs[moved[0] - 1].pair)


def _log_likelihood(drifts: Floats, noise: Floats, moved: list[Floats]) -> float:
    """Log density of the drifts, the parts' motions integrated out, up to what all hypotheses share."""
    logs = []
    for scale in MOVED_SCALES if moved else (0.0,):
        C = noise + scale**2 * sum((part @ part.T for part in moved), np.zeros_like(noise))
        # Scaled to its own diagonal: held directions are metres wide, others known to a millimetre.
        sigma = np.sqrt(np.diag(C))
        values, vectors = np.linalg.eigh(C / np.outer(sigma, sigma))
        values = np.maximum(values, _ROUNDING)
        z = vectors.T @ (drifts / sigma)
        logs.append(-0.5 * float(z**2 @ (1.0 / values)) - 0.5 * float(np.log(values).sum()))
        logs[-1] -= float(np.log(sigma).sum())
    return float(logsumexp(logs) - np.log(len(logs)))


_EXACT = 1e-5
"""``MOVED_SIGMA``; nothing is known better, whatever a covariance says: it may be singular."""

_ROUNDING = 1e-12
"""Share of a variance below which an eigenvalue is rounding."""
