import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import se3
from pipeline.causes import CLOCK, LENS, SOURCES, CauseParameters, Section, explain

P = CauseParameters()
LIMITS = np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.20, 0.15, 0.15])
SOUND = np.diag([math.radians(0.1) ** 2] * 3 + [0.04**2] * 3)
NOTHING_KNOWN = np.diag([1e3] * 6)
SYNC_S = 0.003
F, CENTRE = 721.5, np.array([0.27, 0.0, -0.08])
B = se3.vehicle_block(se3.AXES_CAM_IN_VEHICLE)


def line_information(start, end, points):
    """Information (6,6) of one line by FORMULAS D1, D2: 1 px at its ends, 3 cm for each of its points."""
    ends = (np.array([start, end]) - CENTRE) @ se3.AXES_CAM_IN_VEHICLE
    z = ends[:, 2]
    uv = F * ends[:, :2] / z[:, None]
    n = np.array([-(uv[1] - uv[0])[1], (uv[1] - uv[0])[0]])
    n /= np.linalg.norm(n)
    J = np.array(
        [
            n @ (F / p[2] * np.array([[1, 0, -p[0] / p[2]], [0, 1, -p[1] / p[2]]]))
            @ np.hstack([-se3.skew(p), np.eye(3)])
            for p in ends
        ]
    )  # fmt: skip
    across = np.cross(*ends)
    across /= np.linalg.norm(across)
    kappa = F / np.linalg.norm(across[:2])
    length = float(np.linalg.norm(ends[1] - ends[0]))
    sig, spread = np.array([-0.5, 0.5]) * length, points * length**2 / 12
    S = np.eye(2) + 0.03**2 * kappa**2 * (1 / points + np.outer(sig, sig) / spread) / np.outer(z, z)
    return J.T @ np.linalg.inv(S) @ J


def road_information():
    """Of a frame with two lanes and four poles (FORMULAS D5), vehicle axes."""
    ground = -1.73
    I_xi = np.zeros((6, 6))
    for y in (1.8, -1.8):
        I_xi += line_information((6.5, y, ground), (30.0, y, ground), 40)
    for x, y in ((12, 5), (18, -6), (25, 6), (32, -6)):
        top = min(4.0, math.tan(math.radians(2.0)) * x - ground)
        I_xi += line_information((x, y, ground + 0.5), (x, y, ground + top), 12)
    return B @ I_xi @ B.T


ROAD = road_information()


def driven(speed, yaw_rate=0.0, beside=CENTRE):
    """Drift that a second of delay feigns, seen from the camera point, for a drive ahead and a turn (G1)."""
    omega = np.array([0.0, 0.0, yaw_rate])
    return np.concatenate([omega, np.array([speed, 0.0, 0.0]) + np.cross(omega, beside)])


def section(motion, theta, information=ROAD, lens=0.0, rng=None):
    """One frame whose estimates are those of the unknowns (8,), noisy where random numbers are given."""
    W = np.zeros((7, 7))
    W[:6, :6], W[6, 6] = information, lens
    return lensed(motion, theta, W, rng)


def lensed(motion, theta, W, rng=None):
    """The same with information (7,7) on mount and lens."""
    design = np.zeros((7, 8))
    design[:6, :6], design[:6, CLOCK], design[6, LENS] = np.eye(6), motion, 1.0
    H = design.T @ W @ design
    noise = np.zeros(8) if rng is None else design.T @ (_root(W) @ rng.normal(size=7))
    unit = np.sqrt(np.diag(H) + 1e-6 * np.diag(H).max())
    return Section(
        from_ns=0,
        to_ns=0,
        curvature=H,
        pull=H @ theta + noise,
        certainty=np.linalg.pinv(H / np.outer(unit, unit), rcond=1e-12, hermitian=True)
        / np.outer(unit, unit),
        motion=np.abs(motion),
        speed=float(np.linalg.norm(motion[3:])),
        sync_s=SYNC_S,
    )


def _root(W):
    values, vectors = np.linalg.eigh(W)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def only(place, size):
    return size * np.eye(8)[place]


def told(sections, sound=SOUND, limits=LIMITS):
    return explain(sections, sound, limits, P)


def test_the_road_of_the_oracle_is_the_one_of_the_formulas():
    sigma = np.sqrt(np.diag(np.linalg.inv(ROAD)))
    np.testing.assert_allclose(np.degrees(sigma[:3]), [0.359, 0.106, 0.077], rtol=0.03)
    np.testing.assert_allclose(sigma[3:], [0.032, 0.030, 0.020], rtol=0.03)


@pytest.mark.parametrize(
    ("mean_speed", "swing", "turning", "sd_ms"),
    [(15.0, 5.0, 0.0, 0.56), (10.0, 5.0, 0.15, 0.38), (12.0, 0.0, 0.1, 0.80)],
)
def test_a_delay_is_known_as_well_as_the_motion_allows(mean_speed, swing, turning, sd_ms):
    """FORMULAS G2: 300 frames with the errors of two lanes and four poles, axis by axis."""
    rng = np.random.default_rng(5)
    each_axis = np.diag(1.0 / np.diag(np.linalg.inv(ROAD)))
    motions = [driven(mean_speed + swing * math.sin(0.3 * k), turning * rng.normal()) for k in range(300)]
    found = told([section(motion, np.zeros(8), each_axis) for motion in motions], NOTHING_KNOWN)
    assert found.time_sigma_s * 1e3 == pytest.approx(sd_ms, rel=0.1)
    assert found.separable


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_the_sigma_of_a_delay_is_the_closed_form(seed):
    """FORMULAS G2: sum a^T W a - (sum a^T W)(sum W)^-1(sum W a)."""
    rng = np.random.default_rng(seed)
    motions = [driven(rng.uniform(2, 20), 0.2 * rng.normal()) for _ in range(12)]
    weights = [ROAD * rng.uniform(0.2, 5.0) for _ in motions]
    found = told([section(a, np.zeros(8), W) for a, W in zip(motions, weights, strict=True)], NOTHING_KNOWN)
    Wa = sum(W @ a for a, W in zip(motions, weights, strict=True))
    information = sum(a @ W @ a for a, W in zip(motions, weights, strict=True))
    information -= Wa @ np.linalg.inv(sum(weights)) @ Wa
    assert found.time_sigma_s == pytest.approx(information**-0.5, rel=1e-3)


AT_MANY_SPEEDS = [driven(v, w) for v, w in ((2, 0.1), (6, 0.0), (11, -0.05), (15, 0.0), (9, 0.2), (0, 0))]
AT_ONE_SPEED = [driven(11.0)] * 6


def test_at_one_speed_a_delay_and_a_step_ahead_are_one():
    """FORMULAS G2: constant speed, straight: singular; only x + v dt is known."""
    delayed = told([section(a, only(CLOCK, 0.03)) for a in AT_ONE_SPEED])
    moved = told([section(a, only(3, 0.33)) for a in AT_ONE_SPEED])
    for found in (delayed, moved):
        assert not found.separable
        assert found.time_sigma_s > 0.1
        assert found.cause(P) == "forward_or_sync"
        assert found.needed[0] < 1.0
        assert not found.changed("clock", P)
    np.testing.assert_allclose(delayed.alone, moved.alone, atol=1e-3)


def test_at_many_speeds_a_delay_is_named_with_its_size():
    found = told([section(a, only(CLOCK, 0.03), 30 * ROAD) for a in AT_MANY_SPEEDS])
    assert found.separable
    assert found.time_offset_s == pytest.approx(0.03, abs=0.001)
    assert found.cause(P) == "time_offset"
    assert found.changed("clock", P)


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("motions", [AT_MANY_SPEEDS, AT_ONE_SPEED], ids=["many speeds", "one speed"])
def test_a_moved_mount_is_named_unless_it_looks_like_a_delay(axis, motions):
    size = math.radians(1.0) if axis < 3 else 0.4
    found = told([section(a, only(axis, size), 30 * ROAD, lens=1e8) for a in motions])
    wanted = "forward_or_sync" if axis == 3 and motions is AT_ONE_SPEED else "mount"
    assert found.cause(P) == wanted
    assert not found.changed("clock", P)
    assert not found.changed("lens", P)


def explained(alone, unexplained):
    """An explanation with the misfits given, of a mount that could do without its own change."""
    found = told([section(driven(10.0), np.zeros(8))])
    return dataclasses.replace(found, alone=np.array(alone), needed=np.zeros(3), unexplained=unexplained)


@pytest.mark.parametrize(
    ("alone", "unexplained", "named"),
    [
        # A section with sweeps and images a tenth of a second apart: a metre ahead fits better by 11.
        ((1.0, 12.7, 270.0), 274.0, "forward_or_sync"),
        ((1.0, 26.7, 270.0), 274.0, "forward_or_sync"),
        ((1.0, 26.8, 270.0), 274.0, "mount"),
        # A turn that no delay explains, however little it is: the clock fits no better than nothing.
        ((1.0, 24.0, 25.0), 26.0, "mount"),
        ((12.7, 1.0, 270.0), 274.0, "time_offset"),
    ],
)
def test_the_mount_is_blamed_only_where_the_clock_explains_less_than_its_five_unknowns_more(
    alone, unexplained, named
):
    assert explained(alone, unexplained).cause(P) == named


def test_a_mount_that_moved_while_the_clock_went_wrong_is_still_told():
    theta = only(CLOCK, 0.04) + only(2, math.radians(1.0))
    found = told([section(a, theta, 30 * ROAD) for a in AT_MANY_SPEEDS])
    assert found.cause(P) == "mount"
    assert found.changed("clock", P)


def like_a_step(information, range_m, share):
    """Information (7,7) where a longer focal length looks like a step ahead, but for a share of it."""
    step = information[:, 3] * range_m
    W = np.zeros((7, 7))
    W[:6, :6] = information
    W[:6, 6] = W[6, :6] = step
    W[6, 6] = step[3] * range_m + share * information[3, 3] * range_m**2
    return W


@pytest.mark.parametrize(("share", "named"), [(0.3, "intrinsics_changed"), (1e-9, "mount")])
def test_another_focal_length_is_named_where_near_and_far_are_seen(share, named):
    sections = [lensed(a, only(LENS, 0.02), like_a_step(30 * ROAD, 20.0, share)) for a in AT_MANY_SPEEDS]
    found = told(sections)
    assert found.cause(P) == named
    assert found.changed("lens", P) == (named == "intrinsics_changed")
    if named == "intrinsics_changed":
        assert found.zoom == pytest.approx(0.02, abs=3 * found.zoom_sigma)


def test_what_no_single_cause_explains_stays_open():
    theta = only(CLOCK, 0.05) + only(LENS, 0.04)
    found = told([lensed(a, theta, like_a_step(30 * ROAD, 20.0, 0.5)) for a in AT_MANY_SPEEDS])
    assert found.needed[0] < P.mount
    assert found.cause(P) == "cause_open"


def test_assumed_motion_tells_no_delay():
    sections = [section(a, only(CLOCK, 0.03), 30 * ROAD) for a in AT_MANY_SPEEDS]
    sections[2] = dataclasses.replace(sections[2], tracked=False)
    assert not told(sections).separable


def test_a_vehicle_that_stands_tells_no_delay():
    assert not told([section(driven(0.0), np.zeros(8))] * 3).separable


def test_misfits_of_a_healthy_mount_are_chi_square_distributed():
    """What each source adds when it is sound: 6, 1 and 1 degrees of freedom; sigma of the delay honest."""
    rng = np.random.default_rng(8)
    needed, z = [], []
    for _ in range(400):
        m = np.linalg.cholesky(SOUND) @ rng.normal(size=6)
        theta = np.concatenate([m, [SYNC_S * rng.normal(), P.zoom * rng.normal()]])
        W = like_a_step(ROAD, 20.0, 0.5)
        found = told([lensed(a, theta, W, rng) for a in AT_MANY_SPEEDS])
        needed.append(found.needed)
        z.append((found.time_offset_s - theta[CLOCK]) / found.time_sigma_s)
    np.testing.assert_allclose(np.mean(needed, axis=0), [6.0, 1.0, 1.0], rtol=0.25)
    assert 0.60 < np.mean(np.abs(z) < 1.0) < 0.76


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 1000))
def test_the_order_of_sections_is_of_no_matter_and_more_never_widen(seed):
    rng = np.random.default_rng(seed)
    theta = np.concatenate([0.01 * rng.normal(size=6), [0.01, 0.0]])
    sections = [section(driven(v, 0.1 * rng.normal()), theta, rng=rng) for v in rng.uniform(1, 20, 6)]
    whole, turned = told(sections), told(sections[::-1])
    np.testing.assert_allclose(turned.needed, whole.needed, rtol=1e-6, atol=1e-6)
    assert told(sections[:4]).time_sigma_s >= whole.time_sigma_s * (1 - 1e-9)


def test_all_sources_have_a_place():
    found = told([section(driven(10.0), np.zeros(8))])
    assert found.needed.shape == found.alone.shape == (len(SOURCES),)
    assert found.unexplained == pytest.approx(0.0, abs=1e-9)
