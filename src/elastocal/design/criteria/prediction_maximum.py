"""G-optimality: the largest prediction variance over a region."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.power_mean import power_mean, power_mean_slope
from elastocal.design.criteria.scenarios import ScenarioCriterion
from elastocal.design.criteria.variances import Variances
from elastocal.errors import require


@dataclass(frozen=True)
class GCriterion(ScenarioCriterion):
    """`G`: Φ_s = max_t tr(A_t V_s A_tᵀ), V = M⁻¹, in m²: the worst of a region's T points.

    A (S, T, r, p) in m per scaled parameter: what is predicted at point t, as r components.
    1/Φ is the minimum of concave functions.  A finite `order` q gives the power mean
    (Σ_t φ_t^q / T)^{1/q} ≤ Φ, smooth.  `reported`: √Φ in µm, the root mean square error at the
    worst point.  Raises InputError where A is zero.
    Source: Kiefer & Wolfowitz 1960; Atkinson, Donev & Tobias 2007, ch. 9 and 10.
    """

    A: Array
    order: float = np.inf
    name = "G"

    def __post_init__(self) -> None:
        require(
            self.A.ndim == 4 and bool(np.isfinite(self.A).all()),
            f"A of the G criterion has shape {self.A.shape}; give finite (scenarios, T, r, p)",
        )
        require(
            bool(self.A.any(axis=(1, 2, 3)).all()),
            "A of the G criterion is zero: no target depends on the parameters; check the test "
            "poses and loads",
        )

    @cached_property
    def variances(self) -> Variances:
        return Variances(self.A)

    def each(self, M: Array) -> Array:
        return power_mean(self.variances.of(M), self.order)

    def each_gradient(self, M: Array) -> tuple[Array, Array]:
        values, gains = self.variances.with_gains(M)
        weighted = gains * power_mean_slope(values, self.order)[:, None, :, None]
        return power_mean(values, self.order), np.einsum("sitq,sjtq->sij", weighted, gains)

    def each_after_adding(self, M: Array, blocks: Array) -> Array:
        return power_mean(self.variances.after_adding(M, blocks), self.order)

    def softened(self, order: float) -> GCriterion:
        return GCriterion(self.A, order)

    def reported(self, value: float) -> tuple[float, str]:
        return 1e6 * float(np.sqrt(value)), "µm"
