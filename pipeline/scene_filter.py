"""What scenes say of a mount, one after the other: Kalman filters of mount, street and clock, many at once.

Evidence comes in scenes, stretches of road that share no frames. Of scene k the estimate of the mount is

    d_k = m + s_k + f_k tau + e_k

m the mount; s_k the systematic part, common to a street and another on the next (covariance: the floor;
correlation falls over metres); f_k the drift that one sigma of error in time feigns, tau that error, one for
the whole drive (FORMULAS G1); e_k the random error. m and s_k can not be told apart in one street, so the
floor is never divided by a number of scenes, only, slowly, by a number of streets (FORMULAS F2, F4).
"""

import math
from dataclasses import dataclass

import numpy as np

from pipeline.records import Floats

STATES = 13
"""m (6), s (6), tau."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What one stretch of road says of the mount, vehicle axes, rad and m.

    Attributes:
        drift: float64 (6,), estimate against the expected mean.
        covariance: float64 (6,6), of its random error; large in directions that it does not see.
        feigned: float64 (6,), drift that one sigma of error in time feigns.
        way_m: Way driven since any origin, m.
        stamp_ns: Of its newest frame.
    """

    drift: Floats
    covariance: Floats
    feigned: Floats
    way_m: float
    stamp_ns: int


def prior(mount: Floats, floor: Floats) -> Floats:
    """Covariance (13,13) of a filter that has heard no scene.

    Args:
        mount: float64 (6,6), of the mount.
        floor: float64 (6,6), of the systematic part.
    """
    covariance = np.zeros((STATES, STATES))
    covariance[:6, :6], covariance[6:12, 6:12], covariance[12, 12] = mount, floor, 1.0
    return covariance


def driven(
    mean: Floats, covariance: Floats, way_m: float, floor: Floats, correlation_m: float
) -> tuple[Floats, Floats]:
    """Filters brought ahead on the road, where the systematic part forgets itself.

    Args:
        mean: float64 (n,13).
        covariance: float64 (n,13,13).
        way_m: Driven since the last scene, m.
        floor: float64 (6,6), covariance of the systematic part.
        correlation_m: Way over which it keeps 1/e of itself.
    """
    kept = math.exp(-way_m / correlation_m)
    scale = np.ones(STATES)
    scale[6:12] = kept
    covariance = covariance * np.outer(scale, scale)
    covariance[:, 6:12, 6:12] += (1.0 - kept**2) * floor
    return mean * scale, covariance


def heard(scene: Scene, mount: Floats, uncertainty: Floats, most_square: float) -> Floats:
    """Covariance (6,6) of a scene's random error, widened where it is too far off to be heard in full.

    Args:
        scene: See there.
        mount: float64 (6,), the mount as it is believed.
        uncertainty: float64 (6,6), of that, the floor included.
        most_square: Squared sigmas for which a scene is heard at most.
    """
    expected = scene.covariance + np.outer(scene.feigned, scene.feigned) + uncertainty
    off = scene.drift - mount
    square = float(off @ np.linalg.solve(expected, off))
    return np.asarray(scene.covariance + max(0.0, square / most_square - 1.0) * expected)


def updated(mean: Floats, covariance: Floats, scene: Scene, noise: Floats) -> tuple[Floats, Floats, Floats]:
    """Filters after a scene, whose random error has covariance ``noise`` (6,6): Kalman's update.

    Returns:
        Means (n,13), covariances (n,13,13), and how far off each had expected the scene, squared sigmas (n,),
        counted by the error that the scene itself states.
    """
    f = scene.feigned
    # A scene shows m + s + f tau: sums of columns and rows are a tenth of the work of products with H.
    seen = covariance[:, :, :6] + covariance[:, :, 6:12] + covariance[:, :, 12:] * f
    expected = seen[:, :6] + seen[:, 6:12] + f[:, None] * seen[:, 12:] + noise
    gain = np.swapaxes(np.linalg.solve(expected, np.swapaxes(seen, 1, 2)), 1, 2)
    off = scene.drift - (mean[:, :6] + mean[:, 6:12] + mean[:, 12:] * f)
    covariance = covariance - gain @ np.swapaxes(seen, 1, 2)
    stated = expected + (scene.covariance - noise)
    squares = np.einsum("ni,ni->n", off, np.linalg.solve(stated, off[..., None])[..., 0])
    mean = mean + (gain @ off[..., None])[..., 0]
    return mean, 0.5 * (covariance + np.swapaxes(covariance, 1, 2)), squares
