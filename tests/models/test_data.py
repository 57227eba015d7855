import json

import cv2
import numpy as np
import pytest

from models import data
from models.data import DataError, Sampler, fingerprint, read_set, read_sets
from pipeline import labels


def write_set(folder, *, pictures=3, said=None, size=(120, 200)):
    """A set whose pictures are grey with one bright lane line, one dark pole and an ignored band on top."""
    (folder / "images").mkdir(parents=True)
    (folder / "labels").mkdir()
    ids = [f"{i:03d}" for i in range(pictures)]
    for i, identifier in enumerate(ids):
        picture = np.full((*size, 3), 100, np.uint8)
        label = np.zeros(size, np.uint8)
        label[:10] = labels.IGNORE
        label[60:, 80 + i : 84 + i] = labels.LANE
        label[20:60, 150 : 153 + i] = labels.POLE
        picture[label == labels.LANE] = 250
        picture[label == labels.POLE] = 10
        cv2.imwrite(str(folder / "images" / f"{identifier}.png"), picture)
        cv2.imwrite(str(folder / "labels" / f"{identifier}.png"), label)
    default = {"labelled_classes": [0, 1, 2], "splits": {"train": ids[:-1], "val": ids[-1:]}}
    (folder / "set.json").write_text(json.dumps(default | (said or {})))
    return folder


def test_a_set_gives_its_pictures_and_labels(tmp_path):
    one = read_set(write_set(tmp_path / "a"))
    picture, label = one.read("000")
    assert picture.shape == (120, 200, 3)
    assert set(np.unique(label)) == {0, 1, 2, 255}
    assert one.splits == {"train": ("000", "001"), "val": ("002",)}
    assert [s.folder.name for s in read_sets([tmp_path])] == ["a"]


@pytest.mark.parametrize(
    "said",
    [
        {"labelled_classes": None},
        {"splits": [1]},
        {"splits": {"train": 4}},
        {"splits": {"train": ["../../a"]}},
        {"folded_into": {"0": [3]}},
        {"folded_into": {"x": [0]}},
        {"folded_into": [0]},
    ],
)
def test_set_json_that_says_nonsense_is_refused_by_its_name(tmp_path, said):
    with pytest.raises(DataError, match=r"set\.json"):
        read_set(write_set(tmp_path / "a", said=said))


def test_labels_that_the_set_does_not_know_are_refused(tmp_path):
    one = read_set(write_set(tmp_path / "a", said={"labelled_classes": [0, 1]}))
    with pytest.raises(DataError, match=r"values \[2\]"):
        one.read("000")
    folded = read_set(
        write_set(tmp_path / "b", said={"labelled_classes": [1], "folded_into": {"0": [0, 3], "2": [2, 4]}})
    )
    folded.read("000")


def test_damaged_missing_and_ill_sized_files_are_refused(tmp_path):
    one = read_set(write_set(tmp_path / "a"))
    with pytest.raises(DataError, match="lacks"):
        one.read("777")
    (tmp_path / "a" / "labels" / "000.png").write_bytes(b"no picture")
    with pytest.raises(DataError, match="can not be decoded"):
        one.read("000")
    cv2.imwrite(str(tmp_path / "a" / "labels" / "001.png"), np.zeros((5, 5), np.uint8))
    with pytest.raises(DataError, match="does not fit"):
        one.read("001")


def test_a_root_without_sets_or_with_other_classes_is_refused(tmp_path):
    with pytest.raises(DataError, match="no "):
        read_sets([tmp_path])
    write_set(tmp_path / "a")
    (tmp_path / "classes.json").write_text(json.dumps({"classes": ["cat", "dog"]}))
    with pytest.raises(DataError, match="classes are not"):
        read_sets([tmp_path])


def test_fingerprint_tells_any_changed_training_file_and_no_other(tmp_path):
    write_set(tmp_path / "a")
    before = fingerprint(read_sets([tmp_path]))
    assert fingerprint(read_sets([tmp_path])) == before
    (tmp_path / "a" / "labels" / "002.png").write_bytes(b"val")
    assert fingerprint(read_sets([tmp_path])) == before
    path = tmp_path / "a" / "images" / "001.png"
    path.write_bytes(path.read_bytes() + b"\0")
    assert fingerprint(read_sets([tmp_path])) != before


def test_the_same_seed_draws_the_same_crops(tmp_path):
    write_set(tmp_path / "a")
    batches = [
        Sampler(read_sets([tmp_path]), (64, 96), {}).batch(4, np.random.default_rng(5)) for _ in range(2)
    ]
    for first, second in zip(*batches, strict=True):
        assert np.array_equal(first, second)
    rgb, label, groups = batches[0]
    assert (rgb.shape, rgb.dtype) == ((4, 3, 64, 96), np.uint8)
    assert (label.shape, label.dtype) == ((4, 64, 96), np.uint8)
    assert groups.shape == (4, 9, 9)


def test_crops_seek_thin_things_and_keep_picture_and_label_together(tmp_path, monkeypatch):
    """Paint is the bright and the pole the dark of these pictures: so it must be after the geometry alone."""
    monkeypatch.setattr(data.augment, "CHANCES", ())
    write_set(tmp_path / "a", size=(240, 400))
    sampler = Sampler(
        read_sets([tmp_path]),
        (64, 64),
        {},
        thin_share=1.0,
        widths=(300.0, 600.0),
        paint_share=0.0,
        pole_share=0.0,
    )
    rng = np.random.default_rng(6)
    seen = 0
    for _ in range(60):
        crop = sampler.draw(rng)
        grey = crop.picture[..., 0].astype(int)
        lane, pole = crop.label == labels.LANE, crop.label == labels.POLE
        seen += bool(lane.any() or pole.any())
        if lane.sum() > 60:
            assert np.median(grey[lane]) > 180
        if pole.sum() > 60:
            assert np.median(grey[pole]) < 80
    assert seen > 50


def test_weights_say_how_often_a_set_is_drawn(tmp_path):
    write_set(tmp_path / "dark")
    write_set(tmp_path / "marked", said={"labelled_classes": [1, 2], "folded_into": {"0": [0, 3]}})
    sampler = Sampler(read_sets([tmp_path]), (32, 32), {"dark": 1.0, "marked": 3.0})
    rng = np.random.default_rng(7)
    marked = sum(bool(sampler.draw(rng).groups[0, 3]) for _ in range(200))
    assert 120 < marked < 180
    with pytest.raises(DataError, match="fog"):
        Sampler(read_sets([tmp_path]), (32, 32), {"fog": 1.0})


def test_synthetic_marks_are_drawn_where_road_is_known(tmp_path):
    """A set without paint gets some, as often as asked, and its poles too."""
    folder = write_set(tmp_path / "a", size=(240, 400), said={"labelled_classes": [0, 1, 2, 3]})
    for file in (folder / "labels").iterdir():
        label = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        label[:] = labels.OTHER
        label[100:] = labels.ROAD
        cv2.imwrite(str(file), label)
    sets = read_sets([tmp_path])

    def shares(**chances):
        sampler = Sampler(sets, (128, 192), {}, widths=(300.0, 600.0), **chances)
        rng = np.random.default_rng(3)
        crops = [sampler.draw(rng).label for _ in range(60)]
        return [np.mean([(crop == value).sum() > 20 for crop in crops]) for value in data.THIN]

    assert shares(paint_share=0.0, pole_share=0.0) == [0.0, 0.0]
    lane, pole = shares(paint_share=1.0, pole_share=0.0)
    assert lane > 0.4
    assert pole == 0.0
    lane, pole = shares(paint_share=0.0, pole_share=1.0)
    assert lane == 0.0
    assert pole > 0.5


def test_only_the_sets_that_are_asked_for_are_read(tmp_path):
    for name in ("a", "b", "c"):
        write_set(tmp_path / name)
    assert [one.folder.name for one in read_sets([tmp_path], frozenset({"c", "a"}))] == ["a", "c"]
    with pytest.raises(DataError, match="no set fog below"):
        read_sets([tmp_path], frozenset({"a", "fog"}))
