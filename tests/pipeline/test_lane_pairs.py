"""Roads with known lines: the true extrinsic is among the candidates, but for the way along the road."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pipeline import se3
from pipeline.errors import InputError
from pipeline.ground import Ground
from pipeline.lane_pairs import LanePairParameters, lane_pair_extrinsics

_spec = importlib.util.spec_from_file_location(
    "semantic_scenes", Path(__file__).parents[1] / "oracles" / "semantic_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)

EXACT = {"sigma_px": 1e-6, "sigma_m": 1e-6}


def road(seed, *, lanes=3, poles=2, **noise):
    """Truth, ground and lines of a road; poles stand upright."""
    rng = np.random.default_rng(seed)
    truth = scenes.truth_of(rng)
    strips, posts = scenes.road(rng, lanes=lanes, poles=poles)
    cloud, image = scenes.lines_of(rng, truth, strips, posts, **noise)
    return truth, level(np.eye(3)), cloud, image


def level(R):
    """The ground of the scenes, seen from a LiDAR turned by R."""
    return Ground(R @ np.array([0.0, 0.0, 1.0]), scenes.HEIGHT, np.zeros(0, dtype=bool))


def turned(lines, R):
    return [dataclasses.replace(line, start=R @ line.start, end=R @ line.end) for line in lines]


def misses(T, truth, ground):
    """Turn in deg and shift across the road in m of each candidate (N,4,4) from the truth."""
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    centre = -truth[:3, :3].T @ truth[:3, 3]
    ahead = np.cross(ground.normal, np.cross(truth[2, :3], ground.normal))
    ahead /= np.linalg.norm(ahead)
    off = centres - centre
    off -= (off @ ahead)[:, None] * ahead
    turn = [np.degrees(se3.rotation_angle(one[:3, :3], truth[:3, :3])) for one in T]
    return np.array(turn), np.linalg.norm(off, axis=1)


def best(T, truth, ground):
    """Of the candidates the one with the least turn: its turn and its shift across."""
    turn, shift = misses(T, truth, ground)
    k = int(np.argmin(turn + 10.0 * shift))
    return turn[k], shift[k]


@pytest.mark.parametrize("seed", range(8))
def test_exact_lines_hold_the_truth_whatever_the_frame_of_the_lidar(seed):
    truth, _, cloud, image = road(seed, **EXACT)
    # The poles of these scenes lean by 0.7 deg, and up is taken from them: no better than that.
    R = se3.exp_so3(np.random.default_rng(seed).normal(0, 1.5, 3))
    T = lane_pair_extrinsics(turned(cloud, R), image, level(R), scenes.CAMERA)
    turn, shift = best(T, truth @ se3.inverse(se3.transform(R, np.zeros(3))), level(R))
    assert turn < 2.0
    assert shift < 0.15


def test_an_upright_pole_gives_the_truth_to_rounding():
    rng = np.random.default_rng(4)
    truth = scenes.truth_of(rng)
    cloud, image = scenes.lines_of(rng, truth, *scenes.road(rng, lanes=2, poles=0), **EXACT)
    foot = np.array([12.0, 3.5, -scenes.HEIGHT])
    ends = se3.apply(truth, np.stack([foot, [*foot[:2], foot[2] + 2.0]]))
    uv = (ends @ scenes.CAMERA.K.T)[:, :2] / ends[:, 2:]
    pole = dataclasses.replace(image[0], label="pole", start=uv[0], end=uv[1])
    T = lane_pair_extrinsics(cloud, [*image, pole], level(np.eye(3)), scenes.CAMERA)
    turn, shift = best(T, truth, level(np.eye(3)))
    assert turn < 1e-3
    assert shift < 1e-3
    assert np.abs(np.einsum("nij,nkj->nik", T[:, :3, :3], T[:, :3, :3]) - np.eye(3)).max() < 1e-9


def test_without_poles_a_level_image_tells_up():
    truth, ground, cloud, image = road(3, poles=0, **EXACT)
    T = lane_pair_extrinsics(cloud, image, ground, scenes.CAMERA)
    turn, _ = best(T, truth, ground)
    # The cameras of these scenes are rolled by a degree or two.
    assert turn < 4.0


def test_noisy_lines_hold_it_within_what_the_edges_bridge():
    found = []
    for seed in range(20):
        truth, ground, cloud, image = road(100 + seed, lanes=4, poles=3)
        turn, shift = best(lane_pair_extrinsics(cloud, image, ground, scenes.CAMERA), truth, ground)
        found.append(turn < 1.5 and shift < 0.3)
    assert np.mean(found) >= 0.95


def test_both_ways_along_the_road_and_only_cameras_above_it_near_the_lidar():
    _, ground, cloud, image = road(5)
    p = LanePairParameters()
    T = lane_pair_extrinsics(cloud, image, ground, scenes.CAMERA, p)
    centres = -np.einsum("nji,nj->ni", T[:, :3, :3], T[:, :3, 3])
    height = centres @ ground.normal + ground.offset
    assert p.height_m[0] <= height.min()
    assert height.max() <= p.height_m[1]
    assert np.linalg.norm(centres, axis=1).max() <= p.baseline_m
    ahead = T[:, 2, 0]
    assert (ahead > 0.5).any()
    assert (ahead < -0.5).any()
    # Up in the image is up in the world, to 45 deg.
    assert (-T[:, 1, :3] @ ground.normal > np.cos(p.upright) - 1e-9).all()


@pytest.mark.parametrize("lacking", ["image", "cloud", "both", "one"])
def test_too_few_lanes_give_no_candidates(lacking):
    _, ground, cloud, image = road(6)
    lanes = [line for line in image if line.label == "lane"]
    kept = {
        "image": (cloud, [line for line in image if line.label == "pole"]),
        "cloud": ([line for line in cloud if line.label == "pole"], image),
        "both": ([], []),
        "one": (cloud, lanes[:1]),
    }[lacking]
    assert lane_pair_extrinsics(*kept, ground, scenes.CAMERA).shape == (0, 4, 4)


def test_one_line_twice_is_no_road():
    _, ground, cloud, image = road(7)
    lanes = [line for line in image if line.label == "lane"]
    assert len(lane_pair_extrinsics(cloud[:1] * 3, image, ground, scenes.CAMERA)) == 0
    assert len(lane_pair_extrinsics(cloud, lanes[:1] * 3, ground, scenes.CAMERA)) == 0


def test_a_thousand_lines_are_bounded():
    rng = np.random.default_rng(8)
    _, ground, cloud, image = road(8)
    p = LanePairParameters()
    many = [
        dataclasses.replace(line, start=line.start + rng.normal(0, 1e-3, 3))
        for line in cloud
        for _ in range(200)
    ]
    T = lane_pair_extrinsics(many, image * 100, ground, scenes.CAMERA, p)
    views = p.image_lanes * (p.image_lanes - 1) / 2 * (p.image_poles + 1)
    assert len(T) <= views * p.cloud_lanes * (p.cloud_lanes - 1) * 2


@pytest.mark.parametrize("bad", [{"image_lanes": 1}, {"cloud_lanes": 1}, {"image_poles": -1}])
def test_parameters_that_leave_no_pair_are_refused(bad):
    with pytest.raises(InputError, match="below"):
        LanePairParameters(**bad)
