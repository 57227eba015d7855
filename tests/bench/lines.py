"""What lines cost, each step beside its target: the cloud's, the image's, and the solvers on them."""

from typing import TYPE_CHECKING

import numpy as np

from monitor.evaluated_frames import simulated_frames
from monitor.first_guess import masks_of_network
from monitor.frame_calibration import lines_around
from pipeline.cloud_lanes import find_lanes
from pipeline.cloud_poles import find_poles
from pipeline.coarse import CoarseSolution, NoCoarse, coarse_extrinsic
from pipeline.ground import fit_ground
from pipeline.height_maps import Mode, height_maps
from pipeline.image_lines import find_image_lines
from pipeline.image_segments import find_image_segments
from pipeline.line_witness import find_lines, in_view, solve_lines
from pipeline.mount import Mount
from pipeline.records import FramePair, Masks
from pipeline.segmentation import Segmenter
from pipeline.semantic_cost import RandomSearchParameters, points_in_view, points_of_lines, random_search
from pipeline.structure_lines import find_structure_lines
from tests.bench.dense_crf import least

if TYPE_CHECKING:
    from collections.abc import Callable

TARGETS_MS = {
    "cloud lines": 60.0,
    "image lines": 20.0,
    "coarse extrinsic": 100.0,
    "refinement, a frame": 30.0,
    "Algorithm 1, 4 x 2500 samples": 300.0,
}
"""For 120 000 points and 1242x375 px on two cores."""

_MODES: tuple[Mode, Mode] = ("plateau", "ridge")
_WINDOW = 20
"""Frames that one refinement takes in."""
_SEED = 3


def costs(pair: FramePair, masks: Masks, mount: Mount) -> dict[str, float]:
    """Least process time of each step on one frame, ms; NaN where the frame gives the step nothing to do."""
    cloud, camera, T = pair.cloud, mount.camera, mount.T_cam_lidar
    seen = in_view(cloud, camera, T)
    ground = fit_ground(cloud, mount.up, _rng())
    if ground is None:
        raise SystemExit("no ground in the frame that is measured")
    steps: dict[str, Callable[[], object]] = {
        "cloud: ground": lambda: fit_ground(cloud, mount.up, _rng()),
        "cloud: lanes": lambda: find_lanes(cloud, ground, seen, _rng()),
        "cloud: poles": lambda: find_poles(cloud, ground, seen),
        "cloud: structure": lambda: find_structure_lines(cloud, seen, _rng()),
        "image lines": lambda: find_image_lines(pair.image, masks, camera),
        "image segments (LSD)": lambda: find_image_segments(pair.image, camera),
    }
    found = {name: least(step) for name, step in steps.items()}
    found["cloud lines"] = sum(spent for name, spent in found.items() if name.startswith("cloud: "))
    return found | _solvers(pair, masks, mount)


def _solvers(pair: FramePair, masks: Masks, mount: Mount) -> dict[str, float]:
    """Costs of refinement and random search on the lines of one frame."""
    camera, T = mount.camera, mount.T_cam_lidar
    lines = find_lines(
        pair.cloud, pair.image, masks, camera, T, up=mount.up, forward=mount.forward, rng=_rng()
    )
    points = points_of_lines(pair.cloud, lines.cloud_lines)
    plateau, ridge = (height_maps(masks, camera, mode) for mode in _MODES)
    found = {
        "refinement, a frame": float("nan"),
        "Algorithm 1, 4 x 2500 samples": float("nan"),
    }
    if solve_lines([lines] * _WINDOW, camera, T).matches[0]:
        found["refinement, a frame"] = least(lambda: solve_lines([lines] * _WINDOW, camera, T)) / _WINDOW
    visible = points_in_view(points, camera, T)
    if len(visible.lane) and len(visible.pole):
        stages = (plateau, plateau, ridge, ridge)
        settings = RandomSearchParameters()
        found["Algorithm 1, 4 x 2500 samples"] = least(
            lambda: random_search(T, visible, stages, camera, _rng(), settings)
        )
    return found


def coarse_cost(segmenter: Segmenter) -> dict[str, float]:
    """Least process time of the coarse extrinsic, ms, on a drawn street of 12 lanes and 13 poles.

    The frames that are measured else may lack a pole, and giving up is quick and tells nothing.
    """
    frame = next(iter(simulated_frames(1, 0)))
    masks = masks_of_network(segmenter, frame.pair, None)
    image_lines = find_image_lines(frame.pair.image, masks, frame.camera)
    cloud_lines, _ = lines_around(frame, _rng())
    points = points_of_lines(frame.pair.cloud, cloud_lines)
    plateau = height_maps(masks, frame.camera, "plateau")

    def coarse() -> CoarseSolution | NoCoarse:
        return coarse_extrinsic(cloud_lines, image_lines, points, plateau, frame.camera)

    if isinstance(coarse(), NoCoarse):
        raise SystemExit("no coarse extrinsic in the frame that is measured")
    return {"coarse extrinsic": least(coarse)}


def _rng() -> np.random.Generator:
    return np.random.default_rng(_SEED)
