"""Which part of a rig has moved, said for people and programs: several cameras that share one LiDAR."""

from collections.abc import Mapping
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from monitor.status import Name
from pipeline import se3
from pipeline.belief import Belief
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.which_part import PairDrift, WhichPart, which_part

_TOLD_ODDS = 3.0
"""Odds below which the first two hypotheses are not told apart: 'positive evidence' begins there."""

_MOST_ODDS = 1000.0
"""Odds beyond which a figure says no more: the model itself is not that sure."""


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class PartShare(_Part):
    """One account of the drifts, and how probable it is after the evidence."""

    kind: Literal["nothing", "lidar", "camera", "several"] = Field(description="what has moved")
    pair: Name | None = Field(description="the pair whose camera it is")
    probability: FiniteFloat = Field(ge=0, le=1)


class Parts(_Part):
    """What the pairs that share a LiDAR say together."""

    lidar: str = Field(description="topic of the LiDAR")
    pairs: tuple[Name, ...] = Field(description="those that had something to say")
    hypotheses: tuple[PartShare, ...] = Field(description="the most probable first; together they make 1")
    odds: FiniteFloat = Field(ge=1, description="of the first against the second, 1000 at most")
    sentence: str


def parts_of(
    watched: Mapping[str, tuple[Mount, Belief | None]], lidars: Mapping[str, str], parameters: Parameters
) -> tuple[Parts, ...]:
    """What moved, for each LiDAR that several pairs with something to say share; by the LiDAR's topic.

    Args:
        watched: Pair -> what is stored of it and what is believed of it.
        lidars: Pair -> topic of its LiDAR.
        parameters: Settings of the pairs.
    """
    together: dict[str, list[PairDrift]] = {}
    for name, (mount, belief) in sorted(watched.items()):
        if belief is not None and not belief.judgement.blind and not belief.judgement.contradicted:
            together.setdefault(lidars[name], []).append(pair_drift(name, mount, belief, parameters))
    told = [(lidar, drifts, which_part(drifts)) for lidar, drifts in sorted(together.items())]
    return tuple(_said(lidar, drifts, found) for lidar, drifts, found in told if found is not None)


def pair_drift(name: str, mount: Mount, belief: Belief, parameters: Parameters) -> PairDrift:
    """What is known of one pair, in camera axes."""
    B = se3.vehicle_block(mount.R_vehicle_cam)
    expectation, evidence = mount.expectation(parameters.test), belief.evidence
    noise = evidence.covariance + expectation.floor + expectation.covariance
    return PairDrift(
        pair=name,
        T_expected=se3.retract(mount.T_cam_lidar, B.T @ expectation.mean),
        T_estimated=belief.T_estimated,
        covariance=B.T @ noise @ B,
        feigned=np.asarray(B.T @ evidence.feigned, dtype=np.float64),
    )


def _said(lidar: str, drifts: list[PairDrift], found: WhichPart) -> Parts:
    shares = tuple(
        PartShare(kind=h.kind, pair=h.pair, probability=min(1.0, h.probability)) for h in found.hypotheses
    )
    odds = min(_MOST_ODDS, found.odds)
    return Parts(
        lidar=lidar,
        pairs=tuple(drift.pair for drift in drifts),
        hypotheses=shares,
        odds=odds,
        sentence=_sentence(shares, odds),
    )


def _sentence(shares: tuple[PartShare, ...], odds: float) -> str:
    """What has moved, with odds, or that it can not be told."""
    first, second = shares[0], shares[1]
    if odds < _TOLD_ODDS:
        return f"Which part has moved can not be told: {_name(first)} or {_name(second)} ({odds:.1f}:1)."
    at_least = "more than " if odds >= _MOST_ODDS else ""
    against = f"({at_least}{odds:.0f}:1 against {_name(second)})"
    verb = "have" if first.kind == "several" else "has"
    name = _name(first)
    return f"{name[0].upper()}{name[1:]} {verb} moved {against}."


def _name(share: PartShare) -> str:
    names = {"nothing": "nothing", "lidar": "the LiDAR", "several": "several parts"}
    return f"the camera of pair {share.pair}" if share.kind == "camera" else names[share.kind]
