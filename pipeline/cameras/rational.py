"""Brown-Conrady lenses in OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]] (FORMULAS E2)."""

import numpy as np

from pipeline.cameras import coefficients
from pipeline.records import Floats

_IMAGINARY = 1e-9
"""Imaginary part below which a root is real."""


class Rational:
    """plumb_bob is the rational polynomial whose denominator is 1."""

    names = ("plumb_bob", "rational_polynomial")

    def distort(self, xy: Floats, D: Floats) -> Floats:
        """FORMULAS E2, plumb_bob and rational."""
        k1, k2, p1, p2, k3, k4, k5, k6 = coefficients(D, 8)
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        g = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return np.column_stack(
            [x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        )

    def jacobian(self, xy: Floats, D: Floats) -> Floats:
        """Derivative of :meth:`distort`, (N,2,2)."""
        k1, k2, p1, p2, k3, k4, k5, k6 = coefficients(D, 8)
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        top = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        g = top / bottom
        dg = (k1 + r2 * (2 * k2 + 3 * k3 * r2)) / bottom - g * (k4 + r2 * (2 * k5 + 3 * k6 * r2)) / bottom
        J = np.empty((len(x), 2, 2))
        J[:, 0, 0] = g + 2 * x * x * dg + 2 * p1 * y + 6 * p2 * x
        J[:, 0, 1] = J[:, 1, 0] = 2 * x * y * dg + 2 * p1 * x + 2 * p2 * y
        J[:, 1, 1] = g + 2 * y * y * dg + 6 * p1 * y + 2 * p2 * x
        return J

    def limit(self, D: Floats) -> float:
        """Radius where the distorted radius stops growing (tangential terms are too small to matter)."""
        k1, k2, _, _, k3, k4, k5, k6 = coefficients(D, 8)
        top = np.polynomial.Polynomial([0, 1, 0, k1, 0, k2, 0, k3])
        bottom = np.polynomial.Polynomial([1, 0, k4, 0, k5, 0, k6])
        slope = top.deriv() * bottom - top * bottom.deriv()
        roots = np.concatenate(
            [np.asarray(p.trim(1e-15).roots(), dtype=np.complex128) for p in (slope, bottom)]
        )
        radii = roots.real[(np.abs(roots.imag) < _IMAGINARY) & (roots.real > 0.0)]
        return float(radii.min(initial=float("inf")))


MODEL = Rational()
