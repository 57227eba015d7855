"""What counts as an edge of a cloud, and the kinds of them (PROBE section 1)."""

import math
from dataclasses import dataclass
from typing import Literal

RING_JUMP, BETWEEN_RINGS, PAINT = 0, 1, 2
"""Kinds of edges."""

KIND_NAMES: tuple[Literal["ring_jump", "between_rings", "paint"], ...] = (
    "ring_jump",
    "between_rings",
    "paint",
)


@dataclass(frozen=True, slots=True)
class EdgeParameters:
    """What counts as an edge. Lengths in metres, angles in steps of the sensor itself.

    Attributes:
        jump_m: Smallest jump along a ring, m: the depth of a parked car's flank.
        jump_share: The same as a share of the nearer range: noise and slant grow with range.
        jump_up_m: Smallest jump to the ring above, m.
        jump_up_share: The same as a share: the road itself recedes from ring to ring.
        sparsest_rad: With rings further apart, jumps between them are left out: where in the gap the edge is
            lies open, and half of this gap is three times the blur of the image.
        above_ground_m: The nearer point of a jump to the ring above stands at least so high, m.
        gap_steps: A gap along the ring of more azimuth steps breaks it: what lies there was not seen.
        view_lasting: Without rings so many neighbours in a row lie farther: where a sensor beside the camera
            looks past a border, near and far points alternate, and three far ones follow by chance.
        view_above_ground_m: Without rings an edge stands so high above the ground, m: neighbours along a row
            of the view lie at different places of a road that recedes.
        inset: How far an edge lies from the nearer point towards the farther ray, in steps: between the two,
            a little on the side of the body, for a beam that grazes it still returns.
        weights: Weight of each kind: between rings the edge is known to half a ring's gap only.
        most: Edges kept per frame.
        margin_px: Edges so far outside the image are kept: a wrong extrinsic may move them in.
        ground_band_m: Paint lies within so much of the ground plane, m.
        paint_nearest_m: Nearer, the car's own hood and shadow are seen.
        paint_farthest_m: Farther, a strip is narrower than a step.
        strip_narrowest_m: Narrower is noise.
        strip_widest_m: Wider is no longer a line.
        background_m: Width of road at each side of a strip with which it is compared, m.
        paint_noise: A strip rises over its background by so many sigma of the intensity noise.
        paint_contrast: The same as a share of the road's median intensity.
        paint_asymmetry: Largest difference of the two backgrounds as a share of the rise: a kerb is a step.
    """

    jump_m: float = 0.5
    jump_share: float = 0.06
    jump_up_m: float = 1.0
    jump_up_share: float = 0.15
    sparsest_rad: float = math.radians(0.8)
    above_ground_m: float = 0.4
    gap_steps: float = 2.6
    view_lasting: int = 5
    view_above_ground_m: float = 0.2
    inset: float = 0.45
    weights: tuple[float, float, float] = (1.0, 0.5, 1.0)
    most: int = 1500
    margin_px: float = 30.0
    ground_band_m: float = 0.15
    paint_nearest_m: float = 3.0
    paint_farthest_m: float = 35.0
    strip_narrowest_m: float = 0.05
    strip_widest_m: float = 0.8
    background_m: float = 0.6
    paint_noise: float = 5.0
    paint_contrast: float = 0.35
    paint_asymmetry: float = 0.35
