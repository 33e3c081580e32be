"""Observability index O5: the harmonic sum of the singular values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.spectral import SpectralCriterion


@dataclass(frozen=True)
class FifthObservability(SpectralCriterion):
    """`O5` = 1 / Σ_i (1/σ_i), to be maximised: Φ_s = 1/O5² = (tr V_II^{1/2})², V = M⁻¹.

    k² times the matrix mean of order −1/2 between D and A, hence 1/Φ is concave.  σ as in
    SpectralCriterion.  `reported`: O5, in noise standard deviations per typical size.
    Source: Sun & Hollerbach 2008, IEEE Int. Conf. Robotics and Automation, 831–836, where O1 is
    related to D, O3 to E and O5 to A; Pukelsheim 2006, ch. 6.
    """

    name = "O5"

    def phi(self, mu: Array) -> Array:
        return np.asarray((mu**-0.5).sum(axis=-1) ** 2)

    def slope(self, mu: Array) -> Array:
        return np.asarray((mu**-0.5).sum(axis=-1)[..., None] * mu**-1.5)

    def reported(self, value: float) -> tuple[float, str]:
        return float(1 / np.sqrt(value)), ""
