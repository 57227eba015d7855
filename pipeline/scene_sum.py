"""Small steady drift over many scenes: a likelihood ratio over every stretch of road that ends now.

A window tells a drift that exceeds its floor at once; a smaller one shows only over several streets. For each
beginning of a stretch a filter of its own (``scene_filter``) estimates the mount over the stretch, from
nothing; another one estimates it over all that came before, from what is expected of an unmoved mount. The
statistic is the squared difference of the two in sigmas, for the beginning where it is largest. The
systematic parts before and after count as independent, as around a corner: where they agree, alarms are rarer
still. Where the scenes of a stretch contradict each other, its sigmas grow by what they differ (Birge's
ratio). What a scene does not see carries no information in that direction, which a vector sum of whitened
innovations could not take into account (FORMULAS F3).
"""

import math
from dataclasses import dataclass, field

import numpy as np

from pipeline import scene_filter
from pipeline.drift_test import Expectation
from pipeline.records import Floats, read_only
from pipeline.run_length import AlarmBudget, alarm_level, suspicion_level
from pipeline.scene_filter import Scene

NEW_SCENE_M = 20.0
"""m driven from one scene to the next, at least: what is 20 m ahead, where pitch and up, yaw and left are
told apart, is new. Standing still adds none."""

_FARTHEST = np.array([math.radians(10.0)] * 3 + [3.0] * 3)
"""rad, m; sigma of the mount of a stretch before its scenes are heard: nothing is known of it."""

_DENSE = 16
"""Beginnings kept of each age: the last 16 all, then every second one to 32 scenes, every fourth to 64..."""

_MOST_SURPRISE = 60.0
"""Squared sigmas, ten times what is expected: a single false mode shall not make an hour of scenes unsure."""

_OLDEST = 4096
"""Scenes; older beginnings than 80 km are let go, but for the first."""


@dataclass(frozen=True, slots=True)
class SceneSumParameters:
    """How scenes are summed.

    Attributes:
        correlation_m: Way over which the systematic part keeps 1/e of itself: streets in town are 100 to
            300 m long, and too long a way only makes the sum slower.
        most_square: No scene alone is heard for more than this, squared sigmas: chi-square, 6 degrees of
            freedom, at 0.05. What is further off may be a false mode: five of them must agree before they
            are believed. A drift of that size is repeated by the next scenes, and told by single windows.
        budget: How often a false alarm may come.
    """

    correlation_m: float = 300.0
    most_square: float = 12.59
    budget: AlarmBudget = field(default_factory=AlarmBudget)


@dataclass(frozen=True, slots=True, eq=False)
class SceneSum:
    """What is known after some scenes; never changes, :func:`advance` gives the next.

    The first of the filters is the unmoved mount's; the others are those of the stretches, oldest first.

    Attributes:
        scenes: Scenes heard.
        way_m: Of the last one, or None.
        mean: float64 (n,13), of each filter.
        covariance: float64 (n,13,13), likewise.
        before: float64 (n,6), the mount as known before each stretch began (row 0: zeros).
        before_covariance: float64 (n,6,6), likewise.
        scatter: float64 (n,), sum of the squares, in sigmas, by which scenes surprised each filter, but for
            the first scene of a stretch.
        first: int64 (n,), number of the scene with which each stretch begins.
        first_ns: int64 (n,), its stamp.
        statistics: float64 (n,), squared difference of before and since, in sigmas (row 0: zero).
    """

    scenes: int
    way_m: float | None
    mean: Floats
    covariance: Floats
    before: Floats
    before_covariance: Floats
    scatter: Floats
    first: np.ndarray
    first_ns: np.ndarray
    statistics: Floats

    def __post_init__(self) -> None:
        names = ("mean", "covariance", "before", "before_covariance", "scatter", "first", "first_ns")
        for name in (*names, "statistics"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def statistic(self) -> float:
        """Largest over all stretches that end now; chi-square of six degrees each, without drift."""
        return float(self.statistics.max())

    @property
    def since_ns(self) -> int | None:
        """Stamp of the scene with which the most telling stretch begins, or None before any scene."""
        return int(self.first_ns[self._telling]) if self.scenes else None

    @property
    def moved(self) -> Floats:
        """The mount in the most telling stretch, float64 (6,), against the expected mean."""
        return np.asarray(self.mean[self._telling, :6])

    @property
    def moved_covariance(self) -> Floats:
        """Covariance of :attr:`moved`, float64 (6,6), the floor included."""
        return np.asarray(self.covariance[self._telling, :6, :6])

    @property
    def _telling(self) -> int:
        return int(np.argmax(self.statistics))


def begin(expectation: Expectation) -> SceneSum:
    """Before the first scene of a drive, of what is expected of an unmoved mount."""
    return SceneSum(
        scenes=0,
        way_m=None,
        mean=np.zeros((1, scene_filter.STATES)),
        covariance=scene_filter.prior(expectation.covariance, expectation.floor)[None],
        before=np.zeros((1, 6)),
        before_covariance=np.zeros((1, 6, 6)),
        scatter=np.zeros(1),
        first=np.zeros(1, dtype=np.int64),
        first_ns=np.zeros(1, dtype=np.int64),
        statistics=np.zeros(1),
    )


def is_new(total: SceneSum, oldest_m: float, newest_m: float) -> bool:
    """Whether a window of frames is a scene of its own: none of its frames was in the one before.

    Args:
        total: The sum.
        oldest_m: Way at the window's oldest frame, m.
        newest_m: Way at its newest frame, m: what :attr:`Scene.way_m` is to be.
    """
    return total.way_m is None or (oldest_m >= total.way_m and newest_m - total.way_m >= NEW_SCENE_M)


def advance(
    total: SceneSum, scene: Scene, expectation: Expectation, parameters: SceneSumParameters
) -> SceneSum:
    """The sum after one more scene.

    Args:
        total: Before it.
        scene: With ``way_m`` not below that of the last one.
        expectation: The same as at :func:`begin`: its floor is that of the systematic part.
        parameters: See there.
    """
    way = 0.0 if total.way_m is None else max(scene.way_m - total.way_m, 0.0)
    mean, covariance = scene_filter.driven(
        total.mean, total.covariance, way, expectation.floor, parameters.correlation_m
    )
    before, before_covariance = mean[0, :6], covariance[0, :6, :6]
    noise = scene_filter.heard(scene, before, before_covariance + expectation.floor, parameters.most_square)
    fresh = scene_filter.prior(np.diag(_FARTHEST**2), expectation.floor)
    mean, covariance, squares = scene_filter.updated(
        np.concatenate([mean, np.zeros((1, scene_filter.STATES))]),
        np.concatenate([covariance, fresh[None]]),
        scene,
        noise,
    )
    # The first scene of a stretch surprises nobody: nothing was expected.
    scatter = np.append(total.scatter + np.minimum(squares[:-1], _MOST_SURPRISE), 0.0)
    before = np.concatenate([total.before, before[None]])
    widened = before_covariance * _excess(total.scatter[:1], np.array([total.scenes]))
    before_covariance = np.concatenate([total.before_covariance, widened[None]])
    first = np.append(total.first, total.scenes)
    kept = _kept(first, total.scenes)
    mean, covariance, before, before_covariance, scatter, first = (
        values[kept] for values in (mean, covariance, before, before_covariance, scatter, first)
    )
    difference = mean[:, :6] - before
    since = covariance[:, :6, :6] * _excess(scatter, total.scenes - first)[:, None, None]
    whole = np.linalg.solve(since + before_covariance, difference[..., None])[..., 0]
    statistics = np.einsum("ni,ni->n", difference, whole)
    # The unmoved mount's own filter is no stretch.
    statistics[0] = 0.0
    return SceneSum(
        scenes=total.scenes + 1,
        way_m=scene.way_m,
        mean=mean,
        covariance=covariance,
        before=before,
        before_covariance=before_covariance,
        scatter=scatter,
        first=first,
        first_ns=np.append(total.first_ns, scene.stamp_ns)[kept],
        statistics=statistics,
    )


def alarming(total: SceneSum, parameters: SceneSumParameters) -> bool:
    """Whether the sum says 'moved', at the run length of the budget."""
    return total.scenes > 0 and total.statistic > alarm_level(total.scenes, parameters.budget)


def suspicious(total: SceneSum, parameters: SceneSumParameters) -> bool:
    """Whether the sum wants more evidence."""
    return total.scenes > 0 and total.statistic > suspicion_level(total.scenes, parameters.budget)


def _excess(scatter: Floats, scenes: np.ndarray) -> Floats:
    """By how much scenes scatter more than they state, squared, at least 1 (Birge's ratio), (n,).

    Where false modes abound, sigmas are too small; that scenes contradict each other tells.
    """
    return np.asarray(np.maximum(1.0, scatter / (6.0 * np.maximum(scenes, 1))), dtype=np.float64)


def _kept(first: np.ndarray, newest: int) -> np.ndarray:
    """Indices of the filters that stay: beginnings get sparser with age, the first of all stays."""
    age = newest - first
    spacing = 2 ** np.ceil(np.log2(np.maximum(age + 1, _DENSE) / _DENSE)).astype(np.int64)
    stays = (first % spacing == 0) & (age <= _OLDEST)
    stays |= first == 0
    return np.flatnonzero(stays)
