"""Write a checkpoint as one ONNX file with its contract: ``python -m models.export --checkpoint F --out F``.

The file takes RGB float32 0..255 (1, 3, H, W), H and W multiples of 32, and gives class probabilities float32
(1, classes, H/2, W/2). Its metadata names classes, label contract, input size rule, normalisation, model
version and the hash of the training data; the run time refuses a file that says something else than it does.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import onnx
import torch

from models.bisenetv2 import GRID, STRIDE, BiSeNetV2
from pipeline import labels

INPUT_RULE = (
    f"longer side at most 1280 px by area means; "
    f"right and bottom edge repeated to multiples of {STRIDE}; grid 1/{GRID}"
)
"""How a picture becomes an input. Changes together with ``pipeline.segmentation.INPUT_RULE``."""

NORMALISATION = "rgb 0..255, centred and scaled in the graph"
"""What the pixel values are. Changes together with ``pipeline.segmentation.NORMALISATION``."""


class Probabilities(torch.nn.Module):
    """The network with the softmax over its head, the weights of the loss taken out again.

    A loss that weighs class c by w_c is least where the network says p_c ~ w_c q_c, q being the true share:
    paint of weight 3 is then said with 0.75 where it is as likely as not. Subtracting log w_c gives q back.
    """

    def __init__(self, network: BiSeNetV2, class_weights: list[float]) -> None:
        super().__init__()
        self.network = network
        self.register_buffer("overstated", torch.tensor(class_weights).log().view(1, -1, 1, 1))

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        """Map (1, 3, H, W) to probabilities (1, classes, H/2, W/2)."""
        logits, _ = self.network(rgb)
        # Spelt out: the runtime's own softmax across channels takes some five times as long.
        weighed = logits - self.overstated
        odds = torch.exp(weighed - weighed.amax(dim=1, keepdim=True))
        return odds / odds.sum(dim=1, keepdim=True)


def to_onnx(
    network: BiSeNetV2, out: Path, *, class_weights: list[float], version: str, data_sha256: str
) -> None:
    """Export the network in evaluation mode as a single file, written beside its name and renamed when whole.

    Args:
        network: With the weights to ship.
        out: The ``.onnx`` file.
        class_weights: Weights of the loss that the network was trained with.
        version: Name of these weights.
        data_sha256: ``data.fingerprint`` of what they were trained on.
    """
    model = Probabilities(network.to("cpu", memory_format=torch.contiguous_format), class_weights).eval()
    example = torch.zeros(1, 3, 2 * STRIDE, 4 * STRIDE)
    height, width = torch.export.Dim("rows", min=1, max=256), torch.export.Dim("columns", min=1, max=256)
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        unfinished = Path(folder) / out.name
        torch.onnx.export(
            model,
            (example,),
            unfinished,
            input_names=["rgb"],
            output_names=["probabilities"],
            dynamo=True,
            dynamic_shapes={"rgb": {2: STRIDE * height, 3: STRIDE * width}},
            verbose=False,
        )
        graph = onnx.load(unfinished)
        said = {
            "class_names": ",".join(labels.NAMES),
            "labels_version": labels.VERSION,
            "input_rule": INPUT_RULE,
            "normalisation": NORMALISATION,
            "model_version": version,
            "training_data_sha256": data_sha256,
        }
        _forget_where_it_was_made(graph)
        onnx.helper.set_model_props(graph, said)
        onnx.save(graph, unfinished, save_as_external_data=False)
        unfinished.replace(out)


def _forget_where_it_was_made(graph: onnx.ModelProto) -> None:
    """Take out the exporter's stack traces: paths of this machine, and a tenth of the file."""
    for node in graph.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in (*graph.graph.value_info, *graph.graph.input, *graph.graph.output):
        del value.metadata_props[:]


def main() -> None:
    """Read the options and export the running mean of a checkpoint's weights."""
    parser = argparse.ArgumentParser(prog="python -m models.export", description=__doc__)
    parser.add_argument("--checkpoint", type=Path, required=True, help="checkpoint.pt of models.train")
    parser.add_argument("--out", type=Path, required=True, help="the .onnx file")
    parser.add_argument("--version", required=True, help="name of these weights, for example 1.0")
    options = parser.parse_args()
    state = torch.load(options.checkpoint, map_location="cpu", weights_only=True)
    network = BiSeNetV2()
    network.load_state_dict(state["average"])
    to_onnx(
        network,
        options.out,
        class_weights=state["class_weights"],
        version=options.version,
        data_sha256=state["data_sha256"],
    )


if __name__ == "__main__":
    main()
