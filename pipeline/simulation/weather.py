"""Hour and weather of a street: how far one sees, clouds, night with lamps and head lights, wet and snow."""
# ruff: noqa: PLR2004 - the figures are falloffs in m and shares of brightness

import math
from dataclasses import dataclass, field

import numpy as np

from pipeline import labels
from pipeline.records import Floats, read_only
from pipeline.simulation.solids import Material, Solids
from pipeline.simulation.surface import F32
from pipeline.simulation.textures import Textures, smooth

CLEAR_M = 700.0
"""m; contrast falls to 37 % over this distance on a clear day."""
_LAMP_REACH_M = 28.0
"""m; farther lamps add nothing that is seen."""
_MOST_LAMPS = 14
"""Lamps that are counted: the nearest to the camera."""
_SODIUM = np.array([[0.35], [0.75], [1.15]], dtype=np.float32)
_BEAM = np.array([[0.85], [1.0], [1.1]], dtype=np.float32)


def _none() -> Floats:
    return np.zeros((0, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Weather:
    """Hour and weather; by default a clear day.

    Attributes:
        sight: Contrast falls to 37 % over this distance, m.
        night: 0 day, 1 dark.
        wet: 0 dry, 1 under water.
        glossy: Roads glare against the sun, and the sky has a sun and clouds of several kinds.
        billows: Size of the clouds relative to the usual.
        glow: Colour of the sky at the horizon, linear BGR.
        sun: Colour of sunlight, linear BGR.
        lamps: float64 (n,3), lights of the street that burn at night, m, world.
    """

    sight: float = CLEAR_M
    night: float = 0.0
    wet: float = 0.0
    glossy: bool = False
    billows: float = 1.0
    glow: tuple[float, float, float] = (0.80, 0.78, 0.76)
    sun: tuple[float, float, float] = (0.84, 0.96, 1.05)
    lamps: Floats = field(default_factory=_none)

    def __post_init__(self) -> None:
        object.__setattr__(self, "lamps", read_only(self.lamps))


def sky(weather: Weather, textures: Textures, direction: F32, sun: Floats, overcast: float) -> F32:
    """Radiance (3,N) of the sky: a gradient, the sun, clouds in layers; dark at night.

    Args:
        weather: Hour and weather.
        textures: Noise tables.
        direction: float32 (3,N), world, of any length.
        sun: float64 (3,), unit vector towards it.
        overcast: 0 clear, 1 grey.
    """
    d = direction / np.sqrt((direction * direction).sum(axis=0))
    rise = np.maximum(d[2], np.float32(0.005))
    pale = np.exp(-3.5 * rise)
    horizon = np.array(weather.glow, dtype=np.float32)[:, None] * np.float32(0.9 + 0.3 * overcast)
    zenith = np.array([[0.75], [0.42], [0.22]], dtype=np.float32)
    blue = pale * horizon + (1.0 - pale) * zenith
    toward = sun.astype(np.float32) @ d
    # The disc is half a degree wide; the air about it is bright for some degrees.
    blue += (
        40.0 * (toward > 0.99998) + 0.9 * np.maximum(toward, 0.0) ** 160 + 0.3 * np.maximum(toward, 0.0) ** 12
    )
    far = np.float32(2.2 * weather.billows) / (rise + np.float32(0.06))
    u, v = d[0] * far, d[1] * far
    # So many cells that one picture sees more than one billow of the table.
    cloud = smooth(textures.rough, u, v, 8.0) + 0.45 * smooth(textures.rough, u + 9.0, v, 19.0)
    cloud += 0.15 * smooth(textures.fine, u, v + 5.0, 15.0)
    # Some clouds are veils, others have edges: the same noise through a flat or a steep step.
    steep = 0.4 + 2.5 * (0.5 + 0.5 * math.sin(9.0 * weather.billows))
    cover = np.clip(steep * (cloud + 3.2 * overcast - 1.3), 0.0, 1.0)
    body = np.float32(0.93) - 0.16 * np.clip(cloud, -1.0, 2.0) * np.float32(0.4 + overcast)
    shown = blue + cover * (np.maximum(body, np.float32(0.3)) - blue)
    return np.asarray(shown * dusk(weather), dtype=np.float32)


def dusk(weather: Weather) -> np.float32:
    """What is left of the light of day, 1 by day."""
    return np.float32((1.0 - weather.night) ** 2 + 0.006 * weather.night)


def lamps_of(solids: Solids, near: Floats) -> Floats:
    """Middles (n,3) of the nearest lamps of poles, for ``Weather.lamps``."""
    lamp = (solids.material == Material.LAMP) & (solids.label == labels.POLE)
    places = solids.centre[lamp]
    order = np.argsort(np.hypot(*(places[:, :2] - near[:2]).T))
    return np.asarray(places[order[:_MOST_LAMPS]])


def lamp_light(weather: Weather, place: F32, normal: F32) -> F32:
    """Irradiance (3,N) that lamps of the street give to surfaces at (3,N) with normals (3,N) or (3,1)."""
    total = np.zeros(place.shape[1], dtype=np.float32)
    for lamp in weather.lamps.astype(np.float32):
        near = np.flatnonzero((np.abs(place[0] - lamp[0]) + np.abs(place[1] - lamp[1])) < _LAMP_REACH_M)
        away = lamp[:, None] - place[:, near]
        square = (away * away).sum(axis=0) + np.float32(0.3)
        facing = normal if normal.shape[1] == 1 else normal[:, near]
        cosine = np.maximum((away * facing).sum(axis=0), np.float32(0.0))
        # It shines down: little goes sideways and nothing up.
        down = np.clip(away[2] / np.sqrt(square), 0.0, 1.0)
        total[near] += 14.0 * cosine * down / (square * np.sqrt(square))
    return np.asarray(np.float32(weather.night) * total * _SODIUM, dtype=np.float32)


def head_light(weather: Weather, direction: F32, depth: F32, facing: F32) -> F32:
    """Irradiance (3,N) of the own head lights on points that the camera sees.

    Args:
        weather: Hour.
        direction: float32 (3,N), right, down, ahead in the camera, at ahead = 1.
        depth: float32 (N,), m.
        facing: float32 (N,), cosine between surface and view; a road is lit at a flat angle.
    """
    spread = np.exp(-((direction[0] / 0.45) ** 2)) * np.exp(
        -((np.minimum(direction[1] - 0.05, 0.0) / 0.09) ** 2)
    )
    beam = 160.0 * spread * np.maximum(facing, np.float32(0.02)) / (depth * depth + 25.0)
    return np.asarray(np.float32(weather.night) * beam * _BEAM, dtype=np.float32)
