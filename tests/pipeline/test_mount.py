import dataclasses
import math

import numpy as np
import pytest

from pipeline.baseline import learn
from pipeline.drift_test import DriftTestParameters
from pipeline.mount import Mount
from pipeline.road_samples import Scatter
from pipeline.run_tail import Tail
from tests.pipeline.simulated_windows import FLOOR, simulated_drive
from tests.pipeline.test_watch import CAMERA, LIMITS

PARAMETERS = DriftTestParameters()
STORED = Mount(
    camera=CAMERA,
    T_cam_lidar=np.eye(4),
    T_vehicle_lidar=None,
    sigma_rad=math.radians(0.1),
    sigma_m=0.02,
    limits=LIMITS,
    required=("pitch", "yaw"),
)


@pytest.fixture(scope="module")
def baseline():
    rng = np.random.default_rng(0)
    drives = [simulated_drive(rng, f"{i}", bias=np.full(6, 1e-3), spread=0.5 * FLOOR) for i in range(4)]
    return learn(drives, PARAMETERS, 1e7, rng)


def test_without_a_baseline_the_stored_extrinsic_is_expected_with_its_own_sigma():
    expected = STORED.expectation(PARAMETERS)
    assert not expected.mean.any()
    assert np.sqrt(np.diag(expected.covariance)) == pytest.approx([math.radians(0.1)] * 3 + [0.02] * 3)
    assert STORED.noise == 1.0
    assert STORED.thresholds(PARAMETERS) is PARAMETERS


def test_with_a_baseline_its_bias_is_expected_whatever_sigma_is_stored(baseline):
    mount = dataclasses.replace(STORED, baseline=baseline)
    vague = dataclasses.replace(mount, sigma_rad=1.0, sigma_m=1.0)
    for one in (mount, vague):
        expected = one.expectation(PARAMETERS)
        assert expected.mean == pytest.approx(baseline.bias)
        assert expected.covariance == pytest.approx(baseline.covariance)


@pytest.mark.parametrize(("learned", "used"), [(0.6, 1.0), (1.0, 1.0), (1.7, 1.7)])
def test_windows_are_made_less_sure_by_a_baseline_but_never_surer(baseline, learned, used):
    noisy = dataclasses.replace(baseline, scatter=Scatter(noise=learned, correlation_m=30.0))
    assert dataclasses.replace(STORED, baseline=noisy).noise == used


@pytest.mark.parametrize(("threshold", "alarm"), [(None, PARAMETERS.alarm), (40.0, 40.0), (3.0, 22.46)])
def test_the_alarm_is_that_of_the_wanted_run_length_but_never_below_suspicion(baseline, threshold, alarm):
    tail = Tail(stretches=900, needed=800, wanted_s=1e7, threshold=threshold, interval=(1.0, 50.0))
    mount = dataclasses.replace(STORED, baseline=dataclasses.replace(baseline, tail=tail))
    assert mount.thresholds(PARAMETERS).alarm == alarm
