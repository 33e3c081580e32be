"""E-optimality: the worst-known direction in the space of the parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.power_mean import power_mean, power_mean_slope
from elastocal.design.criteria.spectral import SpectralCriterion


@dataclass(frozen=True)
class EigenvalueCriterion(SpectralCriterion):
    """`E`: Φ_s = λ_max(V_II) = 1/μ_1, V = M⁻¹: the largest variance of any unit combination.

    A finite `order` q gives the power mean (Σ μ_i^{−q} / k)^{1/q} ≤ Φ, smooth where the smallest
    eigenvalue is multiple, as it often is at the optimum: the matrix means of Kiefer 1974, with
    A at q = 1 and E at q = ∞.  `reported`: √Φ, the standard deviation of the worst-known
    direction, in typical sizes of the parameters.
    Source: Ehrenfeld 1955; Pukelsheim 2006, ch. 6; Atkinson, Donev & Tobias 2007, ch. 10.
    """

    order: float = np.inf
    name = "E"

    def phi(self, mu: Array) -> Array:
        return power_mean(1 / mu, self.order)

    def slope(self, mu: Array) -> Array:
        return power_mean_slope(1 / mu, self.order) / mu**2

    def softened(self, order: float) -> Self:
        return replace(self, order=order)

    def reported(self, value: float) -> tuple[float, str]:
        return float(np.sqrt(value)), "typical sizes"
