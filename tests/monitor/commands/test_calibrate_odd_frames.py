"""``calibwatch calibrate`` of frames that show nothing, and of sensors mounted any way round."""

import json
import math

import cv2
import numpy as np
import pytest

from pipeline import se3
from tests.drives import PARAMETERS
from tests.monitor.frame_folders import frame, write_frames


def with_cloud(folder, **arrays):
    np.savez(folder / "cloud.npz", **arrays)
    return folder


def calibrated(calibwatch, folder, *options):
    code, out, err = calibwatch("calibrate", folder, "--json", *options)
    return code, json.loads(out) if out else None, err


def _one_ring(count=4000):
    angle = np.linspace(-np.pi, np.pi, count)
    return np.column_stack([10 * np.cos(angle), 10 * np.sin(angle), np.full(count, -1.7)]).astype(np.float32)


CLOUDS = {
    "one point": np.array([[9.0, 1.0, -1.0]], np.float32),
    "points all equal": np.tile(np.float32([9.0, 1.0, -1.0]), (4000, 1)),
    "one ring": _one_ring(),
    "all behind": np.random.default_rng(0).uniform((-60, -20, -2), (-5, 20, 4), (4000, 3)).astype(np.float32),
    "out of reach": np.full((4000, 3), 3e38, np.float32),
    "no numbers": np.full((4000, 3), np.nan, np.float32),
}


@pytest.mark.parametrize("kind", CLOUDS)
def test_a_cloud_of_nothing_gives_no_statement_in_one_line(calibwatch, tmp_path, kind):
    folder = with_cloud(write_frames(tmp_path / "frame"), xyz=CLOUDS[kind])
    code, result, err = calibrated(calibwatch, folder)
    assert code in (1, 4)
    assert "Traceback" not in err
    assert code == 4 or len(err.splitlines()) == 1
    for pair in result or []:
        assert pair["observable"] == []


@pytest.mark.parametrize("shade", [0, 255])
def test_an_image_of_nothing_gives_no_statement(calibwatch, tmp_path, shade):
    folder = write_frames(tmp_path / "frame")
    height, width = frame().image.pixels.shape[:2]
    cv2.imwrite(str(folder / "image.png"), np.full((height, width, 3), shade, np.uint8))
    code, result, err = calibrated(calibwatch, folder)
    assert code == 4
    assert "Traceback" not in err
    assert all(pair["observable"] == [] for pair in result or [])


TURNS = {
    "as it is": (0.0, 0.0, 0.0),
    "upside down": (math.pi, 0.0, 0.0),
    "left is forward": (0.0, 0.0, math.pi / 2),
}


def test_turning_the_lidar_turns_no_answer(calibwatch, tmp_path):
    """The rig file tells how it is mounted; drift is told in the vehicle's axes."""
    answers = []
    for name, turn in TURNS.items():
        motion = se3.transform(se3.exp_so3(np.array(turn)), np.zeros(3))
        folder = write_frames(
            tmp_path / name.replace(" ", "_"),
            T_cam_lidar=(PARAMETERS.T_stored @ se3.inverse(motion)).tolist(),
            T_vehicle_lidar=(PARAMETERS.T_vehicle_lidar @ se3.inverse(motion)).tolist(),
        )
        c = frame().cloud
        xyz = se3.apply(motion, c.xyz.astype(np.float64)).astype(np.float32)
        with_cloud(folder, xyz=xyz, intensity=c.intensity, ring=c.ring.astype(np.uint8), time=c.time)
        code, result, _ = calibrated(calibwatch, folder, "--inject", "yaw=0.8")
        assert code == 0
        answers.append(result[0])
    straight, *others = answers
    assert {"yaw", "pitch"} <= set(straight["observable"])
    for other in others:
        for axis in ("roll", "pitch", "yaw"):
            a, b = straight["axes"][axis], other["axes"][axis]
            assert b["value"] == pytest.approx(a["value"], abs=max(0.1, a["sigma"]))


def test_points_out_of_reach_among_the_others_change_nothing(calibwatch, tmp_path):
    plain = write_frames(tmp_path / "plain")
    c = frame().cloud
    folder = write_frames(tmp_path / "dirty")
    n = 500
    with_cloud(
        folder,
        xyz=np.concatenate([c.xyz, np.full((n, 3), 1e20, np.float32)]),
        intensity=np.concatenate([c.intensity, np.ones(n, np.float32)]),
        ring=np.concatenate([c.ring, np.zeros(n, c.ring.dtype)]).astype(np.uint8),
        time=np.concatenate([c.time, np.zeros(n, np.float32)]),
    )
    (a,), (b,) = (calibrated(calibwatch, where)[1] for where in (plain, folder))
    assert b["axes"] == a["axes"]
