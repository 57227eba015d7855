"""Sweeps of a spinning sensor in motion through a street of boxes, each beam cast in closed form."""

import math

import numpy as np
from scipy.linalg import expm

from pipeline.records import PointCloud

REACH_M = 60.0
"""m; the farthest return."""


def twist_matrix(omega, velocity):
    """The 4x4 generator: its matrix exponential is the pose after a second."""
    w = np.zeros((4, 4))
    w[:3, :3] = [[0, -omega[2], omega[1]], [omega[2], 0, -omega[0]], [-omega[1], omega[0], 0]]
    w[:3, 3] = velocity
    return w


def street(rng, *, length=75.0, recesses=True):
    """Boxes (n,2,3) as lowest and highest corner along a road in x: facades, parked cars, posts."""
    boxes = []
    for side in (-1.0, 1.0):
        x = -length
        while x < length:
            depth = rng.uniform(7.0, 13.0) if recesses else 9.0
            wide = rng.uniform(5.0, 14.0)
            boxes.append(_box(x, x + wide, side * depth, side * (depth + 6.0), 0.0, 9.0))
            x += wide
        for x in np.arange(-length, length, 8.0) if recesses else ():
            boxes.append(_box(x, x + rng.uniform(3.5, 4.5), side * 3.5, side * 5.3, 0.2, 1.5))
            boxes.append(_box(x + 6.0, x + 6.25, side * 6.0, side * 6.25, 0.0, 5.0))
    return np.array(boxes)


def _box(x0, x1, y0, y1, z0, z1):
    return np.array([[x0, min(y0, y1), z0], [x1, max(y0, y1), z1]])


def sweep(
    boxes,
    rng,
    *,
    omega,
    velocity,
    start,
    clockwise=True,
    rings=40,
    columns=600,
    period=0.1,
    noise=0.015,
    carried=None,
    height=1.8,
):
    """One sweep that begins at ``start`` s; ``carried`` (k,2,3) are boxes that move with the sensor.

    The sensor stands at the origin, ``height`` above the ground plane, at time zero. Each column is cast from
    where the sensor is at that moment; beams begin straight back.
    """
    elevation = np.radians(np.linspace(-24.0, 4.0, rings))
    share = (np.arange(columns) + 0.5) / columns
    azimuth = math.pi + (-1.0 if clockwise else 1.0) * 2.0 * math.pi * share
    beams = np.stack(
        [
            np.cos(elevation)[:, None] * np.cos(azimuth),
            np.cos(elevation)[:, None] * np.sin(azimuth),
            np.broadcast_to(np.sin(elevation)[:, None], (rings, columns)),
        ],
        axis=-1,
    )
    generator = twist_matrix(omega, velocity)
    T = np.stack([expm((start + t) * generator) for t in share * period])
    direction = np.einsum("cij,rcj->rci", T[:, :3, :3], beams)
    origin = T[:, :3, 3] + np.array([0.0, 0.0, height])
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(direction[..., 2] < 0, -origin[:, 2] / direction[..., 2], np.inf)
        # Columns that may meet a box, judged in plan with half a metre to spare for the tilt of the sensor.
        level = np.einsum("cij,cj->ci", T[:, :3, :3], beams[rings // 2])[:, :2]
        margin = np.array([[-0.5, -0.5], [0.5, 0.5]])
        for low, high in boxes:
            if np.linalg.norm(np.clip(0.0, low[:2], high[:2])) > REACH_M + 5.0:
                continue
            around = np.stack([low[:2], high[:2]]) + margin
            meets = np.flatnonzero(_entry(*around, origin[:, :2], level, least=-np.inf) < np.inf)
            entry = _entry(low, high, origin[meets], direction[:, meets])
            distance[:, meets] = np.minimum(distance[:, meets], entry)
        for low, high in () if carried is None else carried:
            distance = np.minimum(distance, _entry(low, high, np.array([0.0, 0.0, height]), beams))
    seen = distance < REACH_M
    distance = distance + rng.normal(0.0, noise, distance.shape)
    xyz = beams[seen] * distance[seen][:, None]
    time = np.broadcast_to(share * period, (rings, columns))[seen]
    return PointCloud(xyz.astype(np.float32), time=time.astype(np.float32))


def _entry(low, high, origin, direction, least=0.5):
    near, far = (low - origin) / direction, (high - origin) / direction
    into = np.minimum(near, far).max(axis=-1)
    out = np.maximum(near, far).min(axis=-1)
    return np.where((into < out) & (out > 0.5) & (into > least), into, np.inf)
