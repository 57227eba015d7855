"""A lens without distortion: rectified images."""

import numpy as np

from pipeline.records import Floats


class Pinhole:
    """x and y as they are."""

    names = ("pinhole", "none", "")

    def distort(self, xy: Floats, D: Floats) -> Floats:  # noqa: ARG002 - the protocol's signature
        """Nothing is bent."""
        return xy

    def jacobian(self, xy: Floats, D: Floats) -> Floats:  # noqa: ARG002 - the protocol's signature
        """Identity for each point, (N,2,2)."""
        return np.broadcast_to(np.eye(2), (len(xy), 2, 2))

    def limit(self, D: Floats) -> float:  # noqa: ARG002 - the protocol's signature
        """A pinhole never folds."""
        return float("inf")


MODEL = Pinhole()
