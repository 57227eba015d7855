"""Two witnesses of one mount, fused in information form, or found to contradict each other (FORMULAS F6).

Both look at the same image and the same sweep, so their errors may be common: they are joined by covariance
intersection, which never divides a common error by two.
"""

from dataclasses import dataclass

import numpy as np

from pipeline.records import Floats

_WEIGHTS = np.linspace(0.0, 1.0, 21)
"""Shares of the first witness that covariance intersection tries."""

_PRIOR_SIGMA = np.array([1.0, 1.0, 1.0, 10.0, 10.0, 10.0])
"""rad, m; a prior so wide that it only keeps a direction without any information invertible (it is held)."""

_ROUNDING = 1e-9
"""Share of the largest information below which a direction is null (FORMULAS D3)."""

CONTRADICTION = (10.83, 13.82, 16.27, 18.47, 20.52, 22.46)
"""Chi-square thresholds at 1e-3 for 1 to 6 degrees of freedom (FORMULAS F2)."""


@dataclass(frozen=True, slots=True, eq=False)
class Testimony:
    """What one witness says in vehicle axes.

    Attributes:
        drift: float64 (6,), rad and m; components without information are 0.
        information: float64 (6,6), of its random error, symmetric and semidefinite.
    """

    drift: Floats
    information: Floats

    def covariance(self) -> Floats:
        """Covariance (6,6); a held direction gets the width of the prior."""
        return np.asarray(np.linalg.inv(self.information + np.diag(_PRIOR_SIGMA**-2)), dtype=np.float64)


def contradiction(a: Testimony, b: Testimony) -> bool:
    """Whether two witnesses, their own floors included, differ by more than their errors allow, at 1e-3."""
    scale = np.outer(_PRIOR_SIGMA, _PRIOR_SIGMA)
    A, B = a.information * scale, b.information * scale
    values, vectors = np.linalg.eigh(A @ np.linalg.pinv(A + B, hermitian=True) @ B)
    # Rounding leaves a trace in directions that only one of them knows: no degree of freedom.
    common = values > max(1.0, _ROUNDING * float(values[-1]))
    difference = vectors[:, common].T @ ((a.drift - b.drift) / _PRIOR_SIGMA)
    rank = int(common.sum())
    return rank > 0 and float(values[common] @ difference**2) > CONTRADICTION[rank - 1]


def intersected(a: Testimony, b: Testimony) -> Testimony:
    """Covariance intersection: ``I = w I_a + (1 - w) I_b`` with the w that leaves the smallest volume."""
    prior = np.diag(_PRIOR_SIGMA**-2)
    volumes = [np.linalg.slogdet(w * a.information + (1.0 - w) * b.information + prior)[1] for w in _WEIGHTS]
    w = float(_WEIGHTS[int(np.argmax(volumes))])
    information = w * a.information + (1.0 - w) * b.information
    pull = w * a.information @ a.drift + (1.0 - w) * b.information @ b.drift
    drift = np.asarray(np.linalg.solve(information + prior, pull), dtype=np.float64)
    return Testimony(drift, information)


def with_floor(testimony: Testimony, floor: Floats) -> Testimony:
    """``(I^-1 + floor)^-1`` for a singular I too: a direction without information stays without."""
    information = testimony.information @ np.linalg.inv(np.eye(6) + floor @ testimony.information)
    return Testimony(testimony.drift, 0.5 * (information + information.T))
