"""``calibwatch extrinsic import`` as a person calls it: what it prints, writes, and refuses."""

import numpy as np
import pytest
from click.testing import CliRunner

from monitor.cli import calibwatch, main
from monitor.rig import load_rig
from pipeline.errors import RigError
from pipeline.se3 import exp_so3, inverse, transform

T = transform(exp_so3(np.array([1.2, -1.1, 1.3])), np.array([0.1, -0.2, 0.3]))


@pytest.fixture
def matrix(tmp_path):
    path = tmp_path / "T.txt"
    np.savetxt(path, T, fmt="%.17g")
    return path


def run(*arguments):
    return CliRunner().invoke(calibwatch, ["extrinsic", "import", *map(str, arguments)])


def test_the_rig_file_holds_the_extrinsic_and_the_message_says_how_it_was_read(matrix, tmp_path):
    out = tmp_path / "rig.toml"
    result = run(matrix, "--out", out, "--direction", "T_lidar_cam", "--pair", "front")
    assert result.exit_code == 0, result.output
    assert "read as T_lidar_cam (by --direction), inverted" in result.output
    pair = load_rig(out).pairs[0]
    assert pair.name == "front"
    np.testing.assert_allclose(pair.T_cam_lidar, inverse(T), atol=1e-14)
    assert [path.name for path in tmp_path.iterdir()] != []
    assert not list(tmp_path.glob("*.partial"))


def test_a_rig_file_is_replaced_only_by_force(matrix, tmp_path):
    out = tmp_path / "rig.toml"
    out.write_text("mine")
    result = run(matrix, "--out", out, "--direction", "T_cam_lidar")
    assert isinstance(result.exception, RigError)
    assert out.read_text() == "mine"
    assert run(matrix, "--out", out, "--direction", "T_cam_lidar", "--force").exit_code == 0
    np.testing.assert_allclose(load_rig(out).pairs[0].T_cam_lidar, T, atol=1e-14)


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["--out", "rig.toml"], 1, "which way"),
        (["--out", "rig.json", "--direction", "T_cam_lidar"], 1, "no .toml file"),
        (["--out", "none/rig.toml", "--direction", "T_cam_lidar"], 1, "can not be written"),
        (["--out", "rig.toml", "--direction", "T_cam_lidar", "--pair", "a/b"], 1, "can not name a pair"),
        (["--out", "rig.toml", "--direction", "up"], 2, "T_lidar_cam"),
        (["--out", "rig.toml", "--size", "9"], 2, "1920x1200"),
        (["--out", "rig.toml", "--format", "kitti"], 1, "calib_cam_to_cam.txt"),
    ],
)
def test_bad_use_gives_its_exit_code_and_one_line(
    matrix, tmp_path, monkeypatch, capsys, arguments, code, told
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["extrinsic", "import", str(matrix), *arguments])
    assert ended.value.code == code
    error = capsys.readouterr().err
    assert told in error
    assert code == 2 or error.count("\n") == 1
    assert not (tmp_path / "rig.toml").exists()
