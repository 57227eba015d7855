"""Solids: boxes, cylinders and ellipsoids as affine images of the unit shapes, and where rays meet them."""

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pipeline.records import Floats, read_only
from pipeline.simulation.surface import F32, Rays


class Shape(IntEnum):
    """The unit shape: cube [-1,1]^3, cylinder about z between -1 and 1, ball."""

    BOX = 0
    CYLINDER = 1
    ELLIPSOID = 2


class Material(IntEnum):
    """How a surface is drawn."""

    PLAIN = 0
    FACADE = 1
    LEAVES = 2
    CABIN = 3
    PLATE = 4
    FRONT = 5
    CANOPY = 6
    RAILING = 7
    BARK = 8
    RUST = 9
    BANDS = 10
    WOOD = 11
    LAMP = 12
    POSTER = 13
    LIGHT = 14


_BOX, _CYLINDER, _ELLIPSOID, _LEAVES = (int(k) for k in (*Shape, Material.LEAVES))
_CANOPY, _RAILING = int(Material.CANOPY), int(Material.RAILING)
"""Plain numbers: enumerations are slow to compare and every solid of every pass asks."""

CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
"""The corners of the unit cube, which holds every unit shape."""

_RAGGED = 0.55
"""Half chord of the unit ball below which rays may pass between leaves."""
_MESH_SHARE, _PLANK_SHARE = 0.25, 0.3
"""Of all railings; the rest has uprights 1 to 9 cm wide."""
_RAIL_AT_M, _RAIL_M, _MESH_M, _WIRE_M = 0.15, 0.06, 0.12, 0.014
"""m; height of the lower rail of a railing, thickness of its rails, cells and wires of a mesh."""
_LOOSE = 1.15
"""The same for a canopy, whose outline is torn and through which the sky is seen here and there."""


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """One solid.

    Attributes:
        shape: Unit shape.
        centre: float64 (3,), m, world (or the frame of the thing it is a part of).
        axes: float64 (3,3), rotation; columns are the solid's axes.
        half: float64 (3,), half sizes along its axes, m.
        label: Class of ``pipeline.labels``.
        colour: Albedo, linear BGR 0..1.
        reflectance: To the LiDAR, 0..1; above 0.8 retro-reflecting.
        material: How it is drawn.
    """

    shape: Shape
    centre: Floats
    axes: Floats
    half: Floats
    label: int
    colour: tuple[float, float, float]
    reflectance: float
    material: Material = Material.PLAIN


@dataclass(frozen=True, slots=True, eq=False)
class Solids:
    """Many solids as arrays of one row each.

    Attributes:
        shape: uint8 (n,), :class:`Shape`.
        centre: float64 (n,3), m, world.
        to_unit: float64 (n,3,3), maps offsets from the centre to the unit shape.
        half: float64 (n,3), m.
        velocity: float64 (n,3), m/s, world.
        label: uint8 (n,).
        colour: float32 (n,3), linear BGR.
        reflectance: float32 (n,).
        material: uint8 (n,), :class:`Material`.
    """

    shape: NDArray[np.uint8]
    centre: Floats
    to_unit: Floats
    half: Floats
    velocity: Floats
    label: NDArray[np.uint8]
    colour: F32
    reflectance: F32
    material: NDArray[np.uint8]

    def __post_init__(self) -> None:
        for name in self.__slots__:
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.shape)

    @classmethod
    def of(cls, solids: list[Solid]) -> Self:
        """Stacks solids that stand still."""
        n = len(solids)
        axes = np.array([s.axes for s in solids]).reshape(n, 3, 3)
        half = np.array([s.half for s in solids], dtype=np.float64).reshape(n, 3)
        return cls(
            np.array([s.shape for s in solids], dtype=np.uint8),
            np.array([s.centre for s in solids], dtype=np.float64).reshape(n, 3),
            axes.transpose(0, 2, 1) / half[:, :, None],
            half,
            np.zeros((n, 3)),
            np.array([s.label for s in solids], dtype=np.uint8),
            np.array([s.colour for s in solids], dtype=np.float32).reshape(n, 3),
            np.array([s.reflectance for s in solids], dtype=np.float32),
            np.array([s.material for s in solids], dtype=np.uint8),
        )

    def moved(self, T: Floats, velocity: Floats) -> "Solids":
        """The same solids carried by the rigid 4x4 ``T`` and moving with ``velocity`` (3,), m/s."""
        return replace(
            self,
            centre=self.centre @ T[:3, :3].T + T[:3, 3],
            to_unit=self.to_unit @ T[:3, :3].T,
            velocity=np.broadcast_to(velocity, self.centre.shape).copy(),
        )

    def joined(self, other: "Solids") -> "Solids":
        """Both, in this order."""
        fields = {
            name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in self.__slots__
        }
        return Solids(**fields)

    def corners(self) -> Floats:
        """Corners of the boxes that hold the solids, float64 (n,8,3), m, world."""
        edges = self.to_unit.transpose(0, 2, 1) * (self.half**2)[:, None, :]
        return np.asarray(self.centre[:, None, :] + CORNERS @ edges.transpose(0, 2, 1))

    def meet(self, index: int, rays: Rays, window: tuple[slice, slice], grain: F32) -> F32:
        """Parameter t float32 at which the rays of a window enter solid ``index`` (inf: they do not).

        Args:
            index: Which solid.
            rays: Grid of rays.
            window: Rows and columns to test.
            grain: float32 (k,k), k a power of two, 0..1: where leaves let rays pass.
        """
        A = self.to_unit[index]
        d = rays.direction[:, window[0], window[1]]
        u = np.matmul(A.astype(np.float32), d.reshape(3, -1)).reshape(d.shape)
        start = self._start(index, rays, window)
        shape, material = int(self.shape[index]), int(self.material[index])
        with np.errstate(divide="ignore", invalid="ignore"):
            if shape == _BOX:
                enter, leave = _slabs(start, u, (0, 1, 2))
            elif shape == _CYLINDER:
                side, back = _round(start, u, 2)
                floor, roof = _slabs(start, u, (2,))
                enter, leave = np.maximum(side, floor), np.minimum(back, roof)
            else:
                enter, leave = _round(start, u, 3)
            met = (enter < leave) & (enter > 0)
            if material == _LEAVES and shape == _ELLIPSOID:
                met &= self._leafy(index, start, u, (enter, leave), grain)
            elif material == _CANOPY and shape == _ELLIPSOID:
                met &= self._loose(index, start, u, (enter, leave), grain)
            elif material == _RAILING:
                met &= self._barred(index, start, u, enter, grain)
        return np.where(met, enter, np.float32(np.inf))

    def _start(self, index: int, rays: Rays, window: tuple[slice, slice]) -> tuple[F32, F32, F32]:
        """Origins of the rays in the unit frame, as three arrays that broadcast to the window."""
        full = rays.direction.shape[1:]
        A, centre, velocity = self.to_unit[index], self.centre[index], self.velocity[index]
        rel = [_cut(rays.origin[k], full, window) - centre[k] for k in range(3)]
        if velocity.any():
            time = _cut(rays.time, full, window)
            rel = [rel[k] - velocity[k] * time for k in range(3)]
        x, y, z = (
            (A[i, 0] * rel[0] + A[i, 1] * rel[1] + A[i, 2] * rel[2]).astype(np.float32) for i in range(3)
        )
        return x, y, z

    def _leafy(
        self, index: int, start: tuple[F32, F32, F32], u: F32, chord: tuple[F32, F32], grain: F32
    ) -> NDArray[np.bool_]:
        """Whether a ray that enters a crown meets a leaf: in the middle always, by the grain at the rim."""
        enter, leave = chord
        half = 0.5 * (leave - enter) * np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
        sure = ~(half < _RAGGED)
        k = len(grain) - 1
        scale = 23.0 * self.half[index]
        rim = np.nonzero(~sure & np.isfinite(half))
        t = enter[rim]
        place = [np.broadcast_to(start[i], half.shape)[rim] + t * u[i][rim] for i in range(3)]
        row = ((place[0] + place[1]) * np.float32(scale[0])).astype(np.int32) + 37 * index
        column = ((place[2] + 0.3 * place[1]) * np.float32(scale[2])).astype(np.int32)
        sure[rim] = half[rim] > _RAGGED * grain[row & k, column & k]
        return np.asarray(sure)

    def _loose(
        self, index: int, start: tuple[F32, F32, F32], u: F32, chord: tuple[F32, F32], grain: F32
    ) -> NDArray[np.bool_]:
        """Whether a ray meets a leaf of a canopy: leaves in twigs in boughs, three scales of grain."""
        enter, leave = chord
        half = 0.5 * (leave - enter) * np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
        met = np.zeros(half.shape, dtype=np.bool_)
        inside = np.nonzero(half > 0)
        t = enter[inside]
        x, y, z = (
            (np.broadcast_to(start[i], half.shape)[inside] + t * u[i][inside])
            * np.float32(self.half[index, i])
            for i in range(3)
        )
        k = len(grain) - 1
        density = np.zeros(t.shape, dtype=np.float32)
        for cells, share in ((1.9, 0.35), (6.0, 0.35), (21.0, 0.3)):
            row = ((x + y) * np.float32(cells)).astype(np.int32) + 61 * index
            column = ((z + 0.4 * (x - y)) * np.float32(cells)).astype(np.int32) + 17 * index
            density += np.float32(share) * grain[row & k, column & k]
        met[inside] = half[inside] > _LOOSE * density**2 / 0.55
        return met

    def _barred(
        self, index: int, start: tuple[F32, F32, F32], u: F32, enter: F32, grain: F32
    ) -> NDArray[np.bool_]:
        """Whether a ray that enters a railing meets it: uprights between two rails, planks or wire mesh."""
        along, up = ((start[i] + enter * u[i] + 1) * np.float32(self.half[index, i]) for i in (0, 2))
        k = len(grain) - 1
        kind, pitch, bar = (float(grain[(37 * index) & k, (61 * j) & k]) for j in range(3))
        rails = (np.abs(up - _RAIL_AT_M) < _RAIL_M / 2) | (2 * np.float32(self.half[index, 2]) - up < _RAIL_M)
        if kind < _MESH_SHARE:
            wires = [np.mod(way, _MESH_M) < _WIRE_M for way in (along + up, along - up)]
            return np.asarray(wires[0] | wires[1] | rails)
        if kind < _MESH_SHARE + _PLANK_SHARE:
            pitch, bar = 0.10 + 0.05 * pitch, 0.84
        else:
            pitch, bar = 0.09 + 0.16 * pitch, 0.12 + 0.25 * bar
        return np.asarray((np.mod(along, pitch) < bar * pitch) | rails)


def _cut(values: F32, full: tuple[int, ...], window: tuple[slice, slice]) -> F32:
    """The part of a two-dimensional broadcastable array that belongs to a window, still broadcastable."""
    rows = window[0] if values.shape[0] == full[0] else slice(None)
    columns = window[1] if values.shape[1] == full[1] else slice(None)
    return values[rows, columns]


def _slabs(start: tuple[F32, F32, F32], u: F32, axes: tuple[int, ...]) -> tuple[F32, F32]:
    """Where rays enter and leave the slabs -1..1 along the axes."""
    enter = leave = np.zeros((), dtype=np.float32)
    for step, k in enumerate(axes):
        # A ray along the slab: never 0 / 0.
        per_t = 1 / (u[k] + np.float32(1e-30))
        middle, half = -start[k] * per_t, np.abs(per_t)
        enter = middle - half if step == 0 else np.maximum(enter, middle - half)
        leave = middle + half if step == 0 else np.minimum(leave, middle + half)
    return enter, leave


def _round(start: tuple[F32, F32, F32], u: F32, dimensions: int) -> tuple[F32, F32]:
    """Where rays enter and leave the unit circle (2) or ball (3); NaN: never.

    The discriminant is ``|u|^2 - |start x u|^2``: the usual ``b^2 - ac`` cancels for thin poles far away.
    """
    x, y, z = start
    cross = x * u[1] - y * u[0]
    a, b, apart = u[0] * u[0] + u[1] * u[1], x * u[0] + y * u[1], cross * cross
    if dimensions == 3:
        a, b = a + u[2] * u[2], b + z * u[2]
        p, q = y * u[2] - z * u[1], z * u[0] - x * u[2]
        apart = apart + p * p + q * q
    root = np.sqrt(a - apart)
    return (-b - root) / a, (-b + root) / a


def upright(heading: float, lean: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """Rotation (3,3) of a thing that stands with a heading and leans forward and left, rad."""
    c, s = np.cos(heading), np.sin(heading)
    Rz = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    z = np.array([np.tan(lean[0]), np.tan(lean[1]), 1.0])
    z /= np.linalg.norm(z)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    return np.asarray(Rz @ np.column_stack([x, np.cross(z, x), z]))
