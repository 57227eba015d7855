"""Write a network with 8 bit convolutions: ``python -m models.quantise --model F --data DIR --out F``.

Weights and activations of the convolutions become integers; ranges are those seen on pictures of the training
splits. The file keeps the contract of the one it was made from, so that the same commands run and judge it.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from models.bisenetv2 import STRIDE
from models.data import LabelledSet, read_sets

if TYPE_CHECKING:
    from numpy.typing import NDArray

PER_SET = 4
"""Pictures of each set that the ranges are taken from: a few of every camera, not many of one."""

SIZE = (640, 1280)
"""Height and width of their input, px: half a frame of the longest side that the input rule lets through."""


class Pictures(CalibrationDataReader):  # type: ignore[misc] # onnxruntime has no types
    """Gives onnxruntime pictures of the training splits, one at a time."""

    def __init__(self, sets: list[LabelledSet], rng: np.random.Generator) -> None:
        self._left = [
            (one, ids[int(i)])
            for one in sets
            if (ids := one.splits.get("train", ()))
            for i in rng.permutation(len(ids))[:PER_SET]
        ]

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:
        """Return the next input, RGB float32 (1, 3, H, W), or None after the last."""
        if not self._left:
            return None
        one, identifier = self._left.pop()
        picture, _ = one.read(identifier)
        scale = SIZE[1] / picture.shape[1]
        size = SIZE[1], max(STRIDE, min(SIZE[0], int(picture.shape[0] * scale) // STRIDE * STRIDE))
        shrinks = scale < 1.0
        resized = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        return {"rgb": np.ascontiguousarray(resized[..., ::-1].transpose(2, 0, 1)[None], dtype=np.float32)}


def quantise(model: Path, out: Path, sets: list[LabelledSet], rng: np.random.Generator) -> None:
    """Write the quantised model beside its final name and rename it when whole.

    Args:
        model: An exported ``.onnx`` file.
        out: The quantised one.
        sets: Sets with a ``train`` split, for the ranges.
        rng: Chooses the pictures.
    """
    with tempfile.TemporaryDirectory(dir=out.parent) as folder:
        prepared, unfinished = Path(folder) / "prepared.onnx", Path(folder) / out.name
        # Shapes stay symbolic: any size of picture goes in.
        quant_pre_process(str(model), str(prepared), skip_symbolic_shape=True)
        settings: dict[str, Any] = {
            "quant_format": QuantFormat.QDQ,
            "per_channel": True,
            "activation_type": QuantType.QUInt8,
            "weight_type": QuantType.QInt8,
            "op_types_to_quantize": ["Conv"],
        }
        quantize_static(str(prepared), str(unfinished), Pictures(sets, rng), **settings)
        graph = onnx.load(unfinished)
        said = {entry.key: entry.value for entry in onnx.load(model).metadata_props}
        onnx.helper.set_model_props(graph, {**said, "model_version": f"{said['model_version']}-int8"})
        onnx.save(graph, unfinished)
        unfinished.replace(out)


def main() -> None:
    """Read the options and quantise."""
    parser = argparse.ArgumentParser(prog="python -m models.quantise", description=__doc__)
    parser.add_argument("--model", type=Path, required=True, help="an exported .onnx file")
    parser.add_argument(
        "--data", type=Path, action="append", required=True, help="folder of sets; may be repeated"
    )
    parser.add_argument("--out", type=Path, required=True, help="the .onnx file to write")
    options = parser.parse_args()
    quantise(options.model, options.out, read_sets(options.data), np.random.default_rng(0))


if __name__ == "__main__":
    main()
