"""How well windows of a drive know the mount, by their length: ``python -m tests.window_results FOLDER``.

Scatter of estimates over the windows of one drive (PROBE 2), and the share of starts far off that come home
(PROBE 6). Edges only, no lines, no motion compensation beyond that of the watch. Markdown goes to stdout.
"""

import dataclasses
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from monitor.daemon import mount_of
from monitor.preparation import prepare
from pipeline import edge_witness, se3
from pipeline.edge_witness import EdgeFrame
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import Floats
from pipeline.watch import Watch
from pipeline.window import WindowParameters
from tests.results import _pairs

LENGTHS = (1, 5, 10)
STARTS = ((1.0, 0.1), (2.0, 0.3))
DRAWS = 24
SEED = 5
HOME = np.array([math.radians(0.1)] * 3 + [0.04] * 3)
"""What counts as come home, on each axis: PROBE 6."""

_EVER = 10**18
_ALL = WindowParameters(
    most_frames=10**6, dense_frames=10**6, brief_ns=_EVER, longest_ns=_EVER, least_frames=10**6
)


def main() -> None:
    """Prints both tables."""
    folder = Path(sys.argv[1])
    names = sys.argv[2:] or ["kitti_raw_0009_a", "kitti_raw_sfnd"]
    drives = {name: _frames(folder / name) for name in names}
    print(
        "| recording | frames | windows | roll pitch yaw (deg) | forward left up (cm), rms about their mean |"
    )
    print("|---|---|---|---|---|")
    for name, (mount, frames) in drives.items():
        for length in LENGTHS:
            _tell_scatter(name, mount, frames, length)
    print("\n| recording | frames | start off on every axis | come home |")
    print("|---|---|---|---|")
    for name, (mount, frames) in drives.items():
        for degrees, metres in STARTS:
            home = _come_home(mount, frames, degrees, metres)
            print(f"| {name} | 10 | {degrees:g} deg, {100 * metres:g} cm | {home} of {DRAWS} |", flush=True)


def _frames(path: Path) -> tuple[Mount, Sequence[EdgeFrame]]:
    """The drive as the edge witness keeps it, every frame."""
    pair = prepare(str(path), None, None).rig.pairs[0]
    mount = mount_of(pair)
    watch = Watch(mount, dataclasses.replace(Parameters(), window=_ALL), None)
    for sensed in _pairs(str(path), pair):
        watch.step(sensed)
    return mount, watch.edge_frames


def _estimate(mount: Mount, frames: Sequence[EdgeFrame], T_stored: Floats) -> Floats:
    """The extrinsic that a window of frames asks for."""
    parameters = Parameters()
    test, settings = parameters.test, parameters.edge_witness
    B = se3.vehicle_block(mount.R_vehicle_cam)
    expectation = mount.expectation(test)
    doubt = B.T @ (expectation.floor + expectation.covariance) @ B
    batch = edge_witness.batch_of(frames, mount.camera, settings.most_edges)
    rng = np.random.default_rng(parameters.seed)
    return se3.retract(T_stored, edge_witness.solve(batch, T_stored, doubt, settings, rng).xi)


def _tell_scatter(name: str, mount: Mount, frames: Sequence[EdgeFrame], length: int) -> None:
    T = mount.T_cam_lidar
    windows = [frames[k : k + length] for k in range(len(frames) - length + 1)]
    drifts = np.array([se3.mount_drift(T, _estimate(mount, w, T), mount.R_vehicle_cam) for w in windows])
    angle, shift = np.split(np.std(drifts, axis=0), 2)
    angles = " ".join(f"{v:.2f}" for v in np.degrees(angle))
    shifts = " ".join(f"{v:.1f}" for v in 100 * shift)
    print(f"| {name} | {length} | {len(windows)} | {angles} | {shifts} |", flush=True)


def _come_home(mount: Mount, frames: Sequence[EdgeFrame], degrees: float, metres: float) -> int:
    """Starts off by so much on every axis, signs drawn, that end where one from the stored extrinsic ends."""
    rng, T = np.random.default_rng(SEED), mount.T_cam_lidar
    begins = (0, (len(frames) - 10) // 2, len(frames) - 10)
    ends = [_estimate(mount, frames[k : k + 10], T) for k in begins]
    home = 0
    for draw in range(DRAWS):
        off = rng.choice([-1.0, 1.0], 6) * np.array([math.radians(degrees)] * 3 + [metres] * 3)
        begin, end = begins[draw % 3], ends[draw % 3]
        start = se3.displaced(T, off, mount.R_vehicle_cam)
        reached = _estimate(mount, frames[begin : begin + 10], start)
        home += bool((np.abs(se3.local(end, reached)) < HOME).all())
    return home


if __name__ == "__main__":
    main()
