"""What the engine hands to its outputs: every event goes to every output, in order, from one thread."""

from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from monitor.candidate_file import CandidateDocument
from monitor.parts import Parts
from monitor.status import Status
from pipeline.records import (
    CameraImage,
    CameraModel,
    CloudLine,
    Floats,
    ImageLine,
    LineMatch,
    Masks,
    read_only,
)


@dataclass(frozen=True, slots=True, eq=False)
class StatusEvent:
    """A status is due: once a second, and at each change."""

    status: Status


@dataclass(frozen=True, slots=True, eq=False)
class FrameEvent:
    """A frame was used; what was seen in it.

    Attributes:
        pair: Name of the pair.
        stamp_ns: Stamp of the image, ns.
        image: The image as the camera gives it, distorted.
        camera: Its intrinsics.
        masks: Its masks, or None where the frame got none.
        points: float32 (N,3), metres, LiDAR frame, deskewed to the stamp of the image: at least those that
            either extrinsic puts into the image.
        intensity: float32 (N,), 0..1, or None where the sensor gives none.
        edge_points: float32 (M,3), metres, LiDAR frame: points at jumps of range; (0,3): none sought.
        T_stored: float64 (4,4), the stored T_cam_lidar.
        T_estimated: float64 (4,4), the estimated T_cam_lidar, or None while there is no estimate.
        matches: Lines that were matched in this frame.
        cloud_lines: All lines of the cloud, matched or not.
        image_lines: All lines of the (undistorted) image, matched or not.
    """

    pair: str
    stamp_ns: int
    image: CameraImage
    camera: CameraModel
    masks: Masks | None
    points: NDArray[np.float32]
    intensity: NDArray[np.float32] | None
    edge_points: NDArray[np.float32]
    T_stored: Floats
    T_estimated: Floats | None
    matches: tuple[LineMatch, ...] = ()
    cloud_lines: tuple[CloudLine, ...] = ()
    image_lines: tuple[ImageLine, ...] = ()

    def __post_init__(self) -> None:
        for name in ("points", "intensity", "edge_points", "T_stored", "T_estimated"):
            array = getattr(self, name)
            if array is not None:
                object.__setattr__(self, name, read_only(array))


@dataclass(frozen=True, slots=True)
class ProposalEvent:
    """What is proposed for a pair has changed.

    Attributes:
        pair: Name of the pair.
        document: The extrinsic that is proposed, or None: nothing is.
        reason: Why nothing is proposed, one sentence; empty with a document.
    """

    pair: str
    document: CandidateDocument | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class EndEvent:
    """Nothing more comes.

    Attributes:
        complete: Whether the input was read to its end; False: interrupted or failed.
        note: One sentence for people, or empty.
        warnings: What else people should know of this run (what the source lost), one sentence each.
        parts: Which part of the rig has moved, for each LiDAR that several pairs share.
    """

    complete: bool
    note: str = ""
    warnings: tuple[str, ...] = ()
    parts: tuple[Parts, ...] = ()


Event: TypeAlias = StatusEvent | FrameEvent | ProposalEvent | EndEvent


class Output(Protocol):
    """Something that tells the world. Nothing here may block the engine for longer than a disk write."""

    @property
    def lost(self) -> str | None:
        """One clause that says what was lost for good and why; None while all is well."""

    def handle(self, event: Event) -> None:
        """Takes one event; OSError or CalibwatchError: this output is lost, the run goes on."""

    def close(self) -> None:
        """Frees what it holds; without an EndEvent before it, what was written stays marked as not whole."""
