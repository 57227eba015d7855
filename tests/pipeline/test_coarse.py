import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pipeline import se3
from pipeline.coarse import CoarseParameters, CoarseSolution, NoCoarse, coarse_extrinsic
from pipeline.errors import InputError
from pipeline.height_maps import HeightMaps, height_maps
from pipeline.line_triples import TripleParameters
from pipeline.records import CloudLine, ImageLine
from pipeline.semantic_cost import SemanticPoints

_spec = importlib.util.spec_from_file_location(
    "semantic_scenes", Path(__file__).parents[1] / "oracles" / "semantic_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)

CAMERA = scenes.CAMERA
UP = np.array([0.0, 0.0, 1.0])


@dataclasses.dataclass
class Scene:
    truth: np.ndarray
    cloud: list
    image: list
    points: SemanticPoints
    maps: HeightMaps

    def solve(self, **changes):
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        up, parameters = changes.pop("up", None), changes.pop("parameters", None)
        given.update(changes)
        return coarse_extrinsic(
            given["cloud"],
            given["image"],
            given["points"],
            given["maps"],
            CAMERA,
            up=up,
            parameters=parameters,
        )

    def errors(self, solution):
        T = solution.T_cam_lidar
        return (
            np.degrees(se3.rotation_angle(T[:3, :3], self.truth[:3, :3])),
            np.linalg.norm(T[:3, 3] - self.truth[:3, 3]),
        )


def make(seed, *, lanes=3, poles=3, sigma_px=1.0, sigma_m=0.03):
    rng = np.random.default_rng(seed)
    truth = scenes.truth_of(rng)
    strips, posts = scenes.road(rng, lanes=lanes, poles=poles)
    cloud, image = scenes.lines_of(rng, truth, strips, posts, sigma_px=sigma_px, sigma_m=sigma_m)
    points = scenes.points_of(rng, strips, posts)
    masks = scenes.masks_of(truth, strips, posts)
    return Scene(truth, cloud, image, points, height_maps(masks, CAMERA, "plateau"))


@pytest.fixture(scope="module")
def scene():
    return make(7)


def turned(scene, frame):
    """The same scene with the LiDAR's frame moved: p' = frame p."""
    cloud = [
        dataclasses.replace(
            line, start=se3.apply(frame, line.start[None])[0], end=se3.apply(frame, line.end[None])[0]
        )
        for line in scene.cloud
    ]
    points = SemanticPoints(
        *(se3.apply(frame, xyz).astype(np.float32) for xyz in (scene.points.lane, scene.points.pole))
    )
    return Scene(scene.truth @ se3.inverse(frame), cloud, scene.image, points, scene.maps)


def test_roads_with_two_lanes_and_a_pole_are_solved_without_a_prior():
    """At 1 px and 3 cm: within 3 deg and 0.5 m, from any frame of the LiDAR and any order of the lines."""
    rng = np.random.default_rng(1)
    good, fine = [], []
    for seed in range(36):
        made = make(2000 + seed, lanes=int(rng.integers(2, 5)), poles=int(rng.integers(1, 6)))
        labels = [line.label for line in made.image]
        if labels.count("lane") < 2 or "pole" not in labels:
            continue
        frame = se3.transform(se3.exp_so3(rng.normal(0, 1.5, 3)), rng.normal(0, 0.5, 3))
        made = turned(made, frame)
        rng.shuffle(made.cloud)
        rng.shuffle(made.image)
        found = made.solve()
        angle, shift = made.errors(found) if isinstance(found, CoarseSolution) else (180.0, 99.0)
        good.append(angle < 3.0 and shift < 0.5)
        if labels.count("lane") >= 3 and labels.count("pole") >= 2:
            fine.append((angle, shift))
    assert len(good) >= 30
    assert np.mean(good) >= 0.95
    # With lines to spare all of them take part: no single triple is so sharp.
    assert np.median(fine, axis=0)[0] < 0.3
    assert np.median(fine, axis=0)[1] < 0.1


def test_without_noise_the_truth_comes_out():
    made = make(3, sigma_px=1e-6, sigma_m=1e-6)
    found = made.solve()
    angle, shift = made.errors(found)
    assert angle < 0.01
    assert shift < 0.005
    assert found.cost > 1.95
    assert len(found.matches) == len(made.cloud) == len(made.image)
    for match in found.matches:
        k = next(k for k, line in enumerate(made.cloud) if line is match.cloud)
        assert made.image[k] is match.image


def test_more_lines_sharpen_the_answer_of_three():
    alone, together = [], []
    for seed in range(12):
        made = make(4000 + seed, lanes=4, poles=4)
        found = made.solve()
        assert isinstance(found, CoarseSolution)
        assert len(found.matches) > 3
        together.append(made.errors(found))
        few = made.solve(parameters=CoarseParameters(all_lines=3, triples=TripleParameters(2, 1)))
        alone.append(made.errors(few) if isinstance(few, CoarseSolution) else (180.0, 99.0))
    assert (np.median(together, axis=0) < np.median(alone, axis=0)).all()


def test_the_printed_selection_gives_the_printed_enumeration(scene):
    """CRLF: the two largest lanes and the largest pole of the image, n1 (n1 - 1) n2 ways, four roots each."""
    printed = CoarseParameters(triples=TripleParameters(image_lanes=2, image_poles=1))
    found = scene.solve(parameters=printed)
    lanes = sum(line.label == "lane" for line in scene.cloud)
    poles = len(scene.cloud) - lanes
    assert 1 <= found.tried <= 4 * lanes * (lanes - 1) * poles
    angle, shift = scene.errors(found)
    assert angle < 3.0
    assert shift < 0.5
    assert found.tried < scene.solve().tried


def test_candidates_are_ranked_and_differ(scene):
    p = CoarseParameters()
    found = scene.solve(parameters=p)
    np.testing.assert_array_equal(found.candidates[0], found.T_cam_lidar)
    assert found.cost == found.costs[0]
    # Nearly all points are in view, so that J decides.
    assert (found.costs[1:] < found.cost).all()
    assert found.margin > 0
    assert np.isinf(found.margin) == (len(found.costs) == 1)
    for k in range(len(found.candidates)):
        for j in range(k):
            a, b = found.candidates[j], found.candidates[k]
            far = se3.rotation_angle(a[:3, :3], b[:3, :3]) > p.distinct_rad
            assert far or np.linalg.norm(a[:3, 3] - b[:3, 3]) > p.distinct_m
    assert not found.T_cam_lidar.flags.writeable


def test_a_road_that_looks_alike_from_two_places_says_so():
    """Two lanes and two equal pairs of poles 4 m apart along the road: both places fit, J can not tell."""
    rng = np.random.default_rng(8)
    strips = [(1.8, 7.0, 30.0), (-1.8, 7.0, 30.0)]
    truth = scenes.truth_of(rng)
    seen, hidden = (14.0, 5.0, 1.0), (18.0, 5.0, 1.0)
    cloud, _ = scenes.lines_of(rng, truth, strips, [seen, hidden])
    _, image = scenes.lines_of(rng, truth, strips, [seen])
    points = scenes.points_of(rng, strips, [seen, hidden])
    maps = height_maps(scenes.masks_of(truth, strips, [seen]), CAMERA, "plateau")
    found = coarse_extrinsic(cloud, image, points, maps, CAMERA)
    assert found.margin < 0.2
    both = [np.linalg.norm(T[:3, 3] - truth[:3, 3]) for T in found.candidates[:2]]
    assert min(both) < 0.5
    assert max(both) == pytest.approx(4.0, abs=0.6)


@pytest.mark.parametrize("up", [None, UP, np.array([0.5, 0.0, 0.8])])
def test_up_may_be_told_roughly_or_not_at_all(scene, up):
    angle, shift = scene.errors(scene.solve(up=up))
    assert angle < 1.0
    assert shift < 0.3


def test_up_the_wrong_way_finds_no_camera_above_the_road(scene):
    found = scene.solve(up=-UP)
    assert not isinstance(found, CoarseSolution) or found.cost < scene.solve().cost - 0.1


def test_a_pole_that_does_not_tell_up_leaves_both_signs_open():
    """A post that reaches as far below the lanes' plane as above it."""
    made = make(9, poles=2)
    sunk = [
        dataclasses.replace(line, start=line.start + drop, end=line.end + drop)
        if line.label == "pole"
        else line
        for line in made.cloud
        for drop in [np.array([0.0, 0.0, -0.5 * (line.start + line.end)[2] - scenes.HEIGHT])]
    ]
    found = made.solve(cloud=sunk)
    assert isinstance(found, CoarseSolution)
    # The pole's line is the same, however it is cut.
    angle, shift = made.errors(found)
    assert angle < 3.0
    assert shift < 0.5


def only(lines, **most):
    """At most so many lines of each class."""
    return [line for label, count in most.items() for line in [a for a in lines if a.label == label][:count]]


REASONS = {
    "fewer than two lanes in the image": lambda s: {"image": only(s.image, lane=1, pole=3)},
    "no pole in the image": lambda s: {"image": only(s.image, lane=3)},
    "fewer than two lanes in the cloud": lambda s: {"cloud": only(s.cloud, lane=1, pole=3)},
    "no pole in the cloud": lambda s: {"cloud": only(s.cloud, lane=3)},
    "no two parallel lanes apart from each other in the cloud": lambda s: {
        "cloud": only(s.cloud, lane=1) + only(s.cloud, lane=1, pole=3)
    },
    "the image's lanes lie in one plane with the camera": lambda s: {
        "image": only(s.image, lane=1) + only(s.image, lane=1, pole=3)
    },
    "every pole stands dead ahead or in line with the lanes": lambda s: {
        "image": [*only(s.image, lane=3), through_vanishing_point(s)]
    },
    "no correspondence puts the lines in front of an upright camera above the road": lambda _: {
        "parameters": CoarseParameters(triples=TripleParameters(baseline_m=1e-3))
    },
    "no candidate meets the masks": lambda s: {
        "maps": HeightMaps(np.zeros_like(s.maps.lane), np.zeros_like(s.maps.pole), 1.0, 1.0)
    },
}


def through_vanishing_point(scene):
    ahead = scene.truth[:3, 0] @ CAMERA.K.T
    u, v = ahead[:2] / ahead[2]
    return ImageLine("pole", np.array([u, v - 40.0]), np.array([u, v + 40.0]), 1.0)


@pytest.mark.parametrize("reason", REASONS)
def test_a_scene_that_can_not_give_it_says_why(scene, reason):
    found = scene.solve(**REASONS[reason](scene))
    assert isinstance(found, NoCoarse)
    assert found.reason == reason


def test_nothing_at_all_is_an_ordinary_answer(scene):
    none = np.zeros((0, 3), np.float32)
    assert isinstance(scene.solve(cloud=[], image=[]), NoCoarse)
    assert isinstance(scene.solve(image=[]), NoCoarse)
    assert isinstance(scene.solve(points=SemanticPoints(none, none)), NoCoarse)
    broken = [
        CloudLine("lane", np.full(3, np.nan), np.ones(3), np.arange(3), 0.03, 9.0),
        CloudLine("lane", np.ones(3), np.ones(3), np.arange(3), 0.03, 9.0),
        CloudLine("pole", np.ones(3), np.full(3, np.inf), np.arange(3), 0.03, 9.0),
    ]
    point = ImageLine("pole", np.ones(2), np.ones(2), 1.0)
    assert scene.solve(cloud=broken).reason == "fewer than two lanes in the cloud"
    same = scene.solve(cloud=[*scene.cloud, *broken], image=[*scene.image, point])
    np.testing.assert_array_equal(same.T_cam_lidar, scene.solve().T_cam_lidar)


def test_duplicates_and_lines_of_other_classes_change_little(scene):
    other = dataclasses.replace(scene.image[0], label="structure")
    found = scene.solve(cloud=scene.cloud * 2, image=[*scene.image, *scene.image, other])
    angle, shift = scene.errors(found)
    assert angle < 2.0
    assert shift < 0.4


def test_lanes_that_run_on_behind_the_camera_and_poles_there_do_not_matter(scene):
    """A LiDAR that turns fully sees the road behind as well."""
    behind = np.array([-45.0, 0.0, 0.0])
    longer = [
        dataclasses.replace(line, **{back(line): getattr(line, back(line)) + behind}, mean_m=None)
        if line.label == "lane"
        else line
        for line in scene.cloud
    ]
    poles = [
        dataclasses.replace(line, start=line.start + behind, end=line.end + behind)
        for line in scene.cloud
        if line.label == "pole"
    ]
    angle, shift = scene.errors(scene.solve(cloud=[*longer, *poles]))
    assert angle < 3.0
    assert shift < 0.5


def back(line):
    """Name of the rear end of a lane."""
    return "start" if line.start[0] < line.end[0] else "end"


def test_a_thousand_lines_are_bounded(scene):
    rng = np.random.default_rng(11)
    cloud, image = list(scene.cloud), list(scene.image)
    for _ in range(500):
        lane = np.array([rng.uniform(5, 20), rng.uniform(-20, 20), -scenes.HEIGHT])
        cloud.append(scenes.fitted("lane", np.stack([lane, lane + np.array([10, 0, 0])]), rng))
        cloud.append(scenes.fitted("pole", np.stack([lane, lane + np.array([0, 0, 0.9])]), rng))
        u, v = rng.uniform([0, 180], [1242, 375])
        image.append(ImageLine("lane", np.array([u, v]), np.array([u + 20, v + rng.uniform(10, 20)]), 1.0))
        image.append(ImageLine("pole", np.array([u, v - 30]), np.array([u + rng.uniform(-1, 1), v]), 1.0))
    found = scene.solve(cloud=cloud, image=image)
    p = TripleParameters()
    assert found.tried <= 4 * 6 * p.image_poles * p.cloud_lanes * (p.cloud_lanes - 1) * p.cloud_poles
    # Among short lines without number the triple may be another; its J is no worse than that of the true one.
    assert found.cost > scene.solve().cost - 0.3


@pytest.mark.parametrize(
    "bad",
    [
        lambda: CoarseParameters(finalists=0),
        lambda: CoarseParameters(points=0),
        lambda: TripleParameters(image_lanes=1),
        lambda: TripleParameters(cloud_poles=0),
    ],
)
def test_parameters_that_leave_no_triple_are_refused(bad):
    with pytest.raises(InputError, match="below"):
        bad()


def test_lines_that_claim_no_noise_at_all_are_solved():
    """sigma 0, as a drawn map or a simulation gives: the weights stay finite."""
    made = make(3, sigma_px=0.0, sigma_m=0.0)
    cloud = [dataclasses.replace(line, sigma_m=0.0) for line in made.cloud]
    image = [dataclasses.replace(line, sigma_px=0.0) for line in made.image]
    found = made.solve(cloud=cloud, image=image)
    assert isinstance(found, CoarseSolution)
    angle, shift = made.errors(found)
    assert angle < 0.01
    assert shift < 0.005
