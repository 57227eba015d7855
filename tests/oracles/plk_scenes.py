"""The scenes of PLK Table I as rebuilt in FORMULAS H: lines in camera axes, camera, truth, start."""

import numpy as np

from pipeline import se3
from pipeline.plk import LinePairs

K = np.array([[600.0, 0.0, 640.0], [0.0, 600.0, 360.0], [0.0, 0.0, 1.0]])
_SIDE = 1.5 * np.array([0.2, 1.0, 0.1])
_RANDOM_TEN = """1.26,1.53,12.55 .24,1.01,11.41 1.01,.28,9.01 2.85,1.62,9.41 .22,.96,14.49 -.16,-.62,13.42
-2.13,.47,6.92 -1.94,.25,3.87 1.11,.74,10.04 -.44,-.65,8.9 .38,-1.36,12.25 -1.95,-1.81,12.69 3.39,-.28,11.58
.78,1.17,11.78 -1.01,-1.06,5.98 -.66,1.68,5.08 .01,1.31,10.82 -1.46,1.75,9.8 -.97,-1.61,9.52 .25,-.05,7.72"""


def _euler(yaw_deg, pitch_deg, roll_deg):
    turns = np.radians([[0, 0, yaw_deg], [0, pitch_deg, 0], [roll_deg, 0, 0]])
    return se3.exp_so3(turns[0]) @ se3.exp_so3(turns[1]) @ se3.exp_so3(turns[2])


TRUTH = se3.transform((_euler(2, -1, 1.5) @ se3.AXES_CAM_IN_VEHICLE).T, np.array([0.10, -0.25, -0.15]))
START = se3.transform(_euler(5, 5, 5) @ TRUTH[:3, :3], TRUTH[:3, 3] + 0.5)


def scene(name):
    """Ends (N,3), (N,3) of the lines of scene a..e in camera axes."""
    if name in "ab":
        ends = np.array(
            [
                [[-2, -1.5, 6], [-1.5, 2, 7]],
                [[1, -1.8, 5], [3, 0.5, 9]],
                [[-1.5, 1.5, 5], [2.5, 1, 8]],
            ],
            dtype=float,
        )
        if name == "b":
            ends[:, :, 2] = 7 + 0.3 * ends[:, :, 0] + 0.2 * ends[:, :, 1]
        return ends[:, 0], ends[:, 1]
    if name in "cd":
        middle = {"c": [[-2, 0, 6], [0.5, 0, 9], [2, 0, 7]], "d": [[-2, 0, 6], [0, 0, 6.6], [2, 0, 7.2]]}[
            name
        ]
        return np.array(middle) - _SIDE, np.array(middle) + _SIDE
    ends = np.array([[float(x) for x in point.split(",")] for point in _RANDOM_TEN.split()])
    return ends[0::2], ends[1::2]


def pairs_of(name, sigma_px, rng):
    """The scene's lines moved to the LiDAR frame, with noisy image ends."""
    start, end = scene(name)
    R, t = TRUTH[:3, :3], TRUTH[:3, 3]
    image = []
    for points in (start, end):
        uv = points @ K.T
        image.append(uv[:, :2] / uv[:, 2:] + rng.normal(0, sigma_px, (len(uv), 2)))
    covariance = np.broadcast_to(sigma_px**2 * np.eye(2), (len(start), 2, 2))
    return LinePairs((start - t) @ R, (end - t) @ R, image[0], image[1], covariance)
