import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import se3
from pipeline.observability import MAX_SIGMA, in_vehicle_axes, observable

LIMITS = np.array([np.radians(0.75), np.radians(0.5), np.radians(0.5), 0.2, 0.15, 0.15])


def information_of(sigmas, rng):
    """An information matrix with the given sigmas (in alert limits) along random directions."""
    V = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    D_inv = np.diag(1 / LIMITS)
    weights = [0 if np.isinf(s) else s**-2.0 for s in sigmas]
    return D_inv @ V @ np.diag(weights) @ V.T @ D_inv, V


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000))
def test_directions_and_their_sigmas_come_back(seed):
    rng = np.random.default_rng(seed)
    sigmas = np.array([np.inf, 2.5, 1.5, 0.5, 0.2, 0.1])
    information, V = information_of(sigmas, rng)
    seen = observable(information, LIMITS)
    np.testing.assert_allclose(seen.sigmas, sigmas, rtol=1e-6)
    assert seen.rank == 5
    assert seen.observed.tolist() == [False, False, True, True, True, True]
    np.testing.assert_allclose(np.abs((seen.directions * V).sum(axis=0)), 1.0, atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000))
def test_a_held_direction_does_not_leak_into_the_observed_ones(seed):
    rng = np.random.default_rng(seed)
    information, V = information_of([np.inf, 0.5, 0.4, 0.3, 0.2, 0.1], rng)
    seen = observable(information, LIMITS)
    drift = LIMITS * rng.normal(size=6)
    noisy_along_null = drift + LIMITS * (1e3 * V[:, 0])
    np.testing.assert_allclose(seen.restrict(drift), seen.restrict(noisy_along_null), atol=1e-6)
    assert np.abs(V[:, 0] @ (seen.restrict(drift) / LIMITS)) < 1e-7


def test_axis_sigmas_are_those_of_the_inverse_where_all_is_observed():
    information, _ = information_of([1.0, 0.5, 0.4, 0.3, 0.2, 0.1], np.random.default_rng(1))
    seen = observable(information, LIMITS)
    np.testing.assert_allclose(seen.axis_sigmas, np.sqrt(np.diag(np.linalg.inv(information))), rtol=1e-8)
    np.testing.assert_allclose(seen.restrict(LIMITS), LIMITS, rtol=1e-8)
    assert np.array_equal(seen.axis_observed, seen.axis_sigmas <= MAX_SIGMA * LIMITS)


def test_a_null_axis_touches_only_itself():
    information = np.diag(np.array([1.0, 1, 1, 0, 1, 1]) / (0.1 * LIMITS) ** 2)
    seen = observable(information, LIMITS)
    assert seen.axis_observed.tolist() == [True, True, True, False, True, True]
    assert np.isinf(seen.axis_sigmas[3])


def test_no_information_observes_nothing():
    seen = observable(np.zeros((6, 6)), LIMITS)
    assert seen.rank == 0
    assert not seen.observed.any()
    assert not seen.axis_observed.any()
    assert np.array_equal(seen.restrict(LIMITS), np.zeros(6))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_more_information_never_widens_an_axis(seed):
    rng = np.random.default_rng(seed)
    first, _ = information_of([1.0, 0.5, 0.4, 0.3, 0.2, 0.1], rng)
    more, _ = information_of([np.inf, np.inf, np.inf, 2.0, 1.0, 0.5], rng)
    assert (
        observable(first + more, LIMITS).axis_sigmas <= observable(first, LIMITS).axis_sigmas * (1 + 1e-9)
    ).all()


def test_vehicle_axes_follow_the_motion_of_the_mount():
    R_vc = se3.AXES_CAM_IN_VEHICLE
    T = se3.transform(R_vc.T, np.array([0.1, -0.2, 0.3]))
    xi = np.array([1e-5, -2e-5, 3e-5, 1e-4, 2e-4, -3e-4])
    information = np.diag([1.0, 2, 3, 4, 5, 6])
    drift, turned = in_vehicle_axes(xi, information, R_vc)
    np.testing.assert_allclose(drift, se3.mount_drift(T, se3.retract(T, xi), R_vc), atol=1e-8)
    # Camera x is vehicle -left, y is -up, z is forward.
    assert np.diag(turned) == pytest.approx([3, 1, 2, 6, 4, 5])
