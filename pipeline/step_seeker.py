"""Watches the frames of one pair for a step, as they come (``shock``)."""

from collections.abc import Sequence

import numpy as np

from pipeline import se3
from pipeline.belief import Belief
from pipeline.edge_score import EdgeFrame, batch_of, mean_responses
from pipeline.mount import Mount
from pipeline.onset import Onset
from pipeline.opinions import Steady
from pipeline.parameters import Parameters
from pipeline.shock import Alertness, find_shock, heeded, moved, weighed


class StepSeeker:
    """Looks for steps in the frames of one pair, as they come.

    Args:
        mount: What is stored of the pair.
        parameters: Settings.
    """

    def __init__(self, mount: Mount, parameters: Parameters) -> None:
        self._mount = mount
        self._settings = parameters.edge_witness
        self._parameters = parameters.shock
        self._budget = parameters.scenes.budget
        self._alertness = Alertness()

    @property
    def due(self) -> bool:
        """Whether a judgement should not wait: frames enough have come since what may be a step."""
        return self._alertness.after >= self._parameters.least_frames

    def forget(self) -> None:
        """The frames to come have nothing to do with those before."""
        self._alertness = Alertness()

    def see(self, frame: EdgeFrame, belief: Belief | None) -> None:
        """Notes how well a new frame fits what is believed."""
        if belief is None or belief.edges is None or belief.judgement.blind:
            self._alertness = Alertness()
            return
        batch = batch_of([frame], self._mount.camera, self._settings.most_edges)
        response = float(mean_responses(batch, [belief.T_estimated])[0, 0])
        self._alertness = heeded(self._alertness, frame.stamp_ns, response, belief.edges.xi, self._parameters)

    def said(self, frames: Sequence[EdgeFrame], belief: Belief, now_ns: int) -> Steady | None:
        """What the newest frames say of a sudden move, once judgements enough in a row found it."""
        if belief.edges is None:
            return None
        trail, B = belief.edges.trail, se3.vehicle_block(self._mount.R_vehicle_cam)
        args = self._mount.camera, trail.T_stored, B, trail.places, self._settings, self._parameters
        found = find_shock(frames, self._alertness, *args)
        self._alertness = weighed(self._alertness, found, self._budget, self._parameters)
        if found is None or self._alertness.found < self._parameters.confirmations:
            return None
        surely = moved(found, self._budget)
        return Steady(
            alarming=surely,
            suspicious=True,
            drift=B @ found.xi,
            sigma=np.sqrt(np.diag(B @ found.covariance @ B.T)),
            over=f"the last {(now_ns - found.since_ns) / 1e9:.1f} s",
            onset=Onset(found.since_ns, found.before_ns, found.since_ns),
            timed=not surely,
        )
