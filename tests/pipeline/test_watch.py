import dataclasses
import functools
import math
from contextlib import contextmanager

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline import se3
from pipeline.mount import Mount
from pipeline.parameters import Parameters
from pipeline.records import AXES, CameraImage, CameraModel, FramePair, PointCloud
from pipeline.simulation.drive import Drive, DriveParameters
from pipeline.simulation.lidar import spinning
from pipeline.simulation.scene import SceneParameters
from pipeline.watch import Watch

LIMITS = np.array([math.radians(0.75), math.radians(0.5), math.radians(0.5), 0.20, 0.15, 0.15])
CAMERA = CameraModel(
    "pinhole", np.array([[360.0, 0, 269.5], [0, 360, 89.5], [0, 0, 1]]), np.zeros(0), 540, 180
)
FORWARD, LEFT = 0.0, 90.0
S = 1_000_000_000


def looking(yaw_deg):
    """T_cam_lidar of a camera on the roof that looks ``yaw_deg`` to the left of ahead."""
    lidar = DriveParameters().T_vehicle_lidar
    R = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix() @ se3.AXES_CAM_IN_VEHICLE
    return se3.inverse(se3.transform(R, np.array([1.2, 0.1, 1.6]))) @ lidar


@functools.cache
def simulated(yaw_deg=FORWARD, frames=9, **changes):
    """A short drive at 10 Hz with small sensors: parameters and pairs."""
    parameters = DriveParameters(
        seed=3,
        duration=0.1 * frames,
        scene=SceneParameters(length=200.0),
        lidar=spinning(64, 900),
        camera=CAMERA,
        T_stored=looking(yaw_deg),
        exposure=0.053 if yaw_deg == FORWARD else 0.028,
        **{name: np.array(value) if name == "drift" else value for name, value in changes.items()},
    )
    pairs = [
        FramePair("front", f.cloud, f.image, f.cloud_stamp_ns, f.image_stamp_ns, 0.1)
        for f in Drive(parameters)
    ]
    return parameters, pairs


def mount_of(parameters, drift=None, turn=None):
    """What is stored where the mount has moved by ``drift`` since, the LiDAR frame turned by ``turn``."""
    drift = np.zeros(6) if drift is None else drift
    T = se3.stored_before(parameters.T_stored, drift, parameters.T_vehicle_lidar[:3, :3])
    back = np.eye(4) if turn is None else se3.inverse(turn)
    return Mount(
        camera=parameters.camera,
        T_cam_lidar=T @ back,
        T_vehicle_lidar=parameters.T_vehicle_lidar @ back,
        sigma_rad=math.radians(0.1),
        sigma_m=0.02,
        limits=LIMITS,
        required=("pitch", "yaw"),
    )


def turned_pairs(pairs, turn):
    def moved(cloud):
        return dataclasses.replace(cloud, xyz=se3.apply(turn, cloud.xyz).astype(np.float32))

    return [dataclasses.replace(pair, cloud=moved(pair.cloud)) for pair in pairs]


def watched(mount, pairs):
    """A watch that has seen the pairs, and the states it went through."""
    watch, states = Watch(mount, Parameters(), None), []
    for pair in pairs:
        watch.step(pair)
        states.append(watch.memory.state)
    return watch, states


def injected(axis, size):
    """A drift of one axis, degrees or metres."""
    return (math.radians(size) if axis < 3 else size) * np.eye(6)[axis]


def check_told(watch, states, axis, drift):
    judgement = watch.belief.judgement
    assert states[-1] == "drifted"
    assert watch.memory.severity == "major"
    off = np.abs(judgement.drift - drift)
    assert np.degrees(off[:3]).max() < 0.3
    assert off[3:].max() < 0.1
    assert int(np.argmax(np.abs(judgement.drift) / LIMITS)) == axis
    assert f"{AXES[axis]} {'+' if drift[axis] > 0 else '-'}" in watch.memory.reason
    # The estimate as an extrinsic is that drift away from the stored one.
    mount = watch.mount
    again = se3.mount_drift(mount.T_cam_lidar, watch.belief.T_estimated, mount.R_vehicle_cam)
    np.testing.assert_allclose(again, judgement.drift, atol=1e-9)


def test_a_true_extrinsic_is_not_suspected():
    parameters, pairs = simulated()
    watch, states = watched(mount_of(parameters), pairs)
    assert set(states) <= {"starting", "healthy"}
    judgement = watch.belief.judgement
    assert np.degrees(np.abs(judgement.drift[:3])).max() < 0.15
    assert np.abs(judgement.drift[3:]).max() < 0.05
    assert not judgement.suspicious
    assert judgement.observable.all()
    assert watch.frames == len(pairs)
    assert watch.window_stamps == tuple(pair.image_stamp_ns for pair in pairs)


@pytest.fixture(scope="module")
def yawed():
    """A watch that was told of a degree of yaw, its states, and the drift."""
    parameters, pairs = simulated()
    drift = injected(2, 1.0)
    return *watched(mount_of(parameters, drift), pairs), drift


def test_a_degree_of_yaw_is_told_with_sign_and_size(yawed):
    watch, states, drift = yawed
    check_told(watch, states, 2, drift)
    onset = watch.memory.onset
    assert onset.from_ns <= onset.stamp_ns <= onset.to_ns <= watch.window_stamps[-1]


def test_the_same_frames_give_the_same_verdict(yawed):
    watch, states, drift = yawed
    parameters, pairs = simulated()
    again, others = watched(mount_of(parameters, drift), pairs)
    assert others == states
    np.testing.assert_array_equal(again.belief.judgement.drift, watch.belief.judgement.drift)
    assert again.memory.reason == watch.memory.reason


@pytest.mark.parametrize("axis", ["z", "x"])
def test_a_lidar_turned_by_90_degrees_tells_the_same_drift(yawed, axis):
    watch, _, drift = yawed
    parameters, pairs = simulated()
    turn = se3.transform(Rotation.from_euler(axis, 90, degrees=True).as_matrix(), np.zeros(3))
    other, states = watched(mount_of(parameters, drift, turn), turned_pairs(pairs, turn))
    check_told(other, states, 2, drift)
    off = np.abs(other.belief.judgement.drift - watch.belief.judgement.drift)
    assert np.degrees(off[:3]).max() < 0.03
    assert off[3:].max() < 0.01


SETUPS = {"forward": (FORWARD, 0), "left": (LEFT, 0), "lidar turned": (FORWARD, 90)}


@pytest.mark.slow
@pytest.mark.parametrize("axis", range(6), ids=AXES)
@pytest.mark.parametrize("setup", SETUPS)
@pytest.mark.parametrize("sign", [1, -1])
def test_each_axis_is_told_with_sign_and_size(setup, axis, sign):
    camera_yaw, lidar_yaw = SETUPS[setup]
    parameters, pairs = simulated(camera_yaw, frames=14)
    drift = injected(axis, sign * (1.0 if axis < 3 else 0.3))
    turn = se3.transform(Rotation.from_euler("z", lidar_yaw, degrees=True).as_matrix(), np.zeros(3))
    watch, states = watched(mount_of(parameters, drift, turn), turned_pairs(pairs, turn))
    if setup == "left" and AXES[axis] in ("yaw", "forward"):
        # Abeam a second of one row of houses shows where both together lead, not which of the two it was, and
        # an error in time would look like forward: the sign and half the size are told, and doubt.
        assert {"suspect", "drifted"} & set(states)
        assert "healthy" not in states
        assert watch.belief.judgement.drift[axis] / drift[axis] > 0.5
        return
    if AXES[axis] == "forward":
        # A second at one speed: a delay of 27 ms would look the same.
        assert (watch.memory.state, watch.memory.code) == ("suspect", "forward_or_sync")
        assert not {"healthy", "drifted"} & set(states)
        assert watch.belief.judgement.drift[axis] == pytest.approx(drift[axis], abs=0.1)
        return
    check_told(watch, states, axis, drift)


@pytest.mark.slow
def test_a_mount_that_moves_on_the_way_is_told_with_its_moment():
    drift = injected(2, 1.0)
    # Four seconds later the window has forgotten what was before.
    parameters, pairs = simulated(frames=50, drift_time=1.0, drift=tuple(drift))
    watch, states = watched(mount_of(parameters), pairs)
    assert set(states[:10]) <= {"starting", "healthy"}
    assert states[-1] == "drifted"
    onset = watch.memory.onset
    assert onset.from_ns <= parameters.drift_stamp_ns <= onset.to_ns
    assert abs(watch.belief.judgement.drift[2] - drift[2]) < math.radians(0.3)


@pytest.mark.slow
def test_full_size_sensors_are_healthy_within_three_seconds():
    parameters = DriveParameters(seed=8, duration=3.0)
    pairs = [
        FramePair("front", f.cloud, f.image, f.cloud_stamp_ns, f.image_stamp_ns, 0.1)
        for f in Drive(parameters)
    ]
    _, states = watched(mount_of(parameters), pairs)
    assert states[-1] == "healthy"
    assert set(states) == {"starting", "healthy"}


def fresh():
    parameters, pairs = simulated()
    return Watch(mount_of(parameters), Parameters(), None), pairs


def without(pair, keep):
    cloud = pair.cloud
    return dataclasses.replace(
        pair,
        cloud=PointCloud(cloud.xyz[keep], cloud.intensity[keep], cloud.ring[keep], cloud.time[keep]),
    )


def road_ahead(pair):
    """Rings that see nothing but the lane before the vehicle."""
    bearing = np.arctan2(pair.cloud.xyz[:, 1], pair.cloud.xyz[:, 0])
    return without(pair, (pair.cloud.ring > 26) & (pair.cloud.ring < 34) & (np.abs(bearing) < 0.1))


@pytest.mark.parametrize(
    ("reason", "change"),
    [
        ("image_size", lambda p: dataclasses.replace(p, image=CameraImage(np.zeros((90, 270, 3), np.uint8)))),
        ("empty_cloud", lambda p: without(p, np.zeros(len(p.cloud), bool))),
        ("no_edges", lambda p: without(p, p.cloud.ring == 40)),
        ("no_scan_pattern", lambda p: without(p, p.cloud.xyz[:, 0] < -1)),
        ("no_scan_pattern", lambda p: without(p, np.arange(len(p.cloud)) < 3)),
        ("no_edges", road_ahead),
    ],
)
def test_a_frame_that_gives_nothing_says_why_and_leaves_no_trace(reason, change):
    watch, pairs = fresh()
    for pair in pairs[:2]:
        findings = watch.step(change(pair))
        assert findings.dropped == reason
        assert not findings.judged
    assert watch.frames == 0
    assert watch.window_stamps == ()
    assert watch.belief is None
    assert watch.memory.state == "starting"
    watch.finish()
    assert watch.memory.state == "unobservable"
    # A good frame after it is taken.
    assert watch.step(pairs[2]).dropped is None
    assert watch.window_stamps == (pairs[2].image_stamp_ns,)


def test_frames_without_edges_age_those_with_them():
    watch, pairs = fresh()
    for pair in pairs[:3]:
        watch.step(pair)
    assert len(watch.window_stamps) == 3
    newest = pairs[2].image_stamp_ns
    # Lines alone go on coming, a second apart, on the same spot.
    for second in range(1, 40):
        now_ns = newest + second * 10**9
        watch._line_frames.append((now_ns, None))  # noqa: SLF001 - a network would take a minute
        watch._enter(now_ns)  # noqa: SLF001 - the same
        watch._retain(now_ns, 0.0)  # noqa: SLF001 - the same
        assert (watch.window_stamps == ()) == (now_ns - newest > watch.parameters.window.oldest_ns)
    assert watch.window_stamps == ()
    assert watch.departed["past"] == 3
    assert watch.breaks == 0


def test_findings_of_a_good_frame():
    watch, pairs = fresh()
    findings = watch.step(pairs[0])
    assert findings.dropped is None
    assert findings.masks is None
    assert findings.lines is None
    assert findings.edge_points.dtype == np.float32
    assert len(findings.edge_points) > 50
    assert len(findings.cloud) == len(pairs[0].cloud)


def test_silence_is_stale_and_empties_the_window():
    watch, pairs = fresh()
    for pair in pairs[:3]:
        watch.step(pair)
    last = pairs[2].image_stamp_ns
    watch.silent(last + 2 * S - 1)
    assert watch.memory.state == "starting"
    assert len(watch.window_stamps) == 3
    watch.silent(last + 2 * S)
    assert watch.memory.state == "stale"
    assert watch.window_stamps == ()
    later = dataclasses.replace(
        pairs[3], image_stamp_ns=last + 9 * S, cloud_stamp_ns=pairs[3].cloud_stamp_ns + 9 * S
    )
    watch.step(later)
    assert watch.memory.state == "starting"
    assert watch.window_stamps == (last + 9 * S,)


def test_silence_before_the_first_pair():
    watch, _ = fresh()
    watch.silent(5 * S)
    assert watch.memory.state == "starting"
    watch.silent(7 * S)
    assert watch.memory.state == "stale"


def at(pair, shift_ns):
    return dataclasses.replace(
        pair,
        image_stamp_ns=pair.image_stamp_ns + shift_ns,
        cloud_stamp_ns=pair.cloud_stamp_ns + shift_ns,
    )


@pytest.mark.parametrize("jump_s", [-1000, -1, 60])
def test_a_clock_that_jumps_begins_a_new_window(jump_s):
    watch, pairs = fresh()
    for pair in pairs[:3]:
        watch.step(pair)
    moved = [at(pair, jump_s * S) for pair in pairs[3:6]]
    for pair in moved:
        watch.step(pair)
    assert watch.window_stamps == tuple(pair.image_stamp_ns for pair in moved)
    assert watch.memory.input_ns == moved[-1].image_stamp_ns
    assert watch.memory.since_ns <= moved[-1].image_stamp_ns
    assert watch.memory.state == "starting"


def test_a_recording_without_pairs_and_one_that_is_too_short():
    watch, pairs = fresh()
    watch.finish(7 * S)
    assert (watch.memory.state, watch.memory.code) == ("unobservable", "no_pairs")
    watch, pairs = fresh()
    watch.step(pairs[0])
    watch.finish()
    assert watch.memory.state == "unobservable"
    assert watch.memory.code in ("too_short", "nothing_in_common")
    assert watch.belief is not None
    watch, pairs = fresh()
    watch.step(without(pairs[0], pairs[0].cloud.ring == 40))
    watch.finish()
    assert watch.memory.state == "unobservable"


def test_stages_are_measured_by_the_caller():
    begun, ended = [], []

    @contextmanager
    def stage(name):
        begun.append(name)
        yield
        ended.append(name)

    watch, pairs = fresh()
    for pair in pairs[:5]:
        watch.step(pair, stage)
    assert begun == ended
    assert begun[:4] == ["motion", "ground", "edges", "gradients"]
    assert "judgement" in begun


def test_up_and_forward_are_those_of_the_vehicle_else_of_the_camera():
    parameters, _ = simulated()
    mount = mount_of(parameters)
    np.testing.assert_allclose(mount.up, parameters.T_vehicle_lidar[2, :3], atol=1e-12)
    np.testing.assert_allclose(mount.forward, parameters.T_vehicle_lidar[0, :3], atol=1e-12)
    bare = dataclasses.replace(mount, T_vehicle_lidar=None)
    np.testing.assert_allclose(bare.up, -mount.T_cam_lidar[1, :3], atol=1e-12)
    np.testing.assert_allclose(bare.forward, mount.T_cam_lidar[2, :3], atol=1e-12)


def test_an_acknowledged_drift_that_is_still_there_is_told_again():
    parameters, pairs = simulated()
    watch, states = watched(mount_of(parameters, injected(2, 1.0)), pairs)
    assert states[-1] == "drifted"
    first, last = pairs[0].image_stamp_ns, pairs[-1].image_stamp_ns
    # Wrong from the beginning, and no drive before it.
    assert watch.memory.onset.stamp_ns == watch.memory.onset.from_ns == first
    assert watch.acknowledge(last, "Ada", "noted")
    assert (watch.memory.state, watch.memory.severity, watch.memory.onset) == ("starting", None, None)
    assert not watch.acknowledge(last, "Ada", "noted")
    for pair in pairs:
        later = {name: getattr(pair, name) + S for name in ("cloud_stamp_ns", "image_stamp_ns")}
        watch.step(dataclasses.replace(pair, **later))
    assert watch.memory.state == "drifted"
    assert watch.memory.onset.from_ns >= last
