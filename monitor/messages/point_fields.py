"""Named columns of any numeric type -> :class:`~pipeline.records.PointCloud`: one reading for every format.

Field names are compared in lower case. What a field means is settled here and nowhere else:

- ``x y z``: metres. Points that are not finite or out of every sensor's reach, and returns at exactly
  (0, 0, 0), are dropped from every array together: so sensors and drivers mark a beam without an echo.
- intensity (:data:`INTENSITY`, the first that exists): 0..1. uint8 is divided by 255. Floats of which 99 %
  are at most 1 stand as they are. Anything else is divided by 255 or, where it is larger (signal counts), by
  the 99.9 % quantile; then all is clipped to 0..1. Quantiles of the valid points, not the largest value:
  signs and other retroreflectors beyond the nominal scale must not change it.
- ring (:data:`RING`): kept where every valid point has a whole number in 0..65535.
- time (:data:`TIME`): see :func:`seconds_after`.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from monitor.messages import Codec
from pipeline.errors import InputError
from pipeline.records import PointCloud

CODECS: dict[str, Codec] = {}
"""This module is shared by those of the point clouds and decodes no type by itself."""

Column: TypeAlias = NDArray[Any]

INTENSITY = ("intensity", "i", "reflectivity", "reflectance")
RING = ("ring", "channel", "laser_id", "line", "laser", "beam")
TIME = ("t", "time", "timestamp", "offset_time", "time_offset", "time_stamp")

KNOWN = frozenset(("x", "y", "z", *INTENSITY, *RING, *TIME))
"""Fields that :func:`cloud_of` reads; the others need not even be of a type that is known."""

FARTHEST_M = 1e4
"""m on each axis; no LiDAR reaches so far. Larger numbers stand for no echo and would overflow in squares."""

NOMINAL_SHARE = 0.99
"""Share of points within 0..1 that tells a scale of 0..1; retroreflectors are some tenths of a percent."""

COUNTS_SHARE = 0.999
"""Share of signal counts that are not clipped: full scale is what hardly any point exceeds."""

LONGEST_SWEEP_S = 2.0
"""s; spinning sensors take 0.05 to 0.2 s, slow scanners up to 1 s."""

COARSEST_S = 1e-3
"""s; a hundredth of a sweep: absolute seconds in float32 step by 128 s."""

_CLOCKS = ((10**17, 1), (10**14, 10**3), (10**11, 10**6), (10**8, 10**9))
"""Least value and ns per unit of clocks counted from 1970 in ns, us, ms, s: dates from 1973 to 5138."""

_UPTIME = {True: 10**8, False: 10**11}
"""Floats (True) and integers below it count from the sweep or the sensor's start, never from 1970."""


class Field(NamedTuple):
    """Where a field stands in a packed point: ``dtype`` carries the byte order, ``offset`` is in bytes."""

    name: str
    offset: int
    dtype: np.dtype[Any]


class Packing(NamedTuple):
    """How points lie in a buffer: ``height`` rows of ``width`` points; steps in bytes."""

    width: int
    height: int
    point_step: int
    row_step: int
    fields: Sequence[Field]


def packed_columns(data: memoryview | NDArray[np.uint8], packing: Packing) -> dict[str, Column]:
    """Views of the fields that :func:`cloud_of` knows, 1-D, in the order of the points.

    Raises:
        InputError: A field or row does not fit, or the data are shorter than declared.
    """
    width, height, point_step, row_step, fields = packing
    if row_step < width * point_step:
        raise InputError(f"rows of {row_step} bytes can not hold {width} points of {point_step} bytes")
    needed = (height - 1) * row_step + width * point_step if width and height else 0
    if len(data) < needed:
        raise InputError(
            f"{height}x{width} points of {point_step} bytes need {needed} bytes, the data have {len(data)}",
            hint="the message was cut short",
        )
    columns: dict[str, Column] = {}
    for field in fields:
        name = field.name.lower()
        if name in columns or name not in KNOWN:
            continue
        end = field.offset + field.dtype.itemsize
        if end > point_step:
            raise InputError(f"field '{field.name}' ends at byte {end} of a point of {point_step}")
        if needed == 0:
            columns[name] = np.empty(0, field.dtype)
            continue
        columns[name] = np.ndarray(
            (height, width), field.dtype, buffer=data, offset=field.offset, strides=(row_step, point_step)
        ).reshape(-1)
    return columns


def text_columns(tokens: Sequence[bytes], fields: Sequence[Field], per_point: int) -> dict[str, Column]:
    """Columns of the fields that :func:`cloud_of` knows from numbers written as text.

    Args:
        tokens: The numbers, point by point.
        fields: ``offset`` counts numbers, not bytes.
        per_point: Numbers of one point.

    Raises:
        InputError: A token is no number, or not one of its field's type.
    """
    columns: dict[str, Column] = {}
    for field in fields:
        name = field.name.lower()
        if name in columns or name not in KNOWN:
            continue
        chosen = tokens[field.offset :: per_point]
        read = float if field.dtype.kind == "f" else int
        try:
            with np.errstate(over="ignore"):  # beyond float32 is inf, which is dropped
                columns[name] = np.fromiter(map(read, chosen), field.dtype, len(chosen))
        except (ValueError, OverflowError) as error:
            raise InputError(f"field '{field.name}': {error}", hint="the file is damaged") from error
    return columns


def cloud_of(columns: Mapping[str, Column], stamp_ns: int) -> PointCloud:
    """The cloud that named columns of equal length describe; owns its arrays.

    Args:
        columns: Lower-case field name -> (N,) of any integer or float type and byte order; others are
            ignored.
        stamp_ns: Stamp of the sweep, ns: times are told relative to it.

    Raises:
        InputError: x, y or z is missing.
    """
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise InputError(
            f"the cloud has no field {', '.join(missing)}",
            hint=f"its fields are {', '.join(sorted(columns)) or 'none that is known'}",
        )
    xyz = np.empty((len(columns["x"]), 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # float64 beyond float32 becomes inf, which is dropped
        for axis, name in enumerate("xyz"):
            xyz[:, axis] = columns[name]
    with np.errstate(invalid="ignore"):  # what is not finite is not within reach either
        keep = np.logical_and.reduce([np.abs(xyz[:, axis]) <= FARTHEST_M for axis in range(3)])
    keep &= (xyz[:, 0] != 0) | (xyz[:, 1] != 0) | (xyz[:, 2] != 0)
    if keep.all():
        chosen: NDArray[np.intp] | slice = slice(None)
    else:
        chosen = np.flatnonzero(keep)
        xyz = xyz[chosen]

    def first(names: tuple[str, ...]) -> Column | None:
        return next((columns[name][chosen] for name in names if name in columns), None)

    intensity, ring, time = first(INTENSITY), first(RING), first(TIME)
    return PointCloud(
        xyz,
        None if intensity is None else unit_intensity(intensity),
        None if ring is None else _whole(ring),
        None if time is None else seconds_after(time, stamp_ns),
    )


def unit_intensity(values: Column) -> NDArray[np.float32]:
    """Intensities of any type and scale as float32 in 0..1, by the rule at the head of this module."""
    if values.dtype == np.uint8:
        return values.astype(np.float32) / np.float32(255)
    with np.errstate(over="ignore", invalid="ignore"):
        found = values.astype(np.float32)
    if not np.isfinite(found).all():
        found = np.where(np.isfinite(found), found, np.float32(0))
    if not len(found):
        return found
    nominal, counts = (int(share * (len(found) - 1)) for share in (NOMINAL_SHARE, COUNTS_SHARE))
    ordered = np.partition(found, (nominal, counts))
    if values.dtype.kind != "f" or ordered[nominal] > 1:
        found /= np.maximum(ordered[counts], np.float32(255))
    return np.clip(found, 0, 1, out=found)


def _whole(values: Column) -> NDArray[np.uint16] | None:
    if values.dtype.kind == "f" and not (np.isfinite(values).all() and (values == np.floor(values)).all()):
        return None
    if len(values) and not (values.min() >= 0 and values.max() <= np.iinfo(np.uint16).max):
        return None
    return values.astype(np.uint16)


def seconds_after(values: Column, stamp_ns: int) -> NDArray[np.float32] | None:
    """Times of points in seconds after the stamp of the sweep, or None where they tell nothing.

    The unit is the first of these in which the points span at most :data:`LONGEST_SWEEP_S`: that of a clock
    counted from 1970, by the size of the numbers (s, ms, us or ns); ns for integers; s, ms, us, ns for
    floats. Clocks from 1970 are told relative to ``stamp_ns``, others count from it. Where that puts the
    first point further from the stamp than a sweep lasts, the clock is another one (another epoch, the
    sensor's uptime) and times count from the earliest point. Times that are all equal (a converter's filler),
    not finite, coarser than :data:`COARSEST_S`, or that make no sweep in any unit say nothing.

    Args:
        values: (N,), any integer or float type.
        stamp_ns: Stamp of the sweep, ns.
    """
    if not len(values):
        return np.empty(0, np.float32)
    real = values.dtype.kind == "f"
    if real and not np.isfinite(values).all():
        return None
    low, high = values.min().item(), values.max().item()
    if low == high:
        return None
    since_1970 = next((ns for least, ns in _CLOCKS if low >= least), None) if low >= _UPTIME[real] else None
    units = (*(() if since_1970 is None else (since_1970,)), *((10**9, 10**6, 10**3, 1) if real else (1,)))
    unit = next((ns for ns in units if (high - low) * ns <= LONGEST_SWEEP_S * 1e9), None)
    if unit is None or (real and float(np.spacing(values.max())) * unit > COARSEST_S * 1e9):
        return None
    origin = math.floor(low)  # whole units: the difference is taken first, so that nothing rounds
    after_ns = _since(values, origin)
    after_ns *= unit
    first_ns = origin * unit - (stamp_ns if unit == since_1970 else 0)
    offset_ns = -float(after_ns.min()) if abs(first_ns) > LONGEST_SWEEP_S * 1e9 else float(first_ns)
    after_ns += offset_ns
    after_ns *= 1e-9
    return after_ns.astype(np.float32)


def _since(values: Column, origin: int) -> NDArray[np.float64]:
    """``values - origin`` without rounding or overflow: their span is known to be small."""
    if values.dtype.kind == "f":
        return np.subtract(values, float(origin), dtype=np.float64)
    wide = np.uint64 if values.dtype.kind == "u" else np.int64
    return np.subtract(values, wide(origin), dtype=wide).astype(np.float64)
