"""A network with 8 bit convolutions says nearly what it said before, under the same contract."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

from models import export, quantise  # noqa: E402
from models.bisenetv2 import BiSeNetV2  # noqa: E402
from models.data import read_sets  # noqa: E402
from pipeline import segmentation  # noqa: E402
from tests.models.test_data import write_set  # noqa: E402


@pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning")  # of torch about itself
def test_eight_bits_say_nearly_the_same(tmp_path):
    torch.manual_seed(0)
    network = BiSeNetV2()
    whole, small = tmp_path / "whole.onnx", tmp_path / "small.onnx"
    export.to_onnx(network, whole, class_weights=[1.0] * 9, version="3", data_sha256="ef" * 32)
    write_set(tmp_path / "data" / "a", size=(96, 160))
    quantise.quantise(whole, small, read_sets([tmp_path / "data"]), np.random.default_rng(0))
    assert small.stat().st_size < 0.5 * whole.stat().st_size
    first = segmentation.Segmenter(whole.read_bytes(), threads=1)
    second = segmentation.Segmenter(small.read_bytes(), threads=1)
    assert (second.info.version, second.info.training_data) == ("3-int8", "ef" * 32)
    image = np.random.default_rng(1).integers(0, 256, (97, 130, 3)).astype(np.uint8)
    a, b = first.probabilities(image), second.probabilities(image)
    assert a.shape == b.shape
    assert np.abs(a - b).max() < 0.1
    assert not np.array_equal(a, b)
