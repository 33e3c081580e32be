"""The worst case over the scenarios of the arm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from elastocal.design.criteria.base import Array, Criterion, Gradient
from elastocal.design.criteria.power_mean import power_mean, power_mean_slope
from elastocal.design.criteria.scenarios import ScenarioCriterion


@dataclass(frozen=True)
class Worst(Criterion):
    """Φ = max_s Φ_s(M_s): the least favourable scenario of the true arm (maximin design).

    1/Φ = min_s 1/Φ_s is concave.  A finite `order` q gives the power mean
    (Σ_s Φ_s^q / S)^{1/q} ≤ Φ, smooth and with concave 1/Φ as well.  Units as of `base`.
    Source: Pronzato & Walter 1988; Atkinson, Donev & Tobias 2007, ch. 17 and 18.
    """

    base: ScenarioCriterion
    order: float = np.inf

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.base.name)
        object.__setattr__(self, "certifiable", self.base.certifiable)

    def value(self, M: Array) -> Array:
        return power_mean(self.base.each(M), self.order)

    def gradient(self, M: Array) -> Gradient:
        values, G = self.base.each_gradient(M)
        slope = power_mean_slope(values, self.order)
        return Gradient(float(power_mean(values, self.order)), slope[:, None, None] * G)

    def after_adding(self, M: Array, blocks: Array) -> Array:
        return power_mean(self.base.each_after_adding(M, blocks), self.order)

    def softened(self, order: float) -> Worst:
        return Worst(self.base.softened(order), order)

    def reported(self, value: float) -> tuple[float, str]:
        return self.base.reported(value)
