"""What the lines of a window may be heard to say: matched well enough, and around the right place."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from pipeline import line_witness, se3
from pipeline.line_witness import LineFrame, LineSolution
from pipeline.records import CameraModel, Floats

_FIT = 1e-3
"""Chance of right pairs to fit each other no better; below it some are wrong, nobody knows which."""

_REACH = 2.5
"""Sigmas of the prior of the matching: an answer beyond it comes from lines taken for each other."""


def match_lines(frames: Sequence[LineFrame], camera: CameraModel, T_cam_lidar: Floats) -> LineSolution | None:
    """The lines of all frames matched around an extrinsic; None where nothing is.

    Args:
        frames: Lines of each frame of the window that has any.
        camera: Intrinsics.
        T_cam_lidar: float64 (4,4), around which they are matched.
    """
    if not frames:
        return None
    solution = line_witness.solve_lines(list(frames), camera, T_cam_lidar)
    return solution if solution.estimate.features > 0 else None


def testifies(lines: LineSolution) -> bool:
    """Whether matched lines may be heard: fitting each other, within reach of the matching."""
    within = bool(np.all(np.abs(lines.estimate.xi) <= _REACH * line_witness.PRIOR_SIGMA))
    return within and lines.fit >= _FIT


def heard(
    near: LineSolution | None,
    frames: Sequence[LineFrame],
    camera: CameraModel,
    T_expected: Floats,
    edges_xi: Floats | None,
) -> LineSolution | None:
    """The lines as they are to be heard, against the expected extrinsic; None where they tell nothing.

    Where edges tell a drift beyond the reach of the matching, and are right, lines are taken for their
    neighbours around the expected extrinsic, and contradict what is right. So they are matched around the
    edges' estimate too, and heard where more of them fit; of as many at both places they tell neither.

    Args:
        near: What :func:`match_lines` gives around the expected extrinsic.
        frames: See there.
        camera: Likewise.
        T_expected: float64 (4,4), the extrinsic that is expected to hold.
        edges_xi: float64 (6,), what the edges tell, against it, camera axes; None where they tell nothing.
    """
    near = near if near is not None and testifies(near) else None
    if edges_xi is None or bool(np.all(np.abs(edges_xi) <= _REACH * line_witness.PRIOR_SIGMA)):
        return near
    T_edges = se3.retract(T_expected, edges_xi)
    far = match_lines(frames, camera, T_edges)
    if far is None or not testifies(far):
        return near
    if near is not None and near.estimate.features >= far.estimate.features:
        return near if near.estimate.features > far.estimate.features else None
    xi = se3.local(T_expected, se3.retract(T_edges, far.estimate.xi))
    return dataclasses.replace(far, estimate=dataclasses.replace(far.estimate, xi=xi))
