"""Simulated frames that several files look at, made once a session: each takes a second."""

import pytest

from pipeline.simulation.drive import Drive, DriveParameters


@pytest.fixture(scope="session")
def drive():
    """A street that is driven for a second; frames are made when asked for."""
    return Drive(DriveParameters(seed=5, duration=1.0))


@pytest.fixture(scope="session")
def street(drive):
    """One frame of it: 64 rings of 1800 columns, 960x304 px."""
    return drive.frame(4)
