"""Every setting of the algorithms in one tree; each stage describes its own, with unit and reason."""

from dataclasses import dataclass, field

from pipeline.causes import CauseParameters
from pipeline.drift_test import DriftTestParameters
from pipeline.edge_parameters import EdgeParameters
from pipeline.edge_witness import EdgeWitnessParameters
from pipeline.masks import MaskParameters
from pipeline.scene_sum import SceneSumParameters
from pipeline.scene_track import TrackParameters
from pipeline.shock import ShockParameters
from pipeline.traces import TraceParameters
from pipeline.verdict import VerdictParameters
from pipeline.window import WindowParameters


@dataclass(frozen=True, slots=True)
class Parameters:
    """Settings of one pair's pipeline.

    Attributes:
        edges: What counts as an edge of the cloud.
        edge_witness: How edges are compared with the image.
        masks: How the network's probabilities become masks.
        lines_every_ns: Time between frames that get masks and lines: the network takes 0.1 s of two cores,
            and lines of neighbouring frames are the same lines.
        window: Which frames stay, and when they are judged.
        test: Thresholds of the drift test.
        scenes: How all scenes of a drive are summed, and how often a false alarm may come.
        causes: How a moved mount is told from clocks and lens.
        track: How fast a wandering mount is followed over scenes.
        shock: When a sudden move is looked for, and when it is believed.
        verdict: Hysteresis and patience.
        traces: How much of the past is kept to tell when a drift began.
        seed: Of the random numbers that RANSAC and the contrast draw.
    """

    edges: EdgeParameters = field(default_factory=EdgeParameters)
    edge_witness: EdgeWitnessParameters = field(default_factory=EdgeWitnessParameters)
    masks: MaskParameters = field(default_factory=MaskParameters)
    lines_every_ns: int = 500_000_000
    window: WindowParameters = field(default_factory=WindowParameters)
    test: DriftTestParameters = field(default_factory=DriftTestParameters)
    scenes: SceneSumParameters = field(default_factory=SceneSumParameters)
    causes: CauseParameters = field(default_factory=CauseParameters)
    track: TrackParameters = field(default_factory=TrackParameters)
    shock: ShockParameters = field(default_factory=ShockParameters)
    verdict: VerdictParameters = field(default_factory=VerdictParameters)
    traces: TraceParameters = field(default_factory=TraceParameters)
    seed: int = 20_260
