"""sensor_msgs/CameraInfo: intrinsics of raw and of rectified images.

R and the last column of P are never used: both describe the motion from the camera to a rectified stereo
frame, and that motion is part of the extrinsic that the rig or tf states for the frame of the images.
"""

from collections.abc import Sequence

import numpy as np
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__CameraInfo as RosCameraInfo
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__RegionOfInterest as RegionOfInterest

from monitor.messages import CameraInfo, Codec, Decoded, Message, ros
from pipeline.cameras import lens_models
from pipeline.errors import InputError
from pipeline.records import CameraModel, Floats

TYPE = "sensor_msgs/msg/CameraInfo"

_COEFFICIENTS = {"pinhole": 0, "plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}
"""How many coefficients each model reads; a message may leave trailing ones out, and what follows must be
zero."""

_FISHEYE = "equidistant"
"""Bends without coefficients too: r = f theta."""

_SYNONYMS = {"": "plumb_bob", "none": "pinhole", "fisheye": "equidistant", "kannala_brandt": "equidistant"}


def decode(message: Message) -> tuple[Decoded, ...]:
    """K and D for raw images, P[:, :3] for rectified ones; both with binning and region of interest applied.

    Raises:
        InputError: No CameraInfo, K without a focal length (an uncalibrated camera), or an unknown lens.
    """
    msg = ros.deserialize(message, RosCameraInfo, TYPE)
    crop = _crop(msg)
    size = (msg.width, msg.height)
    raw = camera_model(msg.distortion_model, msg.k.reshape(3, 3), msg.d, size)
    rectified = rectified_model(msg.p.reshape(3, 4), size)
    info = CameraInfo(_cropped(raw, crop), None if rectified is None else _cropped(rectified, crop))
    return (Decoded(ros.stamp_ns(msg.header.stamp), ros.frame_name(msg.header.frame_id), info),)


def camera_model(name: str, K: Floats, D: Sequence[float] | Floats, size: tuple[int, int]) -> CameraModel:
    """The camera that a message's K, D and name of the distortion describe.

    Coefficients that are all zero, or absent, make a pinhole of any lens but a fisheye.

    Args:
        name: Name of the distortion model, of ROS or Foxglove.
        K: float64 (3,3), px.
        D: Coefficients in OpenCV's order.
        size: (width, height), px.

    Raises:
        InputError: The lens is not known, or K, D or the size is not a camera's.
    """
    coefficients = np.array(D, np.float64)
    if not np.isfinite(coefficients).all():
        raise InputError(f"distortion D {coefficients.tolist()} is not finite")
    model = _SYNONYMS.get(name, name)
    if model not in _COEFFICIENTS:
        raise InputError(
            f"distortion model '{name}' is not known", hint=f"known: {', '.join(sorted(lens_models()))}"
        )
    used = _COEFFICIENTS[model]
    if np.any(coefficients[used:]):
        raise InputError(
            f"distortion model '{name}' has {used} coefficients, D has {len(coefficients)}",
            hint="a thin prism or tilted sensor is not modelled: calibrate with one of the known models",
        )
    coefficients = coefficients[:used]
    if not coefficients.any() and model != _FISHEYE:
        model, coefficients = "pinhole", np.empty(0)
    return CameraModel(model, np.array(K, np.float64), coefficients, *size)


def rectified_model(P: Floats, size: tuple[int, int]) -> CameraModel | None:
    """The pinhole of P[:, :3] (3,4), or None where P is zero: the camera was never rectified."""
    return CameraModel("pinhole", np.array(P[:, :3], np.float64), np.empty(0), *size) if np.any(P) else None


def encode_camera_info(camera: CameraModel, stamp_ns: int, frame: str) -> bytes:
    """A CameraInfo in CDR: ``camera`` for raw images and, where it is a pinhole, for rectified ones too.

    Args:
        camera: Intrinsics.
        stamp_ns: Stamp, ns.
        frame: Frame id of the camera.
    """
    pinhole = camera.model == "pinhole"
    P = np.zeros((3, 4))
    if pinhole:
        P[:, :3] = camera.K
    msg = RosCameraInfo(
        header=ros.header(stamp_ns, frame),
        height=camera.height,
        width=camera.width,
        distortion_model="plumb_bob" if pinhole else camera.model,
        d=np.zeros(5) if pinhole else np.array(camera.D),
        k=np.array(camera.K).reshape(-1),
        r=np.eye(3).reshape(-1),
        p=P.reshape(-1),
        binning_x=0,
        binning_y=0,
        roi=RegionOfInterest(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )
    return ros.serialize(msg, TYPE)


def _crop(msg: RosCameraInfo) -> tuple[int, int, int, int, int, int]:
    """(x, y, width, height, binning x, binning y) of the delivered image on the full sensor."""
    roi = msg.roi
    whole = roi.width == 0 or roi.height == 0  # the message's own way to say: no region
    x, y, width, height = (
        (0, 0, msg.width, msg.height) if whole else (roi.x_offset, roi.y_offset, roi.width, roi.height)
    )
    if x + width > msg.width or y + height > msg.height:
        raise InputError(
            f"region {width}x{height} at ({x}, {y}) leaves the sensor of {msg.width}x{msg.height} px"
        )
    return x, y, width, height, max(1, msg.binning_x), max(1, msg.binning_y)


def _cropped(camera: CameraModel, crop: tuple[int, int, int, int, int, int]) -> CameraModel:
    """The camera of the delivered image: pixel u of it covers sensor px ``x + b u .. x + b u + b - 1``."""
    x, y, width, height, bin_x, bin_y = crop
    if (x, y, width, height, bin_x, bin_y) == (0, 0, camera.width, camera.height, 1, 1):
        return camera
    shift = np.array(
        [
            [1 / bin_x, 0, -(x + (bin_x - 1) / 2) / bin_x],
            [0, 1 / bin_y, -(y + (bin_y - 1) / 2) / bin_y],
            [0, 0, 1],
        ]
    )
    with np.errstate(over="ignore", invalid="ignore"):  # a K that overflows is refused by CameraModel
        K = shift @ camera.K
    return CameraModel(camera.model, K, camera.D, width // bin_x, height // bin_y)


CODECS: dict[str, Codec] = {TYPE: decode}
