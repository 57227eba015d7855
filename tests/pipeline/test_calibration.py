import dataclasses
import math

import cv2
import numpy as np
import pytest

from pipeline import labels, se3
from pipeline.calibration import CalibrationParameters, Calibrator, held_directions, leaning
from pipeline.frame_modes import EdgeModes, ModeParameters, Prior
from pipeline.mount import Mount
from pipeline.observability import observable
from pipeline.parameters import Parameters
from pipeline.records import AXES, CameraImage, FramePair, PointCloud
from pipeline.segmentation import grid_size
from pipeline.simulation.drive import Drive
from pipeline.simulation.rigs import draw_rig

QUICK = CalibrationParameters(modes=ModeParameters(draws=64, climbed=2, draws_of_place=8))
DRIFTS = [
    np.concatenate([np.radians([1.0, -1.5, 1.2]), [0.2, -0.15, 0.1]]),
    np.concatenate([np.radians([-1.5, 1.0, -1.8]), [-0.25, 0.2, -0.2]]),
]


def mount_of(drive, limits, drift=None):
    """The mount as it was stored before it moved by ``drift`` to where it truly is."""
    p = drive.parameters
    T = p.T_stored if drift is None else se3.stored_before(p.T_stored, drift, p.T_vehicle_lidar[:3, :3])
    return Mount(p.camera, T, p.T_vehicle_lidar, math.radians(0.1), 0.02, limits, ("yaw", "pitch"))


def pair_of(frame):
    return FramePair("front", frame.cloud, frame.image, frame.cloud_stamp_ns, frame.image_stamp_ns)


def calibrate_frames(mount, pairs, segmenter=None, settings=None):
    calibrator = Calibrator(mount, Parameters(), segmenter, settings or CalibrationParameters())
    for pair in pairs:
        calibrator.step(pair)
    return calibrator.finish()


@pytest.mark.parametrize("drift", DRIFTS)
def test_a_single_frame_finds_back_from_two_degrees_with_honest_sigma(drive, straight_frames, limits, drift):
    mount = mount_of(drive, limits, drift)
    found = calibrate_frames(mount, [pair_of(straight_frames[1])])
    error = se3.mount_drift(drive.parameters.T_stored, found.T_estimated, mount.R_vehicle_cam)
    assert found.observable.all()
    assert (found.held, found.frames, found.dropped) == ((), 1, {})
    assert np.all(np.abs(error) < 3.0 * found.sigma)
    assert np.all(found.sigma[:3] < math.radians(0.3))
    assert np.all(found.sigma[3:] < 0.12)
    assert np.allclose(found.drift, drift, atol=4.0 * found.sigma.max())
    assert found.modes[0].share == max(mode.share for mode in found.modes)
    assert sum(mode.share for mode in found.modes) == pytest.approx(1.0)


@pytest.mark.slow
def test_sigma_is_honest_on_streets_and_rigs_of_all_kinds(limits):
    errors = []
    for seed in range(16):
        rng = np.random.default_rng([11, seed])
        parameters = draw_rig(rng)
        drive = Drive(parameters)
        # Single sweeps are not straightened: the way driven while they last is an error of its own.
        frame = drive.frame(0)
        mount = mount_of(drive, limits, rng.uniform(-2.0, 2.0, 6) * Prior().sigma)
        found = calibrate_frames(mount, [pair_of(frame)])
        error = se3.mount_drift(parameters.T_stored, found.T_estimated, mount.R_vehicle_cam)
        errors.extend((error / found.sigma)[found.observable])
    normalised = np.abs(errors)
    assert len(normalised) >= 60
    assert 0.6 <= np.mean(normalised < 1.0) <= 0.9
    assert np.mean(normalised < 2.0) >= 0.88
    assert np.mean(normalised > 4.0) <= 0.05


def test_an_image_of_another_place_gives_nothing_and_the_guess_stays(drive, straight_frames, limits):
    frame = straight_frames[1]
    noise = np.random.default_rng(1).integers(0, 256, frame.image.pixels.shape, dtype=np.uint8)
    mount = mount_of(drive, limits)
    found = calibrate_frames(mount, [dataclasses.replace(pair_of(frame), image=CameraImage(noise))])
    assert not found.observable.any()
    assert found.held == AXES
    assert "nothing in common" in found.reason
    assert np.array_equal(found.T_estimated, mount.T_cam_lidar)
    assert np.array_equal(found.drift, np.zeros(6))
    assert np.array_equal(found.covariance, np.diag(Prior().sigma ** 2))


def test_pairs_that_can_not_be_used_are_counted_by_reason(drive, straight_frames, limits):
    pair = pair_of(straight_frames[1])
    small = CameraImage(np.zeros((20, 30, 3), dtype=np.uint8))
    nothing = PointCloud(np.zeros((0, 3), dtype=np.float32))
    few = PointCloud(np.random.default_rng(1).normal(size=(9, 3)).astype(np.float32))
    pairs = [
        dataclasses.replace(pair, image=small),
        dataclasses.replace(pair, cloud=nothing),
        dataclasses.replace(pair, cloud=few),
    ]
    found = calibrate_frames(mount_of(drive, limits), pairs)
    assert found.dropped == {"image_size": 1, "empty_cloud": 1, "no_scan_pattern": 1}
    assert (found.frames, found.modes) == (0, ())
    assert not found.observable.any()
    assert "too few edges" in found.reason


def test_no_pair_at_all_gives_the_guess(drive, limits):
    found = calibrate_frames(mount_of(drive, limits), [])
    assert (found.frames, found.modes, found.held) == (0, (), AXES)


def test_a_long_drive_is_thinned_evenly_and_every_pair_counts(drive, straight_frames, limits):
    settings = dataclasses.replace(QUICK, most_frames=3)
    calibrator = Calibrator(mount_of(drive, limits), Parameters(), None, settings)
    edges_found = []

    def stage(name):
        edges_found.append(name)
        return contextless()

    for k in range(9):
        frame = straight_frames[k % 3]
        step = k * 100_000_000
        pair = dataclasses.replace(
            pair_of(frame),
            cloud_stamp_ns=frame.cloud_stamp_ns + step,
            image_stamp_ns=frame.image_stamp_ns + step,
        )
        assert calibrator.step(pair, stage) is None
    assert calibrator.frames == 9
    # 0 1 2 and 3 make one too many: 0 2 stay; then every second comes: 4, 6 makes it 0 4, every fourth: 8.
    assert edges_found.count("edges") == 7
    assert edges_found.count("motion") == 9
    found = calibrator.finish(stage)
    assert found.frames == 9
    assert {"search", "refinement"} <= set(edges_found)


class Seeing:
    """In place of the network: the true labels of one picture."""

    def __init__(self, classes):
        columns, rows = grid_size(classes.shape[1], classes.shape[0])
        self._answer = np.stack(
            [
                cv2.resize((classes == k).astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
                for k in range(len(labels.NAMES))
            ]
        )

    def probabilities(self, pixels):
        del pixels
        return self._answer


def test_lines_that_agree_with_the_edges_do_not_move_the_answer(drive, straight_frames, limits):
    frame, mount = straight_frames[1], mount_of(drive, limits, DRIFTS[0])
    alone = calibrate_frames(mount, [pair_of(frame)], settings=QUICK)
    heard = calibrate_frames(mount, [pair_of(frame)], Seeing(frame.labels), QUICK)
    assert heard.observable.all()
    assert np.all(np.abs(heard.drift - alone.drift) < 0.5 * alone.sigma)
    assert heard.modes[0].share >= alone.modes[0].share - 0.05


@pytest.mark.parametrize("wrong", [True, False])
def test_lines_beside_their_masks_take_a_fit_its_share(drive, straight_frames, limits, monkeypatch, wrong):
    frame, mount = straight_frames[1], mount_of(drive, limits)
    T_true = drive.parameters.T_stored
    T_wrong = se3.retract(T_true, np.array([0.0, math.radians(1.6), 0.0, 0.0, 0.0, 0.0]))
    judges = []

    def weighed(batch, T_guess, tops, prior, modes, rng, second):
        del batch, T_guess, tops, prior, modes
        judges.append(second(np.stack([T_true, T_wrong] if wrong else [T_true, T_true]), rng))
        return EdgeModes(((np.zeros(6), 0.4),), np.array([1.0]), np.eye(6) * 1e-6, contrast=1.0, peak=9.0)

    monkeypatch.setattr("pipeline.calibration.weighed", weighed)
    calibrate_frames(mount, [pair_of(frame)], Seeing(frame.labels), QUICK)
    if wrong:
        assert judges[0][0] > 0.9
    else:
        assert judges[0][0] == pytest.approx(0.5, abs=0.1)


class contextless:  # noqa: N801 - a context manager, named as one
    """A stage that is not timed."""

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


def test_held_directions_are_named_by_the_axes_they_lean_on(limits):
    information = np.diag(1.0 / (0.1 * limits) ** 2)
    direction = np.array([0.0, 0.8, 0.0, 0.1, 0.0, 0.6])
    direction /= np.linalg.norm(direction)
    P = np.eye(6) - np.outer(direction, direction)
    held = information @ np.diag(limits**2)
    held = (P @ held @ P) / np.outer(limits, limits)
    seen = observable(held, limits)
    assert held_directions(seen) == ("pitch with up",)
    assert leaning(seen).tolist() == [[False, True, False, False, False, True]]
    assert held_directions(observable(information, limits)) == ()


def test_the_same_frames_give_the_same_answer(drive, straight_frames, limits):
    mount, pair = mount_of(drive, limits, DRIFTS[0]), pair_of(straight_frames[0])
    first = calibrate_frames(mount, [pair], settings=QUICK)
    second = calibrate_frames(mount, [pair], settings=QUICK)
    assert np.array_equal(first.T_estimated, second.T_estimated)
    assert np.array_equal(first.covariance, second.covariance)
