"""Fisheye lens: the radius grows with a polynomial of the angle to the axis (FORMULAS E2, equidistant)."""

import numpy as np

from pipeline.cameras import coefficients
from pipeline.records import Floats

_ON_AXIS = 1e-9
"""Normalised radius below which a ray counts as the optical axis; the lens is linear there to rounding."""

_IMAGINARY = 1e-9
"""Imaginary part below which a root is real."""


class Equidistant:
    """Four coefficients k1..k4 on odd powers of the angle."""

    names = ("equidistant", "fisheye")

    def distort(self, xy: Floats, D: Floats) -> Floats:
        """``(x, y) theta_d / r`` with the limit 1 at the axis."""
        k1, k2, k3, k4 = coefficients(D, 4)
        r = np.hypot(xy[:, 0], xy[:, 1])
        theta = np.arctan(r)
        t2 = theta * theta
        theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        ratio = np.where(r > _ON_AXIS, theta_d / np.maximum(r, _ON_AXIS), 1.0)
        return xy * ratio[:, None]

    def jacobian(self, xy: Floats, D: Floats) -> Floats:
        """Derivative of :meth:`distort`, (N,2,2): radial and tangential scale in the polar frame."""
        k1, k2, k3, k4 = coefficients(D, 4)
        r = np.hypot(xy[:, 0], xy[:, 1])
        theta = np.arctan(r)
        t2 = theta * theta
        theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        radial = (1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))) / (1 + r * r)
        tangential = np.where(r > _ON_AXIS, theta_d / np.maximum(r, _ON_AXIS), 1.0)
        unit = np.where(r[:, None] > _ON_AXIS, xy / np.maximum(r, _ON_AXIS)[:, None], [1.0, 0.0])
        outer = unit[:, :, None] * unit[:, None, :]
        return np.asarray(
            tangential[:, None, None] * np.eye(2) + (radial - tangential)[:, None, None] * outer
        )

    def limit(self, D: Floats) -> float:
        """Tangent of the angle where the image radius stops growing; inf where that lies beyond 90 deg."""
        k1, k2, k3, k4 = coefficients(D, 4)
        slope = np.polynomial.Polynomial([1, 0, 3 * k1, 0, 5 * k2, 0, 7 * k3, 0, 9 * k4]).trim(1e-15)
        roots = np.asarray(slope.roots(), dtype=np.complex128)
        angles = roots.real[(np.abs(roots.imag) < _IMAGINARY) & (roots.real > 0.0)]
        first = float(angles.min(initial=np.pi / 2))
        return float(np.tan(first)) if first < np.pi / 2 else float("inf")


MODEL = Equidistant()
