"""Class probabilities of an image: an onnxruntime session made from a model's bytes, and their contract.

An image of (W,H) px is reduced by area means so that its longer side has at most ``LONGEST_SIDE`` px, then
its right and bottom edge is repeated up to multiples of ``STRIDE``. The network answers on a grid of one cell
per ``GRID`` reduced px; the cells of the repeated edge are cut off again. ``grid_scale`` gives grid px per
image px: cell (i, j) lies at image px ``(i + 0.5) / scale_x - 0.5, (j + 0.5) / scale_y - 0.5``, as in
``records.Masks``.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from pipeline import labels
from pipeline.errors import InputError, ModelError

LONGEST_SIDE = 1280
"""px. At a focal length of 720 px a post of 12 cm is 3 px wide at 30 m; a frame of 1242x375 costs some 0.1 s
of two cores. Twice the side costs four times the time."""

STRIDE = 32
"""px. The deepest stage of the network is at 1/32."""

GRID = 2
"""Reduced px per cell of the answer."""

INPUT_RULE = (
    f"longer side at most {LONGEST_SIDE} px by area means; "
    f"right and bottom edge repeated to multiples of {STRIDE}; grid 1/{GRID}"
)
"""The rule above as a model file states it in its metadata."""

NORMALISATION = "rgb 0..255, centred and scaled in the graph"
"""What the values of the network's input are, as a model file states it."""

LARGEST_SIDE = 16384
"""px. Longer images are refused: no camera of a vehicle has them, and a damaged size must not cost memory."""

_TRAIN_HINT = "use the model that came with this version, or export one with python -m models.export"


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """Which model a session runs.

    Attributes:
        hash: SHA-256 of the model's bytes, hexadecimal.
        version: Its version by its own metadata.
        training_data: SHA-256 of what it was trained on, by its own metadata.
    """

    hash: str
    version: str
    training_data: str


def reduced_size(width: int, height: int) -> tuple[int, int]:
    """Return (width, height) of the reduced image in px, at least 1x1."""
    longest = max(width, height)
    if longest <= LONGEST_SIDE:
        return width, height
    scale = LONGEST_SIDE / longest
    return max(1, round(width * scale)), max(1, round(height * scale))


def grid_size(width: int, height: int) -> tuple[int, int]:
    """Return (width, height) in cells of the answer to an image of (width, height) px."""
    reduced_width, reduced_height = reduced_size(width, height)
    return -(-reduced_width // GRID), -(-reduced_height // GRID)


def grid_scale(width: int, height: int) -> tuple[float, float]:
    """Return grid px per image px (scale_x, scale_y) for an image of (width, height) px."""
    reduced_width, reduced_height = reduced_size(width, height)
    return reduced_width / (GRID * width), reduced_height / (GRID * height)


def to_bgr(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Return any image that a decoder gives as BGR uint8 (H,W,3).

    Args:
        image: uint8, or uint16 of full range 0..65535; (H,W), (H,W,1), BGR (H,W,3) or BGRA (H,W,4), whose
            alpha is dropped.

    Raises:
        InputError: If it is of another type or shape, empty, or longer than ``LARGEST_SIDE``.
    """
    channels = image.shape[2] if image.ndim == 3 else 1
    if (
        image.ndim not in {2, 3}
        or channels not in {1, 3, 4}
        or image.dtype not in {np.dtype(t) for t in "BH"}
    ):
        raise InputError(
            f"image of {image.dtype}{image.shape} can not be segmented",
            hint="wanted is uint8 or uint16 of (H,W), (H,W,3) or (H,W,4)",
        )
    if not all(0 < side <= LARGEST_SIDE for side in image.shape[:2]):
        raise InputError(
            f"image of {image.shape[1]}x{image.shape[0]} px can not be segmented",
            hint=f"both sides must be between 1 and {LARGEST_SIDE} px",
        )
    pixels = image if image.dtype == np.uint8 else image.astype(np.uint16, copy=False) // 257
    if channels == 1:
        pixels = np.repeat(pixels.reshape(*image.shape[:2], 1), 3, axis=2)
    return pixels[..., :3].astype(np.uint8, copy=False)


def network_input(image_bgr: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Reduce and pad: BGR uint8 (H,W,3) to RGB float32 (1,3,h,w), 0..255, h and w multiples of 32."""
    height, width = image_bgr.shape[:2]
    size = reduced_size(width, height)
    reduced = (
        image_bgr if size == (width, height) else cv2.resize(image_bgr, size, interpolation=cv2.INTER_AREA)
    )
    right, bottom = -size[0] % STRIDE, -size[1] % STRIDE
    padded = cv2.copyMakeBorder(np.ascontiguousarray(reduced), 0, bottom, 0, right, cv2.BORDER_REPLICATE)
    return np.ascontiguousarray(padded[..., ::-1].transpose(2, 0, 1)[None], dtype=np.float32)


class Segmenter:
    """A session of the network. What it answers is not changed by use; one thread at a time should call it.

    Args:
        model: The bytes of the ``.onnx`` file.
        threads: Threads that one call may use; they sleep between calls.

    Raises:
        ModelError: If the bytes are no model, or a model of another contract.
    """

    def __init__(self, model: bytes, *, threads: int = 2) -> None:
        self._made_of = model, threads
        session = self._begun()
        metadata = dict(session.get_modelmeta().custom_metadata_map)
        _check_contract(metadata)
        self._input = _check_ends(session)
        self._session: onnxruntime.InferenceSession | None = session
        self.info = ModelInfo(
            hash=hashlib.sha256(model).hexdigest(),
            version=metadata.get("model_version", ""),
            training_data=metadata.get("training_data_sha256", ""),
        )

    def rest(self) -> None:
        """Gives back the memory of the session until it is asked again."""
        self._session = None

    def _begun(self) -> onnxruntime.InferenceSession:
        model, threads = self._made_of
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # A plan of the memory is kept beside what it was made from: 40 MB more, and no time less.
        options.enable_mem_pattern = False
        options.log_severity_level = 4
        try:
            return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's exceptions are classes of a private module
            raise ModelError(
                f"the {len(model)} bytes given are no readable ONNX model", hint=_TRAIN_HINT
            ) from error

    def __reduce__(self) -> tuple[Callable[[bytes, int], "Segmenter"], tuple[bytes, int]]:
        """Another process makes its own session, of the same bytes."""
        return _segmenter, self._made_of

    def probabilities(self, image_bgr: NDArray[np.generic]) -> NDArray[np.float32]:
        """Return what each cell of the image shows.

        Args:
            image_bgr: Image as ``to_bgr`` takes it.

        Returns:
            float32 (classes,h,w), classes in the order of ``labels.NAMES``, summing to 1 over them; (w,h) is
            ``grid_size`` of the image and ``grid_scale`` places it.

        Raises:
            InputError: If the image is none that can be segmented.
            ModelError: If the network fails on it.
        """
        bgr = to_bgr(image_bgr)
        columns, rows = grid_size(bgr.shape[1], bgr.shape[0])
        self._session = self._session or self._begun()
        try:
            (answer,) = self._session.run(None, {self._input: network_input(bgr)})
        except Exception as error:  # as above
            raise ModelError(
                f"the model failed on an image of {bgr.shape[1]}x{bgr.shape[0]} px", hint=_TRAIN_HINT
            ) from error
        cells: NDArray[np.float32] = answer[0, :, :rows, :columns]
        if cells.shape != (len(labels.NAMES), rows, columns):
            raise ModelError(
                f"the model gave {answer.shape} for a grid of {columns}x{rows}", hint=_TRAIN_HINT
            )
        return cells


def _segmenter(model: bytes, threads: int) -> Segmenter:
    return Segmenter(model, threads=threads)


def _check_contract(metadata: dict[str, str]) -> None:
    """Compare what the model says of itself with what this module does."""
    wanted = {
        "class_names": ",".join(labels.NAMES),
        "labels_version": labels.VERSION,
        "input_rule": INPUT_RULE,
        "normalisation": NORMALISATION,
    }
    for key, value in wanted.items():
        if key not in metadata:
            raise ModelError(f"the model's metadata has no '{key}'", hint=_TRAIN_HINT)
        if metadata[key] != value:
            raise ModelError(
                f"the model's {key} is '{metadata[key][:200]}', wanted '{value}'", hint=_TRAIN_HINT
            )


def _check_ends(session: onnxruntime.InferenceSession) -> str:
    """Check inputs and outputs of the graph; return the input's name."""
    inputs, outputs = session.get_inputs(), session.get_outputs()
    ends = [(end.type, list(end.shape)[:2]) for end in (*inputs, *outputs)]
    if ends != [("tensor(float)", [1, 3]), ("tensor(float)", [1, len(labels.NAMES)])]:
        raise ModelError(f"the model's inputs and outputs are {ends}", hint=_TRAIN_HINT)
    return str(inputs[0].name)
