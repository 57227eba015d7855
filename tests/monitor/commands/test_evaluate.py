"""``calibwatch evaluate masks``: closed forms on pictures whose masks are known, and bad sets in one line."""

import json

import cv2
import numpy as np
import pytest

from monitor.commands.evaluate import LONGEST_SIDE
from monitor.training_scenes import write_scene
from pipeline import labels, segmentation
from pipeline.label_image import label_image
from pipeline.masks import MaskParameters, masks_from_probabilities
from pipeline.segmentation import Segmenter, grid_scale
from tests.monitor.labelled import write_set
from tests.oracles import plain_network

WIDTH = 1280


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "plain.onnx"
    path.write_bytes(plain_network.model())
    return path


@pytest.fixture
def measured(calibwatch, network, tmp_path):
    """Evaluation of sets by the plain network, as JSON: set name -> its report."""

    def run(*options, folder=tmp_path):
        code, out, err = calibwatch("evaluate", "masks", folder, "--model", network, "--json", *options)
        assert (code, err) == (0, "")
        return {one["name"]: one for one in json.loads(out)["sets"]}

    return run


def stripe(first, last, value=labels.LANE, height=64):
    label = np.full((height, WIDTH), labels.ROAD, np.uint8)
    label[:, first:last] = value
    return label


def pair(seen, truth):
    return plain_network.picture(seen), truth


def value(report, name, way="thresholds", of="lane"):
    return report["classes"][of]["masks"][way][name]["value"]


def test_masks_that_are_right_get_full_marks(measured, tmp_path):
    both = stripe(400, 420)
    both[:, 800:808] = labels.POLE
    write_set(tmp_path / "right", [pair(both, both)] * 2)
    report = measured("--no-crf")["right"]
    for way in ("argmax", "thresholds"):
        for of, wide in (("lane", 20), ("pole", 8)):
            found = report["classes"][of]["masks"][way]
            assert {name: ratio["value"] for name, ratio in found.items()} == pytest.approx(
                {"iou": 1, "precision": 1, "recall": 1, "f": 1, "covered": wide / WIDTH}
            )
            assert found["iou"]["low"] == found["iou"]["high"] == 1.0
            assert report["classes"][of]["labelled"] == pytest.approx(wide / WIDTH)
    assert (report["images"], report["masks_ms"]) == (2, None)
    assert report["network_ms"] > 0
    assert "crf" not in report["classes"]["lane"]["masks"]


@pytest.mark.parametrize(("moved", "forgiven"), [(2, 1.0), (4, 0.9)])
def test_two_pixels_at_1280_are_forgiven_and_four_are_not(measured, tmp_path, moved, forgiven):
    write_set(tmp_path / "a", [pair(stripe(400 + moved, 420 + moved), stripe(400, 420))])
    report = measured("--no-crf")["a"]
    assert value(report, "precision") == value(report, "recall") == pytest.approx(forgiven)
    assert value(report, "iou") == pytest.approx((20 - moved) / (20 + moved))


def test_the_crf_is_the_one_of_the_watch(measured, tmp_path):
    """A stripe with holes, and specks: what the pipeline makes of it is what is judged."""
    truth = stripe(400, 420)[:, :601]
    holes = np.random.default_rng(4).random(truth.shape) < 0.2
    seen = np.where(holes, labels.ROAD, truth)
    seen[:, 500:] = np.where(holes[:, 500:], labels.LANE, labels.ROAD)
    picture = plain_network.picture(seen)
    write_set(tmp_path / "a", [(picture, truth)])
    report = measured()["a"]
    probabilities = Segmenter(plain_network.model()).probabilities(picture)
    for way, parameters in (("crf", MaskParameters()), ("thresholds", MaskParameters(crf=None))):
        masks = masks_from_probabilities(probabilities, picture, parameters, scale=grid_scale(601, 64))
        mask, lane = label_image(masks, (601, 64)) == labels.LANE, truth == labels.LANE
        assert value(report, "iou", way=way) == pytest.approx((mask & lane).sum() / (mask | lane).sum())
        assert value(report, "covered", way=way) == pytest.approx(mask.mean())
    assert value(report, "iou", way="crf") != value(report, "iou")
    assert report["masks_ms"] > 0
    assert report["classes"]["lane"]["reliability"].keys() == {"network", "crf"}


def test_classes_that_a_set_does_not_draw_are_left_out(measured, tmp_path):
    seen = stripe(400, 420)
    seen[:, 800:808] = labels.POLE
    poles = stripe(800, 808, labels.POLE)
    write_set(tmp_path / "poles", [pair(seen, poles)], labelled_classes=[0, 2, 3], folded_into={"3": [3, 1]})
    write_set(tmp_path / "roads", [pair(seen, stripe(0, 0))], labelled_classes=[3])
    found = measured("--no-crf")
    assert found.keys() == {"poles"}
    assert found["poles"]["classes"].keys() == {"pole"}
    assert value(found["poles"], "iou", of="pole") == 1.0


def test_what_may_be_the_class_or_another_says_nothing(measured, tmp_path):
    """Paint was drawn, but value 3 may hide some: false alarms count on 0 alone."""
    truth = stripe(400, 420)
    truth[:, :100] = labels.OTHER
    seen = truth.copy()
    seen[:, 40:60] = seen[:, 900:920] = labels.LANE
    write_set(tmp_path / "a", [pair(seen, truth)], labelled_classes=[0, 1, 3], folded_into={"3": [3, 1]})
    assert value(measured("--no-crf")["a"], "iou") == pytest.approx(20 / 40)
    ignored = np.where(truth == labels.ROAD, labels.IGNORE, truth).astype(np.uint8)
    write_set(tmp_path / "b", [pair(seen, ignored)], labelled_classes=[0, 1])
    report = measured("--no-crf")["b"]
    assert value(report, "iou") == pytest.approx(20 / 40)
    assert value(report, "covered") == pytest.approx(40 / 120)


def test_a_drawn_class_that_is_folded_itself_gives_no_figure(measured, tmp_path):
    seen = stripe(400, 420)
    write_set(tmp_path / "a", [pair(seen, seen)], folded_into={"1": [1, 3]})
    report = measured("--no-crf")["a"]
    assert report["classes"]["lane"]["labelled"] == 0.0
    assert value(report, "recall") is None
    assert value(report, "iou") is None


def test_an_image_found_and_one_missed_is_anything_from_nothing_to_all(measured, tmp_path):
    found = stripe(400, 420)
    write_set(tmp_path / "a", [pair(found, found), pair(stripe(0, 0), found)])
    ratio = measured("--no-crf")["a"]["classes"]["lane"]["masks"]["thresholds"]["recall"]
    assert ratio == {"value": 0.5, "low": 0.0, "high": 1.0}


def test_other_thresholds_and_the_reliability_are_told(measured, tmp_path):
    """A stripe between odd columns: the cells at its borders are half covered, p = 0.5."""
    odd = stripe(401, 419)
    write_set(tmp_path / "a", [pair(odd, odd)])
    report = measured("--no-crf")["a"]["classes"]["lane"]
    sweep = {float(t): quality["iou"]["value"] for t, quality in report["sweep"].items()}
    assert sorted(sweep) == pytest.approx([0.05 * i for i in range(1, 20)])
    for threshold, iou in sweep.items():
        assert iou == pytest.approx(18 / 20 if threshold <= 0.5 else 16 / 18)
    said = report["reliability"]["network"]
    rows = 64
    assert said["pixels"] == [rows * (WIDTH - 20), 0, 0, 0, 0, rows * 4, 0, 0, 0, rows * 16]
    assert said["observed"] == [0.0, *[None] * 4, 0.5, *[None] * 3, 1.0]
    assert said["stated"] == [0.0, *[None] * 4, 0.5, *[None] * 3, 1.0]
    assert said["error"] == 0.0


def test_images_are_reduced_first_where_that_is_asked(measured, tmp_path):
    """At a fourth of the width a cell is 8 px: borders on multiples of 8 stay, others are rounded out."""
    write_set(tmp_path / "a", [pair(stripe(400, 424), stripe(400, 424))])
    write_set(tmp_path / "b", [pair(stripe(400, 420), stripe(400, 420))])
    found = measured("--no-crf", "--longest-side", "320")
    assert value(found["a"], "iou") == 1.0
    assert value(found["b"], "iou") == pytest.approx(20 / 24)
    assert LONGEST_SIDE == segmentation.LONGEST_SIDE


def test_tables_go_to_stdout_and_files(calibwatch, network, tmp_path):
    both = stripe(400, 420)
    both[:, 800:808] = labels.POLE
    write_set(tmp_path / "sets" / "one", [pair(both, both)] * 2)
    options = ("--model", network, "--out", tmp_path / "out", "--threads", "1")
    code, out, err = calibwatch("evaluate", "masks", tmp_path / "sets", *options)
    assert (code, err) == (0, "")
    assert (tmp_path / "out" / "masks.md").read_text() == out
    told = json.loads((tmp_path / "out" / "masks.json").read_text())
    assert (told["schema"], told["split"], told["threads"]) == ("calibwatch.mask-evaluation/1", "val", 1)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["masks.json", "masks.md"]
    full = " | ".join(["1.00 [1.00, 1.00]"] * 4)
    assert f"| one | lane | 2 | thresholds | {full} | 1.56 | 1.56 |" in out.splitlines()
    tables = [block.splitlines() for block in out.split("\n\n") if block.startswith("|")]
    assert [len(table) for table in tables] == [2 + 6, 2 + 4, 2 + 1]
    for table in tables:
        assert len({line.count("|") for line in table}) == 1


def test_the_network_that_ships_finds_paint_on_simulated_streets(calibwatch, tmp_path):
    folder = tmp_path / "streets"
    for name in ("images", "labels"):
        (folder / name).mkdir(parents=True)
    ids = [write_scene(folder, 7, index) for index in range(2)]
    (folder / "set.json").write_text(json.dumps({"labelled_classes": list(range(9)), "splits": {"val": ids}}))
    code, out, err = calibwatch("evaluate", "masks", folder, "--json", "--no-crf")
    assert (code, err) == (0, "")
    (report,) = json.loads(out)["sets"]
    assert value(report, "f") > 0.3
    drawn = [cv2.imread(str(folder / "labels" / f"{name}.png"), cv2.IMREAD_UNCHANGED) for name in ids]
    lane, known = (sum(np.isin(label, v).sum() for label in drawn) for v in (labels.LANE, range(9)))
    assert report["classes"]["lane"]["labelled"] == pytest.approx(lane / known)


def no_files(folder):
    (folder / "labels" / "p0.png").unlink()


def other_size(folder):
    assert cv2.imwrite(str(folder / "labels" / "p0.png"), np.zeros((5, 5), np.uint8))


def unknown_value(folder):
    assert cv2.imwrite(str(folder / "labels" / "p0.png"), stripe(0, 9, 200))


def text_picture(folder):
    (folder / "images" / "p0.png").write_text("no picture")


def outside(folder):
    (folder / "set.json").write_text('{"labelled_classes": [1], "splits": {"val": ["../../p0"]}}')


def other_split(folder):
    (folder / "set.json").write_text('{"labelled_classes": [1], "splits": {"train": ["p0"]}}')


def nothing_drawn(folder):
    (folder / "set.json").write_text('{"labelled_classes": [3], "splits": {"val": ["p0"]}}')


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (no_files, "p0 of a split lacks"),
        (other_size, "p0.png: 5x5 px, its image has 1280x64"),
        (unknown_value, "values [200] are neither labelled nor folded"),
        (text_picture, "images/p0.png: a picture that starts with"),
        (outside, "'../../p0' is no plain name of a file"),
        (other_split, "has a split 'val' and labelled lane or pole"),
        (nothing_drawn, "has a split 'val' and labelled lane or pole"),
    ],
)
def test_a_set_that_can_not_be_used_is_one_line(calibwatch, network, tmp_path, harm, told):
    folder = write_set(tmp_path / "a", [pair(stripe(4, 24), stripe(4, 24))])
    harm(folder)
    code, out, err = calibwatch("evaluate", "masks", tmp_path, "--model", network, "--out", tmp_path / "out")
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert told in err
    assert err.endswith(")\n")
    assert not list((tmp_path / "out").iterdir())


def test_what_is_no_folder_of_sets_no_network_and_no_place_is_one_line(calibwatch, network, tmp_path):
    folder = write_set(tmp_path / "a", [pair(stripe(4, 24), stripe(4, 24))])
    (tmp_path / "file").write_text("no network")
    for arguments, told in (
        ([tmp_path / "none"], "holds no set.json"),
        ([folder, "--model", tmp_path / "file"], f"model {tmp_path / 'file'}: "),
        ([folder, "--model", network, "--out", tmp_path / "file" / "out"], "can not be made"),
    ):
        code, out, err = calibwatch("evaluate", "masks", *arguments)
        assert (code, out, len(err.splitlines())) == (1, "", 1)
        assert told in err


@pytest.mark.parametrize(
    "arguments", [[], ["x", "--longest-side", "1281"], ["x", "--threads", "0"], ["x", "--spilt", "val"]]
)
def test_wrong_usage_is_two(calibwatch, arguments):
    assert calibwatch("evaluate", "masks", *arguments)[0] == 2
