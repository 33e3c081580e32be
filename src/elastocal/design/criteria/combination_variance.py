"""c-optimality: the variance of one parameter or linear combination."""

from __future__ import annotations

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.trace import TraceCriterion


def combination_variance(combination: Array, scenarios: int, unit: str) -> TraceCriterion:
    """`c`: Φ = cᵀ V c, V = M⁻¹: the variance of c·X̂, in `unit`².

    `combination` c (p,), in `unit` per scaled parameter.  `reported`: its standard deviation √Φ.
    The optimal weights often make M singular in the limit, where Φ is inf here: the bound holds,
    and weights as close to the optimum as one likes remain regular.
    Source: Elfving 1952; Pukelsheim 2006, ch. 2; Atkinson, Donev & Tobias 2007, ch. 10.
    """
    C = np.broadcast_to(np.outer(combination, combination), (scenarios, *combination.shape * 2))
    return TraceCriterion(C, "c", scale=1.0, unit=unit)
