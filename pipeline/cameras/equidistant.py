"""Fisheye lens: radius grows with a polynomial of the angle to the optical axis (FORMULAS E2, equidistant)."""

import numpy as np

from pipeline.records import Floats


class Equidistant:
    """Four coefficients k1..k4 on odd powers of the angle."""

    names = ("equidistant", "fisheye")

    def distort(self, xy: Floats, D: Floats) -> Floats:
        """``(x, y) theta_d / r`` with the limit 1 at the axis."""
        k1, k2, k3, k4 = _padded(D)
        r = np.hypot(xy[:, 0], xy[:, 1])
        theta = np.arctan(r)
        t2 = theta * theta
        theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        ratio = np.where(r > 1e-9, theta_d / np.maximum(r, 1e-9), 1.0)
        return xy * ratio[:, None]

    def jacobian(self, xy: Floats, D: Floats) -> Floats:
        """Derivative of :meth:`distort`, (N,2,2): radial and tangential scale in the polar frame."""
        k1, k2, k3, k4 = _padded(D)
        r = np.hypot(xy[:, 0], xy[:, 1])
        theta = np.arctan(r)
        t2 = theta * theta
        theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        radial = (1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))) / (1 + r * r)
        tangential = np.where(r > 1e-9, theta_d / np.maximum(r, 1e-9), 1.0)
        unit = np.where(r[:, None] > 1e-9, xy / np.maximum(r, 1e-9)[:, None], [1.0, 0.0])
        outer = unit[:, :, None] * unit[:, None, :]
        return np.asarray(
            tangential[:, None, None] * np.eye(2) + (radial - tangential)[:, None, None] * outer
        )

    def limit(self, D: Floats) -> float:
        """tan of the angle where the image radius stops growing; inf where that lies behind 90 degrees."""
        k1, k2, k3, k4 = _padded(D)
        slope = np.polynomial.Polynomial([1, 0, 3 * k1, 0, 5 * k2, 0, 7 * k3, 0, 9 * k4]).trim(1e-15)
        angles = [root.real for root in slope.roots() if abs(root.imag) < 1e-9 and root.real > 0]
        first = min(angles, default=np.pi / 2)
        return float(np.tan(first)) if first < np.pi / 2 else float("inf")


def _padded(D: Floats) -> tuple[float, ...]:
    return tuple(np.pad(D[:4], (0, max(0, 4 - len(D)))).tolist())


MODEL = Equidistant()
