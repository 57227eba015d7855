"""A network whose answer is known: in a picture of values 0 and 1, green is paint and blue is pole.

Red is everything else. Each cell answers with the share of its 2x2 px.
"""

import numpy as np

from pipeline import labels, segmentation
from tests.oracles import onnx_bytes

CONTRACT = {
    "class_names": ",".join(labels.NAMES),
    "labels_version": labels.VERSION,
    "input_rule": segmentation.INPUT_RULE,
    "normalisation": segmentation.NORMALISATION,
    "model_version": "7.1",
    "training_data_sha256": "ab" * 32,
}


def model(**changed):
    """Bytes of the file; keywords replace metadata, None leaves them out."""
    return onnx_bytes.block_means({k: v for k, v in (CONTRACT | changed).items() if v is not None})


def picture(label):
    """uint8 (H,W,3), BGR, in which that network sees the label image (H,W)."""
    classes = (labels.POLE, labels.LANE, labels.OTHER)
    shown = np.stack([label == value for value in classes], axis=-1)
    shown[..., 2] |= ~shown.any(axis=-1)
    return shown.astype(np.uint8)
