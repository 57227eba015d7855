"""The figures in docs/results.md: ``python -m tests.results FOLDER`` with a folder of recordings (DESIGN 11).

Every sequence is judged with its own extrinsic and with ones that are wrong by a known amount, once as it is
and once without its rings; every single frame is calibrated. Markdown goes to stdout. The engine is the one
of ``replay``, without its outputs.
"""

import dataclasses
import math
import sys
import threading
from pathlib import Path

import numpy as np

from monitor.calibrating import Calibration, calibrate
from monitor.daemon import mount_of
from monitor.injection import inject
from monitor.intake import Intake
from monitor.messages import Message
from monitor.model_file import model_bytes
from monitor.preparation import prepare
from monitor.rig import RigPair
from monitor.sources import open_source
from pipeline.parameters import Parameters
from pipeline.records import AXES, FramePair, PointCloud
from pipeline.rings import ring_numbers
from pipeline.segmentation import Segmenter
from pipeline.watch import Watch

SEQUENCES = (
    "kitti_raw_0009_a",
    "kitti_raw_sfnd",
    "kitti_raw_0005_a",
    "kitti_odom_03_a",
    "kitti_raw_0009_mcap/kitti_0009.mcap",
)
WRONG = tuple((axis, sign * 1.0) for axis in AXES[:3] for sign in (1, -1)) + tuple(
    (axis, 0.3) for axis in AXES[3:]
)
HEAD = """| recording | injected | state | told after | roll pitch yaw (deg) | forward left up (m) | T |
|---|---|---|---|---|---|---|"""

CUBE_M = 0.1
"""m; clouds of several sensors are often thinned so before they are passed on."""


def main() -> None:
    """Prints all tables."""
    folder = Path(sys.argv[1])
    what = sys.argv[2:] or ["sequences", "ringless", "singles"]
    segmenter = Segmenter(model_bytes(None))
    for part, rings in (("sequences", True), ("ringless", False)):
        if part in what:
            print("\n" + HEAD)
            for name in SEQUENCES:
                _sequence(folder / name, segmenter, rings=rings)
    if "singles" in what:
        print("\n| frame | error roll pitch yaw (deg) | forward left up (m) | observable | why not |")
        print("|---|---|---|---|---|")
        for calib in sorted(folder.glob("**/calib.json")):
            if not (calib.parent / "2011_09_26").exists():
                _single(calib)


def _pairs(location: str, pair: RigPair) -> list[FramePair]:
    intake = Intake(dataclasses.replace(prepare(location, None, None).rig, pairs=(pair,)))
    pairs: list[FramePair] = []
    with open_source(location) as source:
        for message in source:
            if isinstance(message, Message):
                pairs += intake.take(message)
    return pairs + intake.flush()


def _without_rings(cloud: PointCloud, rng: np.random.Generator) -> PointCloud:
    """The means of all points in each cube of ``CUBE_M``, in no order: neither rings nor times are left."""
    cube = np.floor(cloud.xyz / CUBE_M).astype(np.int64)
    _, which, counts = np.unique(cube, axis=0, return_inverse=True, return_counts=True)

    def means(values: np.ndarray) -> np.ndarray:
        return np.bincount(which.ravel(), values) / counts

    order = rng.permutation(len(counts))
    xyz = np.column_stack([means(column) for column in cloud.xyz.T])[order]
    intensity = None if cloud.intensity is None else means(cloud.intensity)[order].astype(np.float32)
    return PointCloud(xyz.astype(np.float32), intensity)


def _sequence(path: Path, segmenter: Segmenter, *, rings: bool) -> None:
    rig = prepare(str(path), None, None).rig
    pairs = _pairs(str(path), rig.pairs[0])
    if not rings:
        rng = np.random.default_rng(1)
        pairs = [dataclasses.replace(pair, cloud=_without_rings(pair.cloud, rng)) for pair in pairs]
        assert ring_numbers(pairs[0].cloud) is None
    for axis, amount in (("none", 0.0), *WRONG):
        drift = np.zeros(6)
        if axis != "none":
            index = AXES.index(axis)
            drift[index] = math.radians(amount) if index < 3 else amount
        watch = Watch(mount_of(inject(rig.pairs[0], drift)), Parameters(), segmenter)
        told = None
        for number, pair in enumerate(pairs, 1):
            watch.step(pair)
            if told is None and watch.memory is not None and watch.memory.state == "drifted":
                told = number
        watch.finish()
        assert watch.memory is not None
        d, T = np.full(6, np.nan), math.nan
        if watch.belief is not None:
            d, T = watch.belief.judgement.drift, watch.belief.judgement.statistic
        unit = "" if axis == "none" else f"{axis} {amount:+g} {'deg' if axis in AXES[:3] else 'm'}"
        angles = " ".join(f"{v:+.2f}" for v in np.degrees(d[:3]))
        shifts = " ".join(f"{v:+.3f}" for v in d[3:])
        print(
            f"| {path.name} ({len(pairs)} frames) | {unit or 'nothing'} | {watch.memory.state}"
            f"{' (' + watch.memory.code + ')' if told is None else ''} | "
            f"{'' if told is None else f'{told} frames'} | {angles} | {shifts} | {T:.1f} |",
            flush=True,
        )


def _single(calib: Path) -> None:
    folder = calib.parent
    for result in calibrate(
        str(folder), None, None, reference=None, model=None, stop=threading.Event(), progress=None
    ):
        _tell(f"{folder.parent.name}/{folder.name}" if "singles" in str(folder) else folder.name, result)


def _tell(name: str, result: Calibration) -> None:
    def listed(axes: tuple[str, ...], digits: int) -> str:
        found = [result.axes.get(axis) for axis in axes]
        return " ".join(
            "-"
            if f is None
            else f"{f.value if f.error is None else f.error:+.{digits}f}±{f.sigma:.{digits}f}"
            for f in found
        )

    print(
        f"| {name} {result.pair} | {listed(AXES[:3], 2)} | {listed(AXES[3:], 3)} | "
        f"{len(result.observable)}/6 | {'' if len(result.observable) == 6 else result.reason} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
