"""Simulated frames that several files look at, made once a session: each takes a second."""

import dataclasses
import math

import numpy as np
import pytest

from pipeline import se3
from pipeline.simulation.drive import START_NS, Drive, DriveParameters


@pytest.fixture(scope="session")
def drive():
    """A street that is driven for a second; frames are made when asked for."""
    return Drive(DriveParameters(seed=5, duration=1.0))


@pytest.fixture(scope="session")
def street(drive):
    """One frame of it: 64 rings of 1800 columns, 960x304 px."""
    return drive.frame(4)


@pytest.fixture(scope="session")
def straight_frames(drive, street):
    """Three frames whose points were brought to the exposure by the true motion, without times."""
    frames = [drive.frame(0), street, drive.frame(8)]
    return tuple(dataclasses.replace(frame, cloud=_straightened(drive, frame)) for frame in frames)


def _straightened(drive, frame):
    """The cloud as it would be if all points had been measured at the exposure."""
    start = (frame.cloud_stamp_ns - START_NS) / 1e9
    moments, which = np.unique(frame.cloud.time, return_inverse=True)
    exposed = np.array([(frame.image_stamp_ns - START_NS) / 1e9])
    back = se3.inverse(drive.T_world_lidar(exposed)[0])
    T = back @ drive.T_world_lidar(start + moments.astype(np.float64))
    xyz = np.einsum("nij,nj->ni", T[which, :3, :3], frame.cloud.xyz) + T[which, :3, 3]
    return dataclasses.replace(frame.cloud, xyz=xyz.astype(np.float32), time=None)


@pytest.fixture(scope="session")
def limits():
    """The default alert limits, rad and m."""
    return np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.20, 0.15, 0.15])
