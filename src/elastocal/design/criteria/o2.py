"""Observability index O2: the inverse condition number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.spectral import SpectralCriterion


@dataclass(frozen=True)
class SecondObservability(SpectralCriterion):
    """`O2` = σ_min / σ_max, to be maximised: Φ_s = 1/O2² = μ_k / μ_1, without unit.

    The squared condition number of the information of interest.  It has degree 0 in M and may
    grow when a pose is added, so it gives no lower bound here; without nuisance parameters it
    is quasi-convex: Φ ≤ t is the linear matrix inequality z 1 ⪯ M ⪯ t z 1 in M and z.  σ as in
    SpectralCriterion.  `reported`: O2 between 0 and 1.
    Source: Driels & Pathre 1990, J. Robotic Systems 7(1), 27–53.
    """

    name = "O2"
    certifiable = False

    def phi(self, mu: Array) -> Array:
        return np.asarray(mu[..., -1] / mu[..., 0])

    def slope(self, mu: Array) -> Array:
        slope = np.zeros_like(mu)
        slope[..., 0] += mu[..., -1] / mu[..., 0] ** 2
        slope[..., -1] -= 1 / mu[..., 0]
        return slope

    def reported(self, value: float) -> tuple[float, str]:
        return float(1 / np.sqrt(value)), ""
