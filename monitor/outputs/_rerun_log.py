"""What a recording holds, as entities of rerun: the only module that imports it; loaded by an open recording.

Entities per pair: ``image`` (the picture), ``image/masks``, ``image/lines``, ``image/stored`` and
``image/estimated`` (cloud, edges of range and matched lines, projected by our lens model); ``lidar/points``,
``lidar/lines`` and the camera under both extrinsics; ``drift/<axis>``; ``state`` and ``log``.
"""

from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from monitor.events import FrameEvent
from monitor.outputs._pipe_to_file import PipeToFile
from monitor.status import AXIS_NAMES, STATES, AxisName, Status, unit_of
from pipeline import labels, se3
from pipeline.cameras import project, raw_pixels
from pipeline.records import Floats, Masks

_STORED_RGB = (255, 120, 0)
_ESTIMATED_RGB = (60, 190, 255)
_IMAGE_LINE_RGB = (255, 255, 255)
_STATE_RGB = {
    "starting": (135, 150, 166),
    "healthy": (31, 138, 84),
    "suspect": (224, 154, 26),
    "drifted": (198, 40, 40),
    "unobservable": (105, 114, 125),
    "stale": (74, 91, 128),
    "fault": (123, 45, 139),
}
_SERIES = ("drift", "+2 sigma", "-2 sigma", "+limit", "-limit")
_SERIES_RGB = ((22, 104, 168), (140, 180, 210), (140, 180, 210), (198, 40, 40), (198, 40, 40))
_SERIES_WIDTHS = (2.0, 1.0, 1.0, 1.0, 1.0)

_JPEG_QUALITY = 85
_MOST_POINTS = 12_000
"""points of a cloud that are kept: twice in the image and once in space they take 0.4 MB."""
_MASK_OPACITY = 0.45
_LINE_SAMPLES = 24
"""points along a line: a wide lens bends it."""
_FRUSTUM_M = 0.6
"""m; how far in front of the camera its picture plane is drawn."""
_FLUSH_TIMEOUT_S = 5.0
"""s; a disk that takes longer than this for the data of one period is as good as lost."""
_CLOSE_TIMEOUT_S = 20.0
"""s; what the end of a file may take."""


class RerunLog:
    """An open file of rerun. OSError where it can not be opened.

    rerun's own file writer raises nothing when the disk fills up, and may hang for ever when it is closed
    after that: its bytes go through a pipe instead.

    Args:
        path: The file.
        vehicle: Name of the vehicle.
    """

    def __init__(self, path: Path, vehicle: str) -> None:
        self._rec = rr.RecordingStream("calibwatch")
        self._rec.set_log_time_enabled(enabled=False)
        self._rec.set_log_tick_enabled(enabled=False)
        self._pipe = PipeToFile(path)
        try:
            self._rec.save(self._pipe.source)
        except RuntimeError as error:
            raise OSError(f"rerun can not write: {error}") from error
        finally:
            self._pipe.opened()
        self._rec.send_recording_name(vehicle)
        self._pairs: list[str] = []
        self._states: dict[str, str] = {}
        self._latest_ns = 0

    def status(self, status: Status) -> None:
        """Drift of every axis with its limits; the state where it changed."""
        self._known(status.pair)
        self._at(status.stamp_ns)
        for name, axis in status.drift.items():
            value = axis.value if axis.observable and axis.value is not None else np.nan
            sigma = axis.sigma if axis.observable and axis.sigma is not None else np.nan
            limit = axis.alert_limit
            row = [value, value + 2 * sigma, value - 2 * sigma, limit, -limit]
            self._rec.log(_path(status.pair, "drift", name), rr.Scalars(row))
        if self._states.get(status.pair) != status.state:
            self._states[status.pair] = status.state
            self._rec.log(_path(status.pair, "state"), rr.StateChange(state=status.state))
            level = "INFO" if status.state in ("starting", "healthy") else "WARN"
            text = f"{status.state}: {status.reason}"
            self._rec.log(
                _path(status.pair, "log"), rr.TextLog(text, level=level, color=_STATE_RGB[status.state])
            )

    def frame(self, frame: FrameEvent) -> None:
        """Picture, masks, cloud and lines of one frame."""
        self._known(frame.pair)
        self._at(frame.stamp_ns)
        _, jpeg = cv2.imencode(".jpg", frame.image.pixels, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))
        picture = rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg")
        self._rec.log(_path(frame.pair, "image"), picture)
        masks = _path(frame.pair, "image", "masks")
        if frame.masks is None:
            self._rec.log(masks, rr.Clear(recursive=False))
        else:
            classes = _classes(frame.masks, frame.image.size)
            self._rec.log(masks, rr.SegmentationImage(classes, opacity=_MASK_OPACITY))
        seen = [
            raw_pixels(frame.camera, _samples(match.image.start, match.image.end)) for match in frame.matches
        ]
        self._strips(_path(frame.pair, "image", "lines"), seen, _IMAGE_LINE_RGB)
        self._projected(frame, "stored", frame.T_stored, _STORED_RGB)
        if frame.T_estimated is not None:
            self._projected(frame, "estimated", frame.T_estimated, _ESTIMATED_RGB)
        self._space(frame)

    def note(self, level: str, text: str) -> None:
        """A line in the log of every pair, at the latest stamp."""
        self._at(self._latest_ns)
        for pair in self._pairs or ["run"]:
            self._rec.log(_path(pair, "log"), rr.TextLog(text, level=level))

    def flush(self) -> None:
        """Hands all data to the file; OSError where the file is lost."""
        try:
            self._rec.flush(timeout_sec=_FLUSH_TIMEOUT_S)
        except (RuntimeError, ValueError) as error:
            raise OSError(str(error)) from error
        if self._pipe.error is not None:
            raise OSError(str(self._pipe.error)) from self._pipe.error

    def close(self) -> None:
        """Ends the file; OSError where it is not whole."""
        self._rec.disconnect()
        if not self._pipe.join(_CLOSE_TIMEOUT_S):
            raise OSError(f"the disk took more than {_CLOSE_TIMEOUT_S:.0f} s for the end of the file")
        if self._pipe.error is not None:
            raise OSError(str(self._pipe.error)) from self._pipe.error

    def _at(self, stamp_ns: int) -> None:
        """Everything that this thread logs from here on has this stamp."""
        self._latest_ns = stamp_ns
        self._rec.set_time("stamp", timestamp=np.datetime64(stamp_ns, "ns"))

    def _projected(self, frame: FrameEvent, name: str, T: Floats, colour: tuple[int, int, int]) -> None:
        """The cloud, its edges and the matched lines in the image under one extrinsic."""
        for part, cloud, radius in (("cloud", frame.points, 0.7), ("edges", frame.edge_points, 1.8)):
            uv, inside = project(frame.camera, se3.apply(T, _thinned(cloud)))
            path = _path(frame.pair, "image", name, part)
            self._rec.log(path, rr.Points2D(uv[inside].astype(np.float32), colors=colour, radii=radius))
        lines = [
            project(frame.camera, se3.apply(T, _samples(match.cloud.start, match.cloud.end)))[0]
            for match in frame.matches
        ]
        self._strips(_path(frame.pair, "image", name, "lines"), lines, colour)

    def _strips(self, path: str, lines: list[Floats], colour: tuple[int, int, int]) -> None:
        whole = [line[np.isfinite(line).all(axis=1)].astype(np.float32) for line in lines]
        strips = [line for line in whole if len(line) > 1]
        self._rec.log(path, rr.LineStrips2D(strips, colors=colour, radii=1.5))

    def _space(self, frame: FrameEvent) -> None:
        """Cloud, lines and both cameras in the frame of the LiDAR."""
        points = _thinned(frame.points)
        if frame.intensity is None:
            grey = np.full(len(points), 160, dtype=np.uint8)
        else:
            grey = (80 + 175 * np.clip(_thinned(frame.intensity), 0.0, 1.0)).astype(np.uint8)
        colours = np.repeat(grey[:, None], 3, axis=1)
        self._rec.log(_path(frame.pair, "lidar", "points"), rr.Points3D(points, colors=colours, radii=0.03))
        lines = frame.cloud_lines or tuple(match.cloud for match in frame.matches)
        strips = [np.stack([line.start, line.end]).astype(np.float32) for line in lines]
        tints = [labels.COLOURS_RGB[_CLASS_OF[line.label]] for line in lines]
        self._rec.log(_path(frame.pair, "lidar", "lines"), rr.LineStrips3D(strips, colors=tints, radii=0.04))
        cameras = [("stored", frame.T_stored, _STORED_RGB)]
        if frame.T_estimated is not None:
            cameras.append(("estimated", frame.T_estimated, _ESTIMATED_RGB))
        for name, T_cam_lidar, colour in cameras:
            T_lidar_cam = se3.inverse(T_cam_lidar)
            path = _path(frame.pair, "lidar", f"camera_{name}")
            self._rec.log(path, rr.Transform3D(translation=T_lidar_cam[:3, 3], mat3x3=T_lidar_cam[:3, :3]))
            pinhole = rr.Pinhole(
                image_from_camera=frame.camera.K,
                resolution=[frame.camera.width, frame.camera.height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=_FRUSTUM_M,
                color=colour,
            )
            self._rec.log(path, pinhole)

    def _known(self, pair: str) -> None:
        """Styles and layout of a pair that comes for the first time."""
        if pair in self._pairs:
            return
        self._pairs.append(pair)
        classes = [
            (labels.OTHER, labels.NAMES[labels.OTHER], (0, 0, 0, 0)),  # lets the picture through
            *(
                (index, labels.NAMES[index], labels.COLOURS_RGB[index])
                for index in (labels.LANE, labels.POLE)
            ),
        ]
        self._rec.log(_path(pair, "image"), rr.AnnotationContext(classes), static=True)
        style = rr.SeriesLines(names=list(_SERIES), colors=list(_SERIES_RGB), widths=list(_SERIES_WIDTHS))
        for name in AXIS_NAMES:
            self._rec.log(_path(pair, "drift", name), style, static=True)
        colours = [_STATE_RGB[state] for state in STATES]
        self._rec.log(
            _path(pair, "state"), rr.StateConfiguration(values=list(STATES), colors=colours), static=True
        )
        self._rec.send_blueprint(_blueprint(self._pairs))
        # Styles are written late and are what a cut file lacks first.
        self.flush()


_CLASS_OF = {"lane": labels.LANE, "pole": labels.POLE, "structure": labels.CONSTRUCTION}


def _path(*parts: str) -> str:
    return rr.new_entity_path(list(parts))


def _thinned(array: NDArray[np.float32]) -> NDArray[np.float32]:
    """Every n-th row, so that not too many are left."""
    return array[:: max(1, -(-len(array) // _MOST_POINTS))]


def _samples(start: Floats, end: Floats) -> Floats:
    share = np.linspace(0.0, 1.0, _LINE_SAMPLES)[:, None]
    return np.asarray(start + share * (end - start), dtype=np.float64)


def _classes(masks: Masks, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Class per pixel of the whole image, 0 where there is none."""
    classes = np.zeros(masks.lane.shape, dtype=np.uint8)
    classes[masks.lane] = labels.LANE
    classes[masks.pole] = labels.POLE
    return np.asarray(cv2.resize(classes, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)


def _blueprint(pairs: list[str]) -> rrb.Blueprint:
    """One tab per pair: picture and space above, drift per axis, states and log below."""
    tabs = [
        rrb.Vertical(
            rrb.Horizontal(
                rrb.Spatial2DView(origin=_path(pair, "image"), name="stored (orange), estimated (blue)"),
                rrb.Spatial3DView(origin=_path(pair, "lidar"), name="LiDAR frame"),
                column_shares=[3, 2],
            ),
            rrb.Horizontal(
                rrb.Grid(*(_drift_view(pair, name) for name in AXIS_NAMES), grid_columns=3),
                rrb.Vertical(
                    rrb.StateTimelineView(origin=_path(pair, "state"), name="state"),
                    rrb.TextLogView(origin=_path(pair, "log"), name="log"),
                ),
                column_shares=[3, 2],
            ),
            row_shares=[1, 1],
            name=pair,
        )
        for pair in pairs
    ]
    return rrb.Blueprint(
        rrb.Tabs(*tabs), rrb.TimePanel(timeline="stamp", state="collapsed"), auto_views=False
    )


def _drift_view(pair: str, name: AxisName) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=_path(pair, "drift", name),
        name=f"{name} [{unit_of(name)}], red: limits",
        plot_legend=rrb.PlotLegend(visible=False),
    )
