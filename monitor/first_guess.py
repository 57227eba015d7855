"""A first guess of the extrinsic where none is stored, or one that may be far off: before the calibration."""

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from monitor.intake import Intake, pairs_of
from monitor.line_masks import read_masks
from monitor.model_file import open_segmenter
from monitor.preparation import prepare
from monitor.rig import Rig, RigPair
from monitor.sources import open_source
from pipeline import se3
from pipeline.errors import InputError, RigError
from pipeline.masks import horizon_line, masks_from_probabilities
from pipeline.no_prior import FoundExtrinsic, NoExtrinsic, Prior, find_extrinsic
from pipeline.parameters import Parameters
from pipeline.records import CameraModel, Floats, FramePair, Masks
from pipeline.segmentation import Segmenter, grid_scale

MOST_FRAMES = 10
"""Frames of a drive that are tried before the search is given up: some 2 s each."""

SPACING_NS = 500_000_000
"""ns between them: 5 m further on in town other lines are whole and other edges in view."""


@dataclass(frozen=True, slots=True)
class PriorSigma:
    """How far the stored extrinsic may be off, per axis: rad and m."""

    sigma_rad: float
    sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """What the frames of one pair say of its extrinsic.

    Attributes:
        outcome: Of the frame that gave it, or of the last that did not; None: no frame came.
        frames: Frames that were tried.
    """

    outcome: FoundExtrinsic | NoExtrinsic | None
    frames: int


def find_guesses(
    location: str,
    rig: Rig,
    *,
    sigma: PriorSigma | None,
    masks: Sequence[Path],
    model: Path | None,
    stop: threading.Event,
    tell: Callable[[str], None],
) -> Mapping[str, Guess]:
    """The extrinsic of each pair from its first frame that shows it.

    Args:
        location: The recording.
        rig: Its rig; with ``sigma`` every pair has an extrinsic.
        sigma: How far that may be off; None: it is not looked at.
        masks: Mask files of the frames in their order, or none: the network makes masks.
        model: The network's file, or None: the one that ships.
        stop: Ends the search early.
        tell: Told what each frame gave, one sentence each.

    Raises:
        CalibwatchError: Recording, rig, model or a mask can not be used.
    """
    search = _Search(rig, sigma, masks, model, tell)
    intake = Intake(rig)
    with open_source(location) as source:
        for pair in pairs_of(source, intake, stop):
            search.take(pair)
            if search.over:
                break
    return search.guesses


def first_guesses(
    location: str,
    rig_file: Path | None,
    drift: Floats | None,
    *,
    sigma: PriorSigma | None,
    masks: Sequence[Path],
    model: Path | None,
    stop: threading.Event,
    tell: Callable[[str], None],
) -> dict[str, Floats]:
    """First guesses (4,4) by pair, to calibrate from.

    Where a prior is given and nothing better is found around it, its own extrinsic is the guess. Without one
    such a pair is left out.

    Args:
        location: The recording.
        rig_file: Rig file or calib.json, or None: what the recording says.
        drift: float64 (6,), altered into the stored extrinsic, or None.
        sigma: How far the stored extrinsic may be off; None: it is not looked at and need not exist.
        masks: Mask files of the frames in their order, or none: the network makes masks.
        model: The network's file, or None: the one that ships.
        stop: Ends the search early.
        tell: Told what each frame gave, one sentence each.

    Raises:
        CalibwatchError: Recording, rig, model or a mask can not be used.
    """
    rig = prepare(location, rig_file, drift, needs_extrinsic=sigma is not None).rig
    guesses = find_guesses(location, rig, sigma=sigma, masks=masks, model=model, stop=stop, tell=tell)
    found: dict[str, Floats] = {}
    for pair in rig.pairs:
        outcome = guesses[pair.name].outcome
        if isinstance(outcome, FoundExtrinsic):
            found[pair.name] = outcome.T_cam_lidar
        elif sigma is not None and pair.T_cam_lidar is not None:
            found[pair.name] = pair.T_cam_lidar
    return found


class _Search:
    """The frames of a recording on their way through the search."""

    def __init__(
        self,
        rig: Rig,
        sigma: PriorSigma | None,
        masks: Sequence[Path],
        model: Path | None,
        tell: Callable[[str], None],
    ) -> None:
        if masks and len(rig.pairs) != 1:
            raise RigError(
                f"masks are given for a rig of {len(rig.pairs)} pairs", hint="name one pair in a rig file"
            )
        self.guesses = {pair.name: Guess(None, 0) for pair in rig.pairs}
        self._rig = {pair.name: pair for pair in rig.pairs}
        self._sigma = sigma
        self._masks = list(masks)
        self._segmenter = None if masks else open_segmenter(model, _THREADS)
        self._tell = tell
        self._count = dict.fromkeys(self._rig, 0)
        self._last_ns: dict[str, int] = {}

    @property
    def over(self) -> bool:
        """Whether every pair has its extrinsic or no hope of one."""
        return all(
            isinstance(guess.outcome, FoundExtrinsic) or guess.frames >= self._most
            for guess in self.guesses.values()
        )

    @property
    def _most(self) -> int:
        return len(self._masks) or MOST_FRAMES

    def take(self, pair: FramePair) -> None:
        """Tries a frame, if its pair still needs one and it is far enough from the last."""
        number = self._count[pair.pair]
        self._count[pair.pair] += 1
        guess, last_ns = self.guesses[pair.pair], self._last_ns.get(pair.pair)
        near = not self._masks and last_ns is not None and pair.image_stamp_ns - last_ns < SPACING_NS
        if isinstance(guess.outcome, FoundExtrinsic) or guess.frames >= self._most or near:
            return
        self._last_ns[pair.pair] = pair.image_stamp_ns
        rig_pair = self._rig[pair.pair]
        camera = _camera_of(rig_pair, pair)
        prior = _prior_of(rig_pair, self._sigma)
        found = find_extrinsic(
            pair.cloud,
            pair.image,
            self._masks_of(pair, number, camera, prior),
            camera,
            np.random.default_rng([Parameters().seed, number]),
            prior=prior,
        )
        self.guesses[pair.pair] = Guess(found, guess.frames + 1)
        self._tell(f"pair {pair.pair}, frame {number}: {_said(found)}")

    def _masks_of(self, pair: FramePair, number: int, camera: CameraModel, prior: Prior | None) -> Masks:
        up = None if prior is None else _up_of(self._rig[pair.pair], prior.T_cam_lidar)
        horizon = None if up is None else horizon_line(camera, up)
        if self._segmenter is None:
            return read_masks(self._masks[number], camera, horizon)
        return masks_of_network(self._segmenter, pair, horizon)


_THREADS = 2
"""Threads of the network: the cores that the watch counts on."""


def masks_of_network(segmenter: Segmenter, pair: FramePair, horizon: Floats | None) -> Masks:
    """Masks of a frame as the watch makes them; without a horizon paint may lie anywhere."""
    pixels = pair.image.pixels
    return masks_from_probabilities(
        segmenter.probabilities(pixels), pixels, Parameters().masks, horizon, grid_scale(*pair.image.size)
    )


def _camera_of(rig_pair: RigPair, pair: FramePair) -> CameraModel:
    camera = rig_pair.camera.model
    if camera is None:
        raise RigError(f"pair {pair.pair} has no intrinsics", hint="complete the rig file")
    if pair.image.size != (camera.width, camera.height):
        size, wanted = "x".join(map(str, pair.image.size)), f"{camera.width}x{camera.height}"
        raise InputError(
            f"pair {pair.pair}: images are {size} px, the rig says {wanted}",
            hint="give the intrinsics for this size",
        )
    return camera


def _prior_of(rig_pair: RigPair, sigma: PriorSigma | None) -> Prior | None:
    if sigma is None or rig_pair.T_cam_lidar is None:
        return None
    return Prior(rig_pair.T_cam_lidar, sigma.sigma_rad, sigma.sigma_m)


def _up_of(rig_pair: RigPair, T_cam_lidar: Floats) -> Floats:
    """Up (3,), camera axes, by the vehicle frame or the camera itself."""
    return np.asarray(se3.vehicle_axes(T_cam_lidar, rig_pair.T_vehicle_lidar)[2], dtype=np.float64)


def _said(found: FoundExtrinsic | NoExtrinsic) -> str:
    if isinstance(found, FoundExtrinsic):
        return f"an extrinsic is {found.lead:.1f} standard errors ahead of any other"
    return found.reason
