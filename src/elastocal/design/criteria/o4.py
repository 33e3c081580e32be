"""Observability index O4: the noise amplification index."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.spectral import SpectralCriterion


@dataclass(frozen=True)
class FourthObservability(SpectralCriterion):
    """`O4` = σ_min² / σ_max = O2 · O3, to be maximised: Φ_s = 1/O4² = μ_k / μ_1².

    The noise amplification index.  It has degree −1 in M, but may grow when a pose is added, and
    1/Φ is not concave: no bound.  σ as in SpectralCriterion.  `reported`: O4, in noise standard
    deviations per typical size.
    Source: Nahvi & Hollerbach 1996, IEEE Int. Conf. Robotics and Automation, 647–654.
    """

    name = "O4"
    certifiable = False

    def phi(self, mu: Array) -> Array:
        return np.asarray(mu[..., -1] / mu[..., 0] ** 2)

    def slope(self, mu: Array) -> Array:
        slope = np.zeros_like(mu)
        slope[..., 0] += 2 * mu[..., -1] / mu[..., 0] ** 3
        slope[..., -1] -= 1 / mu[..., 0] ** 2
        return slope

    def reported(self, value: float) -> tuple[float, str]:
        return float(1 / np.sqrt(value)), ""
