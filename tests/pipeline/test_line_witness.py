import dataclasses
import importlib.util
import json
import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import chdtrc

from pipeline import labels, se3
from pipeline.line_witness import (
    FRAME_CORRELATION,
    PRIOR_SIGMA,
    LineFrame,
    effective_frames,
    find_lines,
    in_view,
    solve_lines,
)
from pipeline.observability import in_vehicle_axes, observable
from pipeline.records import CameraImage, CameraModel, Masks, PointCloud
from pipeline.simulation.drive import Drive, DriveParameters, Motion
from pipeline.simulation.lidar import spinning
from pipeline.simulation.scene import SceneParameters

_spec = importlib.util.spec_from_file_location(
    "line_scenes", Path(__file__).parents[1] / "oracles" / "line_scenes.py"
)
scenes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenes)

LIMITS = np.array([*np.radians([0.75, 0.5, 0.5]), 0.20, 0.15, 0.15])
R_VC = se3.AXES_CAM_IN_VEHICLE
WIDE = np.array([*np.radians([2.0] * 3), *[0.3] * 3]) / np.sqrt(3.0)
"""Sigma of a start that is anywhere within 2 deg and 0.3 m per axis."""
ASIDE = np.cross(scenes.UP, scenes.FORWARD)


def frame(rng, **kwargs):
    cloud, image = scenes.line_sets(rng, **kwargs)
    return LineFrame(tuple(cloud), tuple(image), (), ASIDE)


def in_axes(estimate):
    drift, information = in_vehicle_axes(estimate.xi, estimate.information, R_VC)
    return drift, observable(information, LIMITS)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_drift_of_two_alert_limits_is_measured_on_its_axis(axis, sign):
    rng = np.random.default_rng(axis)
    injected = np.zeros(6)
    injected[axis] = 2 * sign * LIMITS[axis]
    frames = [frame(rng, sigma_px=0.5) for _ in range(6)]
    solution = solve_lines(frames, scenes.CAMERA, se3.stored_before(scenes.TRUTH, injected, None))
    drift, seen = in_axes(solution.estimate)
    assert seen.axis_observed.all()
    assert np.abs(drift - injected)[axis] < LIMITS[axis] / 2
    assert (np.abs(drift - injected) < 4 * seen.axis_sigmas).all()
    assert solution.estimate.frames == 6
    assert solution.estimate.features == sum(map(len, solution.matches))


def test_sigma_is_honest_in_every_observed_direction():
    rng = np.random.default_rng(1)
    scores = []
    for _ in range(120):
        injected = rng.normal(0, [*np.radians([0.4, 0.3, 0.3]), 0.1, 0.07, 0.07])
        stored = se3.stored_before(scenes.TRUTH, injected, None)
        solution = solve_lines([frame(rng)], scenes.CAMERA, stored)
        drift, seen = in_axes(solution.estimate)
        V = seen.directions[:, seen.observed]
        scores.append(V.T @ ((drift - injected) / LIMITS) / seen.sigmas[seen.observed])
    scores = np.concatenate(scores)
    # The model's floor of 1.5 cm a line is not in the simulation, so sigma may be wide, never narrow.
    assert 0.68 <= np.mean(np.abs(scores) < 1) <= 0.90
    assert np.mean(np.abs(scores) < 2) >= 0.95


def test_lanes_alone_hold_forward():
    rng = np.random.default_rng(2)
    solution = solve_lines([frame(rng, poles=[]) for _ in range(5)], scenes.CAMERA, scenes.TRUTH)
    drift, seen = in_axes(solution.estimate)
    assert seen.rank == 5
    assert seen.axis_observed.tolist() == [True, True, True, False, True, True]
    assert drift[3] == pytest.approx(0.0, abs=0.02)


def test_poles_alone_hold_up():
    rng = np.random.default_rng(3)
    solution = solve_lines([frame(rng, lanes=[]) for _ in range(5)], scenes.CAMERA, scenes.TRUTH)
    _, seen = in_axes(solution.estimate)
    assert not seen.axis_observed[5]
    assert seen.axis_observed[[2, 3, 4]].all()


def test_what_is_held_does_not_spoil_what_is_seen():
    """A forward drift that lanes can not see leaves pitch, yaw and up alone."""
    rng = np.random.default_rng(4)
    stored = se3.stored_before(scenes.TRUTH, np.array([0, 0, np.radians(0.8), 0.2, 0, 0]), None)
    solution = solve_lines([frame(rng, poles=[]) for _ in range(5)], scenes.CAMERA, stored)
    drift, seen = in_axes(solution.estimate)
    assert drift[2] == pytest.approx(np.radians(0.8), abs=4 * seen.axis_sigmas[2])
    assert abs(drift[5]) < 4 * seen.axis_sigmas[5]


def test_the_prior_does_not_pull_a_weakly_seen_direction():
    """Far poles know forward no better than the prior does; the mean answer is still the true one."""
    injected = np.array([0, 0, 0, 0.3, 0, 0])
    stored = se3.stored_before(scenes.TRUTH, injected, None)
    rng = np.random.default_rng(14)
    forward, sigma = [], []
    for _ in range(40):
        one = frame(rng, poles=[(32.0, -6.0), (40.0, 6.0)], sigma_px=0.7)
        drift, seen = in_axes(solve_lines([one], scenes.CAMERA, stored).estimate)
        forward.append(drift[3])
        sigma.append(seen.axis_sigmas[3])
    assert 0.1 < np.median(sigma) < 0.45
    assert np.mean(forward) == pytest.approx(0.3, abs=0.08)


@pytest.mark.parametrize("kind", ["no frames", "empty frames", "nothing alike"])
def test_nothing_matched_is_no_information(kind):
    rng = np.random.default_rng(5)
    lanes, poles = frame(rng, poles=[]), frame(rng, lanes=[])
    frames = {
        "no frames": [],
        "empty frames": [LineFrame((), (), ("no ground plane in the cloud",), ASIDE)] * 3,
        "nothing alike": [LineFrame(lanes.cloud_lines, poles.image_lines, (), ASIDE)],
    }[kind]
    estimate = solve_lines(frames, scenes.CAMERA, scenes.TRUTH).estimate
    assert estimate.features == estimate.frames == 0
    assert np.array_equal(estimate.information, np.zeros((6, 6)))
    assert np.array_equal(estimate.xi, np.zeros(6))


def test_two_lanes_can_not_check_each_other_and_three_can():
    rng = np.random.default_rng(13)
    for count, speaks in ((1, False), (2, False), (3, True)):
        solution = solve_lines(
            [frame(rng, lanes=scenes.LANES[:count], poles=[])], scenes.CAMERA, scenes.TRUTH
        )
        assert len(solution.matches[0]) == count
        assert (solution.estimate.features == count) is speaks
        assert solution.estimate.information.any() == speaks


def test_a_frame_without_lines_changes_nothing():
    rng = np.random.default_rng(6)
    frames = [frame(rng) for _ in range(3)]
    with_empty = solve_lines([*frames, LineFrame((), (), (), ASIDE)], scenes.CAMERA, scenes.TRUTH)
    alone = solve_lines(frames, scenes.CAMERA, scenes.TRUTH)
    assert np.array_equal(with_empty.estimate.xi, alone.estimate.xi)
    assert with_empty.matches[3] == ()


def test_the_same_frame_many_times_is_not_many_frames():
    rng = np.random.default_rng(7)
    one = frame(rng)
    single = solve_lines([one], scenes.CAMERA, scenes.TRUTH).estimate
    many = solve_lines([one] * 20, scenes.CAMERA, scenes.TRUTH).estimate
    gain = np.trace(many.information) / np.trace(single.information)
    assert gain < effective_frames(20) * 1.3


def test_effective_frames_is_the_variance_ratio_of_an_ar1_mean():
    phi, n = FRAME_CORRELATION, 9
    lags = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    assert effective_frames(n) == pytest.approx(1.0 / ((phi**lags).sum() / n**2))
    assert effective_frames(1) == 1.0
    assert effective_frames(1000) == pytest.approx(1000 * (1 - phi) / (1 + phi), rel=0.01)


def moved(line, left):
    """A cloud line of something that stands or lies beside, m to the left."""
    off = np.array([0.0, left, 0.0])
    return dataclasses.replace(line, start=line.start + off, end=line.end + off)


def with_trunks(rng, share):
    """A frame in which some cloud lines are of something else."""
    cloud, image = scenes.line_sets(rng)
    cloud = [
        moved(line, rng.choice([-1, 1]) * rng.uniform(0.2, 0.8)) if rng.random() < share else line
        for line in cloud
    ]
    return LineFrame(tuple(cloud), tuple(image), (), ASIDE)


def test_a_trunk_beside_a_pole_is_left_out():
    rng = np.random.default_rng(15)
    taken = kept = 0
    for _ in range(40):
        cloud, image = scenes.line_sets(rng)
        trunk = int(rng.integers(4, 8))
        cloud[trunk] = moved(cloud[trunk], 0.5)
        solution = solve_lines(
            [LineFrame(tuple(cloud), tuple(image), (), ASIDE)], scenes.CAMERA, scenes.TRUTH
        )
        taken += any(match.cloud is cloud[trunk] for match in solution.matches[0])
        kept += len(solution.matches[0])
        drift, seen = in_axes(solution.estimate)
        assert (np.abs(drift) < 4 * seen.axis_sigmas).all()
    assert taken <= 2
    assert kept >= 40 * 5


def test_sigma_is_honest_though_one_pair_in_seven_is_wrong():
    rng = np.random.default_rng(16)
    scores, chances = [], []
    for _ in range(60):
        one = with_trunks(rng, 0.15)
        injected = np.concatenate([np.radians(rng.uniform(-2, 2, 3)), rng.uniform(-0.3, 0.3, 3)])
        stored = se3.stored_before(scenes.TRUTH, injected, None)
        solution = solve_lines([one], scenes.CAMERA, stored, WIDE)
        drift, seen = in_axes(solution.estimate)
        V = seen.directions[:, seen.observed]
        z = V.T @ ((drift - injected) / LIMITS) / seen.sigmas[seen.observed]
        scores.append(z)
        chances.append(chdtrc(max(len(z), 1), float(z @ z)))
    flat = np.concatenate(scores)
    assert len(flat) > 120
    assert np.mean(np.abs(flat) < 1) > 0.6
    assert np.mean(np.abs(flat) < 2) > 0.9
    # Two or three of eight that are wrong alike now and then outvote the others.
    assert np.mean(np.abs(flat) > 4) < 0.02
    assert np.mean(np.array(chances) < 1e-4) < 0.05


@pytest.mark.parametrize("shift", [0.2, 0.4])
@pytest.mark.parametrize("lanes", [0, 2])
def test_the_same_wrong_pole_in_every_frame_does_not_vouch_for_itself(lanes, shift):
    """A pole beside the one that the image shows, ten frames long; taken for ten poles it lies by 8 sigma."""
    rng = np.random.default_rng(17)
    frames = []
    for step in range(10):
        cloud, image = scenes.line_sets(rng, lanes=scenes.LANES[:lanes], poles=[(30.0 - 2 * step, 5.0)])
        seen_by_lidar = tuple(moved(line, shift) if line.label == "pole" else line for line in cloud)
        frames.append(LineFrame(seen_by_lidar, tuple(image), (), ASIDE))
    drift, seen = in_axes(solve_lines(frames, scenes.CAMERA, scenes.TRUTH).estimate)
    V = seen.directions[:, seen.observed]
    assert (np.abs(V.T @ (drift / LIMITS)) < 3 * seen.sigmas[seen.observed]).all()


def test_a_wider_prior_holds_what_a_narrow_one_sees():
    rng = np.random.default_rng(18)
    one = frame(rng, poles=[(15.0, 5.0), (15.0, 6.5), (25.0, -6.0)])
    narrow = solve_lines([one], scenes.CAMERA, scenes.TRUTH, PRIOR_SIGMA / 2).estimate
    wide = solve_lines([one], scenes.CAMERA, scenes.TRUTH, 4 * PRIOR_SIGMA).estimate
    assert narrow.features == 7
    assert wide.features < narrow.features
    assert np.linalg.eigvalsh(narrow.information - wide.information).min() > -1e-6 * np.trace(
        narrow.information
    )


def test_fit_tells_pairs_that_no_noise_explains():
    rng = np.random.default_rng(19)
    good, bad = [], []
    for _ in range(15):
        good.append(solve_lines([frame(rng)], scenes.CAMERA, scenes.TRUTH).fit)
        cloud, image = scenes.line_sets(rng, sigma_px=4.0)
        claimed = tuple(dataclasses.replace(line, sigma_px=0.8) for line in image)
        rough = LineFrame(tuple(cloud), claimed, (), ASIDE)
        bad.append(solve_lines([rough], scenes.CAMERA, scenes.TRUTH, PRIOR_SIGMA / 2).fit)
    assert min(good) > 1e-3
    assert np.median(bad) < 0.1 < np.median(good)
    assert solve_lines([], scenes.CAMERA, scenes.TRUTH).fit == 1.0


@pytest.mark.slow
def test_single_frames_of_simulated_streets_are_honest():
    """From points and pixels, start within 2 deg and 0.3 m per axis, masks as the scene is."""
    rng = np.random.default_rng(20)
    scores, answers = [], 0
    for seed in range(16):
        parameters = DriveParameters(
            seed=seed,
            duration=0.15,
            scene=SceneParameters(length=140.0, curvature=float(rng.uniform(0, 0.004))),
            motion=Motion(speed=0.01, swing=0.0, weave=0.0, bob=0.0),
            lidar=spinning(int(rng.choice([32, 64, 128]))),
        )
        shot = Drive(parameters).frame(0)
        painted, pole = shot.labels == labels.LANE, shot.labels == labels.POLE
        masks = Masks(painted, pole, painted.astype(np.float32), pole.astype(np.float32), 1.0, 1.0)
        injected = np.concatenate([np.radians(rng.uniform(-2, 2, 3)), rng.uniform(-0.3, 0.3, 3)])
        stored = se3.stored_before(shot.T_cam_lidar, injected, None)
        found = find_lines(
            shot.cloud,
            shot.image,
            masks,
            parameters.camera,
            stored,
            up=parameters.T_vehicle_lidar[2, :3],
            forward=parameters.T_vehicle_lidar[0, :3],
            rng=rng,
        )
        drift, seen = in_axes(solve_lines([found], parameters.camera, stored, WIDE).estimate)
        answers += bool(seen.observed.any())
        V = seen.directions[:, seen.observed]
        scores.append(V.T @ ((drift - injected) / LIMITS) / seen.sigmas[seen.observed])
    flat = np.concatenate(scores)
    assert answers >= 8
    assert np.abs(flat).max() < 4
    assert np.mean(flat**2) < 1.5
    assert np.mean(np.abs(flat) < 1) > 0.6


def test_misfit_widens_the_answer():
    rng = np.random.default_rng(8)
    cloud, _ = scenes.line_sets(rng)
    honest, rough = [], []
    for _ in range(8):
        cloud, image = scenes.line_sets(rng, sigma_px=0.5)
        honest.append(LineFrame(tuple(cloud), tuple(image), (), ASIDE))
        cloud, image = scenes.line_sets(rng, sigma_px=3.0)
        claimed = [type(line)(line.label, line.start, line.end, 0.5) for line in image]
        rough.append(LineFrame(tuple(cloud), tuple(claimed), (), ASIDE))
    fine, poor = (solve_lines(frames, scenes.CAMERA, scenes.TRUTH).estimate for frames in (honest, rough))
    assert fine.chi2 < 1.5 < poor.chi2
    assert (np.diag(poor.information) < np.diag(fine.information)).all()


def street(rng, *, turn=None):
    """One frame from points and a drawn image."""
    cloud = scenes.sampled_cloud(rng, turn=turn)
    strokes = []
    K = scenes.CAMERA.K
    for label, ends, width in (("lane", scenes.lane_ends(), 0.15), ("pole", scenes.pole_ends(), 0.16)):
        for start, end in ends:
            points = se3.apply(scenes.TRUTH, np.stack([start, end]))
            uv = points @ K.T
            uv = uv[:, :2] / uv[:, 2:]
            # A stroke as wide as in its middle: the centre line is what counts.
            strokes.append((label, uv[0], uv[1], max(4.0, 721.5 * width / points[:, 2].mean())))
    image, masks = scenes.draw(strokes, size=(1242, 375), rng=rng)
    return cloud, image, masks


@pytest.mark.parametrize("turned", [False, True])
def test_from_points_and_pixels_to_the_drift(turned):
    rng = np.random.default_rng(9)
    turn = se3.exp_so3(np.array([0.1, -0.2, math.pi / 2])) if turned else np.eye(3)
    injected = np.array([0, 0, np.radians(0.7), 0, 0, 0])
    stored = se3.stored_before(scenes.TRUTH, injected, None)
    stored = stored @ se3.transform(turn.T, np.zeros(3))
    cloud, image, masks = street(rng, turn=turn)
    found = find_lines(
        cloud,
        image,
        masks,
        scenes.CAMERA,
        stored,
        up=turn @ scenes.UP,
        forward=turn @ scenes.FORWARD,
        rng=rng,
    )
    assert found.reasons == ()
    for line in found.cloud_lines:
        ahead = turn @ (scenes.FORWARD if line.label == "lane" else scenes.UP)
        assert (line.end - line.start) @ ahead > 0
    solution = solve_lines([found], scenes.CAMERA, stored)
    drift, seen = in_axes(solution.estimate)
    assert solution.estimate.features >= 6
    assert seen.axis_observed[1:].all()
    assert drift[2] == pytest.approx(injected[2], abs=np.radians(0.15))
    assert (np.abs(drift - injected) < 4 * seen.axis_sigmas).all()


def test_reasons_tell_what_could_not_be_looked_for():
    rng = np.random.default_rng(10)
    cloud, image, masks = street(rng)
    args = {"up": scenes.UP, "forward": scenes.FORWARD, "rng": rng}
    blind = find_lines(PointCloud(cloud.xyz), image, masks, scenes.CAMERA, scenes.TRUTH, **args)
    assert blind.reasons == ("no lane lines in a cloud without intensity",)
    assert {line.label for line in blind.cloud_lines} == {"pole"}
    empty = PointCloud(np.zeros((0, 3), dtype=np.float32), np.zeros(0, dtype=np.float32))
    nothing = find_lines(empty, image, masks, scenes.CAMERA, scenes.TRUTH, **args)
    assert nothing.reasons == ("no ground plane in the cloud",)
    assert nothing.cloud_lines == ()
    assert len(nothing.image_lines) > 0


def test_view_keeps_what_projects_into_the_image():
    rng = np.random.default_rng(11)
    cloud, _, _ = street(rng)
    seen = in_view(cloud, scenes.CAMERA, scenes.TRUTH)
    points = se3.apply(scenes.TRUTH, cloud.xyz)
    uv = points @ scenes.CAMERA.K.T
    inside = (points[:, 2] > 1.0) & (np.abs(uv[:, 0] / uv[:, 2] - 620.5) < 621)
    inside &= np.abs(uv[:, 1] / uv[:, 2] - 187) < 187.5
    assert seen[inside].all()
    assert not seen[points[:, 2] < 1.0].any()
    assert seen.mean() < 0.9


def test_black_image_and_no_masks_are_ordinary():
    rng = np.random.default_rng(12)
    cloud, _, _ = street(rng)
    black = CameraImage(np.zeros((375, 1242, 3), dtype=np.uint8))
    none = np.zeros((375, 1242), dtype=bool)
    found = find_lines(
        cloud,
        black,
        scenes.masks_of(none, none),
        scenes.CAMERA,
        scenes.TRUTH,
        up=scenes.UP,
        forward=scenes.FORWARD,
        rng=rng,
    )
    assert found.image_lines == ()
    assert solve_lines([found], scenes.CAMERA, scenes.TRUTH).estimate.features == 0


RECORDINGS = Path(os.environ.get("CALIBWATCH_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))


def bright_strokes(pixels):
    """Lane mask without a network: below the horizon, brighter than both sides."""
    grey = cv2.GaussianBlur(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), 1.0)
    beside = cv2.blur(grey, (14, 1))
    mask = np.minimum(grey - np.roll(beside, 14, 1), grey - np.roll(beside, -14, 1)) > 20
    mask[:200] = False
    count, label, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    long = np.hypot(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) > 30
    return (long & (np.arange(count) > 0))[label]


@pytest.mark.recordings
@pytest.mark.parametrize(("name", "tolerance"), [("000005", 0.15), ("000009", 0.45)])
@pytest.mark.parametrize("yaw_deg", [0.0, -0.7])
def test_lanes_of_one_real_frame_give_pitch_and_yaw(name, tolerance, yaw_deg):
    """The published extrinsic is good to 0.1 to 0.2 deg; 000009 is one bent road."""
    folder = RECORDINGS / "kitti_singles" / name
    if not folder.is_dir():
        pytest.skip(f"no recordings in {RECORDINGS}")
    calib = json.loads((folder / "calib.json").read_text())
    truth = np.array(calib["T_cam_lidar"])
    truth[:3, :3] = se3.orthonormalised(truth[:3, :3])
    pixels = cv2.imread(str(folder / "image.png"))
    height, width = pixels.shape[:2]
    camera = CameraModel("pinhole", np.array(calib["camera"]["K"]).reshape(3, 3), np.zeros(0), width, height)
    raw = np.fromfile(folder / "cloud.bin", np.float32).reshape(-1, 4)
    lane, none = bright_strokes(pixels), np.zeros((height, width), dtype=bool)
    masks = Masks(lane, none, lane.astype(np.float32), none.astype(np.float32), 1.0, 1.0)
    injected = np.array([0, 0, np.radians(yaw_deg), 0, 0, 0])
    stored = se3.stored_before(truth, injected, None)
    found = find_lines(
        PointCloud(raw[:, :3].copy(), raw[:, 3].copy()),
        CameraImage(pixels),
        masks,
        camera,
        stored,
        up=-stored[1, :3],
        forward=stored[2, :3],
        rng=np.random.default_rng(0),
    )
    solution = solve_lines([found], camera, stored)
    drift, seen = in_axes(solution.estimate)
    assert seen.axis_observed.tolist()[1:4] == [True, True, False]
    assert abs(np.degrees(drift - injected)[1:3]).max() < tolerance
    assert (np.abs(drift - injected)[seen.axis_observed] < 3 * seen.axis_sigmas[seen.axis_observed]).all()
