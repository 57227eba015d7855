"""How high a statistic must stand to alarm so rarely: the level for a wanted run length (FORMULAS F3, F4).

The sum over scenes asks of every stretch that ends now whether its mean lies where it should. Its run length
follows in closed form from how often a field of Gaussian sums exceeds a level (Siegmund and Venkatraman 1995,
here for several dimensions): no table, no simulation, valid at the far tail where none reaches.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtrc, gammaln, ndtr

_POINTS = 400
"""Parts of the integral over lengths; twice as many change the chance by less than 1e-4 of itself."""

_LONGEST = 4096
"""Scenes in the longest stretch that is asked once a drive is long: 80 km."""

_HIGHEST = 500.0
"""Squared sigmas; chances of 1e-90 and less are nobody's wish."""


@dataclass(frozen=True, slots=True)
class AlarmBudget:
    """How often a false alarm may come, and how that is spent over a drive.

    A drive is short of evidence where it begins and there are few beginnings, so a level that would never do
    for every scene does for the first; from scene to scene the chance falls with the square of their number
    down to what a year of driving allows.

    Attributes:
        first_chance: Of a false alarm in the first scene of a drive: a thousand starts in a vehicle-year make
            a tenth of an alarm, all scenes near the start together less than 0.17.
        yearly_alarms: Of one test, in the scenes of a vehicle-year: two tests (the window, the sum over
            scenes) and the starts together make one alarm (DESIGN 4).
        yearly_scenes: 2920 h (a year of 8 h days) at 20 m/s, a new scene each 20 m.
        suspicion_factor: Suspicion may come so many times as often as an alarm.
    """

    first_chance: float = 1e-4
    yearly_alarms: float = 0.4
    yearly_scenes: float = 1e7
    suspicion_factor: float = 10.0

    def chance(self, scenes: int) -> float:
        """Allowed chance of a false alarm in scene number ``scenes`` of a drive (1 is the first)."""
        return max(self.first_chance / max(scenes, 1) ** 2, self.yearly_alarms / self.yearly_scenes)

    @property
    def settled(self) -> int:
        """Number of the scene from which on the chance falls no further."""
        return math.ceil(math.sqrt(self.first_chance * self.yearly_scenes / self.yearly_alarms))


def chance_per_scene(level: float, dimensions: int, longest: int) -> float:
    """Chance of one more scene to lift the highest statistic of all stretches that end with it over a level.

    ``P(chi2 > h) + a f(a) / 2 int x nu(x)^2 dx`` over x from ``a / sqrt(longest)`` to a, with a = sqrt(h), f
    the density of chi, and nu the overshoot of a random walk. The first term is the chance of the newest
    scene alone, which the integral leaves out.

    Args:
        level: Squared sigmas, positive.
        dimensions: Of the independent innovations.
        longest: Scenes in the longest stretch that is asked.
    """
    a = math.sqrt(level)
    x = np.linspace(a / math.sqrt(max(longest, 1)), a, _POINTS)
    integral = float(np.trapezoid(x * _overshoot(x) ** 2, x))
    half = 0.5 * dimensions
    density = math.exp(
        (dimensions - 1) * math.log(a) - 0.5 * level - (half - 1.0) * math.log(2.0) - gammaln(half)
    )
    return float(chdtrc(dimensions, level) + 0.5 * a * density * integral)


def _overshoot(x: np.ndarray) -> np.ndarray:
    """Siegmund's nu(x): by how much steps of size x that jump over a level make an alarm rarer."""
    half = 0.5 * x
    density = np.exp(-0.5 * half**2) / math.sqrt(2.0 * math.pi)
    return np.asarray((ndtr(half) - 0.5) / half / (half * ndtr(half) + density))


def level_for(chance: float, dimensions: int, longest: int) -> float:
    """The level, squared sigmas, that one more scene exceeds with a chance (below a half)."""

    def excess(level: float) -> float:
        return math.log(chance_per_scene(level, dimensions, longest) / chance)

    return float(brentq(excess, 1e-3, _HIGHEST, xtol=1e-6))


def alarm_level(scenes: int, budget: AlarmBudget, dimensions: int = 6) -> float:
    """The statistic, squared sigmas, above which a test alarms in scene number ``scenes`` of a drive.

    27.86 in the first scene, where it is chi-square at 1e-4. It holds for one window as for the sum over
    scenes, which is what makes it as high as 52 in the long run.
    """
    return _spent(min(scenes, budget.settled), budget, 1.0, dimensions)


def suspicion_level(scenes: int, budget: AlarmBudget, dimensions: int = 6) -> float:
    """The same above which more evidence is wanted."""
    return _spent(min(scenes, budget.settled), budget, budget.suspicion_factor, dimensions)


@functools.lru_cache(maxsize=1024)
def _spent(scenes: int, budget: AlarmBudget, factor: float, dimensions: int) -> float:
    longest = max(scenes, 1) if scenes < budget.settled else _LONGEST
    return level_for(factor * budget.chance(scenes), dimensions, longest)
