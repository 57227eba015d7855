"""One recording through decoding and the watch, every stage measured in this process."""

import dataclasses
import resource
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypedDict

import cv2
import numpy as np

from monitor.daemon import mount_of
from monitor.intake import Intake
from monitor.memory import keep_freed
from monitor.messages import Message, decode
from monitor.model_file import model_bytes
from monitor.preparation import prepare
from monitor.sources import open_source
from pipeline.masks import horizon_line, masks_from_probabilities
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import CameraImage, FramePair, PointCloud
from pipeline.segmentation import Segmenter, grid_scale
from pipeline.watch import Watch
from tests.bench import dense_crf, lines
from tests.bench.dense_crf import least

STAGES = {
    "decode cloud": 1.0,
    "decode image": 1.0,
    "motion": 1.0,
    "ground": 1.0,
    "edges": 1.0,
    "gradients": 1.0,
    "information": 1.0,
    "network": 0.2,
    "masks": 0.2,
    "lines": 0.2,
    "judgement": 0.1,
    "inquiry": 0.1,
    "proposal": 0.1,
}
"""Stages and how often each runs per frame: 10 Hz, masks and lines at 2 Hz, a judgement a second."""

_BEGINNING = 12
"""Frames that do not count where there are more: the first 1.2 s, in which windows are short."""

_MOST_FRAMES = 40


class Cost(TypedDict):
    """Of one call, ms."""

    process_ms: float
    wall_ms: float
    calls_per_frame: float


class Measured(TypedDict):
    """What one process found."""

    frames: int
    points: int
    image: str
    stages: dict[str, Cost]
    ratios: dict[str, float]
    lines: dict[str, float]
    peak_mb: float


class _Stopwatch:
    """Process and wall time of every call of every stage."""

    def __init__(self) -> None:
        self.frame = 0
        self.calls: dict[str, list[tuple[int, float, float]]] = defaultdict(list)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        wall, process = time.perf_counter(), time.process_time()
        yield
        spent = time.process_time() - process, time.perf_counter() - wall
        self.calls[name].append((self.frame, 1e3 * spent[0], 1e3 * spent[1]))

    def cost(self, name: str) -> Cost:
        calls = np.array(self.calls[name] or [(0, np.nan, np.nan)])
        settled = calls[calls[:, 0] > _BEGINNING]
        calls = settled if len(settled) else calls
        # Every third sweep is registered, for ten times the cost of the others: the median would hide it.
        middle = np.mean if name == "motion" else np.median
        return Cost(
            process_ms=float(middle(calls[:, 1])),
            wall_ms=float(middle(calls[:, 2])),
            calls_per_frame=STAGES[name],
        )


def measure(location: str, threads: int) -> Measured:
    """All stages of the first pair of a recording, and what its alternatives cost."""
    keep_freed()
    cv2.setNumThreads(threads)
    rig = prepare(location, None, None).rig
    rig = dataclasses.replace(rig, pairs=rig.pairs[:1])
    mount, parameters = mount_of(rig.pairs[0]), Parameters()
    segmenter = Segmenter(model_bytes(None), threads=threads)
    clock = _Stopwatch()
    watch = Watch(mount, parameters, segmenter)
    newest: FramePair | None = None
    for pair in _pairs(location, Intake(rig), clock):
        clock.frame += 1
        watch.step(pair, clock.stage)
        newest = pair
    if newest is None:
        raise SystemExit(f"{location} holds no pair of sweep and image")
    # Read before the alternatives, which hold more than a watch does.
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    stages = {name: clock.cost(name) for name in STAGES}
    ratios = _ratios(stages) if threads == 1 else {}
    if threads == 1:
        ratios |= _of_masks(mount, parameters, segmenter, newest)
        ratios |= _of_judgements(location, mount, parameters, Intake(rig))
    width, height = newest.image.size
    return Measured(
        frames=clock.frame,
        points=len(newest.cloud),
        image=f"{width}x{height}",
        stages=stages,
        ratios=ratios,
        lines=_of_lines(mount, parameters, segmenter, newest) if threads == 1 else {},
        peak_mb=peak_mb,
    )


def _pairs(location: str, intake: Intake, clock: _Stopwatch) -> Iterator[FramePair]:
    """The pairs of a recording; decoding is measured by a call of its own."""
    count = 0
    with open_source(location) as source:
        for message in source:
            if not isinstance(message, Message):
                continue
            before = len(clock.calls["decode"])
            with clock.stage("decode"):
                values = decode(message)
            kinds = {type(one.value) for one in values}
            for kind, name in ((PointCloud, "decode cloud"), (CameraImage, "decode image")):
                if kind in kinds:
                    clock.calls[name].append(clock.calls["decode"][before])
            for pair in intake.take(message):
                yield pair
                count += 1
                if count == _MOST_FRAMES:
                    return
    yield from intake.flush()


def _ratios(stages: dict[str, Cost]) -> dict[str, float]:
    def process(*names: str) -> float:
        return sum(stages[name]["process_ms"] for name in names)

    return {
        "evidence of edges (ground, edges, gradients) / network": process("ground", "edges", "gradients")
        / process("network"),
        "masks with CRF / network": process("masks") / process("network"),
        "decoding / evidence of edges": process("decode cloud", "decode image")
        / process("ground", "edges", "gradients"),
    }


def _of_masks(
    mount: Mount, parameters: Parameters, segmenter: Segmenter, pair: FramePair
) -> dict[str, float]:
    """The masks of one frame with their CRFs, on the network's grid, half of the image's, against none."""
    pixels = pair.image.pixels
    seen = segmenter.probabilities(pixels)
    horizon = horizon_line(mount.camera, mount.T_cam_lidar[:3, :3] @ mount.up)
    plain = dataclasses.replace(parameters.masks, crf=None)
    costs = {
        settings: least(lambda settings=settings: masks_from_probabilities(seen, pixels, settings, horizon))
        for settings in (parameters.masks, plain)
    }
    return {"masks: without CRF / with": costs[plain] / costs[parameters.masks]} | dense_crf.measure(
        seen, pixels, lambda: masks_from_probabilities(seen, pixels, parameters.masks, horizon)
    )


def _of_lines(
    mount: Mount, parameters: Parameters, segmenter: Segmenter, pair: FramePair
) -> dict[str, float]:
    """What lines cost on one frame, with the masks that the watch makes of it."""
    pixels = pair.image.pixels
    horizon = horizon_line(mount.camera, mount.T_cam_lidar[:3, :3] @ mount.up)
    scale = grid_scale(*pair.image.size)
    masks = masks_from_probabilities(
        segmenter.probabilities(pixels), pixels, parameters.masks, horizon, scale
    )
    return lines.costs(pair, masks, mount) | lines.coarse_cost(segmenter)


def _of_judgements(location: str, mount: Mount, parameters: Parameters, intake: Intake) -> dict[str, float]:
    """A window's judgement by as many edges as are looked at, against all of them."""
    every = dataclasses.replace(
        parameters, edge_witness=dataclasses.replace(parameters.edge_witness, most_edges=10**9)
    )
    clocks = {"thinned": _Stopwatch(), "full": _Stopwatch()}
    watches = {"thinned": Watch(mount, parameters, None), "full": Watch(mount, every, None)}
    for pair in _pairs(location, intake, _Stopwatch()):
        for name, watch in watches.items():
            clocks[name].frame += 1
            watch.step(pair, clocks[name].stage)
    thinned, full = (clocks[name].cost("judgement")["process_ms"] for name in ("thinned", "full"))
    return {"judgement: thinned edges / all": thinned / full}
