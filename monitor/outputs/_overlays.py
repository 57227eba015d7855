"""Overlays of the report: the same place under the stored and under the estimated extrinsic.

A frame is kept compressed, with the points and lines that either extrinsic puts into the image.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from monitor.events import FrameEvent
from monitor.outputs._places import Pixels, Place, best_places, within
from pipeline import se3
from pipeline.cameras import project, raw_pixels
from pipeline.records import CameraModel, Floats, LineMatch

STORED_BGR = (0, 120, 255)
ESTIMATED_BGR = (255, 190, 60)
"""Orange and blue: told apart by colour-blind eyes too."""
_DARK_BGR = (20, 20, 20)
_IMAGE_LINE_BGR = (255, 255, 255)

_KEPT_JPEG_QUALITY = 92
_CROP_JPEG_QUALITY = 82
_OVERVIEW_JPEG_QUALITY = 68
_MOST_POINTS = 20_000
"""points kept of a frame: enough for every place, 240 kB."""
_CROP_SHOWN_PX = 460
"""px; width of a crop as it is shown."""
_OVERVIEW_PX = 860
"""px; largest width of the overview."""
_LINE_SAMPLES = 24
"""points along a line: a wide lens bends it."""


@dataclass(frozen=True, slots=True, eq=False)
class KeptFrame:
    """A frame as the report needs it.

    Attributes:
        stamp_ns: Stamp of the image, ns.
        jpeg: The image.
        camera: Its intrinsics.
        points: float32 (N,3), metres, LiDAR frame: edges of range where there are any, else the cloud.
        T_stored: float64 (4,4).
        T_estimated: float64 (4,4).
        matches: Matched lines.
    """

    stamp_ns: int
    jpeg: bytes
    camera: CameraModel
    points: NDArray[np.float32]
    T_stored: Floats
    T_estimated: Floats
    matches: tuple[LineMatch, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """One place twice, as JPEG."""

    place: Place
    stored: bytes
    estimated: bytes


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """What is shown of one frame: all of it with the places marked, and the places."""

    stamp_ns: int
    overview: bytes
    crops: tuple[Crop, ...]


def keep(event: FrameEvent) -> KeptFrame | None:
    """The frame as the report needs it; None where there is no estimate to compare with."""
    if event.T_estimated is None:
        return None
    points = event.edge_points if len(event.edge_points) else event.points
    inside = np.zeros(len(points), dtype=bool)
    for T in (event.T_stored, event.T_estimated):
        inside |= project(event.camera, se3.apply(T, points))[1]
    points = points[inside]
    points = points[:: max(1, -(-len(points) // _MOST_POINTS))]
    jpeg = _jpeg(event.image.pixels, _KEPT_JPEG_QUALITY)
    return KeptFrame(
        event.stamp_ns, jpeg, event.camera, points, event.T_stored, event.T_estimated, event.matches
    )


def overlay(frame: KeptFrame, most_places: int) -> Overlay:
    """Draws the frame and at most ``most_places`` places of it."""
    image = np.asarray(cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), cv2.IMREAD_COLOR), dtype=np.uint8)
    stored, estimated = _projected(frame)
    places = best_places(image, stored, estimated, most_places)
    crops = tuple(
        Crop(
            place,
            _drawn(image, frame, place, T=frame.T_stored, uv=stored, colour=STORED_BGR),
            _drawn(image, frame, place, T=frame.T_estimated, uv=estimated, colour=ESTIMATED_BGR),
        )
        for place in places
    )
    return Overlay(frame.stamp_ns, _overview(image, stored, estimated, places), crops)


def _projected(frame: KeptFrame) -> tuple[Floats, Floats]:
    """Pixels (M,2) of the points that both extrinsics put into the image."""
    stored, in_stored = project(frame.camera, se3.apply(frame.T_stored, frame.points))
    estimated, in_estimated = project(frame.camera, se3.apply(frame.T_estimated, frame.points))
    both = in_stored & in_estimated
    return stored[both], estimated[both]


def _drawn(
    image: Pixels, frame: KeptFrame, place: Place, *, T: Floats, uv: Floats, colour: tuple[int, int, int]
) -> bytes:
    """One place, enlarged, with points and matched lines under one extrinsic."""
    zoom = _CROP_SHOWN_PX / place.width
    part = image[place.top : place.top + place.height, place.left : place.left + place.width]
    size = (_CROP_SHOWN_PX, max(1, round(place.height * zoom)))
    canvas = cv2.resize(part, size, interpolation=cv2.INTER_CUBIC)

    def shown(pixels: Floats) -> NDArray[np.int32]:
        """Pixels of the image as pixels of the canvas in 1/16."""
        return np.round(((pixels - (place.left, place.top) + 0.5) * zoom - 0.5) * 16).astype(np.int32)

    for match in frame.matches:
        seen = raw_pixels(frame.camera, _samples(match.image.start, match.image.end))
        predicted, _ = project(frame.camera, se3.apply(T, _samples(match.cloud.start, match.cloud.end)))
        for line, tint, thickness in ((seen, _IMAGE_LINE_BGR, 1), (predicted, colour, 2)):
            whole = line[np.isfinite(line).all(axis=1)]
            if len(whole) > 1:
                cv2.polylines(canvas, [shown(whole)], False, tint, thickness, cv2.LINE_AA, 4)  # noqa: FBT003
    for point in shown(uv[within(uv, place.left, place.top, place.width, place.height)]):
        centre = (int(point[0]), int(point[1]))
        cv2.circle(canvas, centre, 56, _DARK_BGR, -1, cv2.LINE_AA, 4)
        cv2.circle(canvas, centre, 40, colour, -1, cv2.LINE_AA, 4)
    return _jpeg(np.asarray(canvas, dtype=np.uint8), _CROP_JPEG_QUALITY)


def _samples(start: Floats, end: Floats) -> Floats:
    share = np.linspace(0.0, 1.0, _LINE_SAMPLES)[:, None]
    return np.asarray(start + share * (end - start), dtype=np.float64)


def _overview(image: Pixels, stored: Floats, estimated: Floats, places: tuple[Place, ...]) -> bytes:
    """The whole image with both sets of points and numbered frames around the places."""
    scale = min(1.0, _OVERVIEW_PX / image.shape[1])
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    canvas = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    for uv, colour in ((stored, STORED_BGR), (estimated, ESTIMATED_BGR)):
        for point in np.round(uv * scale * 16).astype(np.int32):
            cv2.circle(canvas, (int(point[0]), int(point[1])), 20, colour, -1, cv2.LINE_AA, 4)
    for number, place in enumerate(places, start=1):
        first = (round(place.left * scale), round(place.top * scale))
        last = (round((place.left + place.width) * scale) - 1, round((place.top + place.height) * scale) - 1)
        cv2.rectangle(canvas, first, last, _DARK_BGR, 3)
        cv2.rectangle(canvas, first, last, _IMAGE_LINE_BGR, 1)
        where = (first[0] + 5, first[1] + 18)
        cv2.putText(canvas, str(number), where, cv2.FONT_HERSHEY_SIMPLEX, 0.6, _DARK_BGR, 4, cv2.LINE_AA)
        cv2.putText(
            canvas, str(number), where, cv2.FONT_HERSHEY_SIMPLEX, 0.6, _IMAGE_LINE_BGR, 1, cv2.LINE_AA
        )
    return _jpeg(np.asarray(canvas, dtype=np.uint8), _OVERVIEW_JPEG_QUALITY)


def _jpeg(pixels: Pixels, quality: int) -> bytes:
    _, data = cv2.imencode(".jpg", pixels, (cv2.IMWRITE_JPEG_QUALITY, quality))
    return data.tobytes()
