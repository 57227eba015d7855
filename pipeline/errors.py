"""The errors of calibwatch: one base, so that one launcher maps them to one line and an exit code.

CalibwatchError
├── InputError       what came from a file or the bus can not be used
├── RigError         the rig file or settings are wrong
├── ModelError       the segmentation model is missing or of another contract
├── StoreError       the extrinsic store refuses
└── TransportError   the bus can not be reached or was lost
"""


class CalibwatchError(Exception):
    """What was wrong with which input, and the next thing to try.

    Args:
        what: One clause that names the input and what is wrong with it.
        hint: The next thing to try, or empty.
    """

    def __init__(self, what: str, *, hint: str = "") -> None:
        super().__init__(what)
        self.what = what
        self.hint = hint

    def __str__(self) -> str:
        return f"{self.what} ({self.hint})" if self.hint else self.what


class InputError(CalibwatchError):
    """What came from a file or the bus can not be used."""


class RigError(CalibwatchError):
    """The rig file or the settings are wrong."""


class ModelError(CalibwatchError):
    """The segmentation model is missing, damaged or of another contract."""


class StoreError(CalibwatchError):
    """The extrinsic store refuses what was asked."""


class TransportError(CalibwatchError):
    """The bus can not be reached, or the connection was lost."""
