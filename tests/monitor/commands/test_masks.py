"""``calibwatch masks``: label images where the network saw something, one line for each bad image."""

import json

import cv2
import numpy as np
import pytest

from pipeline import labels
from pipeline.label_image import label_image
from pipeline.masks import MaskParameters, masks_from_probabilities
from pipeline.segmentation import Segmenter, grid_scale
from tests.oracles import onnx_bytes, plain_network


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "plain.onnx"
    path.write_bytes(plain_network.model())
    return path


def drawn(height=96, width=256):
    """A label of one stripe of paint and two poles, on even pixels, all beyond the least sizes."""
    label = np.zeros((height, width), np.uint8)
    label[60:80, 40:60] = labels.LANE
    label[8:60, 100:104] = label[8:60, 140:146] = labels.POLE
    return label


def save(path, pixels, *options):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels, options)
    return path


def labels_in(path):
    label = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert label.dtype == np.uint8
    return label


def test_the_label_image_lies_where_the_network_saw_it(calibwatch, network, tmp_path):
    image = save(tmp_path / "a.png", plain_network.picture(drawn()))
    out = tmp_path / "new" / "out"
    code, said, err = calibwatch("masks", image, "--out", out, "--no-crf", "--model", network)
    assert (code, err) == (0, "")
    assert np.array_equal(labels_in(out / "a.png"), drawn())
    assert sorted(path.name for path in out.iterdir()) == ["a.overlay.jpg", "a.png"]
    overlay = cv2.imread(str(out / "a.overlay.jpg"))
    assert overlay.shape == (96, 256, 3)
    # JPEG spreads colours by 16 px: near the poles there is light, far from everything there is none.
    assert overlay[70, 50].max() > 60
    assert overlay[:, 200:].max() < 20
    (line,) = said.splitlines()
    lane, pole = 100 * 400 / drawn().size, 100 * 520 / drawn().size
    assert line.startswith(
        f"{image}  256x96 px  lane {lane:.2f} % in 1 piece  pole {pole:.2f} % in 2 pieces  network "
    )


def test_json_tells_everything(calibwatch, network, tmp_path):
    image = save(tmp_path / "a.png", plain_network.picture(drawn()))
    bad = tmp_path / "bad.jpg"
    bad.write_text("no image")
    options = ("--out", tmp_path / "out", "--model", network, "--json")
    code, said, err = calibwatch("masks", bad, image, *options)
    told = json.loads(said)
    assert code == 1
    assert (told["schema"], told["model_version"], told["crf"], told["complete"]) == (
        "calibwatch.masks/1",
        "7.1",
        True,
        True,
    )
    (found,) = told["images"]
    assert (found["file"], found["width"], found["height"]) == (str(image), 256, 96)
    assert found["pole"]["components"] == 2
    assert found["pole"]["share"] == (labels_in(found["label"]) == labels.POLE).mean()
    assert found["network_ms"] > 0
    (refused,) = told["refused"]
    assert err == f"calibwatch: {refused['reason']}\n"


def test_a_large_image_gets_labels_of_its_own_size(calibwatch, network, tmp_path):
    label = drawn(400, 2560)
    image = save(tmp_path / "wide.png", plain_network.picture(label))
    calibwatch("masks", image, "--out", tmp_path / "out", "--no-crf", "--model", network)
    found = labels_in(tmp_path / "out" / "wide.png")
    assert found.shape == label.shape
    # Cells are 4 px here, and all edges lie on multiples of 4 but that of the wider pole.
    assert np.array_equal(found[:, :138], label[:, :138])
    assert (found != label).sum() <= 2 * 52


def test_bad_images_are_named_and_the_others_are_done(calibwatch, network, tmp_path):
    good = save(tmp_path / "good.png", plain_network.picture(drawn()))
    jpeg = save(
        tmp_path / "cut.jpg", np.random.default_rng(1).integers(0, 256, (90, 120, 3)).astype(np.uint8)
    )
    jpeg.write_bytes(jpeg.read_bytes()[:-700])
    (tmp_path / "empty.png").touch()
    (tmp_path / "text.jpg").write_text("hello")
    (tmp_path / "folder").mkdir()
    long = save(tmp_path / "long.png", np.zeros((1, 17000), np.uint8))
    names = ("cut.jpg", "empty.png", "text.jpg", "folder", "none.png")
    bad = [*(tmp_path / name for name in names), long]
    code, said, err = calibwatch("masks", *bad, good, "--out", tmp_path / "out", "--model", network)
    assert code == 1
    assert said.startswith(f"{good}  ")
    assert len(said.splitlines()) == 1
    lines = err.splitlines()
    assert len(lines) == len(bad)
    for path, line in zip(bad, lines, strict=True):
        assert line.startswith(f"calibwatch: {path}")
        assert line.endswith(")")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["good.overlay.jpg", "good.png"]


@pytest.mark.parametrize(
    "pixels",
    [
        np.zeros((90, 200, 3), np.uint8),
        np.full((90, 200, 3), 255, np.uint8),
        np.full((200, 90), 128, np.uint8),
        np.zeros((1, 1), np.uint8),
        np.full((3, 700, 4), 70, np.uint8),
        np.full((64, 64), 30000, np.uint16),
    ],
    ids=["black", "white", "grey portrait", "one pixel", "alpha", "16 bits"],
)
def test_an_image_of_nothing_gives_an_empty_mask(calibwatch, tmp_path, pixels):
    """By the network that ships."""
    image = save(tmp_path / "nothing.png", pixels)
    code, said, err = calibwatch("masks", image, "--out", tmp_path / "out")
    assert (code, err) == (0, "")
    assert "lane 0.00 % in 0 pieces  pole 0.00 % in 0 pieces" in said
    found = labels_in(tmp_path / "out" / "nothing.png")
    assert found.shape == pixels.shape[:2]
    assert not found.any()


def test_images_of_one_name_are_told_apart_by_their_folders(calibwatch, network, tmp_path):
    """Frames that are all called image.png are a common layout."""
    label = drawn()
    for name in ("x/1/image.png", "x/2/image.png", "other.png"):
        save(tmp_path / name, plain_network.picture(label))
    save(tmp_path / "x" / "2" / "image.jpg", np.zeros((9, 9), np.uint8))
    images = [tmp_path / name for name in ("x/1/image.png", "x/2/image.png", "other.png")]
    out = tmp_path / "out"
    code, said, _ = calibwatch("masks", *images, "--out", out, "--model", network)
    assert (code, len(said.splitlines())) == (0, 3)
    assert sorted(p.name for p in out.glob("*.png")) == ["1_image.png", "2_image.png", "other.png"]
    code, said, err = calibwatch(
        "masks",
        tmp_path / "x/2/image.png",
        tmp_path / "x/2/image.jpg",
        "--out",
        tmp_path / "o2",
        "--model",
        network,
    )
    assert (code, len(said.splitlines())) == (1, 1)
    assert f"{tmp_path / 'x/2/image.jpg'}: {tmp_path / 'x/2/image.png'} has written image.png already" in err


def test_nothing_is_replaced_unasked_and_an_input_never(calibwatch, network, tmp_path):
    image = save(tmp_path / "a.png", plain_network.picture(drawn()))
    out = tmp_path / "out"
    (kept,) = (save(out / "a.png", drawn() * 0 + 7),)
    code, said, err = calibwatch("masks", image, "--out", out, "--model", network)
    assert (code, said) == (1, "")
    assert f"{kept} exists already (--force replaces it)" in err
    assert (labels_in(kept) == 7).all()
    before = image.read_bytes()
    code, _, err = calibwatch("masks", image, "--out", tmp_path, "--force", "--model", network)
    assert code == 1
    assert f"{image} is one of the images" in err
    assert image.read_bytes() == before
    assert calibwatch("masks", image, "--out", out, "--force", "--no-crf", "--model", network)[0] == 0
    assert np.array_equal(labels_in(kept), drawn())


def test_the_crf_takes_part_unless_told(calibwatch, network, tmp_path):
    """A stripe with holes, and specks: the masks are those of the watch's own functions, and differ."""
    label = np.zeros((121, 241), np.uint8)
    label[:, 100:120] = labels.LANE
    holes = np.random.default_rng(4).random(label.shape) < 0.2
    pixels = plain_network.picture(np.where(holes, 0, label))
    image = save(tmp_path / "holes.png", pixels)
    probabilities = Segmenter(plain_network.model()).probabilities(pixels)
    found = {}
    for name, options, parameters in (
        ("with", (), MaskParameters()),
        ("without", ("--no-crf",), MaskParameters(crf=None)),
    ):
        out = tmp_path / name
        assert calibwatch("masks", image, "--out", out, "--model", network, *options)[0] == 0
        masks = masks_from_probabilities(probabilities, pixels, parameters, scale=grid_scale(241, 121))
        found[name] = labels_in(out / "holes.png")
        assert np.array_equal(found[name], label_image(masks, (241, 121)))
    assert not np.array_equal(found["with"], found["without"])


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (b"no network", "no readable ONNX model"),
        (b"", "no readable ONNX model"),
        (plain_network.model(class_names="cat,dog"), "class_names is 'cat,dog'"),
        (plain_network.model(labels_version="0"), "labels_version is '0'"),
        (plain_network.model(input_rule=None), "no 'input_rule'"),
        (onnx_bytes.block_means(plain_network.CONTRACT, classes=6), "inputs and outputs"),
        (onnx_bytes.block_means(plain_network.CONTRACT, pool=4), "for a grid of"),
        (None, "can not be read"),
    ],
)
def test_a_network_that_can_not_be_used_is_named(calibwatch, tmp_path, content, told):
    image = save(tmp_path / "a.png", plain_network.picture(drawn()))
    model = tmp_path / "other.onnx"
    if content is not None:
        model.write_bytes(content)
    code, said, err = calibwatch("masks", image, "--out", tmp_path / "out", "--model", model)
    assert (code, said) == (1, "")
    assert len(err.splitlines()) == 1
    assert err.startswith(f"calibwatch: model {model}")
    assert told in err
    assert not list(tmp_path.glob("out/*"))


def test_a_place_that_can_not_be_written_ends_the_run(calibwatch, network, tmp_path):
    image = save(tmp_path / "a.png", plain_network.picture(drawn()))
    (tmp_path / "file").write_text("in the way")
    code, said, err = calibwatch("masks", image, "--out", tmp_path / "file" / "out", "--model", network)
    assert (code, said, len(err.splitlines())) == (1, "", 1)
    assert "can not be made" in err
    (tmp_path / "out" / "a.overlay.jpg").mkdir(parents=True)
    options = ("--out", tmp_path / "out", "--force", "--model", network)
    code, said, err = calibwatch("masks", image, image, *options)
    assert (code, said, len(err.splitlines())) == (1, "", 1)
    assert "can not be written: Is a directory" in err


def test_an_image_whose_name_is_too_long_for_the_overlay_is_refused_alone(calibwatch, network, tmp_path):
    image, long = (save(tmp_path / f"{'n' * n}.png", plain_network.picture(drawn())) for n in (1, 245))
    code, said, err = calibwatch("masks", long, image, "--out", tmp_path / "out", "--model", network)
    assert (code, len(said.splitlines()), len(err.splitlines())) == (1, 1, 1)
    assert "can not be written: File name too long" in err


def test_sixteen_bits_that_are_hardly_used_are_told(calibwatch, network, tmp_path):
    image = save(tmp_path / "dim.png", plain_network.picture(drawn()).astype(np.uint16) << 8)
    code, _, err = calibwatch("masks", image, "--out", tmp_path / "out", "--model", network)
    assert code == 0
    assert err.startswith(f"warning: {image}: its 16 bits are used")


def test_without_an_image_it_is_wrong_usage(calibwatch):
    code, _, err = calibwatch("masks")
    assert code == 2
    assert "IMAGES" in err
