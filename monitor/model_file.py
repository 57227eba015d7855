"""Where the segmentation network comes from: the file that ships with the package, or one that is named."""

from importlib import resources
from pathlib import Path

import numpy as np

from pipeline.errors import ModelError
from pipeline.segmentation import STRIDE, Segmenter

DEFAULT_NAME = "bisenetv2.onnx"
"""Package data of ``models``; nothing is imported from there."""

FREE_NAME = "bisenetv2_free.onnx"
"""Likewise, trained on pictures without non-commercial terms only; asked for by the word ``FREE``."""

FREE = Path("free")

_LARGEST_BYTES = 256 << 20
"""A network for two cores has megabytes; more is another kind of file."""


def model_bytes(path: Path | None) -> bytes:
    """The bytes of the network at ``path``, or of one that ships; ModelError says what is missing."""
    if path is None:
        return _packaged(DEFAULT_NAME)
    if path == FREE and not path.exists():
        return _packaged(FREE_NAME)
    try:
        size = path.stat().st_size
        if size > _LARGEST_BYTES:
            raise ModelError(
                f"{path} has {size} bytes, too many for a network", hint="--model wants a .onnx file"
            )
        return path.read_bytes()
    except OSError as error:
        raise ModelError(
            f"model {path} can not be read: {error.strerror}", hint="--model wants a .onnx file"
        ) from error


def _packaged(name: str) -> bytes:
    packaged = resources.files("models").joinpath(name)
    if not packaged.is_file():
        raise ModelError(
            f"the network {name} is missing from this installation",
            hint="install calibwatch anew, or name a model with --model FILE",
        )
    return packaged.read_bytes()


def open_segmenter(path: Path | None, threads: int = 2) -> Segmenter:
    """A session of the network at ``path``, or of the one that ships.

    Args:
        path: The .onnx file, ``FREE``, or None.
        threads: Threads that one call may use; the watch counts on two cores.

    Raises:
        ModelError: It can not be read, or is none that this version can use; the text names the file.
    """
    try:
        segmenter = Segmenter(model_bytes(path), threads=threads)
        # Another grid shows with the first answer only.
        segmenter.probabilities(np.zeros((STRIDE, STRIDE, 3), dtype=np.uint8))
    except ModelError as error:
        if path is None or str(path) in error.what:
            raise
        raise ModelError(f"model {path}: {error.what}", hint=error.hint) from error
    return segmenter
