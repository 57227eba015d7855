"""A candidate as a signed document: what it holds, and that tampering is told."""

import dataclasses
import hashlib
import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import monitor.candidate_file as module
from monitor.candidate_file import document_of, json_schema, verified
from monitor.statements import Identity
from monitor.status import Provenance
from pipeline import se3
from pipeline.candidate import Candidate, WindowEstimate
from pipeline.errors import InputError
from pipeline.hold_out import HoldOut
from pipeline.mount import Mount
from pipeline.records import CameraModel

IDENTITY = Identity(
    "van-17",
    "front",
    Provenance(hash="ab" * 32, version=None),
    Provenance(hash=None, version=None),
    "calibwatch test",
)
MOUNT = Mount(
    camera=CameraModel("pinhole", np.array([[100.0, 0, 80], [0, 100, 60], [0, 0, 1]]), np.empty(0), 160, 120),
    T_cam_lidar=se3.transform(se3.AXES_CAM_IN_VEHICLE.T, np.array([0.1, 0.2, 0.3])),
    T_vehicle_lidar=np.eye(4),
    sigma_rad=0.001,
    sigma_m=0.01,
    limits=np.ones(6),
    required=("yaw",),
)
DRIFT = np.array([0.0, 0.0, math.radians(0.5), 0.0, 0.1, 0.0])
COVARIANCE = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
CHECK = HoldOut(10, 20, 8, 31.5, 50, 0.25, 0.41, 0.42, 1e-4, 0.3, None, None, None, None)
WINDOW = WindowEstimate(1, 5, 0.0, 9.0, 8, np.zeros(6), COVARIANCE)


def proposed(**changes):
    T = se3.displaced(MOUNT.T_cam_lidar, DRIFT, MOUNT.R_vehicle_cam)
    return dataclasses.replace(
        Candidate(20, T, COVARIANCE, (WINDOW,), agreed=False, hold_out=CHECK), **changes
    )


def test_a_document_says_what_was_found_and_survives_its_file(tmp_path):
    document = document_of(IDENTITY, MOUNT, proposed())
    path = tmp_path / "front.candidate.json"
    path.write_bytes(document.to_json())
    back = verified(path.read_bytes(), str(path))
    assert back == document
    assert np.array_equal(np.array(back.T_cam_lidar), proposed().T_cam_lidar)
    assert np.array_equal(np.array(back.covariance), COVARIANCE)
    assert (back.drift.yaw, back.drift.left) == (pytest.approx(0.5), pytest.approx(0.1))
    # Camera x is the vehicle's right: its variance is that of left; y is down, z ahead.
    assert back.sigma.left == pytest.approx(math.sqrt(1e-4))
    assert back.sigma.forward == pytest.approx(math.sqrt(3e-4))
    assert back.sigma.roll == pytest.approx(math.degrees(math.sqrt(3e-6)))
    assert (back.axes, back.agreed, back.replaces.hash) == ("vehicle", False, "ab" * 32)
    assert back.hold_out.p_lines is None


def test_the_hash_is_that_of_the_rest_as_sorted_json():
    document = json.loads(document_of(IDENTITY, MOUNT, proposed()).to_json())
    told = document.pop("hash")
    text = json.dumps(document, sort_keys=True, separators=(",", ":"))
    assert told == hashlib.sha256(text.encode()).hexdigest()


@given(st.data())
def test_whatever_number_or_word_is_changed_it_is_told(data):
    document = json.loads(document_of(IDENTITY, MOUNT, proposed()).to_json())
    places = [["stamp_ns"], ["agreed"], ["vehicle"], ["hash"], ["replaces", "hash"], ["hold_out", "p_better"]]
    places += [["T_cam_lidar", i, j] for i in range(3) for j in range(4)]
    places += [["covariance", i, i] for i in range(6)] + [["windows", 0, "frames"], ["drift", "yaw"]]
    *path, last = data.draw(st.sampled_from(places))
    part = document
    for key in path:
        part = part[key]
    old = part[last]
    if isinstance(old, bool):
        part[last] = not old
    elif isinstance(old, str):
        part[last] = ("0" if old[0] != "0" else "1") + old[1:]
    else:
        part[last] = old + 1 if isinstance(old, int) else float(np.nextafter(old, 9.0))
    with pytest.raises(InputError, match="does not match its hash"):
        verified(json.dumps(document).encode(), "file")


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "is no calibwatch.candidate/1"),
        (b"{}", "is no calibwatch.candidate/1: vehicle: Field required"),
        (b"[" * 5000, "is no calibwatch.candidate/1"),
        (b" " * (2 << 20), "too large"),
    ],
)
def test_what_is_no_candidate_is_refused_in_one_line(data, says):
    with pytest.raises(InputError, match=says) as caught:
        verified(data, "file")
    assert "\n" not in caught.value.what


def test_a_signed_document_without_a_rigid_transform_is_refused():
    T = np.array(proposed().T_cam_lidar) * np.array([[1.1], [1.0], [1.0], [1.0]])
    with pytest.raises(InputError, match="no rigid transform"):
        verified(document_of(IDENTITY, MOUNT, proposed(T_cam_lidar=T)).to_json(), "file")


def test_the_committed_schema_is_that_of_the_model():
    committed = Path(module.__file__).with_name("candidate.schema.json").read_text()
    assert json.loads(committed) == json_schema(), (
        "renew it: python -c 'import json, monitor.candidate_file as s; "
        "print(json.dumps(s.json_schema(), indent=2, sort_keys=True))' > monitor/candidate.schema.json"
    )
