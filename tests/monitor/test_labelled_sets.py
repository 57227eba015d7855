"""Sets are found and read as their layout says; what does not keep it is refused by the file."""

import json

import cv2
import numpy as np
import pytest

from monitor.labelled_sets import find_sets
from pipeline import labels
from pipeline.errors import InputError
from tests.monitor.labelled import write_set

PICTURE = np.random.default_rng(1).integers(0, 256, (20, 30, 3)).astype(np.uint8)
LABEL = np.random.default_rng(2).integers(0, 9, (20, 30)).astype(np.uint8)


def test_a_set_gives_its_pictures_and_labels(tmp_path):
    write_set(tmp_path / "b", [(PICTURE, LABEL)])
    write_set(tmp_path / "a", [(PICTURE, LABEL)])
    (tmp_path / "classes.json").write_text(json.dumps({"classes": list(labels.NAMES)}))
    first, second = find_sets([tmp_path])
    assert [one.folder.name for one in (first, second)] == ["a", "b"]
    picture, label = first.read("p0")
    assert np.array_equal(picture, PICTURE)
    assert np.array_equal(label, LABEL)
    assert [one.folder for one in find_sets([tmp_path / "b"])] == [tmp_path / "b"]
    assert len(find_sets([tmp_path / "b", tmp_path])) == 2


def test_a_jpeg_comes_before_a_png(tmp_path):
    folder = write_set(tmp_path / "a", [(PICTURE, LABEL)])
    assert cv2.imwrite(str(folder / "images" / "p0.jpg"), PICTURE)
    (one,) = find_sets([folder])
    assert one.files("p0") == (folder / "images" / "p0.jpg", folder / "labels" / "p0.png")


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "not JSON"),
        ("[1]", "no JSON object"),
        ("{}", "splits is no object"),
        ("[" * 100_000, "not JSON"),
        ('{"labelled_classes": [1], "splits": {"val": ["../../secret"]}}', "no plain name of a file"),
        ('{"labelled_classes": [1], "splits": {"val": ["/etc/passwd"]}}', "no plain name of a file"),
        ('{"labelled_classes": [77], "splits": {}}', "classes 0 to 8"),
        ('{"labelled_classes": [1], "splits": {}, "folded_into": {"0": [1]}}', "does not fit"),
    ],
)
def test_a_description_that_can_not_be_used_is_named(tmp_path, text, told):
    folder = write_set(tmp_path / "a", [(PICTURE, LABEL)])
    (folder / "set.json").write_text(text)
    with pytest.raises(InputError, match=told) as refused:
        find_sets([tmp_path])
    assert str(folder / "set.json") in refused.value.what


def test_other_classes_are_refused(tmp_path):
    write_set(tmp_path / "a", [(PICTURE, LABEL)])
    (tmp_path / "classes.json").write_text('{"classes": ["cat", "dog"]}')
    with pytest.raises(InputError, match=r"classes\.json: classes are not other, lane"):
        find_sets([tmp_path])


def test_a_folder_without_sets_is_refused_even_beside_a_good_one(tmp_path):
    good = write_set(tmp_path / "good" / "a", [(PICTURE, LABEL)])
    for empty in (tmp_path, tmp_path / "none"):
        with pytest.raises(InputError, match=r"holds no set\.json"):
            find_sets([good, empty])


def test_files_that_do_not_fit_are_named(tmp_path):
    folder = write_set(tmp_path / "a", [(PICTURE, LABEL)], labelled_classes=[1, 2], folded_into={"0": [0, 3]})
    (one,) = find_sets([folder])
    with pytest.raises(InputError, match=r"values \[3, 4, 5, 6, 7, 8\] are neither labelled nor folded"):
        one.read("p0")
    with pytest.raises(InputError, match="p1 of a split lacks"):
        one.read("p1")
    assert cv2.imwrite(str(folder / "labels" / "p0.png"), LABEL[1:])
    with pytest.raises(InputError, match="its image has 30x20"):
        one.read("p0")
    (folder / "images" / "p0.png").write_bytes(b"no picture")
    with pytest.raises(InputError, match=r"images/p0\.png: "):
        one.read("p0")
