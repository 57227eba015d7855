import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline import se3
from pipeline.p3l import Degeneracy, above, in_front, p3l_candidates, plane_normals, upright

K = np.array([[721.5, 0.0, 609.6], [0.0, 721.5, 172.9], [0.0, 0.0, 1.0]])
HEIGHT = 1.73


def unit(a):
    return a / np.linalg.norm(a, axis=-1, keepdims=True)


def setups(rng, count, *, lean, turned=True):
    """Random roads of two lanes and a pole, in a LiDAR frame of any axes: truth, starts and ends (M,3,3)."""
    truths, starts, ends = [], [], []
    for _ in range(count):
        y = np.sort(rng.uniform(-6, 6, 2)) + np.array([-1.0, 1.0])
        near, far = rng.uniform(5, 10, 2), rng.uniform(18, 40, 2)
        side = rng.choice([-1.0, 1.0])
        foot = np.array([rng.uniform(8, 35), side * rng.uniform(2.5, 8), -HEIGHT + 0.5])
        tilt = rng.normal(0, np.radians(lean), 2)
        start = np.array([[near[0], y[0], -HEIGHT], [near[1], y[1], -HEIGHT], foot])
        end = np.array(
            [[far[0], y[0], -HEIGHT], [far[1], y[1], -HEIGHT], foot + 3.0 * unit(np.array([*tilt, 1.0]))]
        )
        R = se3.exp_so3(rng.normal(0, 0.05, 3)) @ se3.AXES_CAM_IN_VEHICLE.T
        T = se3.transform(R, R @ -rng.uniform(-0.5, 0.5, 3))
        frame = se3.transform(
            se3.exp_so3(unit(rng.normal(size=3)) * rng.uniform(0, np.pi)) if turned else np.eye(3),
            rng.normal(0, 1.0, 3) if turned else np.zeros(3),
        )
        truths.append(T @ se3.inverse(frame))
        starts.append(se3.apply(frame, start))
        ends.append(se3.apply(frame, end))
    return np.array(truths), np.array(starts), np.array(ends)


def seen_planes(truth, start, end, rng, sigma_px=0.0):
    """Normals (3,M,3) of the planes of the projected lines; ends and signs in any order."""
    normals = []
    for k in range(3):
        uv = []
        for points in (start[:, k], end[:, k]):
            cam = np.einsum("mij,mj->mi", truth[:, :3, :3], points) + truth[:, :3, 3]
            uv.append((cam @ K.T)[:, :2] / cam[:, 2:] + rng.normal(0, 1, (len(cam), 2)) * sigma_px)
        sign = rng.choice([-1.0, 1.0], (len(cam), 1))
        normals.append(sign * plane_normals(uv[0], uv[1], K))
    return normals


def solved(truth, start, end, rng, sigma_px=0.0):
    d = unit(end - start)
    normals = seen_planes(truth, start, end, rng, sigma_px)
    return p3l_candidates(*normals, d[:, 0], d[:, 2], start[:, 0], start[:, 1], start[:, 2])


@pytest.mark.parametrize("lean", [0.0, 3.0])
def test_truth_is_among_the_four_and_cheirality_leaves_it_alone(lean):
    rng = np.random.default_rng(1)
    truth, start, end = setups(rng, 1000, lean=lean)
    found = solved(truth, start, end, rng)
    assert found.valid.all()
    T = found.T_cam_lidar
    right = np.abs(T - truth[:, None]).max(axis=(2, 3)).min(axis=1)
    assert np.median(right) < 1e-12
    assert right.max() < 1e-9
    ends = np.concatenate([start, end], axis=1)
    ahead = in_front(T[:, :, None], ends[:, None]).all(axis=2)
    assert set(ahead.sum(axis=1).tolist()) == {1, 2}
    both = ahead & upright(T, start[:, None, 2], end[:, None, 2])
    # One in a thousand has a second such root, from below the road.
    assert np.mean(both.sum(axis=1) == 1) >= 0.995
    normal = np.cross(end[:, 0] - start[:, 0], start[:, 1] - start[:, 0])
    normal *= np.sign(np.einsum("mi,mi->m", start[:, 2] - start[:, 0], normal))[:, None]
    both &= above(T, start[:, None, 0], normal[:, None])
    assert (both.sum(axis=1) == 1).all()
    np.testing.assert_allclose(T[both], truth, atol=1e-9)


def test_each_root_is_a_rotation_that_puts_all_lines_into_their_planes():
    rng = np.random.default_rng(2)
    truth, start, end = setups(rng, 200, lean=5.0)
    d = unit(end - start)
    normals = seen_planes(truth, start, end, rng)
    T = p3l_candidates(*normals, d[:, 0], d[:, 2], start[:, 0], start[:, 1], start[:, 2]).T_cam_lidar
    R = T[:, :, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 1, 3, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-12)
    for k, n in enumerate(normals):
        for points in (start[:, k], end[:, k]):
            cam = np.einsum("mkij,mj->mki", R, points) + T[:, :, :3, 3]
            assert np.abs(np.einsum("mki,mi->mk", cam, n)).max() < 1e-7
    # Four different ones: no root is counted twice.
    for i in range(4):
        for j in range(i):
            assert np.linalg.norm(R[:, i] - R[:, j], axis=(1, 2)).min() > 1e-3


def test_roots_at_right_angles_form_the_group_of_half_turns():
    rng = np.random.default_rng(3)
    R = solved(*setups(rng, 50, lean=0.0), rng).T_cam_lidar[:, :, :3, :3]
    for k in range(1, 4):
        turn = R[:, k] @ R[:, 0].transpose(0, 2, 1)
        np.testing.assert_allclose(np.trace(turn, axis1=1, axis2=2), -1.0, atol=1e-6)


def test_a_leaning_pole_taken_for_an_upright_one_errs_as_much():
    """FORMULAS B (11): 1 deg sideways gives 1.00 deg and 0.23 m, the printed form's error."""
    rng = np.random.default_rng(4)
    lean = np.radians(1.0)
    start = np.array([[[8.0, 1.8, -HEIGHT], [8.0, -1.8, -HEIGHT], [15.0, 5.0, -HEIGHT + 0.5]]])
    end = start + np.array([[[17.0, 0, 0], [17.0, 0, 0], [0.0, 3 * np.sin(lean), 3 * np.cos(lean)]]])
    R = se3.AXES_CAM_IN_VEHICLE.T
    truth = se3.transform(R, -R @ [0.27, 0.0, -0.08])[None]
    normals = seen_planes(truth, start, end, rng)
    d = unit(end - start)
    for direction, expected in ((d[:, 2], 0.0), (np.array([[0.0, 0.0, 1.0]]), 1.0)):
        T = p3l_candidates(*normals, d[:, 0], direction, *start.transpose(1, 0, 2)).T_cam_lidar[0]
        angles = np.degrees([se3.rotation_angle(one[:3, :3], truth[0, :3, :3]) for one in T])
        assert angles.min() == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(
    ("pole", "rotation_deg", "longitudinal_m"),
    [
        ((8.0, 5.0), 0.31, 0.03),
        ((15.0, 5.0), 0.49, 0.10),
        ((25.0, 5.0), 0.82, 0.31),
        ((40.0, 5.0), 1.20, 0.74),
        ((15.0, 2.5), 0.48, 0.21),
    ],
)
def test_noise_grows_with_the_pole_s_range_as_published(pole, rotation_deg, longitudinal_m):
    """FORMULAS B, degenerate: medians at 1 px, lanes at +-1.8 m from 8 to 25 m, 2.5 m of the pole seen."""
    rng = np.random.default_rng(5)
    count = 1500
    foot = np.array([*pole, -HEIGHT + 0.5])
    top = foot + np.array([0.0, 0.0, 2.5])
    start = np.array([[8.0, 1.8, -HEIGHT], [8.0, -1.8, -HEIGHT], foot])
    end = np.array([[25.0, 1.8, -HEIGHT], [25.0, -1.8, -HEIGHT], top])
    R = se3.AXES_CAM_IN_VEHICLE.T
    truth = np.repeat(se3.transform(R, -R @ [0.27, 0.0, -0.08])[None], count, axis=0)
    start, end = np.repeat(start[None], count, axis=0), np.repeat(end[None], count, axis=0)
    T = solved(truth, start, end, rng, sigma_px=1.0).T_cam_lidar
    both = in_front(T[:, :, None], np.concatenate([start, end], axis=1)[:, None]).all(axis=2)
    both &= upright(T, start[:, None, 2], end[:, None, 2])
    T = T[both]
    assert len(T) >= 0.99 * count
    angle = np.degrees([se3.rotation_angle(one[:3, :3], truth[0, :3, :3]) for one in T])
    centre = -np.einsum("mji,mj->mi", T[:, :3, :3], T[:, :3, 3])
    along = np.abs(centre[:, 0] - 0.27)
    assert np.median(angle) == pytest.approx(rotation_deg, rel=0.10)
    assert np.median(along) == pytest.approx(longitudinal_m, rel=0.12)


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_turning_and_moving_the_lidar_frame_turns_the_answer(seed):
    rng = np.random.default_rng(seed)
    truth, start, end = setups(rng, 1, lean=2.0, turned=False)
    d = unit(end - start)
    normals = seen_planes(truth, start, end, rng)
    frame = se3.transform(se3.exp_so3(rng.normal(0, 1.5, 3)), rng.normal(0, 2, 3))
    here = p3l_candidates(*normals, d[:, 0], d[:, 2], *start.transpose(1, 0, 2)).T_cam_lidar[0]
    moved = np.stack([se3.apply(frame, points) for points in start[0]])[None]
    turned = d @ frame[:3, :3].T
    there = p3l_candidates(*normals, turned[:, 0], turned[:, 2], *moved.transpose(1, 0, 2)).T_cam_lidar[0]
    np.testing.assert_allclose(there @ frame, here, atol=1e-6)


def test_degenerate_sets_are_named_and_the_others_beside_them_solved():
    rng = np.random.default_rng(6)
    truth, start, end = setups(rng, 6, lean=0.0, turned=False)
    n1, n2, n3 = seen_planes(truth, start, end, rng)
    d = unit(end - start)
    d_l, d_p = d[:, 0].copy(), d[:, 2].copy()
    a = unit(np.cross(n1, n2))
    n2[1] = -n1[1]
    n3[2] = a[2]
    n3[3] = unit(np.cross(a[3], [0.1, 1.0, 0.2]))
    d_p[4] = d_l[4]
    # The pole's plane nearly square to the lanes, and a pole that leans by 60 deg along them.
    n3[5] = unit(a[5] + 0.1 * n1[5])
    d_p[5] = unit(d_l[5] + 0.5 * d_p[5])
    found = p3l_candidates(n1, n2, n3, d_l, d_p, start[:, 0], start[:, 1], start[:, 2])
    assert found.degeneracy.tolist() == [
        Degeneracy.NONE,
        Degeneracy.LANES_IN_ONE_PLANE,
        Degeneracy.POLE_ABEAM,
        Degeneracy.POLE_DEAD_AHEAD,
        Degeneracy.POLE_ALONG_LANES,
        Degeneracy.NO_ROOT,
    ]
    assert found.valid.tolist() == [True] + [False] * 5
    assert np.abs(found.T_cam_lidar[0] - truth[0]).max(axis=(1, 2)).min() < 1e-9
    np.testing.assert_array_equal(found.T_cam_lidar[1:], np.broadcast_to(np.eye(4), (5, 4, 4, 4)))


def test_a_root_just_missed_by_noise_is_the_nearest_one():
    """Between r and 1.05 r the pole is laid into its plane as near to its angle as it goes."""
    n1, n2 = unit(np.array([[1.0, 1.0, 0.0]])), unit(np.array([[-1.0, 1.0, 0.0]]))
    # The lanes run along z; the pole's plane is tilted 60 deg from square, so r = cos 60 deg.
    n3 = np.array([[0.0, np.sin(np.radians(30)), np.cos(np.radians(30))]])
    r = np.sin(np.radians(30))
    for excess, valid in ((0.99, True), (1.04, True), (1.06, False)):
        c = r * excess
        d_p = np.array([[c, 0.0, np.sqrt(1 - c * c)]])
        found = p3l_candidates(n1, n2, n3, np.array([[1.0, 0, 0]]), d_p, *np.zeros((3, 1, 3)))
        assert found.valid.tolist() == [valid]
        if valid:
            pole = found.T_cam_lidar[0, :, :3, :3] @ d_p[0]
            missed = np.degrees(np.arcsin(np.abs(pole @ n3[0]))).max()
            assert missed == pytest.approx(
                max(0.0, np.degrees(np.arccos(r) - np.arccos(min(c, 1.0)))), abs=1e-6
            )


def test_no_correspondence_gives_no_candidate():
    none = np.zeros((0, 3))
    found = p3l_candidates(none, none, none, none, none, none, none, none)
    assert found.T_cam_lidar.shape == (0, 4, 4, 4)
    assert found.valid.shape == (0,)


def test_normals_hold_the_line_and_ignore_its_scale():
    rng = np.random.default_rng(7)
    start, end = rng.uniform(0, 1000, (2, 50, 2))
    n = plane_normals(start, end, K)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, atol=1e-12)
    for uv in (start, end, 0.3 * start + 0.7 * end):
        rays = np.column_stack([uv, np.ones(50)]) @ np.linalg.inv(K).T
        assert np.abs((rays * n).sum(axis=1)).max() < 1e-12
    np.testing.assert_array_equal(plane_normals(start[:1], start[:1], K), np.zeros((1, 3)))


def test_rows_with_a_number_missing_are_named_and_the_others_solved():
    rng = np.random.default_rng(8)
    truth, start, end = setups(rng, 9, lean=1.0)
    d = unit(end - start)
    given_ = [*seen_planes(truth, start, end, rng), d[:, 0], d[:, 2], start[:, 0], start[:, 1], start[:, 2]]
    given_ = [array.copy() for array in given_]
    for k, array in enumerate(given_):
        array[k, k % 3] = (np.nan, np.inf)[k % 2]
    found = p3l_candidates(*given_)
    assert found.degeneracy.tolist() == [Degeneracy.NO_NUMBER] * 8 + [Degeneracy.NONE]
    assert np.isfinite(found.T_cam_lidar).all()
    assert np.abs(found.T_cam_lidar[8] - truth[8]).max(axis=(1, 2)).min() < 1e-9
