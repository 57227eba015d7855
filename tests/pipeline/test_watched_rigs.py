"""Rigs of other rings, lenses and axes: a degree is told or suspected, and none that is right is accused."""

import functools
import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from pipeline import se3
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import AXES
from pipeline.watch import Watch

_spec = importlib.util.spec_from_file_location(
    "watched_rigs", Path(__file__).parents[1] / "oracles" / "watched_rigs.py"
)
rigs = importlib.util.module_from_spec(_spec)
sys.modules["watched_rigs"] = rigs  # its dataclasses look themselves up
_spec.loader.exec_module(rigs)

LIMITS = np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.20, 0.15, 0.15])
FRAMES = 14


@functools.cache
def driven(name, seed):
    return rigs.drive_of(rigs.RIGS[name], seed, FRAMES)


def watched(name, seed, drift):
    """A watch that has seen a drive to its end, its mount off by ``drift``, and its states."""
    pairs, T_cam_lidar, T_vehicle_lidar = driven(name, seed)
    mount = Mount(
        camera=rigs.RIGS[name].camera,
        T_cam_lidar=se3.stored_before(T_cam_lidar, drift, T_vehicle_lidar[:3, :3]),
        T_vehicle_lidar=T_vehicle_lidar,
        sigma_rad=math.radians(0.1),
        sigma_m=0.02,
        limits=LIMITS,
        required=("pitch", "yaw"),
    )
    watch, states = Watch(mount, Parameters(), None), []
    for pair in pairs:
        watch.step(pair)
        states.append(watch.memory.state)
    watch.finish()
    return watch, [*states, watch.memory.state]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", rigs.RIGS)
def test_what_is_stored_right_is_not_accused(name, seed):
    watch, states = watched(name, seed, np.zeros(6))
    assert not {"suspect", "drifted"} & set(states), watch.memory.reason
    assert watch.belief.judgement.observable[[1, 2]].all()


@pytest.mark.slow
@pytest.mark.parametrize("axis", range(3), ids=AXES[:3])
@pytest.mark.parametrize("name", rigs.RIGS)
def test_a_degree_is_told_or_suspected(name, axis):
    sign = 1.0 if axis % 2 else -1.0
    drift = sign * math.radians(1.0) * np.eye(6)[axis]
    watch, states = watched(name, 1, drift)
    assert "healthy" not in states
    assert states[-1] in ("suspect", "drifted"), watch.memory.reason
    judgement = watch.belief.judgement
    off = judgement.drift - drift
    assert (np.abs(off) < np.maximum(4.0 * judgement.sigma, [math.radians(0.25)] * 3 + [0.08] * 3)).all()
