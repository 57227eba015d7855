"""Roads with one painted line: two poles and the line hold the true extrinsic."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pipeline import se3
from pipeline.errors import InputError
from pipeline.ground import Ground
from pipeline.pole_pairs import PolePairParameters, pole_pair_extrinsics
from pipeline.records import CloudLine, ImageLine

_spec = importlib.util.spec_from_file_location(
    "semantic_scenes", Path(__file__).parents[1] / "oracles" / "semantic_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)

UP = np.array([0.0, 0.0, 1.0])
ENDS = {
    "lane": np.array([[7.0, 1.6, -scenes.HEIGHT], [30.0, 1.6, -scenes.HEIGHT]]),
    "left": np.array([[11.0, 4.5, -1.0], [11.0, 4.5, 0.7]]),
    "right": np.array([[14.0, -5.0, -1.0], [14.0, -5.0, 0.9]]),
    "far": np.array([[24.0, 6.0, -1.0], [24.0, 6.0, 1.0]]),
}


def lines(truth, R, rng=None, names=tuple(ENDS)):
    """The lines exactly as they are, from a LiDAR turned by R; with rng 0.4 px and 3 cm off at each end."""
    cloud, image = [], []
    for name in names:
        label = "lane" if name == "lane" else "pole"
        xyz = ENDS[name]
        uv = se3.apply(truth, xyz) @ scenes.CAMERA.K.T
        uv = uv[:, :2] / uv[:, 2:]
        noise = (np.zeros((2, 3)), np.zeros((2, 2)))
        if rng is not None:
            noise = rng.normal(0, 0.03, (2, 3)), rng.normal(0, 0.4, (2, 2))
        turned = (xyz + noise[0]) @ R.T
        cloud.append(CloudLine(label, turned[1], turned[0], np.arange(9), 0.03, 9.0))
        image.append(ImageLine(label, *(uv + noise[1]), 1.0))
    return cloud, image


def ground(R):
    return Ground(R @ UP, scenes.HEIGHT, np.zeros(0, dtype=bool))


def least_miss(T, truth):
    """Turn in deg and shift in m of the candidate that is nearest to the truth."""
    turn = np.array([np.degrees(se3.rotation_angle(one[:3, :3], truth[:3, :3])) for one in T])
    shift = np.linalg.norm(T[:, :3, 3] - truth[:3, 3], axis=1)
    k = int(np.argmin(turn + 10 * shift))
    return turn[k], shift[k]


@pytest.mark.parametrize("seed", range(6))
def test_exact_lines_hold_the_truth_whatever_the_frame_of_the_lidar(seed):
    rng = np.random.default_rng(seed)
    truth, R = scenes.truth_of(rng), se3.exp_so3(rng.normal(0, 1.5, 3))
    cloud, image = lines(truth, R)
    T = pole_pair_extrinsics(cloud, image, ground(R), scenes.CAMERA)
    turn, shift = least_miss(T, truth @ se3.inverse(se3.transform(R, np.zeros(3))))
    assert turn < 1e-6
    assert shift < 1e-6


def test_noisy_lines_hold_it_within_what_the_edges_bridge():
    found = []
    for seed in range(20):
        rng = np.random.default_rng(50 + seed)
        truth = scenes.truth_of(rng)
        cloud, image = lines(truth, np.eye(3), rng)
        turn, shift = least_miss(pole_pair_extrinsics(cloud, image, ground(np.eye(3)), scenes.CAMERA), truth)
        found.append(turn < 2.0 and shift < 0.4)
    assert np.mean(found) >= 0.9


def test_only_upright_cameras_above_the_road_near_the_lidar_are_given():
    truth = scenes.truth_of(np.random.default_rng(3))
    cloud, image = lines(truth, np.eye(3))
    p = PolePairParameters()
    T = pole_pair_extrinsics(cloud, image, ground(np.eye(3)), scenes.CAMERA, p)
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    height = centres @ UP + scenes.HEIGHT
    assert len(T) > 1
    assert np.linalg.norm(centres, axis=1).max() <= p.baseline_m + 1e-9
    assert p.height_m[0] <= height.min()
    assert height.max() <= p.height_m[1]
    assert (-T[:, 1, 2] >= np.cos(p.upright) - 1e-9).all()


@pytest.mark.parametrize(
    "names", [(), ("lane",), ("lane", "left"), ("left", "right"), ("lane", "left", "left")]
)
def test_missing_lines_and_one_pole_twice_give_no_candidates(names):
    truth = scenes.truth_of(np.random.default_rng(4))
    cloud, image = lines(truth, np.eye(3), names=names)
    assert pole_pair_extrinsics(cloud, image, ground(np.eye(3)), scenes.CAMERA).shape == (0, 4, 4)


@pytest.mark.parametrize(
    "bad", [{"image_poles": 1}, {"cloud_poles": 1}, {"image_lanes": 0}, {"cloud_lanes": 0}]
)
def test_parameters_that_leave_no_pair_are_refused(bad):
    with pytest.raises(InputError, match="below"):
        PolePairParameters(**bad)
