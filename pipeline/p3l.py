"""Extrinsics from two parallel lines and a third one: the closed form of P3L (CRLF (10)-(13), generalised).

The planes through the camera centre and the two image lanes meet in the lanes' direction; the pole lies in a
third plane and keeps its angle to the lanes: one trigonometric equation with two roots. Two directions fix
the rotation, three planes the translation. The pole may lean, the LiDAR may have any axes (FORMULAS B (11)).
"""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Floats

NEAREST_M = 0.5
"""m; what image and cloud both see lies further in front of the camera (FORMULAS B (12), 4 i)."""
_NO_SINE = 1e-6
"""Sine of an angle below which two directions or planes count as one: only rounding tells them apart."""
_ROOT_SLACK = 1.05
"""|c| / r up to which a missing root is put down to noise: 1.05 is 3 deg for a pole at right angles."""


class Degeneracy(IntEnum):
    """Why three correspondences give no extrinsic."""

    NONE = 0
    LANES_IN_ONE_PLANE = 1
    """Both image lanes lie in one plane with the camera: no vanishing point."""
    POLE_ABEAM = 2
    """The pole's plane is square to the lanes: every roll fits."""
    POLE_DEAD_AHEAD = 3
    """The pole's plane holds the lanes' direction: how far along the lanes the camera stands is lost."""
    POLE_ALONG_LANES = 4
    """The third line is parallel to the lanes."""
    NO_ROOT = 5
    """No line of the pole's plane keeps the pole's angle to the lanes: the three do not belong together."""
    NO_NUMBER = 6
    """A normal, a direction or a point is not finite."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Extrinsics of M correspondences, four roots each.

    Attributes:
        T_cam_lidar: float64 (M,4,4,4), second axis: roots; identity where there is none.
        degeneracy: int8 (M,), a value of :class:`Degeneracy`; all four roots exist where it is NONE.
    """

    T_cam_lidar: Floats
    degeneracy: NDArray[np.int8]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Correspondences (M,) that have roots."""
        return np.asarray(self.degeneracy == Degeneracy.NONE)


def plane_normals(start: Floats, end: Floats, K: Floats) -> Floats:
    """Unit normals (M,3), camera axes, of the planes through the camera centre and image lines.

    Args:
        start: float64 (M,2), px of the ideal image.
        end: float64 (M,2), likewise; from start to end decides the sign.
        K: float64 (3,3), acts on points, px.

    Returns:
        ``unit(K^T (x_s x x_e))`` (PLK (7), corrected: FORMULAS C); 0 where both ends are one.
    """
    ones = np.ones((len(start), 1))
    normals = np.cross(np.hstack([start, ones]), np.hstack([end, ones])) @ K
    return _unit(normals)


def p3l_candidates(
    n1: Floats, n2: Floats, n3: Floats, d_l: Floats, d_p: Floats, p1: Floats, p2: Floats, p3: Floats
) -> Candidates:
    """All extrinsics that put two parallel lines and a third line into their planes (CRLF (10), CRLF (13)).

    The turn to the ground-parallel frame, ``R = R_CG R_GL`` there, is not made: the lines' directions are
    taken as they lie in the LiDAR's frame.

    Args:
        n1: float64 (M,3), unit, camera axes: normal of the plane of the first lane; signs are arbitrary. Rows
            with a number that is not finite, here or below, give nothing.
        n2: Likewise of the second lane.
        n3: Likewise of the pole.
        d_l: float64 (M,3), unit, LiDAR frame: direction of both lanes.
        d_p: float64 (M,3), unit, LiDAR frame: direction of the pole, at any angle to the lanes.
        p1: float64 (M,3), metres, LiDAR frame: a point of the first lane.
        p2: Likewise of the second lane.
        p3: Likewise of the pole.

    Returns:
        Two signs of the lanes' direction times two roots of the pole's: four for each correspondence, or why
        there are none.
    """
    given = (n1, n2, n3, d_l, d_p, p1, p2, p3)
    finite = np.asarray(np.isfinite(np.hstack(given)).all(axis=1))
    # What is not finite would warn on its way and then compare as sound.
    n1, n2, n3, d_l, d_p, p1, p2, p3 = (np.where(finite[:, None], array, 0.0) for array in given)
    a0 = np.cross(n1, n2)
    width = np.linalg.norm(a0, axis=1)
    a = a0 / np.maximum(width, _NO_SINE)[:, None]
    ahead = np.einsum("mi,mi->m", a, n3)
    r = np.sqrt(np.maximum(1.0 - ahead**2, 0.0))
    c = np.einsum("mi,mi->m", d_l, d_p)
    ratio = c / np.maximum(r, _NO_SINE)
    across = np.linalg.norm(np.cross(d_l, d_p), axis=1)
    degeneracy = np.select(
        [
            ~finite,
            width < _NO_SINE,
            across < _NO_SINE,
            np.abs(ahead) < _NO_SINE,
            r < _NO_SINE,
            np.abs(ratio) > _ROOT_SLACK,
        ],
        [
            Degeneracy.NO_NUMBER,
            Degeneracy.LANES_IN_ONE_PLANE,
            Degeneracy.POLE_ALONG_LANES,
            Degeneracy.POLE_DEAD_AHEAD,
            Degeneracy.POLE_ABEAM,
            Degeneracy.NO_ROOT,
        ],
        Degeneracy.NONE,
    ).astype(np.int8)
    T = np.broadcast_to(np.eye(4), (len(n1), 4, 4, 4)).copy()
    good = degeneracy == Degeneracy.NONE
    if good.any():
        T[good, :, :3, :3] = _rotations(a[good], n3[good], ratio[good], d_l[good], d_p[good])
        N = np.stack([n1[good], n2[good], n3[good]], axis=1)
        points = np.stack([p1[good], p2[good], p3[good]], axis=1)
        T[good, :, :3, 3] = _translations(N, T[good, :, :3, :3], points)
    return Candidates(T, degeneracy)


def _rotations(a: Floats, n3: Floats, ratio: Floats, d_l: Floats, d_p: Floats) -> Floats:
    """The four rotations (M,4,3,3) that turn both directions into their planes.

    CRLF (11), generalised to a pole at any angle to the lanes: steps 1 to 3 of FORMULAS B (11).
    """
    # Roots: (+a, +psi), (+a, -psi), (-a, +psi), (-a, -psi).
    lane = a[:, None] * np.array([1.0, 1.0, -1.0, -1.0])[:, None]
    normal = np.broadcast_to(n3[:, None], lane.shape)
    e = _unit(lane - np.einsum("mki,mki->mk", lane, normal)[..., None] * normal)
    f = np.cross(normal, e)
    cosine = np.clip(ratio, -1.0, 1.0)[:, None, None]
    sine = np.sqrt(1.0 - cosine**2) * np.array([1.0, -1.0, 1.0, -1.0])[:, None]
    z = _unit(np.cross(lane, cosine * e + sine * f))
    cam = np.stack([lane, np.cross(z, lane), z], axis=-1)
    z_lidar = _unit(np.cross(d_l, d_p))
    lidar = np.stack([d_l, np.cross(z_lidar, d_l), z_lidar], axis=-1)
    return np.asarray(cam @ lidar[:, None].transpose(0, 1, 3, 2))


def _translations(N: Floats, R: Floats, points: Floats) -> Floats:
    """CRLF (12): shifts (M,4,3) of ``n_i . t = -n_i . (R p_i)``; normals and points (M,3,3), R (M,4,3,3)."""
    right = -np.einsum("mic,mkcl,mil->mki", N, R, points, optimize=True)
    return np.asarray(np.linalg.solve(N[:, None], right[..., None])[..., 0])


def _unit(vectors: Floats) -> Floats:
    """Vectors (...,3) of length 1; 0 stays 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0.0, length, 1.0))


def depths(T_cam_lidar: Floats, points: Floats) -> Floats:
    """z_C (...,) in metres of points (...,3) under extrinsics (...,4,4), broadcast against each other."""
    return np.asarray(np.einsum("...i,...i->...", T_cam_lidar[..., 2, :3], points) + T_cam_lidar[..., 2, 3])


def in_front(T_cam_lidar: Floats, points: Floats) -> NDArray[np.bool_]:
    """Whether points (...,3) lie in front of the camera: cheirality (i) of FORMULAS B."""
    return np.asarray(depths(T_cam_lidar, points) > NEAREST_M)


def upright(T_cam_lidar: Floats, foot: Floats, top: Floats) -> NDArray[np.bool_]:
    """Whether the tops (...,3) of poles project above their feet (...,3): cheirality (ii) of FORMULAS B.

    Both must lie in front of the camera.
    """
    y_foot, y_top = (
        np.einsum("...i,...i->...", T_cam_lidar[..., 1, :3], point) + T_cam_lidar[..., 1, 3]
        for point in (foot, top)
    )
    return np.asarray(y_top * depths(T_cam_lidar, foot) < y_foot * depths(T_cam_lidar, top))


def above(T_cam_lidar: Floats, point: Floats, up: Floats) -> NDArray[np.bool_]:
    """Whether the camera centre lies on the side ``up`` (...,3) of the ground through a point (...,3) of it.

    One set in a thousand has a second root from below the road that :func:`in_front` and :func:`upright` let
    pass; lanes are seen from above.
    """
    R, t = T_cam_lidar[..., :3, :3], T_cam_lidar[..., :3, 3]
    centre = -np.einsum("...ji,...j->...i", R, t)
    return np.asarray(np.einsum("...i,...i->...", centre - point, up) > 0.0)
