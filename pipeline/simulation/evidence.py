"""Evidence of scenes without images: weeks of driving in minutes, for rates that no picture reaches.

Each scene's estimate is drawn from the model of ``scene_filter``, with heavier tails than that assumes: a
mount, the systematic part of a street that is another around each corner, an error in time, a random error.
The random error is as in image-level drives (``evidence_fit``); the streets differ by the floor that was
measured between real ones (PROBE 3), which is more than simulated ones do.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from pipeline.records import Floats, read_only
from pipeline.scene_filter import Scene
from pipeline.scene_sum import NEW_SCENE_M


@dataclass(frozen=True, slots=True)
class Road:
    """One kind of road.

    Attributes:
        name: For people.
        speed: Typical, m/s.
        speed_spread: Standard deviation of its logarithm between stretches.
        street_m: Mean way until the systematic part is another: a corner, a bridge, other buildings.
        worth: Sigmas of the random error over those of a street in town.
        unseen: Share of the scenes that give no estimate: nothing in common, contradicted, empty.
        stay_s: Mean time on such a road.
        share: How often a stretch of it comes, against the other kinds.
    """

    name: str
    speed: float
    speed_spread: float
    street_m: float
    worth: float
    unseen: float
    stay_s: float
    share: float


ROADS = (
    Road("town", 8.0, 0.3, 200.0, 1.0, 0.05, 600.0, 0.35),
    Road("suburb", 12.0, 0.2, 400.0, 1.2, 0.05, 400.0, 0.2),
    Road("country", 20.0, 0.2, 1500.0, 1.8, 0.2, 900.0, 0.15),
    Road("motorway", 30.0, 0.15, 3000.0, 1.8, 0.15, 1500.0, 0.15),
    Road("jam", 1.5, 0.5, 400.0, 1.5, 0.3, 400.0, 0.1),
    Road("empty", 18.0, 0.2, 2000.0, 3.0, 0.8, 300.0, 0.05),
)
"""Speeds and lengths are those of common roads; where less stands beside one, sigmas grow
as between good and bad streets (PROBE 3 and 9: two to three times)."""

_SYNC_S = 0.003
"""s; one sigma of stamps that hardware sets (pipeline.ego)."""

_YAW_RATE = 0.05
"""rad/s; standard deviation on a road with bends: an error in time feigns as much yaw."""


def _typical_covariance() -> Floats:
    sigma = np.array([math.radians(0.08), math.radians(0.07), math.radians(0.045), 0.015, 0.014, 0.016])
    correlation = np.eye(6)
    correlation[1, 5] = correlation[5, 1] = 0.78
    correlation[2, 4] = correlation[4, 2] = -0.9
    return np.asarray(correlation * np.outer(sigma, sigma), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class EvidenceModel:
    """How the estimates of scenes scatter; but for ``street``, defaults are those of 16 image-level streets.

    Attributes:
        covariance: float64 (6,6), stated for a scene of middling worth, vehicle axes, rad and m.
        worth_spread: Standard deviation of the logarithm of its sigmas between scenes of one road.
        ratio: Sigmas of the true random error over the stated ones.
        common: Share of the random error's variance that neighbouring scenes have in common: both see what
            stands further ahead.
        common_m: Way over which that keeps 1/e of itself.
        freedom: Degrees of freedom of the random error's Student tails.
        ridden: Share of the streets whose scenes lie in false modes.
        ridden_ratio: Sigmas of the true random error over the stated ones there.
        street: float64 (6,6), covariance of the systematic part.
        correlation_m: Way over which it keeps 1/e of itself while the street goes on.
    """

    covariance: Floats = field(default_factory=_typical_covariance)
    worth_spread: float = 0.5
    ratio: float = 1.1
    common: float = 0.2
    common_m: float = 100.0
    freedom: float = 5.0
    ridden: float = 0.375
    ridden_ratio: float = 3.6
    street: Floats = field(default_factory=lambda: np.zeros((6, 6)))
    correlation_m: float = 150.0

    def __post_init__(self) -> None:
        for name in ("covariance", "street"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def drawn_ratio(self, rng: np.random.Generator) -> float:
        """Sigmas of the true random error over the stated ones in one street."""
        return self.ridden_ratio if rng.random() < self.ridden else self.ratio


def scenes(
    model: EvidenceModel,
    duration_s: float,
    mount: Callable[[float], Floats],
    rng: np.random.Generator,
    roads: tuple[Road, ...] = ROADS,
) -> Iterator[Scene]:
    """Scenes of one drive; stamps count from 0.

    Args:
        model: Of the scatter.
        duration_s: Of the drive, s.
        mount: Gives the mount, float64 (6,), at a time in s: bias and drift.
        rng: Source of the draw.
        roads: To draw from.
    """
    street_root = np.linalg.cholesky(model.street + 1e-18 * np.eye(6))
    noise_root = np.linalg.cholesky(model.covariance)
    shares = np.array([road.share for road in roads])
    tau = float(rng.normal())
    street, ratio = street_root @ rng.normal(size=6), model.drawn_ratio(rng)
    kept = math.exp(-NEW_SCENE_M / model.correlation_m)
    lasting, alike = rng.normal(size=6), math.exp(-NEW_SCENE_M / model.common_m)
    time, way = 0.0, 0.0
    while time < duration_s:
        road = roads[int(rng.choice(len(roads), p=shares / shares.sum()))]
        until = time + float(rng.exponential(road.stay_s))
        speed = road.speed * math.exp(road.speed_spread * float(rng.normal()))
        while time < min(until, duration_s):
            time += NEW_SCENE_M / speed
            way += NEW_SCENE_M
            if rng.random() < NEW_SCENE_M / road.street_m:
                street, ratio = street_root @ rng.normal(size=6), model.drawn_ratio(rng)
            street = kept * street + math.sqrt(1.0 - kept**2) * (street_root @ rng.normal(size=6))
            lasting = alike * lasting + math.sqrt(1.0 - alike**2) * rng.normal(size=6)
            if rng.random() < road.unseen:
                continue
            worth = road.worth * math.exp(model.worth_spread * float(rng.normal()))
            feigned = _SYNC_S * np.array([0.0, 0.0, _YAW_RATE * rng.normal(), speed, 0.0, 0.0])
            # Student: the same heavy factor on all axes, as a false mode has.
            tail = math.sqrt((model.freedom - 2.0) / float(rng.chisquare(model.freedom)))
            whole = math.sqrt(model.common) * lasting + math.sqrt(1.0 - model.common) * rng.normal(size=6)
            error = worth * ratio * tail * (noise_root @ whole)
            drift = mount(time) + street + tau * feigned + error
            yield Scene(drift, worth**2 * model.covariance, feigned, way, round(time * 1e9))
