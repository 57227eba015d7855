"""Baselines for an evaluation: each drive is judged with what all other drives of its extrinsic taught."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from monitor.baselining import WANTED_S
from monitor.drift_drives import KnownDrive, Place
from pipeline.baseline import Baseline, learn
from pipeline.drive_estimates import Driven
from pipeline.errors import InputError
from pipeline.parameters import Parameters
from pipeline.records import Floats
from pipeline.road_samples import WindowEstimates
from pipeline.segmentation import Segmenter

_SAME_EXTRINSIC = 1e-6
"""Largest difference of any number of two extrinsics that passes as rounding of a file."""


@dataclass(frozen=True, slots=True, eq=False)
class _Taught:
    """What one drive teaches.

    Attributes:
        place: Where it comes from: all pairs of a recording have one street.
        T_cam_lidar: float64 (4,4), its true extrinsic.
        estimates: Of its windows.
    """

    place: str
    T_cam_lidar: Floats
    estimates: WindowEstimates


class OtherDrives:
    """The baselines of an evaluation, learned with nothing wrong and nothing told in other words.

    Args:
        places: Of all drives; each is watched once.
        segmenter: The network.
        parameters: Settings.
        progress: Told each drive, how many are watched, and of how many.
    """

    def __init__(
        self,
        places: Sequence[Place],
        segmenter: Segmenter,
        parameters: Parameters,
        progress: Callable[[str, int, int], None],
    ) -> None:
        self._parameters = parameters
        self._taught: list[_Taught] = []
        for done, place in enumerate(places, 1):
            for drive in place.read():
                driven = Driven(drive.name, drive.mount, parameters, segmenter)
                for frame in drive.frames:
                    driven.step(frame)
                estimates = driven.finish().estimates
                if len(estimates) > 0:
                    self._taught.append(_Taught(place.name, drive.mount.T_cam_lidar, estimates))
            progress(f"baseline from {place.name}", done, len(places))

    def baseline(self, place: str, drive: KnownDrive) -> Baseline:
        """What the drives of other places with the extrinsic of this one taught.

        Raises:
            InputError: There is none.
        """
        others = [
            one.estimates
            for one in self._taught
            if one.place != place
            and np.allclose(one.T_cam_lidar, drive.mount.T_cam_lidar, rtol=0.0, atol=_SAME_EXTRINSIC)
        ]
        if not others:
            raise InputError(
                f"no other drive has the extrinsic of {drive.name} and shows anything",
                hint="name several drives of one rig, or leave --baseline out",
            )
        rng = np.random.default_rng(self._parameters.seed)
        return learn(others, self._parameters.test, WANTED_S, rng)
