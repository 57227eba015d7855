"""What all scenes of a drive say of the mount: whether it moved by a little, and where it is."""

from collections import deque

import numpy as np

from pipeline import scene_sum, scene_track
from pipeline.belief import Belief
from pipeline.mount import Mount
from pipeline.onset import Onset
from pipeline.opinions import Steady
from pipeline.parameters import Parameters
from pipeline.scene_filter import Scene

_STAMPS = 1024
"""Scenes whose stamps are kept: 20 km; a drift that began before is told to have begun before the data."""


class DriveScenes:
    """The scenes of one drive, summed and followed.

    Args:
        mount: What is stored of the pair.
        parameters: Settings.
    """

    def __init__(self, mount: Mount, parameters: Parameters) -> None:
        self._mount = mount
        self._parameters = parameters
        self.forget()

    def forget(self) -> None:
        """Another drive begins, or another mount is expected."""
        self._expectation = self._mount.expectation(self._mount.thresholds(self._parameters.test))
        self.total = scene_sum.begin(self._expectation)
        self.track = scene_track.begin(self._expectation)
        self._stamps: deque[int] = deque(maxlen=_STAMPS)
        self._begun: tuple[int, float] | None = None

    def hear(self, belief: Belief, way_m: tuple[float, float], now_ns: int) -> None:
        """Hears the window as a scene, once it shares no frame with the last one that was heard.

        Args:
            belief: What the window says.
            way_m: Way driven at its oldest and newest frame, m.
            now_ns: Stamp of the latter.
        """
        oldest_m, newest_m = way_m
        if self._begun is None:
            self._begun = (now_ns, oldest_m)
        seen = belief.edges is not None and not belief.judgement.blind and not belief.judgement.contradicted
        whole = newest_m - self._begun[1] >= scene_sum.NEW_SCENE_M
        if not (seen and whole and scene_sum.is_new(self.total, oldest_m, newest_m)):
            return
        evidence = belief.evidence
        scene = Scene(evidence.drift, evidence.covariance, evidence.feigned, newest_m, now_ns)
        self.total = scene_sum.advance(self.total, scene, self._expectation, self._parameters.scenes)
        self.track = scene_track.followed(self.track, scene, self._expectation, self._parameters.track)
        self._stamps.append(now_ns)

    def said(self) -> Steady | None:
        """What they say of a small steady drift; None before the first."""
        since_ns = self.total.since_ns
        if since_ns is None or self._begun is None:
            return None
        before_ns = max((stamp for stamp in self._stamps if stamp < since_ns), default=self._begun[0])
        return Steady(
            alarming=scene_sum.alarming(self.total, self._parameters.scenes),
            suspicious=scene_sum.suspicious(self.total, self._parameters.scenes),
            drift=self.total.moved,
            sigma=np.sqrt(np.diag(self.total.moved_covariance)),
            over=f"{self.total.scenes} scenes" if self.total.scenes > 1 else "one scene",
            onset=Onset(since_ns, before_ns, since_ns),
        )
