"""What a road is made of and bears besides paint: seams, cracks, tracks, repairs, stones, kerbs, verges."""
# ruff: noqa: PLR2004 - the figures are patterns on the ground, in m

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.simulation.surface import F32
from pipeline.simulation.textures import Textures, sample, smooth

Bgr = tuple[float, float, float]
GRASS: Bgr = (0.035, 0.12, 0.075)


@dataclass(frozen=True, slots=True, eq=False)
class Ribbon:
    """A strip along the road.

    Attributes:
        d: Its middle, m to the left of the centre line.
        width: m.
        gain: Of the albedo.
        wander: How far it strays, m.
        span: First and last arc length, m.
        soft: Fades towards its sides, as tracks of tyres do.
    """

    d: float
    width: float
    gain: float
    wander: float
    span: tuple[float, float]
    soft: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Blot:
    """A repair, a trench, a manhole or a spot.

    Attributes:
        place: Arc length and distance to the left of its middle, m.
        half: Half sizes along and across the road, m.
        gain: Of the albedo.
        sealed: A dark rim of tar around it.
        round: An ellipse, not a rectangle.
    """

    place: tuple[float, float]
    half: tuple[float, float]
    gain: float
    sealed: bool
    round: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Roadway:
    """The make of a road; as it stands by default it is asphalt between plain kerbs and grass.

    Attributes:
        ribbons: Strips along it.
        blots: Repairs and spots.
        joint: Distance of the joints of concrete slabs, m; inf: none.
        cracks: 0..1, how cracked it is.
        cobbles: Set in stones.
        kerb: Albedo of the kerb.
        paving: Gain of the albedo of the pavement.
        verge: Albedo of what lies beyond, linear BGR.
        grassy: Whether the verge is vegetation; else it is earth or gravel.
        snow: 0..1, how much of the ground lies under snow; the tracks of the wheels go last.
        wear: 0..1, how much of the paint has gone altogether, in patches.
        paint_albedo: Of fresh white paint.
    """

    ribbons: tuple[Ribbon, ...] = ()
    blots: tuple[Blot, ...] = ()
    joint: float = math.inf
    cracks: float = 0.0
    cobbles: bool = False
    kerb: float = 0.33
    paving: float = 1.0
    verge: Bgr = GRASS
    grassy: bool = True
    snow: float = 0.0
    wear: float = 0.0
    paint_albedo: float = 0.62

    def mark(self, albedo: F32, s: F32, d: F32, fades: F32, textures: Textures) -> None:
        """Puts seams, tracks, repairs, joints and stones on road points, in place.

        Args:
            albedo: float32 (3,N), linear BGR.
            s: Arc length (N,), m.
            d: Distance to the left of the centre line (N,), m.
            fades: Share 0..1 of a pattern of 2.5 cm that the picture resolves, (N,).
            textures: Noise tables.
        """
        if self.cobbles:
            row = np.floor(s / 0.11)
            stone = d / 0.13 + 0.5 * np.mod(row, 2.0)
            tone = sample(textures.fine, np.floor(stone), row, 1.0)
            joint = (np.mod(s, 0.11) < 0.016) | (np.mod(stone, 1.0) < 0.13)
            wide = np.minimum(2.0 * fades, np.float32(1.0))
            albedo *= np.exp(wide * (0.3 * tone - np.where(joint, np.float32(0.7), np.float32(0.0))))
        if math.isfinite(self.joint):
            joint = (np.mod(s, self.joint) < 0.03) | (np.mod(d + 0.4, self.joint * 0.7) < 0.02)
            albedo[:, joint] *= np.float32(0.45)
        for blot in self.blots:
            _blot(blot, albedo, s, d)
        for ribbon in self.ribbons:
            _ribbon(ribbon, albedo, s, d, textures)
        if self.cracks > 0.0:
            # A thin level line of a soft noise wanders like a crack.
            vein = np.abs(smooth(textures.rough, s, d, 1.1)) < np.float32(0.012 * self.cracks)
            torn = vein & (smooth(textures.rough, d, s, 0.13) > 0.4)
            albedo[:, torn] *= np.float32(0.4)

    def worn(self, s: F32, d: F32, textures: Textures) -> F32:
        """Share 0..1 of the paint that is left at road points (N,); in patches it is scrubbed off."""
        if self.wear == 0.0:
            return np.ones(s.shape, dtype=np.float32)
        level = 0.55 * smooth(textures.rough, s, d, 2.5) + 0.6 * sample(textures.fine, s, d, 14.0)
        level += 0.3 * sample(textures.fine, s, d, 45.0)
        # Wear 0.9 leaves a tenth: the level is close to a unit normal, and 3.4 spans its ranks.
        threshold = np.float32(3.4 * (self.wear - 0.5))
        return np.asarray(np.clip(0.5 + 2.0 * (level - threshold), 0.0, 1.0), dtype=np.float32)

    def snowed(self, d: F32, s: F32, textures: Textures, *, edge: float) -> NDArray[np.bool_]:
        """Whether road points (N,) lie under snow: banks at the edges, remains between the wheel tracks."""
        if self.snow == 0.0:
            return np.zeros(s.shape, dtype=np.bool_)
        bank = np.abs(d) - edge + 1.6 * self.snow + 0.35 * smooth(textures.rough, s, d, 1.5)
        remains = smooth(textures.rough, 0.25 * s, d, 2.5) > 3.6 - 3.0 * self.snow
        return np.asarray((bank > 0.0) | remains)


def _ribbon(ribbon: Ribbon, albedo: F32, s: F32, d: F32, textures: Textures) -> None:
    near = np.flatnonzero(
        (np.abs(d - np.float32(ribbon.d)) < ribbon.width + 3.0 * ribbon.wander)
        & (s > ribbon.span[0])
        & (s < ribbon.span[1])
    )
    # Its own row of the table, between whose cells it runs smoothly.
    row = np.full(near.shape, 57.0 * ribbon.d + 13.0 * ribbon.width, dtype=np.float32)
    astray = ribbon.wander * smooth(textures.rough, s[near], row, 1.5)
    off = np.abs(d[near] - np.float32(ribbon.d) - astray) / np.float32(0.5 * ribbon.width)
    if ribbon.soft:
        share = np.clip(1.3 - off, 0.0, 1.0) * (1.0 + 0.2 * sample(textures.fine, s[near], d[near], 6.0))
    else:
        share = (off < 1.0).astype(np.float32)
    albedo[:, near] *= np.exp(np.log(ribbon.gain) * share)


def _blot(blot: Blot, albedo: F32, s: F32, d: F32) -> None:
    near = np.flatnonzero(
        (np.abs(s - np.float32(blot.place[0])) < blot.half[0] + 0.1)
        & (np.abs(d - np.float32(blot.place[1])) < blot.half[1] + 0.1)
    )
    a, b = np.abs(s[near] - np.float32(blot.place[0])), np.abs(d[near] - np.float32(blot.place[1]))
    if blot.round:
        inside = np.hypot(a / blot.half[0], b / blot.half[1]) < 1.0
    else:
        inside = (a < blot.half[0]) & (b < blot.half[1])
        if blot.sealed:
            rim = ~inside | (a > blot.half[0] - 0.05) | (b > blot.half[1] - 0.05)
            albedo[:, near[rim]] *= np.float32(0.4)
    albedo[:, near[inside]] *= np.float32(blot.gain)
