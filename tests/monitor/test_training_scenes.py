import json

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from monitor import training_scenes
from pipeline import labels
from pipeline.simulation.variety import draw_variety, picture


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("training") / "simulated"
    options = ["--out", str(out), "--count", "3", "--seed", "7", "--workers", "1"]
    result = CliRunner().invoke(training_scenes.main, options)
    assert result.exit_code == 0, result.output
    return out


def test_the_set_says_what_it_holds(folder):
    said = json.loads((folder / "set.json").read_text())
    assert said["labelled_classes"] == list(range(len(labels.NAMES)))
    assert said["splits"] == {"train": ["0007_00001", "0007_00002"], "val": ["0007_00000"]}
    for names in said["splits"].values():
        for name in names:
            shown = cv2.imread(str(folder / "images" / f"{name}.jpg"))
            drawn = cv2.imread(str(folder / "labels" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
            assert drawn.dtype == np.uint8
            assert shown.shape[:2] == drawn.shape
            assert set(np.unique(drawn).tolist()) <= {*range(len(labels.NAMES)), labels.IGNORE}
            assert len(np.unique(drawn)) >= 4


def test_a_picture_is_the_same_whenever_it_is_drawn(folder):
    rng = np.random.default_rng([7, 1])
    again, _ = picture(draw_variety(rng), rng)
    drawn = cv2.imread(str(folder / "labels" / "0007_00001.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(drawn, again.labels)


def test_a_folder_that_can_not_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("in the way")
    options = ["--out", str(tmp_path / "file" / "set"), "--count", "1"]
    result = CliRunner().invoke(training_scenes.main, options)
    assert result.exit_code == 1
    assert "folder" in result.output
