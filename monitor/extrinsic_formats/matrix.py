"""A matrix as text: 4x4 or 3x4 numbers, row by row, with or without brackets and commas."""

import numpy as np

from monitor.extrinsic_formats import Choice, Document, Format, Reading, directed, rigid, told
from pipeline.errors import InputError

_PUNCTUATION = str.maketrans("[](),;", "      ")
_MOST_TEXT = 4096
"""Characters; sixteen numbers with every digit need some 400."""


class Matrix:
    """Numbers and nothing else."""

    name = "matrix"
    title = "4x4 or 3x4 numbers as text"

    def matches(self, document: Document) -> bool:
        """Twelve or sixteen numbers and nothing else but brackets, commas and # comments."""
        return _numbers(document) is not None

    def read(self, document: Document, choice: Choice) -> Reading:
        """The matrix in the direction that the user says: the file can not tell it."""
        numbers = _numbers(document)
        if numbers is None:
            raise InputError(f"{document.path} holds no 12 or 16 numbers and nothing else")
        direction = told(choice, f"{document.path} is a bare matrix and")
        T, read_as = directed(
            rigid(np.array(numbers).reshape(-1, 4), str(document.path)), direction, "by --direction"
        )
        return Reading(
            T, read_as, notes=("no intrinsics: the recording's CameraInfo gives them, or K in the rig",)
        )


def _numbers(document: Document) -> list[float] | None:
    if len(document.text) > _MOST_TEXT:
        return None
    lines = (line.partition("#")[0] for line in document.text.splitlines())
    try:
        numbers = [float(word) for line in lines for word in line.translate(_PUNCTUATION).split()]
    except ValueError:
        return None
    return numbers if len(numbers) in (12, 16) else None


FORMAT: Format = Matrix()
