import dataclasses
import functools

import numpy as np
import pytest

from pipeline import se3
from pipeline.baseline import learn
from pipeline.drive_estimates import Driven
from pipeline.parameters import Parameters
from pipeline.records import CameraImage
from pipeline.watch import Watch
from tests.pipeline.test_watch import mount_of, simulated


@functools.cache
def driven():
    parameters, pairs = simulated()
    drive = Driven("drive", mount_of(parameters), Parameters(), None)
    for pair in pairs:
        assert drive.step(pair) is None
    return drive.finish()


def test_the_estimates_are_those_of_a_watch_without_a_baseline():
    parameters, pairs = simulated()
    mount = mount_of(parameters)
    taught = learn([driven().estimates], Parameters().test, 1e7, np.random.default_rng(0))
    again = Driven("drive", dataclasses.replace(mount, baseline=taught), Parameters(), None)
    watch, seen, stamps = Watch(mount, Parameters(), None), [], []
    for pair in pairs:
        again.step(pair)
        if watch.step(pair).judged:
            seen.append(watch.belief.evidence)
            stamps.append(pair.image_stamp_ns)
    for drive in (driven(), again.finish()):
        found = drive.estimates
        assert found.drift == pytest.approx(np.array([evidence.drift for evidence in seen]))
        assert found.covariance == pytest.approx(np.array([evidence.covariance for evidence in seen]))
        assert found.stamp_ns.tolist() == stamps
        assert drive.left_out == 0
    assert len(seen) == 5


def test_the_way_is_that_of_the_window():
    parameters, _ = simulated()
    begin, end = driven().estimates.way_m.T
    assert (end[1:] > end[:-1]).all()
    assert begin == pytest.approx(np.full(len(begin), begin[0]))  # nine frames: none has left the window
    driven_m = parameters.motion.along(np.array([0.453, 0.853]))  # exposures of the fifth and the ninth frame
    assert end[-1] - end[0] == pytest.approx(driven_m[1] - driven_m[0], abs=0.2)


def test_the_bias_is_what_the_mount_shows_against_the_extrinsic_that_is_stored():
    """Stored wrong by a little, in all axes: what a baseline is for."""
    parameters, pairs = simulated()
    wrong = np.array([2e-3, -1.5e-3, 1.5e-3, 0.02, -0.02, 0.02])
    drive = Driven("drive", mount_of(parameters, drift=wrong), Parameters(), None)
    for pair in pairs:
        drive.step(pair)
    found = learn([drive.finish().estimates], Parameters().test, 1e7, np.random.default_rng(0))
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(found.bias - wrong) < 3.0 * sigma).all()
    before = learn([driven().estimates], Parameters().test, 1e7, np.random.default_rng(0))
    shown = found.bias - before.bias
    assert shown[:3] == pytest.approx(wrong[:3], abs=2e-4)
    assert shown[3:] == pytest.approx(wrong[3:], abs=2e-3)


def test_a_baseline_takes_the_place_of_the_stored_extrinsic():
    """Judged by a baseline, an extrinsic stored a little wrong shows no drift, and T is small."""
    parameters, pairs = simulated()
    wrong = np.array([0.0, 0.0, 4e-3, 0.0, 0.0, 0.0])
    mount = mount_of(parameters, drift=wrong)
    drive = Driven("drive", mount, Parameters(), None)
    for pair in pairs:
        drive.step(pair)
    taught = learn([drive.finish().estimates], Parameters().test, 1e7, np.random.default_rng(0))
    watch = Watch(dataclasses.replace(mount, baseline=taught), Parameters(), None)
    for pair in pairs:
        watch.step(pair)
    judgement = watch.belief.judgement
    assert abs(judgement.drift[2]) < 1e-3
    assert judgement.statistic < 6.0
    truth = se3.mount_drift(mount.T_cam_lidar, watch.belief.T_estimated, mount.R_vehicle_cam)
    assert truth[2] == pytest.approx(4e-3, abs=1.5e-3)


def test_a_dark_camera_teaches_nothing():
    parameters, pairs = simulated()
    drive = Driven("dark", mount_of(parameters), Parameters(), None)
    for pair in pairs:
        drive.step(dataclasses.replace(pair, image=CameraImage(np.zeros_like(pair.image.pixels))))
    found = drive.finish()
    assert len(found.estimates) == 0
    assert found.estimates.covariance.shape == (0, 6, 6)
    assert found.left_out > 0


def test_no_frame_is_no_window():
    parameters, _ = simulated()
    found = Driven("empty", mount_of(parameters), Parameters(), None).finish()
    assert len(found.estimates) == 0
    assert found.memory.state == "unobservable"
