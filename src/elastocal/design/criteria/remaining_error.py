"""The test-pose criterion ρ₀² of industry-oriented calibration."""

from __future__ import annotations

import numpy as np

from elastocal.design.criteria.base import Array
from elastocal.design.criteria.trace import TraceCriterion


def remaining_error(A: Array, weights: Array) -> TraceCriterion:
    """`test_pose`: Φ = ρ₀² = E‖δp₀‖² = Σ_t w_t tr(A_t cov(X̂) A_tᵀ) = tr(C M⁻¹), in m².

    The mean square position error left at the user's test poses and loads once the arm is
    compensated by the identified parameters.  A (S, T, r, p) = ∂(position at test pose t)/∂X in m
    per scaled parameter, w = `weights` (T,) scaled to the sum 1, C_s = Σ_t w_t A_tᵀ A_t.
    `reported`: ρ₀ in µm.  It does not depend on the parametrisation; what no test pose shows is
    nuisance.
    Source: Klimchik, Wu, Pashkevich, Caro & Furet 2012, Applied Mechanics and Materials 162,
    161–170.
    """
    w = weights / weights.sum()
    C = np.einsum("t,stri,strj->sij", w, A, A, optimize=True)
    return TraceCriterion(C, "test_pose", scale=1e6, unit="µm")
