"""The drives that are measured: simulated, 64 rings of 1900 columns, 1242x375 px; kept between runs."""

import hashlib
import sys
import tempfile
from pathlib import Path

import numpy as np

import pipeline.simulation
from monitor.simulated_recording import write_drive
from pipeline.records import CameraModel
from pipeline.simulation.drive import DriveParameters
from pipeline.simulation.lidar import spinning
from pipeline.simulation.scene import SceneParameters

SHORT_S = 3.2
"""s; the window of 20 frames is full after two."""

LONG_S = 30.0
"""s; what a replay is measured with. It takes minutes to draw, once."""

_STREET_M = 480.0
"""m; 30 s at 11 m/s, and what is seen at the end."""


def simulated(seconds: float = SHORT_S) -> Path:
    """The recording, written on the first call and whenever the simulation has changed."""
    sources = sorted(Path(next(iter(pipeline.simulation.__path__))).glob("*.py"))
    sources.append(Path(__file__))
    version = hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:12]
    folder = Path(tempfile.gettempdir()) / "calibwatch-bench"
    folder.mkdir(exist_ok=True)
    path = folder / f"simulated-{seconds:g}s-{version}.mcap"
    if not path.exists():
        sys.stderr.write(f"simulating {path}\n")
        K = np.array([[720.0, 0.0, 609.5], [0.0, 720.0, 172.5], [0.0, 0.0, 1.0]])
        camera = CameraModel("pinhole", K, np.zeros(0), 1242, 375)
        scene = SceneParameters() if seconds <= SHORT_S else SceneParameters(length=_STREET_M)
        lidar = spinning(64, 1900)
        write_drive(DriveParameters(seed=7, duration=seconds, scene=scene, lidar=lidar, camera=camera), path)
    return path
