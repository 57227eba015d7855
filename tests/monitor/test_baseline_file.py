import dataclasses
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from monitor.baseline_file import BaselineDocument, document_of, read_baseline, with_baselines, write_baseline
from monitor.baselining import described, learned_from
from monitor.daemon import mount_of
from monitor.injection import inject
from monitor.rig import load_rig, parse_rig
from pipeline import se3
from pipeline.baseline import learn
from pipeline.drift_test import DriftTestParameters
from pipeline.drive_estimates import Drive
from pipeline.errors import InputError, RigError
from pipeline.verdict import start
from tests.pipeline.simulated_windows import FLOOR, simulated_drive

PARAMETERS = DriftTestParameters()
T = se3.inverse(se3.transform(se3.AXES_CAM_IN_VEHICLE, np.array([0.3, 0.1, -0.2])))
PAIR = {
    "name": "front",
    "camera": {"K": [[700, 0, 600], [0, 700, 180], [0, 0, 1]], "width": 1200, "height": 360},
    "extrinsic": {"T_cam_lidar": T.tolist()},
    "T_vehicle_lidar": np.eye(4).tolist(),
}
RIG = parse_rig({"pairs": [PAIR]}, where="here")


def drives(count=3, **changes):
    rng = np.random.default_rng(count)
    return [simulated_drive(rng, f"drive {i}", spread=0.3 * FLOOR, **changes) for i in range(count)]


def learned(count=3):
    return learn(drives(count), PARAMETERS, 1e7, np.random.default_rng(0))


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "front.baseline.json"
    write_baseline(document_of({"front": (mount_of(RIG.pairs[0]), learned())}), path)
    return path


def altered(file, change):
    content = json.loads(file.read_bytes())
    change(content["pairs"]["front"])
    file.write_text(json.dumps(content))
    return file


def test_what_is_written_is_read_again(file):
    (pair,) = with_baselines(RIG, file).pairs
    found, wanted = pair.baseline, learned()
    assert found is not None
    for name in ("bias", "covariance", "spread", "deviation", "own"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name), rel=1e-12, abs=1e-18)
    assert (found.scatter.noise, found.scatter.correlation_m) == (
        wanted.scatter.noise,
        wanted.scatter.correlation_m,
    )
    assert found.tail == wanted.tail
    assert [s.recording for s in found.stretches] == [s.recording for s in wanted.stretches]
    mount = mount_of(pair)
    assert mount.expectation(PARAMETERS).mean == pytest.approx(wanted.bias)
    assert mount.noise >= 1.0
    assert list(file.parent.iterdir()) == [file]


def test_a_rig_file_names_the_baseline_from_its_own_folder(file):
    folder = file.parent / "rigs"
    folder.mkdir()
    rig_file = folder / "van.json"
    rig_file.write_text(json.dumps({"pairs": [PAIR | {"baseline": {"file": "../front.baseline.json"}}]}))
    (pair,) = with_baselines(load_rig(rig_file), None).pairs
    assert pair.baseline is not None
    assert with_baselines(RIG, None).pairs[0].baseline is None


def test_an_injected_drift_is_one_from_the_baseline(file):
    """The baseline holds for the extrinsic as it is stored; what is altered afterwards keeps it."""
    (pair,) = with_baselines(RIG, file).pairs
    drifted = inject(pair, np.array([0, 0, math.radians(0.5), 0, 0, 0]))
    assert drifted.baseline is pair.baseline


def test_a_baseline_of_another_extrinsic_is_refused(file):
    drifted = inject(RIG.pairs[0], np.array([0, 0, 1e-9, 0, 0, 0]))
    with pytest.raises(RigError, match="learned under extrinsic"):
        with_baselines(dataclasses.replace(RIG, pairs=(drifted,)), file)


def test_a_baseline_in_other_axes_is_refused(file):
    turned = se3.transform(se3.exp_so3(np.array([0, 0, 0.1])), np.zeros(3))
    pair = dataclasses.replace(RIG.pairs[0], T_vehicle_lidar=turned)
    with pytest.raises(RigError, match="other vehicle axes"):
        with_baselines(dataclasses.replace(RIG, pairs=(pair,)), file)


def test_a_baseline_without_the_pair_is_refused(file):
    pair = dataclasses.replace(RIG.pairs[0], name="rear")
    with pytest.raises(RigError, match="no baseline of pair rear"):
        with_baselines(dataclasses.replace(RIG, pairs=(pair,)), file)


def _negative(part):
    part["covariance"][2][2] = -1e-9


def _lopsided(part):
    part["spread"][0][5] *= 3.0
    part["spread"][0][5] += 1e-6


def _flat(part):
    part["covariance"] = [[0.0] * 6 for _ in range(6)]


def _singular(part):
    part["covariance"] = [[1e-6] * 6 for _ in range(6)]


@pytest.mark.parametrize("change", [_negative, _lopsided, _flat, _singular])
def test_a_matrix_that_is_no_covariance_is_refused(file, change):
    with pytest.raises(InputError, match="is no covariance"):
        with_baselines(RIG, altered(file, change))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (b"", "is no baseline"),
        (b"\xff\xfe{}", "is no baseline"),
        (b"[" * 100_000, "is no baseline"),
        (b'{"schema": "calibwatch.baseline/2", "software": "", "pairs": {}}', "schema"),
        (b'{"schema": "calibwatch.baseline/1", "software": "", "pairs": {}}', "pairs"),
        (b'{"schema": "calibwatch.baseline/1", "software": "", "pairs": {"a/b": {}}}', "pairs"),
    ],
)
def test_other_content_is_refused(tmp_path, text, what):
    path = tmp_path / "baseline.json"
    path.write_bytes(text)
    with pytest.raises(InputError, match=what):
        read_baseline(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("bias", [0.0] * 5),
        ("bias", [math.nan] + [0.0] * 5),
        ("bias", [1e999] + [0.0] * 5),
        ("noise", 0.0),
        ("noise", "much"),
        ("correlation_m", -1.0),
        ("extrinsic", "abc"),
        ("stretches", []),
        ("deviation", [-1.0] * 6),
        ("more", 1),
    ],
)
def test_a_value_that_can_not_be_is_refused_by_name(file, key, value):
    with pytest.raises(InputError, match=rf"is no baseline: pairs\.front\.{key}"):
        read_baseline(altered(file, lambda part: part.update({key: value})))


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_damaged_files_are_refused_or_whole(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "damaged.json"
    content = bytearray(
        document_of({"front": (mount_of(RIG.pairs[0]), learned(2))}).model_dump_json().encode()
    )
    at = data.draw(st.integers(0, len(content) - 1))
    content[at : at + data.draw(st.integers(0, 40))] = data.draw(st.binary(max_size=8))
    path.write_bytes(content)
    try:
        found = with_baselines(RIG, path)
    except (InputError, RigError):
        return
    baseline = found.pairs[0].baseline
    assert baseline is not None
    assert np.isfinite(baseline.expectation(PARAMETERS).floor).all()


def test_a_missing_file_and_one_that_is_too_large_are_said(tmp_path):
    with pytest.raises(InputError, match="can not be read"):
        read_baseline(tmp_path / "none.json")
    large = tmp_path / "large.json"
    with large.open("wb") as stream:
        stream.truncate(65 << 20)
    with pytest.raises(InputError, match="too many"):
        read_baseline(large)
    with pytest.raises(InputError, match="can not be written"):
        write_baseline(BaselineDocument.model_construct(), tmp_path / "no" / "such.json")


# What is learned from recordings, and what is refused.


MOUNT = mount_of(RIG.pairs[0])


def watched(drive, **changes):
    return Drive(drive, 0, dataclasses.replace(start(0), **changes))


def test_healthy_drives_are_described_in_words():
    told = described(learned_from(MOUNT, [watched(drive) for drive in drives(4)], "front"))
    assert told.samples.startswith("4 recordings, 4 stretches of road (792 m), ")
    assert told.samples.endswith("effective samples")
    assert told.bias.startswith("bias known to 0.0")
    assert "of their sigma, alike over" in told.noise
    assert "too few for a run length" in told.threshold
    assert "default thresholds stay" in told.threshold
    assert len(told.rows) == 6
    assert len(told.others) == 4
    single = described(learned_from(MOUNT, [watched(drive) for drive in drives(1)], "front"))
    assert "one street tells nothing of the spread" in single.bias
    assert single.others == ()


def test_a_drive_that_is_off_by_more_than_a_limit_is_refused_by_name():
    healthy = [watched(drive) for drive in drives(3)]
    bias = np.array([0, 0, math.radians(0.9), 0, 0, 0])
    off = simulated_drive(np.random.default_rng(0), "friday", bias=bias)
    with pytest.raises(InputError, match=r"not healthy: friday is off by yaw \+0\.9"):
        learned_from(MOUNT, [*healthy, watched(off)], "front")


def test_a_drive_on_which_the_mount_moved_is_refused_by_name():
    one, other = drives(2)
    slip = np.zeros_like(one.drift)
    slip[len(one) // 2 :, 2] = -math.radians(0.6)
    moved = dataclasses.replace(one, drift=one.drift + slip)
    with pytest.raises(InputError, match=r"not healthy: drive 0 moved on the way by yaw -0\.[56]"):
        learned_from(MOUNT, [watched(moved), watched(other)], "front")
    # Off by a little from its first window on, it shows the stored extrinsic's own error: that is the bias.
    off = [dataclasses.replace(drive, drift=drive.drift + 3e-3) for drive in (one, other)]
    found = learned_from(MOUNT, [watched(drive, state="drifted") for drive in off], "front").baseline
    assert found.bias == pytest.approx(learned(2).bias + 3e-3)


def test_a_drive_that_differs_from_the_others_is_refused_by_name():
    """Each within its limits, but one under a mount that has moved."""
    bias = np.array([0, 0, math.radians(0.55), 0, -0.02, 0])
    off = simulated_drive(np.random.default_rng(1), "friday", bias=bias)
    mount = dataclasses.replace(MOUNT, limits=MOUNT.limits * 2.0)
    healthy = [watched(drive) for drive in drives(4)]
    with pytest.raises(InputError, match="friday differs from the other recordings by yaw"):
        learned_from(mount, [*healthy, watched(off)], "front")


def test_one_drive_under_two_names_is_refused():
    one, other = drives(2)
    twin = dataclasses.replace(one.chosen(np.arange(5)), recording="part of drive 0")
    with pytest.raises(InputError, match="are the same drive"):
        learned_from(MOUNT, [watched(one), watched(other), watched(twin)], "front")


def test_a_drive_that_shows_nothing_is_left_out_by_name():
    one, other = drives(2)
    dark = watched(one.chosen(np.zeros(len(one), dtype=bool)), reason="It was dark.")
    found = learned_from(MOUNT, [dark, watched(other)], "front")
    assert found.unused == (("drive 0", "It was dark."),)
    with pytest.raises(InputError, match=r"nothing to learn from: drive 0: It was dark\."):
        learned_from(MOUNT, [dark], "front")
