"""Where the mount is now, fused over scenes: a mount that may wander, followed (FORMULAS F2)."""

import math
from dataclasses import dataclass

import numpy as np

from pipeline import scene_filter
from pipeline.drift_test import Expectation
from pipeline.records import Floats, read_only
from pipeline.scene_filter import Scene


@dataclass(frozen=True, slots=True)
class TrackParameters:
    """How fast a mount is followed.

    Attributes:
        walk_rad: Standard deviation of a healthy mount's turn about an axis in an hour of driving, rad: what
            sun and load do to a bracket. A faster one is followed late and told by the tests, a slower one
            only loses precision.
        walk_m: The same of its shift, m.
        correlation_m: See ``SceneSumParameters``.
        most_square: Likewise.
    """

    walk_rad: float = math.radians(0.1)
    walk_m: float = 0.01
    correlation_m: float = 300.0
    most_square: float = 12.59


@dataclass(frozen=True, slots=True, eq=False)
class SceneTrack:
    """What is known of the mount now; never changes, :func:`followed` gives the next.

    Attributes:
        scenes: Scenes heard.
        way_m: At the last one, or None.
        stamp_ns: Of the last one, or None.
        mean: float64 (13,), of the filter.
        covariance: float64 (13,13), likewise.
    """

    scenes: int
    way_m: float | None
    stamp_ns: int | None
    mean: Floats
    covariance: Floats

    def __post_init__(self) -> None:
        for name in ("mean", "covariance"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def drift(self) -> Floats:
        """The mount, float64 (6,), against the expected mean, rad and m."""
        return np.asarray(self.mean[:6])

    @property
    def drift_covariance(self) -> Floats:
        """Of :attr:`drift`, float64 (6,6), the floor between scenes included."""
        return np.asarray(self.covariance[:6, :6])


def begin(expectation: Expectation) -> SceneTrack:
    """Before the first scene of a drive."""
    covariance = scene_filter.prior(expectation.covariance, expectation.floor)
    return SceneTrack(0, None, None, np.zeros(scene_filter.STATES), covariance)


def followed(
    track: SceneTrack, scene: Scene, expectation: Expectation, parameters: TrackParameters
) -> SceneTrack:
    """The track after one more scene.

    Args:
        track: Before it.
        scene: Not older than the last one.
        expectation: The same as at :func:`begin`.
        parameters: See there.
    """
    way = 0.0 if track.way_m is None else max(scene.way_m - track.way_m, 0.0)
    hours = 0.0 if track.stamp_ns is None else max(scene.stamp_ns - track.stamp_ns, 0) / 3.6e12
    mean, covariance = scene_filter.driven(
        track.mean[None], track.covariance[None], way, expectation.floor, parameters.correlation_m
    )
    walk = np.array([parameters.walk_rad**2] * 3 + [parameters.walk_m**2] * 3)
    covariance[:, range(6), range(6)] += hours * walk
    doubt = covariance[0, :6, :6] + expectation.floor
    noise = scene_filter.heard(scene, mean[0, :6], doubt, parameters.most_square)
    mean, covariance, _ = scene_filter.updated(mean, covariance, scene, noise)
    return SceneTrack(track.scenes + 1, scene.way_m, scene.stamp_ns, mean[0], covariance[0])
