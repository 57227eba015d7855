import copy
import itertools
import json

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the train extra")
pytest.importorskip("onnxscript", reason="needs the train extra")

from models import export, train  # noqa: E402 the extra is asked for first
from models.bisenetv2 import BiSeNetV2, Widths  # noqa: E402
from models.data import Sampler, read_sets  # noqa: E402
from pipeline import labels, segmentation  # noqa: E402

CLASSES = len(labels.NAMES)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return BiSeNetV2().eval()


@pytest.mark.parametrize("size", [(32, 32), (32, 96), (384, 256)])
def test_the_head_answers_at_half_scale(network, size):
    with torch.no_grad():
        logits, boosted = network(torch.zeros(1, 3, *size))
    assert logits.shape == (1, CLASSES, size[0] // 2, size[1] // 2)
    assert boosted == []


def test_boosters_answer_in_training_only_at_their_scales():
    logits, boosted = BiSeNetV2().train()(torch.rand(2, 3, 64, 96))
    assert logits.shape[2:] == (32, 48)
    assert [tuple(b.shape[1:]) for b in boosted] == [(CLASSES, 64 // s, 96 // s) for s in (4, 8, 16, 32)]


def test_widths_are_settings():
    small = BiSeNetV2(Widths((8, 8, 16), (8, 16, 16, 32), 2, 16, (8, 8)), classes=3)
    sizes = [sum(p.numel() for p in n.parameters()) for n in (small, BiSeNetV2())]
    assert sizes[0] < sizes[1] / 8
    assert small.eval()(torch.rand(1, 3, 32, 32))[0].shape == (1, 3, 16, 16)


def test_the_network_fits_its_budget():
    weights = sum(p.numel() for name, p in BiSeNetV2().named_parameters() if not name.startswith("boosters"))
    assert 4 * weights < 10e6


def test_a_change_anywhere_in_the_picture_reaches_a_cell(network):
    """The context embedding looks at the whole picture, the skip at its neighbours."""
    exact = copy.deepcopy(network).double()
    x = 255.0 * torch.rand(1, 3, 128, 256, dtype=torch.float64)
    y = x.clone()
    y[..., 120:, 250:] += 100.0
    with torch.no_grad():
        assert not torch.equal(exact(x)[0][..., 0, 0], exact(y)[0][..., 0, 0])


@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning")  # of torch about itself
def test_export_is_one_file_that_the_run_time_accepts_and_agrees_with(network, tmp_path):
    out = tmp_path / "net.onnx"
    weights = [1.0 + 0.5 * c for c in range(CLASSES)]
    export.to_onnx(network, out, class_weights=weights, version="2.5", data_sha256="cd" * 32)
    assert [path.name for path in tmp_path.iterdir()] == ["net.onnx"]
    segmenter = segmentation.Segmenter(out.read_bytes(), threads=1)
    assert (segmenter.info.version, segmenter.info.training_data) == ("2.5", "cd" * 32)
    rng = np.random.default_rng(1)
    for size in ((64, 96), (97, 33), (32, 320)):
        image = rng.integers(0, 256, (*size, 3)).astype(np.uint8)
        with torch.no_grad():
            logits, _ = network(torch.from_numpy(segmentation.network_input(image)))
        weighted = torch.softmax(logits, dim=1)[0].numpy() / np.array(weights)[:, None, None]
        expected = weighted / weighted.sum(axis=0)
        got = segmenter.probabilities(image)
        assert np.abs(got - expected[:, : got.shape[1], : got.shape[2]]).max() < 1e-4


def test_rate_rises_is_held_and_falls_to_the_end_of_the_time():
    recipe = train.Recipe(rate=1.0, warm_up=10, fall=0.4)
    assert train.learning_rate(recipe, 0, 0.0) == pytest.approx(0.1)
    assert train.learning_rate(recipe, 9, 0.0) == pytest.approx(1.0)
    assert train.learning_rate(recipe, 500, 0.6) == pytest.approx(1.0)
    assert train.learning_rate(recipe, 500, 0.8) == pytest.approx(0.5)
    assert train.learning_rate(recipe, 500, 1.0) == pytest.approx(0.0025)


def test_average_is_the_running_mean():
    average, network = torch.nn.Linear(1, 1, bias=False), torch.nn.Linear(1, 1, bias=False)
    values = [1.0, 3.0, -2.0]
    with torch.no_grad():
        average.weight.fill_(0.0)
        expected = 0.0
        for step, value in enumerate(values):
            network.weight.fill_(value)
            train.update_average(average, network, 0.5, step)
            keep = min(0.5, (1 + step) / (10 + step))
            expected = keep * expected + (1 - keep) * value
    assert float(average.weight.detach()) == pytest.approx(expected)


def _folder(tmp_path):
    folder = tmp_path / "data" / "stripes"
    (folder / "images").mkdir(parents=True)
    (folder / "labels").mkdir()
    label = np.full((64, 96), labels.ROAD, np.uint8)
    label[:, 40:52] = labels.LANE
    cv2.imwrite(str(folder / "labels" / "0.png"), label)
    cv2.imwrite(
        str(folder / "images" / "0.png"), np.where(label == labels.LANE, 230, 70)[..., None].repeat(3, 2)
    )
    (folder / "set.json").write_text(json.dumps({"labelled_classes": [1, 3], "splits": {"train": ["0"]}}))
    return tmp_path / "data"


def test_training_learns_resumes_and_keeps_to_its_time(tmp_path):
    """A clock that ticks one second a look: 15 s are 15 steps, and a second call goes on from there."""
    torch.manual_seed(0)
    recipe = train.Recipe(crop=(64, 64), batch=2, warm_up=5, save_s=7.0, rate=5e-3, fall=0.9)
    sets = read_sets([_folder(tmp_path)])
    sampler = Sampler(sets, recipe.crop, {}, widths=(90.0, 130.0), paint_share=0.0, pole_share=0.0)
    device = torch.device("cpu")

    def go_on(minutes):
        ticks = itertools.count()
        run = train.start(recipe, device)
        if (tmp_path / train.CHECKPOINT).is_file():
            run.load(tmp_path / train.CHECKPOINT)
        train.train(
            run,
            sampler,
            recipe,
            minutes=minutes,
            out=tmp_path,
            data="x",
            seed=0,
            clock=lambda: float(next(ticks)),
        )
        return run

    first = go_on(0.25)
    assert (first.step, first.spent_s) == (15, 15.0)
    before_fall = train.start(recipe, device)
    before_fall.load(tmp_path / train.BEFORE_FALL)
    assert before_fall.step == 2
    second = go_on(1.5)
    assert (second.step, second.spent_s) == (90, 90.0)
    before_fall.load(tmp_path / train.BEFORE_FALL)
    assert before_fall.step == 2  # 15 of 90 s: the rate was falling already
    assert not list(tmp_path.glob("*.tmp"))
    rgb, label, _ = sampler.batch(4, np.random.default_rng(3))
    with torch.no_grad():
        logits, _ = second.network.train()(torch.from_numpy(rgb).float())
    said = logits.argmax(dim=1).numpy()
    truth = label[:, ::2, ::2]
    known = truth != labels.IGNORE
    assert (said == truth)[known].mean() > 0.9
